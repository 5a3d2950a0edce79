"""Smoothness term: first differences of every channel, cheap across the edges of its own image.

``rho(d_x f) exp(-k mean_c |d_x I|) + rho(d_y f) exp(-k mean_c |d_y I|)`` with forward differences, in pixels, zero
across the last column and row; I is left2 for D2, left1 for the others, k the edge sharpness (1 in the paper).

Gradient: minus the divergence. A pixel gets its own forward differences' slopes with a minus and those of its left and
upper neighbours with a plus, so rows are independent.

Reference: Godard et al. 2017 (doi:10.1109/CVPR.2017.699).
"""

import numpy as np

from variational.jit import rowwise
from variational.penalties import penalty


def edge_weights(image: np.ndarray, sharpness: float, dtype: np.dtype | type) -> np.ndarray:
    """``(2, H, W)``: the weights of d_x and d_y, zero in the last column (row), of an ``(H, W, c)`` image."""
    planes = np.ascontiguousarray(image.transpose(2, 0, 1), dtype)  # numpy is slow along an axis as short as the channels
    weights = np.zeros((2, *image.shape[:2]), dtype)
    for axis, of_axis in ((2, weights[0, :, :-1]), (1, weights[1, :-1])):
        steps = np.diff(planes, axis=axis)
        np.exp(-sharpness * np.abs(steps, out=steps).mean(axis=0), out=of_axis)
    return weights


@rowwise
def _along_row(f: np.ndarray, edge: np.ndarray, weight: float, eps: float, loss: np.ndarray, flux: np.ndarray) -> None:
    """Horizontal differences of one row; flux[i] is the slope between pixels i - 1 and i, times its weight."""
    for i in range(f.size - 1):
        value, slope = penalty(f[i + 1] - f[i], eps)
        scale = weight * edge[i]
        loss[i] += scale * value
        flux[i + 1] = scale * slope


@rowwise
def _between_rows(above: np.ndarray, f: np.ndarray, below: np.ndarray, edge_above: np.ndarray, edge: np.ndarray,
                  weight: float, eps: float, flux: np.ndarray, loss: np.ndarray, grad: np.ndarray) -> None:
    """Vertical differences of one row, and the row's gradient."""
    for i in range(f.size):
        _, slope_above = penalty(f[i] - above[i], eps)
        value, slope = penalty(below[i] - f[i], eps)
        loss[i] += weight * edge[i] * value
        grad[i] += flux[i] - flux[i + 1] + weight * (edge_above[i] * slope_above - edge[i] * slope)


@rowwise
def smoothness_band(first: int, last: int, plane: np.ndarray, edges: np.ndarray, weight: float, eps: float,
                    loss: np.ndarray, grad: np.ndarray) -> None:
    """Add the term of one channel, rows `first` to `last` (excluded).

    Parameters
    ----------
    plane, loss, grad : np.ndarray
        ``(H, W)``: the channel in pixels, the map, the channel's gradient.
    edges : np.ndarray
        :func:`edge_weights` of the image on whose grid the channel lives.
    weight, eps : float
        eps in pixels.
    """
    height, width = plane.shape
    kind = plane.dtype.type
    flux = np.zeros(width + 1, plane.dtype)
    for y in range(first, last):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        edge_above = edges[1, y - 1] if y > 0 else edges[1, height - 1]  # the last row's weights are zero
        _along_row(plane[y], edges[0, y], kind(weight), kind(eps), loss[y], flux)
        _between_rows(plane[above], plane[y], plane[below], edge_above, edges[1, y], kind(weight), kind(eps), flux,
                      loss[y], grad[y])
