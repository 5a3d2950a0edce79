"""Smoothness term: first differences of every channel, cheap across the edges of its own image.

``rho(d_x f) exp(-k mean_c |d_x I|) + rho(d_y f) exp(-k mean_c |d_y I|)`` with forward differences, in pixels, zero
across the last column and row; I is left2 for D2, left1 for the others, k the edge sharpness (1 in the paper).

Gradient: minus the divergence. A pixel gets its own forward differences' slopes with a minus and those of its left and
upper neighbours with a plus, so rows are independent.

Reference: Godard et al. 2017 (doi:10.1109/CVPR.2017.699).
"""

import numpy as np

from variational.jit import over_rows, rowwise
from variational.penalties import penalty


def edge_weights(planes: np.ndarray, sharpness: float) -> np.ndarray:
    """``(2, H, W)``: the weights of d_x and d_y, zero in the last column (row), of planes by `photometric.padded_planes`."""
    height, width = planes.shape[1] - 2, planes.shape[2] - 2
    weights = np.empty((2, height, width), planes.dtype)
    over_rows(contrast_band, height, planes, -float(sharpness), weights)
    np.exp(weights, out=weights)
    weights[0, :, -1] = weights[1, -1] = 0
    return weights


@rowwise
def contrast_band(first: int, last: int, planes: np.ndarray, factor: float, out: np.ndarray) -> None:
    """`factor` times the mean absolute forward differences along x and y of rows `first` to `last` (excluded)."""
    channels, kind = planes.shape[0], planes.dtype.type
    factor = kind(factor / channels)
    for y in range(first, last):
        for x in range(out.shape[2]):
            along, down = kind(0), kind(0)
            for c in range(channels):
                own = planes[c, y + 1, x + 1]
                along += abs(planes[c, y + 1, x + 2] - own)
                down += abs(planes[c, y + 2, x + 1] - own)
            out[0, y, x], out[1, y, x] = factor * along, factor * down


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
