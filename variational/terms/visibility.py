"""Visibility: which pixels of an image are seen in the other, by checking that the way there leads back.

Flow: ``O = [ |F + B'|^2 < w1 (|F|^2 + |B'|^2) + w2 ]``, B' the backward flow sampled bilinearly at p + F. w1 is
relative, w2 in square pixels. O is a constant for differentiation. Reference: Sundaram et al. 2010
(doi:10.1007/978-3-642-15549-9_32), Meister et al. 2018 (UnFlow). Stereo: the same check with two disparity maps.
"""

import numpy as np

from variational.jit import over_rows, real, rowwise
from variational.sampling import cell, interpolate


@rowwise
def _visible_row(u: np.ndarray, v: np.ndarray, y: int, back_u: np.ndarray, back_v: np.ndarray, shape: tuple[int, int],
                 relative: float, absolute: float, visible: np.ndarray) -> None:
    """One row of O; `back_u`, `back_v` are flattened planes."""
    height, width, row = real(shape[0], relative), real(shape[1], relative), real(y, relative)
    stride, start = np.int32(shape[1]), np.int32(y * shape[1])
    right, below = np.uint32(min(shape[1] - 1, 1)), np.uint32(shape[1] * min(shape[0] - 1, 1))
    for i in range(u.size):
        x = np.int32(i)
        shift_x, fx, _ = cell(u[i], real(x, relative), width)
        shift_y, fy, _ = cell(v[i], row, height)
        k = np.uint32(start + x + np.int32(shift_x) + np.int32(shift_y) * stride)
        bu, _, _ = interpolate(back_u[k], back_u[k + right], back_u[k + below], back_u[k + right + below], fx, fy)
        bv, _, _ = interpolate(back_v[k], back_v[k + right], back_v[k + below], back_v[k + right + below], fx, fy)
        du, dv = u[i] + bu, v[i] + bv
        size = u[i] * u[i] + v[i] * v[i] + bu * bu + bv * bv
        visible[i] = du * du + dv * dv < relative * size + absolute


@rowwise
def visible_band(first: int, last: int, u: np.ndarray, v: np.ndarray, backward: np.ndarray, relative: float,
                 absolute: float, visible: np.ndarray) -> None:
    """Rows `first` to `last` (excluded) of O; u, v ``(H, W)``, backward ``(2, H * W)``, visible ``(H, W)`` bool."""
    kind = u.dtype.type
    for y in range(first, last):
        _visible_row(u[y], v[y], y, backward[0], backward[1], u.shape, kind(relative), kind(absolute), visible[y])


def flow_planes(flow: np.ndarray, dtype: np.dtype | type) -> np.ndarray:
    """``(H, W, 2)`` flow as the kernels want it: ``(2, H * W)``, contiguous."""
    return np.ascontiguousarray(flow.transpose(2, 0, 1).reshape(2, -1).astype(dtype))


def visible_mask(flow: np.ndarray, backward_flow: np.ndarray, w1: float = 0.01, w2: float = 0.05) -> np.ndarray:
    """Which pixels of left1 are seen in left2, by the forward-backward check.

    Parameters
    ----------
    flow, backward_flow : np.ndarray
        ``(H, W, 2)``, (u, v) in pixels: left1 -> left2 on left1's grid, and left2 -> left1 on left2's.
    w1 : float
        Tolerance relative to the squared length of both flows; raising it keeps more of fast motion.
    w2 : float
        Tolerance in square pixels; raising it keeps more of everything. The paper has 0.05, UnFlow and SelFlow 0.5.

    Returns
    -------
    np.ndarray
        ``(H, W)`` bool, True where visible.
    """
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.shape != backward_flow.shape:
        raise ValueError(f"both flows must have shape (H, W, 2), not {flow.shape} and {backward_flow.shape}")
    dtype = np.result_type(flow.dtype, np.float32)
    u, v = (np.ascontiguousarray(flow[..., i], dtype) for i in (0, 1))
    visible = np.empty(flow.shape[:2], np.bool_)
    over_rows(visible_band, flow.shape[0], u, v, flow_planes(backward_flow, dtype), float(w1), float(w2), visible)
    return visible


def visible_stereo(disparity_left: np.ndarray, disparity_right: np.ndarray, tolerance_px: float = 1.0) -> np.ndarray:
    """Which pixels of the left image are seen in the right one, by the left-right check.

    Parameters
    ----------
    disparity_left, disparity_right : np.ndarray
        ``(H, W)`` in pixels, both >= 0, each on its own grid: ``left(x) = right(x - d_left(x))`` and
        ``right(x) = left(x + d_right(x))``.
    tolerance_px : float
        Largest difference of the two, the right one sampled linearly at x - d_left.

    Returns
    -------
    np.ndarray
        ``(H, W)`` bool; False also where the match lies outside the image or either disparity is not finite.
    """
    width = disparity_left.shape[1]
    position = np.arange(width) - disparity_left
    inside = (position >= 0) & (position <= width - 1)
    lower = np.where(inside, position, 0).astype(np.intp)
    upper = np.minimum(lower + 1, width - 1)
    fraction = np.where(inside, position - lower, 0)
    matched = ((1 - fraction) * np.take_along_axis(disparity_right, lower, axis=1)
               + fraction * np.take_along_axis(disparity_right, upper, axis=1))
    return inside & (np.abs(matched - disparity_left) <= tolerance_px)
