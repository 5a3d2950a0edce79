"""The method ``feedforward``: GA-Net's disparities and PWC-Net's motion, nothing refined."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from cgsf.errors import InputError
from cgsf.scene_flow import SceneFlow
from cgsf.threads import keep_freed_memory
from variational.camera import StereoCamera
from variational.frames import Frames
from variational.terms.visibility import visible_mask

if TYPE_CHECKING:
    from torch import Tensor, nn

    from learned.feedforward import FeedforwardModule

#: Weights that ship with the package are named by a bare word.
WEIGHTS = Path(__file__).parents[1] / "learned" / "weights"


@dataclass(frozen=True)
class FeedforwardConfig:
    """Which networks, where, how precisely.

    Parameters
    ----------
    disparity, motion : str
        The name of weights that ship (``learned/weights/NAME.safetensors``), or the path of a ``.safetensors`` file as
        training and ``cgsf import-weights`` write them.
    device : str
        Any device that torch knows: cpu, cuda, mps ...; the tested one is the CPU.
    precision : {"auto", "float32", "bfloat16"}
        Of the convolutions. auto is bfloat16, at a third to a half of the time, on a CPU with instructions for it.
    """

    disparity: str = "disparity"
    motion: str = "flow"
    device: str = "cpu"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"


def run_networks(
    frames: Frames, config: FeedforwardConfig, camera: StereoCamera | None = None, progress: object = None
) -> SceneFlow:
    """Scene flow by the two networks; visible is what forward and backward flow agree on."""
    import torch

    from learned.feedforward import select_device

    try:
        device = select_device(config.device)
    except ValueError as error:
        raise InputError(str(error)) from None
    written = tuple(weights_path(name).stat().st_mtime_ns for name in (config.disparity, config.motion))
    module = _load_module(config, written)
    with torch.inference_mode():
        state, backward = module(*(to_tensor(image).to(device) for image in (
            frames.left1, frames.right1, frames.left2, frames.right2)))
    maps = state[0].float().cpu().numpy()
    backward_flow = backward[0].float().permute(1, 2, 0).contiguous().cpu().numpy()
    visible = visible_mask(np.ascontiguousarray(maps[3:].transpose(1, 2, 0)), backward_flow)
    return SceneFlow.from_state(maps, visible, backward_flow=backward_flow)


@lru_cache(maxsize=1)
def _load_module(config: FeedforwardConfig, written: tuple[int, ...]) -> FeedforwardModule:
    """Both networks, ready to run; kept for the next frame as long as the files are those `written` at these times."""
    from learned.feedforward import FeedforwardModule, fold_normalisation

    keep_freed_memory()
    disparity, motion = (fold_normalisation(load_network(name)) for name in (config.disparity, config.motion))
    return FeedforwardModule(disparity, motion, config.precision).eval().to(config.device)


def weights_path(name: str) -> Path:
    """Where the weights called `name` lie; `InputError` if there are none."""
    path = Path(name) if name.endswith(".safetensors") else WEIGHTS / f"{name}.safetensors"
    if not path.exists():
        raise InputError(f"no weights {path}; train some, or import published ones with: cgsf import-weights")
    return path


def load_network(name: str) -> nn.Module:
    """A network in evaluation mode, from weights that ship or a file; `InputError` if there are none."""
    from learned.checkpoint import CheckpointError, load

    try:
        return load(weights_path(name))[0]
    except CheckpointError as error:
        raise InputError(str(error)) from None


def to_colour(image: np.ndarray) -> np.ndarray:
    """(H, W, 1 or 3) -> (H, W, 3); grey is repeated."""
    return np.broadcast_to(image, (*image.shape[:2], 3))


def to_tensor(image: np.ndarray) -> Tensor:
    """(H, W, 1 or 3) -> (1, 3, H, W); grey is repeated."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(to_colour(image).transpose(2, 0, 1)))[None]
