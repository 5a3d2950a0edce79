"""GA-Net's two guided aggregation layers, as functions: semi-global (SGA) and local (LGA).

Zhang, Prisacariu, Yang, Torr: GA-Net, CVPR 2019 (arXiv:1904.06587), sections 3.1 and 3.2. The plain torch versions run
on any device and in any dtype; on the CPU, in float32 and bfloat16, ``learned.semi_global_kernels`` and
``learned.local_kernels`` take over.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.bfloat16 import to_array
from learned.local_kernels import local_backward, local_forward, local_tasks, local_weights
from learned.semi_global_kernels import semi_global_backward, semi_global_forward
from learned.threads import over_tasks

DIRECTIONS = ("down", "up", "right", "left")
TERMS = 5


def semi_global_aggregation(cost: Tensor, guidance: Tensor, scale_and_shift: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Aggregate costs along four directions with a weight set for every pixel, channel and direction.

    Along direction r: ``A(p, d) = w0 C(p, d) + w1 A(p-r, d) + w2 A(p-r, d-1) + w3 A(p-r, d+1) + w4 max_i A(p-r, i)``.
    The five weights are divided by their L1 norm; a neighbour that does not exist is replaced by C(p, d); the result is
    the largest of the four A.

    Parameters
    ----------
    cost : Tensor (B, C, D, H, W)
    guidance : Tensor (B, 4 * 5 * C, H, W)
        Raw weights, direction outermost (down, up, right, left), then the five terms, then channels.
    scale_and_shift : two Tensor (C,), optional
        The result of every channel is then scaled, shifted and rectified: batch normalisation in evaluation.

    Returns
    -------
    Tensor (B, C, D, H, W)
        In cost's dtype.
    """
    batch, channels, _, height, width = cost.shape
    if guidance.shape != (batch, len(DIRECTIONS) * TERMS * channels, height, width):
        raise ValueError(f"guidance of shape {tuple(guidance.shape)} does not fit costs of shape {tuple(cost.shape)}")
    if cost.device.type == "cpu" and {cost.dtype, guidance.dtype} <= {torch.float32, torch.bfloat16}:
        if scale_and_shift is not None and not torch.is_grad_enabled():
            return _swept(cost, guidance, torch.stack(scale_and_shift).float(), False)[0]
        aggregated: Tensor = _SemiGlobal.apply(cost, guidance)  # the recursion is in float32
    else:
        aggregated = semi_global_aggregation_reference(cost, guidance)
    if scale_and_shift is None:
        return aggregated
    scale, shift = (each.view(-1, 1, 1, 1) for each in scale_and_shift)
    return F.relu(aggregated * scale + shift).to(cost.dtype)


def semi_global_aggregation_reference(cost: Tensor, guidance: Tensor) -> Tensor:
    """The same in plain torch."""
    batch, channels, _, height, width = cost.shape
    weights = guidance.reshape(batch, len(DIRECTIONS), TERMS, channels, 1, height, width)
    weights = F.normalize(weights, p=1, dim=2).transpose(2, 3)
    vertical = [_sweep(cost, weights[:, 0], -2, False), _sweep(cost, weights[:, 1], -2, True)]
    horizontal = [_sweep(cost, weights[:, 2], -1, False), _sweep(cost, weights[:, 3], -1, True)]
    return torch.stack(vertical + horizontal).max(0).values


def _sweep(cost: Tensor, weights: Tensor, axis: int, backwards: bool) -> Tensor:
    """One direction: ``axis`` is the one that is walked along, from its end if ``backwards``."""
    lines = list(zip(cost.unbind(axis), weights.unbind(axis), strict=True))
    aggregated: list[Tensor] = []
    for c, w in reversed(lines) if backwards else lines:
        if not aggregated:
            aggregated.append(c * w.sum(2))
            continue
        previous = aggregated[-1]
        below = torch.cat([c[:, :, :1], previous[:, :, :-1]], 2)
        above = torch.cat([previous[:, :, 1:], c[:, :, -1:]], 2)
        best = previous.max(2, keepdim=True).values
        terms = (c, previous, below, above, best)
        aggregated.append(sum((w[:, :, k] * term for k, term in enumerate(terms)), torch.zeros_like(c)))
    return torch.stack(aggregated[::-1] if backwards else aggregated, axis)


