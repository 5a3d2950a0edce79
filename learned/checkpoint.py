"""Weights on disk: safetensors with a model card inside, and the import of the authors' published checkpoints.

A file holds the tensors and, in its header, the architecture's name, its configuration and where the weights come
from: it is all that :func:`load` needs, and reading it runs no code. Published ``.pth`` files are read by torch's
weights-only unpickler, which refuses anything but tensors and plain values.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from learned.ganet import GANet, GANetConfig
from learned.published import ganet_names, ganet_tensor, pwcnet_names, pwcnet_tensor
from learned.pwcnet import PWCNet, PWCNetConfig
from learned.refiner import Refiner, RefinerConfig
from learned.selector import Selector, SelectorConfig

_ARCHITECTURES: dict[str, tuple[type[nn.Module], type]] = {"ganet": (GANet, GANetConfig),
                                                           "pwcnet": (PWCNet, PWCNetConfig),
                                                           "refiner": (Refiner, RefinerConfig),
                                                           "selector": (Selector, SelectorConfig)}
# Layers that the published classes declare and never run.
_UNUSED = {"ganet": "cost_agg.deconv0b.", "pwcnet": "deconv2."}


class CheckpointError(ValueError):
    """A weights file that cannot be used; the message says what is wrong with it."""


@dataclass(frozen=True)
class ModelCard:
    """Where weights come from and what may be done with them."""

    source: str
    """Who trained them, on what, or the published file they were imported from."""
    licence: str = "unknown: see the source"
    """Licence of the weights (not of this software)."""


def save(net: nn.Module, path: str | Path, card: ModelCard) -> None:
    """Write a network with its configuration and model card, the card also as ``PATH.md`` for people."""
    name = next(name for name, (kind, _) in _ARCHITECTURES.items() if isinstance(net, kind))
    config = asdict(net.config)  # type: ignore[call-overload]
    header = {"architecture": name, "config": json.dumps(config), **asdict(card)}
    tensors = {key: tensor.detach().contiguous() for key, tensor in net.state_dict().items()}
    save_file(tensors, path, metadata=header)
    rows = [f"| {key} | {json.dumps(value)} |" for key, value in config.items()]
    text = [f"# {name} weights: {Path(path).name}", "", f"* Source: {card.source}", f"* Licence: {card.licence}",
            f"* Parameters: {sum(p.numel() for p in net.parameters()):,}",
            "", "| configuration | |", "|---|---|", *rows]
    Path(f"{path}.md").write_text("\n".join(text) + "\n")


def load(path: str | Path) -> tuple[nn.Module, ModelCard]:
    """The network of a file written by :func:`save`, in evaluation mode on the CPU, and its card."""
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  # not a mapping
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: not a readable safetensors file ({error})") from None
    try:
        kind, config = _ARCHITECTURES[header["architecture"]]
        net = kind(config(**_tuples(json.loads(header["config"]))))
        card = ModelCard(header["source"], header["licence"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: no weights of this program, or of another version ({error!r})") from None
    _fill(net, tensors, str(path))
    return net.eval(), card


def import_published(architecture: str, path: str | Path, max_disparity: int = 192) -> nn.Module:
    """A network with the weights of an authors' checkpoint, in evaluation mode.

    Parameters
    ----------
    architecture : "ganet" (the deep model) or "pwcnet" (the dense model)
        Two-channel optical flow becomes the first two of PWC-Net's three outputs, the third is zero.
    path : file
        ``.pth`` or ``.pth.tar``; a ``state_dict`` entry and ``module.`` prefixes are taken off.
    max_disparity : int
        Of GA-Net, in pixels; no weight depends on it.

    Raises
    ------
    CheckpointError
        If the file is no checkpoint, holds more than tensors and plain values, or names and shapes do not match
        exactly: the message lists them.
    """
    theirs = {name: tensor for name, tensor in _read(path).items() if not name.startswith(_UNUSED[architecture])}
    net: nn.Module
    if architecture == "ganet":
        net = gan = GANet(GANetConfig(max_disparity=max_disparity))
        names = ganet_names(gan)
    else:
        net = pwc = PWCNet()
        names = pwcnet_names(pwc)
    shapes = {own: tensor.shape for own, tensor in net.state_dict().items()}
    back = {name: own for own, name in names.items()}
    ours = {}
    for name, tensor in theirs.items():
        own = back.get(name, name)
        if architecture == "ganet":
            ours[own] = ganet_tensor(name, tensor)
        else:
            ours[own] = pwcnet_tensor(tensor, shapes.get(own, tensor.shape))
    _fill(net, ours, str(path))
    return net.eval()


def _read(path: str | Path) -> dict[str, Tensor]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise CheckpointError(f"{path}: holds more than tensors, or is damaged; such a file is not opened") from None
    except (OSError, RuntimeError, EOFError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from None
    if isinstance(content, Mapping) and "state_dict" in content:
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(tensor, Tensor) for tensor in content.values()):
        raise CheckpointError(f"{path}: no state dict of tensors inside")
    return {str(name).removeprefix("module."): tensor for name, tensor in content.items()}


def _fill(net: nn.Module, tensors: dict[str, Tensor], path: str) -> None:
    """Copy tensors into a network; the names and shapes of both must be the same, but for batch counters."""
    wanted = {key: tensor for key, tensor in net.state_dict().items() if not key.endswith("num_batches_tracked")}
    given = {key: tensor for key, tensor in tensors.items() if not key.endswith("num_batches_tracked")}
    wrong = [f"missing: {key}" for key in wanted if key not in given]
    wrong += [f"not wanted: {key}" for key in given if key not in wanted]
    wrong += [f"{key} is {tuple(given[key].shape)}, not {tuple(tensor.shape)}"
              for key, tensor in wanted.items() if key in given and given[key].shape != tensor.shape]
    if wrong:
        raise CheckpointError(f"{path}: weights of another network: " + "; ".join(wrong))
    counters = {key: tensor for key, tensor in net.state_dict().items() if key.endswith("num_batches_tracked")}
    net.load_state_dict(given | counters)


def _tuples(value: Any) -> Any:
    """JSON's lists back to tuples."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
