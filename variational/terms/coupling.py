"""Coupling term: the disparity that a point takes with it must be the disparity found where it arrives.

``O rho(D1 + C - D2(p + F))`` in pixels, D2 on left2's grid, sampled bilinearly.

Gradient. By D1, C, u and v it is local. By D2 it is the adjoint of sampling, a *scatter* to the four pixels around p +
F. To stay parallel and keep the same bits for any number of threads, a band of *target* rows looks through the source
rows that reach it, in order, and adds what falls into it: every target pixel receives its parts in raster order of the
source.
"""

import numpy as np

from variational.jit import real, rowwise
from variational.penalties import penalty
from variational.sampling import cell, interpolate


@rowwise
def _coupling_row(d1: np.ndarray, d2: np.ndarray, change: np.ndarray, u: np.ndarray, v: np.ndarray, y: int,
                  shape: tuple[int, int], visible: np.ndarray, weight: float, eps: float, loss: np.ndarray,
                  grad_d1: np.ndarray, grad_change: np.ndarray, grad_u: np.ndarray, grad_v: np.ndarray,
                  index: np.ndarray, fx: np.ndarray, fy: np.ndarray, pull: np.ndarray) -> None:
    """One row of the term and of its local gradient; the rest is written for :func:`scatter_band`.

    `index`, `fx`, `fy` are the sampled cells, `pull` minus the derivative by the sampled D2.
    """
    zero, height, width, row = real(0, weight), real(shape[0], weight), real(shape[1], weight), real(y, weight)
    stride, start = np.int32(shape[1]), np.int32(y * shape[1])
    right, below = np.uint32(min(shape[1] - 1, 1)), np.uint32(shape[1] * min(shape[0] - 1, 1))
    for i in range(d1.size):
        x = np.int32(i)
        shift_x, fx[i], inside_x = cell(u[i], real(x, weight), width)
        shift_y, fy[i], inside_y = cell(v[i], row, height)
        index[i] = start + x + np.int32(shift_x) + np.int32(shift_y) * stride
        k = np.uint32(index[i])
        sampled, along_x, along_y = interpolate(d2[k], d2[k + right], d2[k + below], d2[k + right + below], fx[i],
                                                fy[i])
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
def coupling_band(first: int, last: int, state: np.ndarray, d2: np.ndarray, visible: np.ndarray, weight: float,
                  eps: float, loss: np.ndarray, gradient: np.ndarray, index: np.ndarray, parts: np.ndarray) -> None:
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
    index, parts : np.ndarray
        ``(H, W)`` int32 and ``(3, H, W)``, written for :func:`scatter_band`.
    """
    kind = state.dtype.type
    shape = (state.shape[1], state.shape[2])
    for y in range(first, last):
        _coupling_row(state[0, y], d2, state[2, y], state[3, y], state[4, y], y, shape, visible[y], kind(weight),
                      kind(eps), loss[y], gradient[0, y], gradient[2, y], gradient[3, y], gradient[4, y], index[y],
                      parts[0, y], parts[1, y], parts[2, y])


@rowwise
def _range(index: np.ndarray) -> tuple[int, int]:
    """Smallest and largest of a row of indices."""
    low = high = index[0]
    for i in range(index.size):
        low, high = min(low, index[i]), max(high, index[i])
    return low, high


@rowwise
def _scatter_row(index: np.ndarray, fx: np.ndarray, fy: np.ndarray, pull: np.ndarray, begin: int, end: int, right: int,
                 below: int, out: np.ndarray) -> None:
    """Spread one source row over the flattened target pixels `begin` to `end` (excluded)."""
    for i in range(index.size):
        if pull[i] != 0:
            k = index[i]
            lower = pull[i] * fy[i]
            upper = pull[i] - lower
            if begin <= k < end:
                out[k] -= upper - upper * fx[i]
                out[k + right] -= upper * fx[i]
            if begin <= k + below < end:
                out[k + below] -= lower - lower * fx[i]
                out[k + below + right] -= lower * fx[i]


@rowwise
def scatter_band(first: int, last: int, index: np.ndarray, parts: np.ndarray, gradient: np.ndarray) -> None:
    """Add the gradient by D2 of *target* rows `first` to `last` (excluded).

    Parameters
    ----------
    index, parts : np.ndarray
        What :func:`coupling_band` wrote, for all rows.
    gradient : np.ndarray
        ``(H * W,)``, gradient[D2] flattened.
    """
    height, width = index.shape
    right, below = min(width - 1, 1), width * min(height - 1, 1)
    begin, end = first * width, last * width
    for y in range(height):
        low, high = _range(index[y])
        if low < end and high + below >= begin:
            _scatter_row(index[y], parts[0, y], parts[1, y], parts[2, y], begin, end, right, below, gradient)
