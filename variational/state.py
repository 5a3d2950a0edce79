"""The ``(5, H, W)`` state: names of its channels, its units, and how it is resized.

The channels are those of the package docstring: D1, D2, C, u, v, in pixels of the grid that the state lives on.
"""

from __future__ import annotations

import cv2
import numpy as np

D1, D2, C, U, V = range(5)
CHANNELS = ("D1", "D2", "C", "u", "v")


def zero_state(shape: tuple[int, int], dtype: np.dtype | type = np.float32) -> np.ndarray:
    """The state of a scene at infinity that does not move: zeros of shape ``(5, *shape)``."""
    return np.zeros((5, *shape), dtype)


def check_state(state: np.ndarray, shape: tuple[int, int]) -> None:
    """Raise ValueError unless `state` is a C-contiguous float32 or float64 array of shape ``(5, *shape)``."""
    if not isinstance(state, np.ndarray) or state.dtype not in (np.float32, np.float64):
        kind = getattr(state, "dtype", type(state).__name__)
        raise ValueError(f"the state must be a float32 or float64 array, not {kind}")
    if state.shape != (5, *shape):
        raise ValueError(f"the state must have shape {(5, *shape)}, not {state.shape}")
    if not state.flags.c_contiguous:
        raise ValueError("the state must be C-contiguous: pass it through numpy.ascontiguousarray")


def flow_of(state: np.ndarray) -> np.ndarray:
    """The flow of a state in OpenCV's layout: ``(H, W, 2)`` contiguous copy of u, v, in pixels."""
    return np.ascontiguousarray(state[U:].transpose(1, 2, 0))


def resize_maps(maps: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Resize a stack of maps ``(n, H, W)`` to ``(n, *shape)``; values are interpolated, their scale is left alone.

    Bilinear between pixel centres where a side grows, the mean over the covered area where both shrink (anti-aliased).
    The grids share their outer edges: pixel centre x goes to ``(x + 0.5) * sx - 0.5``.
    """
    height, width = shape
    if maps.shape[1:] == tuple(shape):
        return maps.copy()
    shrinks = height <= maps.shape[1] and width <= maps.shape[2]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.stack([cv2.resize(plane, (width, height), interpolation=interpolation) for plane in maps])


def resize_state(state: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Resize a state to another grid, in pixels of the new grid.

    Parameters
    ----------
    state : np.ndarray
        ``(5, H, W)``.
    shape : tuple of int
        New ``(H, W)``; any sizes, both ratios independent.

    Returns
    -------
    np.ndarray
        ``(5, *shape)`` of the same type: D1, D2, C and u times the ratio of the widths, v times that of the heights.
    """
    sx, sy = shape[1] / state.shape[2], shape[0] / state.shape[1]
    scale = np.array([sx, sx, sx, sx, sy], state.dtype)[:, None, None]
    return resize_maps(state, shape) * scale


def enlarge_state(state: np.ndarray, shape: tuple[int, int], jump_px: float = 1.0) -> np.ndarray:
    """As :func:`resize_state`, to a larger grid: bilinear on surfaces, the nearest pixel's value at their borders.

    A border is where the two differ by more than `jump_px`, pixels of the new grid; interpolated, it would be a slope
    that belongs to neither side.
    """
    linear = resize_state(state, shape)
    scale = np.array([shape[1] / state.shape[2]] * 4 + [shape[0] / state.shape[1]], state.dtype)
    for plane, own, factor in zip(linear, state, scale, strict=True):
        nearest = factor * cv2.resize(own, shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        np.copyto(plane, nearest, where=np.abs(plane - nearest) > jump_px)
    return linear
