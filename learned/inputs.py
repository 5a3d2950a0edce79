"""What the refiner looks at: a state, its energy, and all that tells whom to trust, each in a range of about one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.alternatives import Grid, camera_motion, kernels_may, second_pair
from learned.batch import Batch
from learned.bfloat16 import autocast_dtype, to_array
from learned.threads import over_tasks
from learned.view_kernels import GRADIENT_MOST, GRADIENT_SCALE, GROUPS, LOSS_MOST, LOSS_SCALE
from learned.view_kernels import observe as view_kernel

if TYPE_CHECKING:
    from learned.refiner import RefinerConfig

Input = Literal["state", "loss", "gradient", "deviation", "image", "evidence"]

_STATE_SCALE = 0.05  # pixels of motion
_SURROUNDINGS_PX = 16  # side of the box that the deviation is measured against


class View(NamedTuple):
    """What G looks at, beside the batch."""

    state: Tensor
    """(B, 5, H, W), pixels."""
    loss: Tensor | None = None
    """(B, H, W): the energy's map."""
    gradient: Tensor | None = None
    """(B, 5, H, W): of the energy."""
    camera_loss: Tensor | None = None
    """(B, H, W): the energy's map if everything followed the camera's motion."""
    prepared: Tensor | None = None
    """What G's own ``prepare`` has made of the images, once for all steps."""


class Seen(NamedTuple):
    """What G sees in it."""

    inputs: Tensor
    """(B, channels, h, w): scaled, channels innermost, in autocast's type."""
    picked: Tensor
    """(B, 5, h, w): the state at the picked pixels."""
    camera: Tensor
    """(B, 3, h, w): C, u and v if the point stands still; the state's own without a camera's motion."""
    residual: Tensor
    """(B, 1, h, w): what the second pair's disparity says of D1 + C, less that."""


def look(config: RefinerConfig, grid: Grid, view: View, batch: Batch) -> Seen:
    """The refiner's inputs in the order of ``config.layout``, and the alternatives that go with them.

    Without a graph to build, on a CPU, a kernel does most of it in one pass.
    """
    picked = grid.pick(view.state)
    device = picked.device.type
    dtype = autocast_dtype(device, picked.dtype)
    needed = {"loss": view.loss, "gradient": view.gradient, "camera loss": view.camera_loss}
    complete = batch.homography is not None and all(needed[name] is not None for name in needed if name in config.layout)
    if config.neighbours and complete and kernels_may(picked) and dtype in (torch.float32, torch.bfloat16):
        return _by_kernel(config, grid, view, batch, picked, dtype)
    coordinates, state = grid.coordinates(picked), view.state
    camera = picked[:, 2:] if batch.homography is None else camera_motion(picked, coordinates, batch.homography)
    residual, round_trip = second_pair(picked, coordinates, state[:, 1:2], _backward_flow(view, batch))
    alternatives = {"camera": camera - picked[:, 2:], "residual": residual, "round trip": round_trip}
    inputs = [_signed_log(alternatives[name]) if name in alternatives else _input(name, config, grid, view, batch, picked)
              for name in config.layout]  # fmt: skip
    # channels innermost: half of a convolution's time
    return Seen(torch.cat(inputs, 1).to(dtype, memory_format=torch.channels_last), picked, camera, residual)


def _by_kernel(config: RefinerConfig, grid: Grid, view: View, batch: Batch, picked: Tensor, dtype: torch.dtype) -> Seen:
    assert batch.homography is not None
    layout, (count, _, height, width) = config.layout, picked.shape
    ends = np.cumsum(list(layout.values()))
    places = {name: int(end) - layout[name] for name, end in zip(layout, ends, strict=True)}
    inputs = torch.empty((count, height, width, config.channels), dtype=dtype)
    camera, residual = torch.empty((count, 3, height, width)), torch.empty((count, 1, height, width))
    nothing = torch.empty(0)
    maps = [nothing.view((0,) * dims) if each is None else each.contiguous()
            for each, dims in ((view.state, 4), (view.loss, 3), (view.gradient, 4), (view.camera_loss, 3))]
    maps += [_boxes(picked, grid), _backward_flow(view, batch).float().contiguous(), batch.homography.float()]
    arrays = *(each.detach().numpy() for each in maps), np.array([places.get(name, -1) for name in GROUPS])
    out = to_array(inputs), camera.numpy(), residual[:, 0].numpy()
    over_tasks(view_kernel, count * height, *arrays, grid.divisor, *out)
    inputs = inputs.movedim(-1, 1)
    for name in places.keys() - set(GROUPS):
        inputs[:, places[name] : places[name] + layout[name]] = _input(name, config, grid, view, batch, picked)
    return Seen(inputs, picked, camera, residual)


def _input(name: str, config: RefinerConfig, grid: Grid, view: View, batch: Batch, picked: Tensor) -> Tensor:
    """An input (B, n, h, w), scaled."""
    match name:
        case "state":
            return _STATE_SCALE * picked
        case "deviation":
            # from boxes, interpolated: a sliding mean costs as much as the convolutions
            around = F.interpolate(_boxes(picked, grid), picked.shape[-2:], mode="bilinear", align_corners=False)
            return _signed_log(picked - around)
        case "loss" if view.loss is not None:
            return LOSS_SCALE * _mean(view.loss[:, None].clamp(max=LOSS_MOST), grid)
        case "gradient" if view.gradient is not None:
            return GRADIENT_SCALE * _mean(view.gradient.clamp(-GRADIENT_MOST, GRADIENT_MOST), grid)
        case "image":
            return grid.pick(batch.images[:, (0, 2)].flatten(1, 2)) - 0.5
        case "evidence" if batch.evidence is not None:
            return grid.pick(batch.evidence) - 0.5
        case "camera loss" if view.camera_loss is not None and view.loss is not None:
            return _signed_log(_mean((view.camera_loss - view.loss)[:, None], grid))
        case "within":
            return _signed_log(torch.cat([_within(view.state[:, channel : channel + 1], grid) for channel in (0, 3)], 1))
    raise ValueError(f"this refiner needs the input {name!r}")


def _backward_flow(view: View, batch: Batch) -> Tensor:
    return -view.state[:, 3:] if batch.backward_flow is None else batch.backward_flow


def _boxes(picked: Tensor, grid: Grid) -> Tensor:
    side = max(_SURROUNDINGS_PX // grid.divisor, 1)
    return F.avg_pool2d(picked, side, ceil_mode=True, count_include_pad=False)


def _mean(maps: Tensor, grid: Grid) -> Tensor:
    """Mean over each block."""
    divisor, padded = grid.divisor, grid.pad(maps)
    corners = [padded[..., i::divisor, j::divisor] for i in range(divisor) for j in range(divisor)]
    return sum(corners[1:], corners[0]) / divisor**2  # a quarter of a pooling's time


def _within(maps: Tensor, grid: Grid) -> Tensor:
    """How the other pixels of a block differ from the one that stands for it."""
    block = F.pixel_unshuffle(grid.pad(maps), grid.divisor)
    return block[:, :-1] - block[:, -1:]


def _signed_log(maps: Tensor) -> Tensor:
    """From a tenth of a pixel to a hundred in a range of about one: asinh(2 x) / 2, which torch has in slow loops only."""
    size = 2 * maps.abs()
    return 0.5 * torch.copysign((size + (size * size + 1).sqrt()).log(), maps)
