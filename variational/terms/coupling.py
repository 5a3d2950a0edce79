"""Coupling term: the disparity that a point takes with it must be the disparity found where it arrives.

``O rho(D1 + C - D2(p + F))`` in pixels, D2 on left2's grid, sampled bilinearly.

Gradient. By D1, C, u and v it is local. By D2 it is the adjoint of sampling, a *scatter* to the four pixels around p + F.
To stay parallel and keep the same bits for any number of threads, a band of *target* rows looks through the source rows
that reach it, in order, and adds what falls into it: every target pixel receives its parts in raster order of the source.
"""

import numpy as np

from variational.jit import real, rowwise
from variational.penalties import penalty
from variational.sampling import cell, interpolate


@rowwise
def _coupling_row(d1: np.ndarray, d2: np.ndarray, change: np.ndarray, u: np.ndarray, v: np.ndarray, y: int,
                  shape: tuple[int, int], visible: np.ndarray, weight: float, eps: float, loss: np.ndarray,
                  grad_d1: np.ndarray, grad_change: np.ndarray, grad_u: np.ndarray, grad_v: np.ndarray,
                  pull: np.ndarray) -> None:
    """One row of the term and of its local gradient; `pull` is minus the derivative by the sampled D2."""
    zero, height, width, row = real(0, weight), real(shape[0], weight), real(shape[1], weight), real(y, weight)
    stride, start = np.int32(shape[1]), np.int32(y * shape[1])
    right, below = np.uint32(min(shape[1] - 1, 1)), np.uint32(shape[1] * min(shape[0] - 1, 1))
    for i in range(d1.size):
        x = np.int32(i)
        shift_x, fx, inside_x = cell(u[i], real(x, weight), width)
        shift_y, fy, inside_y = cell(v[i], row, height)
        k = np.uint32(start + x + np.int32(shift_x) + np.int32(shift_y) * stride)
        sampled, along_x, along_y = interpolate(d2[k], d2[k + right], d2[k + below], d2[k + right + below], fx, fy)
        value, slope = penalty(d1[i] + change[i] - sampled, eps)
        keep = weight if visible[i] else zero
        slope = keep * slope
        loss[i] += keep * value
        pull[i] = slope
        grad_d1[i] += slope
        grad_change[i] += slope
        grad_u[i] -= slope * along_x if inside_x else zero
        grad_v[i] -= slope * along_y if inside_y else zero


@rowwise
def _reach(v: np.ndarray, y: int, height: int) -> tuple[int, int]:
    """First and last row that the row's positions sample."""
    lowest, highest = height, 0
    for i in range(v.size):
        shift, _, _ = cell(v[i], real(y, v[i]), real(height, v[i]))
        target = int(y + shift)
        lowest, highest = min(lowest, target), max(highest, target + 1)
    return lowest, highest


@rowwise
def coupling_band(state: np.ndarray, d2: np.ndarray, visible: np.ndarray, weight: float, eps: float, first: int, last: int,
                  loss: np.ndarray, gradient: np.ndarray, pull: np.ndarray, reach: np.ndarray) -> None:
    """Add the term of rows `first` to `last` (excluded) and its gradient by D1, C, u, v.

    Parameters
    ----------
    state, gradient : np.ndarray
        ``(5, H, W)``.
    d2 : np.ndarray
        ``(H * W,)``, state[D2] flattened.
    visible, loss : np.ndarray
        ``(H, W)``; the term is zero where not visible.
    weight, eps : float
        eps in pixels.
    pull, reach : np.ndarray
        ``(H, W)`` and ``(H, 2)``, written for :func:`scatter_band`.
    """
    kind = state.dtype.type
    shape = (state.shape[1], state.shape[2])
    for y in range(first, last):
        _coupling_row(state[0, y], d2, state[2, y], state[3, y], state[4, y], y, shape, visible[y], kind(weight), kind(eps),
                      loss[y], gradient[0, y], gradient[2, y], gradient[3, y], gradient[4, y], pull[y])
        reach[y, 0], reach[y, 1] = _reach(state[4, y], y, shape[0])


@rowwise
def scatter_band(u: np.ndarray, v: np.ndarray, pull: np.ndarray, reach: np.ndarray, first: int, last: int,
                 gradient: np.ndarray) -> None:
    """Add the gradient by D2 of *target* rows `first` to `last` (excluded); u, v, pull, gradient ``(H, W)``."""
    height, width = u.shape
    right, below = min(width - 1, 1), min(height - 1, 1)
    for y in range(height):
        if reach[y, 1] < first or reach[y, 0] >= last:
            continue
        for x in range(width):
            part = pull[y, x]
            if part == 0:
                continue
            shift_x, fx, _ = cell(u[y, x], real(x, part), real(width, part))
            shift_y, fy, _ = cell(v[y, x], real(y, part), real(height, part))
            i, j = x + np.int32(shift_x), y + np.int32(shift_y)
            lower = part * fy
            upper = part - lower
            if first <= j < last:
                gradient[j, i] -= upper - upper * fx
                gradient[j, i + right] -= upper * fx
            if first <= j + below < last:
                gradient[j + below, i] -= lower - lower * fx
                gradient[j + below, i + right] -= lower * fx
