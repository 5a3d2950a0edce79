"""Correlation of two feature maps: the cost volumes of motion (in two dimensions) and of disparity (in one).

``correlation(a, b, r)[k](x, y) = mean_c a_c(x, y) b_c(x + dx, y + dy)`` with ``k = (dy + r) (2r + 1) + dx + r``;
``disparity_correlation(a, b, D, G)[g, d](x, y) = sum_{c in g} a_c(x, y) b_c(x - d, y)`` of unit vectors. Features
outside the image count as zero. On the CPU numba kernels run forward and backward; anywhere else the torch versions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.jit import lanes, tasks
from learned.threads import over_tasks


def correlation(first: Tensor, second: Tensor, radius: int = 4) -> Tensor:
    """Mean product of the first features with the second's at every displacement up to ``radius`` pixels.

    Parameters
    ----------
    first, second : Tensor (B, C, H, W)
    radius : int
        Largest displacement in x and in y, pixels of this grid.

    Returns
    -------
    Tensor (B, (2 radius + 1)^2, H, W)
        In first's dtype, dy outermost, dx innermost.
    """
    if first.shape != second.shape:
        raise ValueError(f"correlation needs two maps of one shape, not {tuple(first.shape)} and {tuple(second.shape)}")
    if first.device.type == "cpu" and first.dtype in (torch.float32, torch.bfloat16):
        volume: Tensor = _Correlation.apply(first.float(), second.float(), radius)  # sums are kept in float32
        return volume.to(first.dtype)
    return correlation_reference(first, second, radius)


def correlation_reference(first: Tensor, second: Tensor, radius: int = 4) -> Tensor:
    """The same in plain torch, for any device and dtype."""
    height, width = first.shape[-2:]
    padded = F.pad(second, (radius,) * 4)
    size = 2 * radius + 1
    return torch.stack([(first * padded[..., dy : dy + height, dx : dx + width]).mean(1)
                        for dy in range(size) for dx in range(size)], dim=1)


def disparity_correlation(left: Tensor, right: Tensor, disparities: int, groups: int) -> Tensor:
    """Cosine of left and right features in groups of channels, at disparities 0 ... ``disparities`` - 1.

    Parameters
    ----------
    left, right : Tensor (B, C, H, W)
        C a multiple of ``groups``.

    Returns
    -------
    Tensor (B, groups, disparities, H, W)
        In left's dtype, zero where x < disparity.

    References
    ----------
    Guo et al., Group-wise Correlation Stereo Network, CVPR 2019 (there without normalisation).
    """
    if left.shape != right.shape or left.shape[1] % groups:
        shapes = f"{tuple(left.shape)} with {tuple(right.shape)}"
        raise ValueError(f"cannot correlate {shapes} in {groups} groups of channels")
    unit_left, unit_right = (F.normalize(_at_least_float32(side).unflatten(1, (groups, -1)), dim=2)
                             for side in (left, right))
    if left.device.type == "cpu" and left.dtype in (torch.float32, torch.bfloat16):
        volume: Tensor = _DisparityCorrelation.apply(unit_left, unit_right, disparities)
        return volume.to(left.dtype)
    return disparity_correlation_reference(unit_left, unit_right, disparities).to(left.dtype)


def disparity_correlation_reference(left: Tensor, right: Tensor, disparities: int) -> Tensor:
    """The same for unit features (B, groups, C / groups, H, W), in plain torch."""
    width = left.shape[-1]
    padded = F.pad(right, (disparities - 1, 0))
    return torch.stack([(left * padded[..., disparities - 1 - d :][..., :width]).sum(2) for d in range(disparities)], 2)


class _Correlation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, radius: int) -> Tensor:
        ctx.save_for_backward(first, second)
        ctx.radius = radius
        size = 2 * radius + 1
        out = torch.empty((first.shape[0], size * size, *first.shape[2:]))
        over_tasks(_forward, _rows(out), _array(first), _padded(second, radius), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        first, second = ctx.saved_tensors
        radius = ctx.radius
        to_first = to_second = None
        if ctx.needs_input_grad[0]:
            to_first = torch.zeros(first.shape)
            over_tasks(_backward, _rows(first), _array(gradient), _padded(second, radius), to_first.numpy())
        if ctx.needs_input_grad[1]:
            # b is to a at the displacement -d: the same kernel with the volume mirrored, seen from b's pixels
            to_second = torch.zeros(second.shape)
            mirrored = np.empty(gradient.shape, np.float32)
            over_tasks(_mirror, gradient.shape[0] * gradient.shape[1], _array(gradient), radius, mirrored)
            over_tasks(_backward, _rows(first), mirrored, _padded(first, radius), to_second.numpy())
        return to_first, to_second, None


def _at_least_float32(tensor: Tensor) -> Tensor:
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def _rows(maps: Tensor) -> int:
    """Of all samples (B, C, H, W) together."""
    return maps.shape[0] * maps.shape[2]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _padded(tensor: Tensor, radius: int) -> np.ndarray:
    return F.pad(tensor.detach(), (radius,) * 4).contiguous().numpy()


@tasks
def _forward(begin: int, end: int, first: np.ndarray, padded: np.ndarray, out: np.ndarray) -> None:
    _, channels, height, width = first.shape
    size = padded.shape[2] - height + 1
    scale = np.float32(1.0 / channels)
    for job in range(begin, end):
        b, y = job // height, job % height
        for dy in range(size):
            for dx in range(size):
                total = out[b, dy * size + dx, y]
                total[:] = 0
                for c in range(0, channels - 3, 4):
                    multiply_add_four(first, padded, b, c, y, dy, dx, total)
                for c in range(channels // 4 * 4, channels):
                    multiply_add(first[b, c, y], padded[b, c, y + dy, dx:], total)
                for x in range(width):
                    total[x] *= scale


@tasks
def _backward(begin: int, end: int, gradient: np.ndarray, padded: np.ndarray, out: np.ndarray) -> None:
    """out_c(x, y) += sum_d gradient_d(x, y) padded_c(x + d) / C; out comes in as zeros."""
    _, channels, height, width = out.shape
    size = padded.shape[2] - height + 1
    scale = np.float32(1.0 / channels)
    for job in range(begin, end):
        b, y = job // height, job % height
        for c in range(channels):
            total = out[b, c, y]
            for dy in range(size):
                for dx in range(size):
                    multiply_add(gradient[b, dy * size + dx, y], padded[b, c, y + dy, dx:], total)
            for x in range(width):
                total[x] *= scale


@tasks
def _mirror(begin: int, end: int, gradient: np.ndarray, radius: int, out: np.ndarray) -> None:
    """out_{-d}(p) = gradient_d(p - d), zero where p - d is outside."""
    _, displacements, height, width = gradient.shape
    size = 2 * radius + 1
    for job in range(begin, end):
        b, k = job // displacements, job % displacements
        dy, dx = k // size - radius, k % size - radius
        for y in range(height):
            for x in range(width):
                inside = 0 <= y - dy < height and 0 <= x - dx < width
                out[b, displacements - 1 - k, y, x] = gradient[b, k, y - dy, x - dx] if inside else np.float32(0)


class _DisparityCorrelation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, left: Tensor, right: Tensor, disparities: int) -> Tensor:
        ctx.save_for_backward(left, right)
        batch, groups, _, height, width = left.shape
        out = torch.zeros((batch, groups, disparities, height, width))
        over_tasks(_disparity_forward, batch * groups * height, _array(left), _array(right), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        left, right = ctx.saved_tensors
        to_left, to_right = torch.zeros(left.shape), torch.zeros(right.shape)
        rows, arrays = left[:, :, 0, :, 0].numel(), (_array(each) for each in (left, right, gradient))
        over_tasks(_disparity_backward, rows, *arrays, to_left.numpy(), to_right.numpy())
        return to_left, to_right, None


@tasks
def _disparity_forward(begin: int, end: int, left: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    _, groups, channels, height, _ = left.shape
    for job in range(begin, end):
        b, g, y = job // (groups * height), job // height % groups, job % height
        for d in range(out.shape[2]):
            for c in range(channels):
                multiply_add(left[b, g, c, y, d:], right[b, g, c, y], out[b, g, d, y, d:])


@tasks
def _disparity_backward(begin: int, end: int, left: np.ndarray, right: np.ndarray, gradient: np.ndarray,
                        to_left: np.ndarray, to_right: np.ndarray) -> None:
    _, groups, channels, height, _ = left.shape
    for job in range(begin, end):
        b, g, y = job // (groups * height), job // height % groups, job % height
        for d in range(gradient.shape[2]):
            for c in range(channels):
                multiply_add(gradient[b, g, d, y, d:], right[b, g, c, y], to_left[b, g, c, y, d:])
                multiply_add(gradient[b, g, d, y, d:], left[b, g, c, y, d:], to_right[b, g, c, y])


@lanes
def multiply_add(a: np.ndarray, b: np.ndarray, total: np.ndarray) -> None:
    """total += a b, as far as the shortest of them goes."""
    for x in range(min(a.size, b.size, total.size)):
        total[x] += a[x] * b[x]


@lanes
def multiply_add_four(a: np.ndarray, b: np.ndarray, i: int, c: int, y: int, dy: int, dx: int, total: np.ndarray
                       ) -> None:
    """``multiply_add`` of four channels at once: a quarter of the traffic of the total."""
    for x in range(total.size):
        # unsigned: for a signed index numba asks whether it is negative, and nothing is vectorised
        at, there = np.uint64(x), np.uint64(x + dx)
        total[x] += (a[i, c, y, at] * b[i, c, y + dy, there] + a[i, c + 1, y, at] * b[i, c + 1, y + dy, there]
                     + a[i, c + 2, y, at] * b[i, c + 2, y + dy, there]
                     + a[i, c + 3, y, at] * b[i, c + 3, y + dy, there])
