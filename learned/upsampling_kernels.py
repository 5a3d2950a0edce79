"""CPU kernel of convex upsampling: softmax and weighted mean of each fine pixel, in one pass."""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import widen
from learned.elementary import exponential
from learned.jit import lanes, tasks


@tasks
def convex_upsampling(first: int, last: int, disparity: np.ndarray, guidance: np.ndarray, factor: int, out: np.ndarray) -> None:
    """Every fine pixel is a convex combination of the 3 x 3 coarse ones around it.

    Parameters
    ----------
    first, last : int
        Coarse rows of all B together; the last is excluded.
    disparity : np.ndarray
        (B, h, w) float32; beyond the border its values repeat.
    guidance : np.ndarray
        (B, h, w, 9 * factor**2) float32 or uint16: logits, the coarse neighbour outermost, then the fine pixel.
    factor : int
    out : np.ndarray
        (B, factor h, factor w) float32.
    """
    _, height, width = disparity.shape
    fine = factor * factor
    most, total, sums = np.empty(fine, np.float32), np.empty(fine, np.float32), np.empty(fine, np.float32)
    for task in range(first, last):
        b, y = task // height, task % height
        for x in range(width):
            most[:] = -np.inf
            total[:] = 0
            sums[:] = 0
            logits = guidance[b, y, x]
            for k in range(9):
                _largest(logits[k * fine : (k + 1) * fine], most)
            for k in range(9):
                yy, xx = min(max(y + k // 3 - 1, 0), height - 1), min(max(x + k % 3 - 1, 0), width - 1)
                _accumulate(logits[k * fine : (k + 1) * fine], most, disparity[b, yy, xx], total, sums)
            for s in range(fine):
                out[b, y * factor + s // factor, x * factor + s % factor] = sums[s] / total[s]


@lanes
def _largest(logits: np.ndarray, most: np.ndarray) -> None:
    for s in range(most.size):
        logit = widen(logits[s])
        most[s] = logit if logit > most[s] else most[s]


@lanes
def _accumulate(logits: np.ndarray, most: np.ndarray, value: float, total: np.ndarray, sums: np.ndarray) -> None:
    for s in range(most.size):
        weight = exponential(widen(logits[s]) - most[s])
        total[s] += weight
        sums[s] += weight * value