def _swept(cost: Tensor, guidance: Tensor, scale_and_shift: Tensor, wanted: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The result, and what the backward pass needs if it is wanted: costs, weights and which of the directions won."""
    planes, weights = _planes(cost, wanted), _weights(guidance, wanted)
    out = _large(planes.shape, planes.dtype)
    chosen = torch.empty(planes.shape if wanted else (0, 0, 0), dtype=torch.uint8)
    semi_global_forward(*(to_array(each.detach()) for each in (planes, weights, out, chosen, scale_and_shift)))
    return _volume(out, cost), planes, weights, chosen


class _SemiGlobal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, cost: Tensor, guidance: Tensor) -> Tensor:
        wanted = any(ctx.needs_input_grad)
        out, *kept = _swept(cost, guidance, torch.empty((2, 0)), wanted)
        ctx.save_for_backward(*kept)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        planes, weights, chosen = ctx.saved_tensors
        to_planes, to_weights = _large(planes.shape).zero_(), _large(weights.shape)
        arrays = planes, weights, chosen, _planes(gradient, True), to_planes, to_weights
        semi_global_backward(*(to_array(each) for each in arrays))
        return _volume(to_planes, gradient), to_weights.flatten(3).movedim(-1, 1)


def _large(shape: Sequence[int], dtype: torch.dtype = torch.float32) -> Tensor:
    """An uninitialised tensor in numpy's memory, which asks for huge pages: a step of a sweep touches as many pages as
    there are disparities."""
    return torch.from_numpy(np.empty((*shape, dtype.itemsize), np.uint8)).view(dtype)[..., 0]


def _planes(volume: Tensor, precise: bool) -> Tensor:
    """(B, C, D, H, W) as (B, D, H * W * C), the layout of the kernels: a view if the channels are innermost."""
    volume = volume.detach().float() if precise else volume.detach()
    return volume.contiguous(memory_format=torch.channels_last_3d).permute(0, 2, 3, 4, 1).flatten(2)


def _volume(planes: Tensor, like: Tensor) -> Tensor:
    """The (B, C, D, H, W) view of such planes, of like's type."""
    batch, channels, depth, height, width = like.shape
    return planes.view(batch, depth, height, width, channels).permute(0, 4, 1, 2, 3).to(like.dtype)


def _weights(guidance: Tensor, precise: bool) -> Tensor:
    """(B, 4 * 5 * C, H, W) as (B, H, W, 4, 5, C): a view if the channels are innermost."""
    guidance = guidance.detach().float() if precise else guidance.detach()
    return guidance.movedim(1, -1).contiguous().unflatten(3, (len(DIRECTIONS), TERMS, -1))


def local_aggregation(cost: Tensor, guidance: Tensor, times: int = 2) -> Tensor:
    """Filter a cost volume with 3 x 5 x 5 weights of each pixel's own, L1-normalised, the same at every disparity.

    Parameters
    ----------
    cost : Tensor (B, D, H, W)
    guidance : Tensor (B, 75, H, W)
        Raw weights: disparity offset (-1, 0, 1) outermost, then rows, then columns (-2 ... 2). A tap that falls outside
        the volume takes the centre's value.
    times : int
        How often the filter is applied.

    Returns
    -------
    Tensor (B, D, H, W)
        In cost's dtype.
    """
    batch, _, height, width = cost.shape
    if guidance.shape != (batch, 75, height, width):
        raise ValueError(f"guidance of shape {tuple(guidance.shape)} does not fit costs of shape {tuple(cost.shape)}")
    dtype = cost.dtype
    if cost.device.type == "cpu" and dtype in (torch.float32, torch.bfloat16):
        if not torch.is_grad_enabled():
            kernel, cost = _kernel_of(guidance), cost.float()
            for _ in range(times):
                cost = _filtered(cost, kernel)
            return cost.to(dtype)
        weights = F.normalize(guidance.float().contiguous(), p=1, dim=1)
        for _ in range(times):
            cost = _Local.apply(cost.float(), weights)
        return cost.to(dtype)
    return local_aggregation_reference(cost, guidance, times)


def local_aggregation_reference(cost: Tensor, guidance: Tensor, times: int = 2) -> Tensor:
    """The same in plain torch."""
    weights = F.normalize(guidance, p=1, dim=1)
    depth, height, width = cost.shape[1:]
    inside = F.pad(torch.ones_like(cost[:1]), (2, 2, 2, 2, 1, 1))
    for _ in range(times):
        padded = F.pad(cost, (2, 2, 2, 2, 1, 1))
        total = torch.zeros_like(cost)
        for tap in range(75):
            d, y, x = tap // 25, tap // 5 % 5, tap % 5
            window = (slice(None), slice(d, d + depth), slice(y, y + height), slice(x, x + width))
            total = total + weights[:, tap, None] * torch.where(inside[window] > 0, padded[window], cost)
        cost = total
    return cost


def _kernel_of(guidance: Tensor) -> Tensor:
    """Weights (B, 75, H, W), raw or normalised, as ``local_forward`` wants them: (B, H, W, 75)."""
    innermost = guidance.detach().movedim(1, -1).contiguous()
    kernel = torch.empty(innermost.shape)
    over_tasks(local_weights, innermost.shape[0] * innermost.shape[1], to_array(innermost), kernel.numpy())
    return kernel


def _filtered(cost: Tensor, kernel: Tensor) -> Tensor:
    """(B, D, H, W) filtered once; disparities come out innermost."""
    innermost = cost.movedim(1, -1).contiguous()
    out = torch.empty_like(innermost)
    over_tasks(local_forward, local_tasks(*innermost.shape[:3]), innermost.numpy(), kernel.numpy(), out.numpy())
    return out.movedim(-1, 1)


class _Local(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, cost: Tensor, weights: Tensor) -> Tensor:
        cost, weights = cost.detach().contiguous(), weights.detach().contiguous()
        ctx.save_for_backward(cost, weights)
        return _filtered(cost, _kernel_of(weights))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        cost, weights = ctx.saved_tensors
        gradient = gradient.contiguous()
        to_cost, to_weights = torch.zeros_like(cost), torch.zeros_like(weights)
        rows, arrays = cost.shape[0] * cost.shape[2], (cost, weights, gradient, to_cost, to_weights)
        over_tasks(local_backward, rows, *(each.numpy() for each in arrays))
        return to_cost, to_weights
