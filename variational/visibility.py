"""Visibility by projection: what a state itself says of who hides whom at time 2.

The forward-backward check of variational.terms.visibility asks two flow fields whether they agree, which needs both to
be right where one of them cannot be. A state with disparities knows more: of all pixels of left1 that land on one pixel
of left2 the nearest, that of largest disparity, is seen.
"""

import numpy as np

from variational.jit import over_rows, rowwise, scalar
from variational.state import D1, C, U, V


@scalar
def _sources(first: int, last: int, height: int, up: float, down: float) -> tuple[int, int]:
    """Rows from which something may land on rows `first` to `last`, if nothing moves farther `up` or `down`."""
    return max(int(first - down) - 2, 0), min(int(last + up) + 2, height)


@rowwise
def _front(
    first: int, last: int, disparity: np.ndarray, u: np.ndarray, v: np.ndarray, up: float, down: float, front: np.ndarray
) -> None:
    """front (H, W): largest disparity landing on each pixel of left2 and its direct neighbours, -1 where none lands."""
    height, width = disparity.shape
    begin, end = _sources(first, last, height, up, down)
    for y in range(begin, end):
        for x in range(width):
            to_y = int(np.floor(y + v[y, x]))
            if to_y + 1 < first or to_y >= last:
                continue
            to_x = int(np.floor(x + u[y, x]))
            for j in range(max(to_y, first), min(to_y + 2, last)):
                for i in range(max(to_x, 0), min(to_x + 2, width)):
                    if disparity[y, x] > front[j, i]:
                        front[j, i] = disparity[y, x]


@rowwise
def _seen(
    first: int, last: int, disparity: np.ndarray, u: np.ndarray, v: np.ndarray, front: np.ndarray, margin: float,
    seen: np.ndarray,
) -> None:  # fmt: skip
    height, width = disparity.shape
    for y in range(first, last):
        for x in range(width):
            to_x, to_y = int(np.rint(x + u[y, x])), int(np.rint(y + v[y, x]))
            inside = 0 <= to_x < width and 0 <= to_y < height
            seen[y, x] = inside and disparity[y, x] >= front[to_y, to_x] - margin


def _front_of(state: np.ndarray) -> np.ndarray:
    front = np.full(state.shape[1:], -1, np.float32)
    over_rows(_front, len(front), np.maximum(state[D1] + state[C], 0), state[U], state[V], *_reach(state), front)
    return front


def _reach(state: np.ndarray) -> tuple[float, float]:
    """How far pixels move up and down at the most, within the image's height."""
    height = state.shape[1]
    return float(np.clip(-state[V].min(), 0, height)), float(np.clip(state[V].max(), 0, height))


def project_visibility(state: np.ndarray, margin_px: float = 1.5) -> np.ndarray:
    """Which pixels of left1 are seen in left2.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W).
    margin_px : float
        A pixel is hidden where something nearer by more than this disparity lands on the same place.

    Returns
    -------
    np.ndarray
        (H, W) bool; False also where the pixel leaves the image.
    """
    seen = np.empty(state.shape[1:], bool)
    disparity = np.maximum(state[D1] + state[C], 0)
    over_rows(_seen, len(seen), disparity, state[U], state[V], _front_of(state), np.float32(margin_px), seen)
    return seen


@rowwise
def _seen_in_right(first: int, last: int, disparity: np.ndarray, margin: float, seen: np.ndarray) -> None:
    width = disparity.shape[1]
    front = np.empty(width + 1, np.float32)  # largest disparity landing on each pixel of right1's row
    for y in range(first, last):
        for x in range(width + 1):
            front[x] = -1
        for x in range(width):
            to_x = int(np.floor(x - disparity[y, x]))
            if 0 <= to_x < width:
                front[to_x] = max(front[to_x], disparity[y, x])
            if -1 <= to_x < width:
                front[to_x + 1] = max(front[to_x + 1], disparity[y, x])
        for x in range(width):
            to_x = int(np.rint(x - disparity[y, x]))
            seen[y, x] = 0 <= to_x < width and disparity[y, x] >= front[to_x] - margin


def seen_in_right(disparity: np.ndarray, margin_px: float = 1.0) -> np.ndarray:
    """(H, W) bool: pixels of a left image that nothing nearer, by more than `margin_px`, hides from the right camera."""
    seen = np.empty(disparity.shape, bool)
    over_rows(_seen_in_right, len(seen), disparity, np.float32(margin_px), seen)
    return seen


@rowwise
def _backward(
    first: int, last: int, disparity: np.ndarray, u: np.ndarray, v: np.ndarray, up: float, down: float,
    front: np.ndarray, margin: float, best: np.ndarray, backward: np.ndarray,
) -> None:  # fmt: skip
    height, width = disparity.shape
    begin, end = _sources(first, last, height, up, down)
    for y in range(begin, end):
        for x in range(width):
            at_y = y + v[y, x]
            to_y = int(np.rint(at_y))
            if not first <= to_y < last:
                continue
            at_x = x + u[y, x]
            to_x = int(np.rint(at_x))
            if 0 <= to_x < width and disparity[y, x] >= front[to_y, to_x] - margin:
                distance = (at_x - to_x) ** 2 + (at_y - to_y) ** 2
                if distance < best[to_y, to_x]:
                    best[to_y, to_x] = distance
                    backward[to_y, to_x, 0] = -u[y, x]
                    backward[to_y, to_x, 1] = -v[y, x]


def backward_flow(state: np.ndarray, fallback: np.ndarray, margin_px: float = 1.5) -> np.ndarray:
    """Flow from left2 to left1 that belongs to a state.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W).
    fallback : np.ndarray
        (H, W, 2), taken where nothing seen lands.

    Returns
    -------
    np.ndarray
        (H, W, 2) float32, minus the flow of the visible pixel that lands nearest to each pixel's centre.
    """
    backward = fallback.astype(np.float32, copy=True)
    best = np.full(state.shape[1:], np.inf, np.float32)
    disparity = np.maximum(state[D1] + state[C], 0)
    front, margin = _front_of(state), np.float32(margin_px)
    over_rows(_backward, len(best), disparity, state[U], state[V], *_reach(state), front, margin, best, backward)
    return backward
