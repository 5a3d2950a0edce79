"""CPU kernels of the refiner's neighbours: how they differ, and weighted means of what they say, each in one pass."""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import widen
from learned.elementary import exponential
from learned.jit import lanes, tasks


@tasks
def border(first: int, last: int, state: np.ndarray, reliability: np.ndarray, reach: int, out: np.ndarray) -> None:
    """D1, C, u, v of (B, 5, h, w) and a reliability (B, 2, h, w), float32 or uint16, to (B, 6, h + 2 reach, w + 2 reach).

    The border's values repeat outside. Tasks: rows of `out`, of all B together.
    """
    height, width = state.shape[2:]
    for task in range(first, last):
        b, y = task // out.shape[2], task % out.shape[2]
        there = min(max(y - reach, 0), height - 1)
        for c in range(6):
            row = out[b, c, y]
            for x in range(width):
                row[reach + x] = state[b, c + min(c, 1), there, x] if c < 4 else widen(reliability[b, c - 4, there, x])
            row[:reach] = row[reach]
            row[reach + width :] = row[reach + width - 1]


@tasks
def mixture(first: int, last: int, bordered: np.ndarray, preference: np.ndarray, contrasts: np.ndarray, sharpness: float,
            offsets: np.ndarray, reach: int, out: np.ndarray) -> None:
    """``sum_k w_k(p) X(p + o_k)``, ``w = softmax_k(a_k(p) - sharpness * contrast_k(p) + r(p + o_k))``.

    Parameters
    ----------
    first, last : int
        Rows of all B together; the last is excluded.
    bordered : np.ndarray
        (B, 6, h + 2 reach, w + 2 reach) float32, by :func:`border`: X = D1, C, u, v; r of D1 and of the motion.
    preference, contrasts : np.ndarray
        (B, k, h, w), the first float32 or uint16: a, with whatever strides.
    sharpness : float
    offsets : np.ndarray
        (k, 2) of rows and columns, at most `reach`.
    out : np.ndarray
        (B, 4, h, w) float32.
    """
    count, height, width = contrasts.shape[1:]
    own, logits = np.empty((count, width), np.float32), np.empty((count, width), np.float32)
    most, total, sums = np.empty(width, np.float32), np.empty(width, np.float32), np.empty((4, width), np.float32)
    for task in range(first, last):
        b, y = task // height, task % height
        for k in range(count):
            for x in range(width):
                own[k, x] = widen(preference[b, k, y, x]) - sharpness * contrasts[b, k, y, x]
        for group in range(2):
            channels = (0, 1) if group == 0 else (1, 4)
            most[:] = -np.inf
            for k in range(count):
                there, begin = y + reach + offsets[k, 0], reach + offsets[k, 1]
                _add_and_compare(own[k], bordered[b, 4 + group, there, begin:], logits[k], most)
            total[:] = 0
            sums[:] = 0
            for k in range(count):
                there, begin = y + reach + offsets[k, 0], reach + offsets[k, 1]
                _weigh(logits[k], most, total)
                for c in range(channels[0], channels[1]):
                    _accumulate(logits[k], bordered[b, c, there, begin:], sums[c])
            for c in range(channels[0], channels[1]):
                _divide(sums[c], total, out[b, c, y])


@tasks
def contrasts(first: int, last: int, image: np.ndarray, offsets: np.ndarray, reach: int, out: np.ndarray) -> None:
    """Mean absolute difference to each neighbour.

    Parameters
    ----------
    first, last : int
        Rows of all B together; the last is excluded.
    image : np.ndarray
        (B, c, h + 2 reach, w + 2 reach) float32.
    offsets : np.ndarray
        (k, 2) of rows and columns, at most `reach`.
    out : np.ndarray
        (B, k, h, w) float32.
    """
    _, count, height, width = out.shape
    channels = image.shape[1]
    for task in range(first, last):
        b, y = task // height, task % height
        for k in range(count):
            there, begin = y + reach + offsets[k, 0], reach + offsets[k, 1]
            out[b, k, y] = 0
            for c in range(channels):
                _add_difference(image[b, c, y + reach, reach:], image[b, c, there, begin:], out[b, k, y])
            for x in range(width):
                out[b, k, y, x] *= np.float32(1 / channels)


@lanes
def _add_difference(a: np.ndarray, b: np.ndarray, total: np.ndarray) -> None:
    for x in range(total.size):
        total[x] += abs(a[x] - b[x])


@lanes
def _add_and_compare(own: np.ndarray, trust: np.ndarray, logits: np.ndarray, most: np.ndarray) -> None:
    for x in range(most.size):
        logit = own[x] + trust[x]
        logits[x] = logit
        most[x] = logit if logit > most[x] else most[x]


@lanes
def _weigh(logits: np.ndarray, most: np.ndarray, total: np.ndarray) -> None:
    """Logits become weights that are not normalised yet."""
    for x in range(most.size):
        weight = exponential(logits[x] - most[x])
        logits[x] = weight
        total[x] += weight


@lanes
def _accumulate(weights: np.ndarray, values: np.ndarray, sums: np.ndarray) -> None:
    for x in range(sums.size):
        sums[x] += weights[x] * values[x]


@lanes
def _divide(sums: np.ndarray, total: np.ndarray, out: np.ndarray) -> None:
    for x in range(total.size):
        out[x] = sums[x] / total[x]
