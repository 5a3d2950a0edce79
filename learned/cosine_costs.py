"""Cost volume of the compact motion network: cosines of features with those that a motion leads to, and around them.

Without a graph to build, on a CPU, kernels do it in two passes: one looks up and normalises, the other correlates and
writes channels innermost. Anywhere else it is put together of `warp` and `correlation`.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.bfloat16 import narrow, to_array, widen
from learned.correlation import correlation, multiply_add, multiply_add_four
from learned.jit import lanes, tasks
from learned.threads import over_tasks
from learned.warp import FULL_SUPPORT, warp

_SLOPE = 0.1  # of the leaky rectifier, as everywhere in the network
_LEAST = 1e-24  # square length that is taken for zero


def cosine_costs(first: Tensor, second: Tensor, flow: Tensor | None, radius: int) -> Tensor:
    """Leaky-rectified cosine of the first features with the second's at every displacement around a motion.

    Parameters
    ----------
    first, second : Tensor (B, C, H, W)
    flow : Tensor (B, 2, H, W) or None
        Motion (u, v) in pixels of this grid that the search is centred on; None: no motion. Where it leads outside, the
        second's features are zero.
    radius : int
        Largest displacement in x and in y, pixels of this grid.

    Returns
    -------
    Tensor (B, (2 radius + 1)^2, H, W)
        In first's dtype, channels innermost; dy outermost, dx innermost.
    """
    on_cpu, dtype = first.device.type == "cpu", first.dtype
    if on_cpu and not torch.is_grad_enabled() and dtype == second.dtype and dtype in (torch.float32, torch.bfloat16):
        return _by_kernels(first, second, flow, radius)
    second = second if flow is None else warp(second, flow)
    volume = correlation(normalised(first), normalised(second), radius)
    return F.leaky_relu(volume.to(dtype, memory_format=torch.channels_last), _SLOPE)


def normalised(features: Tensor) -> Tensor:
    """Features (B, C, H, W) of mean square one at every pixel, in float32 or better, channels outermost.

    The mean product of two, which correlation takes, is then their cosine.
    """
    features = features.to(torch.promote_types(features.dtype, torch.float32)).contiguous()
    # bounded before the root: its slope is infinite at zero, where warping looked outside
    return features * (features.shape[1] / features.square().sum(1, keepdim=True).clamp(min=_LEAST)).sqrt()


def _by_kernels(first: Tensor, second: Tensor, flow: Tensor | None, radius: int) -> Tensor:
    batch, channels, height, width = first.shape
    there = torch.empty((0, 2, 0, 0)) if flow is None else flow.float().contiguous()
    own, padded = torch.empty(first.shape), torch.zeros((batch, channels, height + 2 * radius, width + 2 * radius))
    nowhere = torch.empty((0, 2, 0, 0)).numpy()
    for features, motion, border, out in ((first, nowhere, 0, own), (second, there.numpy(), radius, padded)):
        innermost = to_array(features.detach().movedim(1, -1).contiguous())
        over_tasks(_look_up, batch * height, innermost, motion, border, out.numpy())
    costs = torch.empty((batch, height, width, (2 * radius + 1) ** 2), dtype=first.dtype)
    over_tasks(_correlate, batch * height, own.numpy(), padded.numpy(), to_array(costs))
    return costs.movedim(-1, 1)


@tasks
def _look_up(begin: int, end: int, features: np.ndarray, flow: np.ndarray, border: int, out: np.ndarray) -> None:
    """Features (B, H, W, C), float32 or uint16, where the flow (B, 2, H, W) leads to (an empty one: where they are),
    normalised, to (B, C, H + 2 border, W + 2 border) float32. Tasks: rows of all B."""
    _, height, width, channels = features.shape
    row = np.empty((width, channels), np.float32)
    for job in range(begin, end):
        b, y = job // height, job % height
        for x in range(width):
            total = row[x]
            total[:] = 0
            if flow.size == 0:
                _add(features[b, y, x], np.float32(1), total)
            else:
                to_x, to_y = np.float32(x) + flow[b, 0, y, x], np.float32(y) + flow[b, 1, y, x]
                inside_x, inside_y = _clamped(to_x, width), _clamped(to_y, height)
                outside_x, outside_y = abs(to_x - inside_x), abs(to_y - inside_y)
                if max(outside_x, outside_y) < 1 and (1 - outside_x) * (1 - outside_y) >= FULL_SUPPORT:
                    x0, y0 = int(inside_x), int(inside_y)
                    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
                    fx, fy = inside_x - np.float32(x0), inside_y - np.float32(y0)
                    _add(features[b, y0, x0], (np.float32(1) - fx) * (np.float32(1) - fy), total)
                    _add(features[b, y0, x1], fx * (np.float32(1) - fy), total)
                    _add(features[b, y1, x0], (np.float32(1) - fx) * fy, total)
                    _add(features[b, y1, x1], fx * fy, total)
            square = np.float32(0)
            for c in range(channels):
                square += total[c] * total[c]
            scale = np.sqrt(np.float32(channels) / max(square, np.float32(_LEAST)))
            for c in range(channels):
                total[c] *= scale
        for c in range(channels):
            for x in range(width):
                out[b, c, y + border, x + border] = row[x, c]


@tasks
def _correlate(begin: int, end: int, first: np.ndarray, padded: np.ndarray, out: np.ndarray) -> None:
    """Mean products of first (B, C, H, W) with padded at all displacements, rectified, to (B, H, W, displacements)."""
    _, channels, height, width = first.shape
    size = padded.shape[2] - height + 1
    scale, slope = np.float32(1.0 / channels), np.float32(_SLOPE)
    totals = np.empty((size * size, width), np.float32)
    for job in range(begin, end):
        b, y = job // height, job % height
        totals[:] = 0
        for dy in range(size):
            for c in range(0, channels - 3, 4):  # four rows of each, and the totals of one dy, stay in the nearest cache
                for dx in range(size):
                    multiply_add_four(first, padded, b, c, y, dy, dx, totals[dy * size + dx])
            for c in range(channels // 4 * 4, channels):
                for dx in range(size):
                    multiply_add(first[b, c, y], padded[b, c, y + dy, dx:], totals[dy * size + dx])
        for x in range(width):
            for k in range(size * size):
                value = scale * totals[k, x]
                out[b, y, x, k] = narrow(value if value > 0 else slope * value, out)


@lanes
def _add(features: np.ndarray, weight: float, total: np.ndarray) -> None:
    for c in range(total.size):
        total[c] += weight * widen(features[c])


@lanes
def _clamped(position: np.float32, size: int) -> np.float32:
    """The nearest position on an axis of `size` pixels; 0 for NaN."""
    position = position if position > 0 else np.float32(0)
    return position if position < np.float32(size - 1) else np.float32(size - 1)
