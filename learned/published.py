"""The authors' published checkpoints: one mapping of names for each network, and what differs in the tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from learned.ganet import GANet, GANetConfig
from learned.pwcnet import PWCNet


def pwcnet_names(net: PWCNet) -> dict[str, str]:
    """This network's tensors -> the names in the authors' checkpoints (whose ``deconv2`` is never used)."""
    config = net.config
    names: dict[str, str] = {}
    coarsest = len(config.pyramid)
    for level in range(1, coarsest + 1):
        suffixes = ("a", "aa", "b") if level < 6 else ("aa", "a", "b")
        names |= {f"pyramid.{level - 1}.{i}.0": f"conv{level}{suffix}.0" for i, suffix in enumerate(suffixes)}
        own = f"decoders.{coarsest - level}"
        if level >= config.finest:
            names |= {f"{own}.convolutions.{i}.0": f"conv{level}_{i}.0" for i in range(len(config.decoder))}
            names[f"{own}.predict"] = f"predict_flow{level}"
        if level > config.finest:
            names |= {f"{own}.upsample_motion": f"deconv{level}", f"{own}.upsample_features": f"upfeat{level}"}
    last = len(config.context)
    names |= {f"context.{i}.0": f"dc_conv{i + 1}.0" for i in range(last)} | {f"context.{last}": f"dc_conv{last + 1}"}
    return {f"{own}.{kind}": f"{theirs}.{kind}" for own, theirs in names.items() for kind in ("weight", "bias")}


def pwcnet_tensor(published: Tensor, shape: torch.Size) -> Tensor:
    """A tensor of the authors' two-channel network with zeros for the third channel; the first two stay as they are.

    An axis of two is the motion's: the new channel comes last. In a longer one, a decoder's dense input, it comes after
    the upsampled motion and before the two upsampled features.
    """
    for axis, size in enumerate(shape[: published.ndim]):
        have = published.shape[axis]
        if size == have + 1:
            at = have if have == 2 else have - 2
            new = torch.zeros_like(published.narrow(axis, 0, 1))
            published = torch.cat([published.narrow(axis, 0, at), new, published.narrow(axis, at, have - at)], axis)
    return published


def ganet_names(net: GANet) -> dict[str, str]:
    """This network's tensors -> the names in the authors' checkpoints (whose ``cost_agg.deconv0b`` is never used)."""
    modules = _ganet_modules(net.config)
    names = {}
    for own in net.state_dict():
        module = own
        rest: list[str] = []
        while module not in modules:
            module, _, last = module.rpartition(".")
            rest.insert(0, last)
        # inside: a convolution with its normalisation, two of them in a join, or a bare layer
        parts = [{"resize": "conv1", "fuse": "conv2", "0": "conv", "1": "bn"}.get(part, part) for part in rest]
        names[own] = ".".join([modules[module], *parts])
    return names


def ganet_tensor(name: str, tensor: Tensor) -> Tensor:
    """The authors' order of the guidance channels is direction, channel, term; here it is direction, term, channel."""
    if "weight_sg" not in name:
        return tensor
    return tensor.unflatten(0, (4, -1, 5)).transpose(1, 2).flatten(0, 2)


def _ganet_modules(config: GANetConfig) -> dict[str, str]:
    names = {"to_left": "conv_x", "to_right": "conv_y", "guidance.feature": "conv_refine",
             "guidance.feature_norm": "bn_relu.0", "guidance.join": "guidance.conv0",
             "aggregation.start": "cost_agg.conv_start"}
    names |= {f"features.stem.{i}": f"feature.conv_start.{i}" for i in range(len(config.stem))}
    names |= {f"guidance.image.{i}": f"conv_start.{i}" for i in range(2)}
    for side, theirs, passes, depth in (("features", "feature", config.unets, len(config.features)),
                                        ("aggregation", "cost_agg", config.hourglasses, len(config.volume) - 1)):
        for i in range(passes):
            for level in range(depth):
                names[f"{side}.down.{i}.{level}"] = f"{theirs}.conv{level + 1}{'ab'[i]}"
                names[f"{side}.up.{i}.{depth - 1 - level}"] = f"{theirs}.deconv{level + 1}{'ab'[i]}"
    for level, count in config.blocks.items():
        for i in range(count):
            number = f"{level or ''}{i + 1}"
            step, conv = f"guidance.steps.{level}.{i}", f"guidance.conv{number}"
            names |= {f"{step}.{j}": f"{conv}.{j}" for j in range(2)} if i == 0 else {step: conv}
            names[f"guidance.weights.{level}.{i}"] = f"guidance.weight_sg{number}"
            names[f"aggregation.blocks.{level}.{i}.norm"] = f"cost_agg.sga{number}.bn_relu.0"
            names[f"aggregation.blocks.{level}.{i}.refine"] = f"cost_agg.sga{number}.conv_refine"
    # the second layer of a head's guidance is a bare convolution
    names |= {f"guidance.head.{i}.{j}": f"guidance.weight_lg{i + 1}.{j}" for i in range(2) for j in range(2)}
    names |= {f"aggregation.heads.{i}": f"cost_agg.disp{i}.conv32x1" for i in range(config.hourglasses + 1)}
    return names
