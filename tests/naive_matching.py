"""Slow plain twins of census, semi-global aggregation, fusion and projection: from the definitions, one pixel at a time."""

import itertools
from collections.abc import Callable

import numpy as np

PATHS = [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (-1, 1), (1, -1)]
"""Steps (dx, dy) of the eight paths."""


def census_distance(a: np.ndarray, b: np.ndarray, ax: int, bx: int, y: int, spacing: int, overlook: float = 0.0) -> int:
    """Neighbours of a 9 x 7 window, `spacing` apart, that are darker than the centre, by more than so much, in one image only."""
    height, width = a.shape
    bits = 0
    for dy, dx in itertools.product(range(-3, 4), range(-4, 5)):
        at_y = min(max(y + dy * spacing, 0), height - 1)
        in_a = a[at_y, min(max(ax + dx * spacing, 0), width - 1)] < a[y, ax] - overlook
        in_b = b[at_y, min(max(bx + dx * spacing, 0), width - 1)] < b[y, bx] - overlook
        bits += bool(in_a != in_b)
    return bits


def aggregate(costs: np.ndarray, large: Callable[[int, int, int, int], int], small: int) -> np.ndarray:
    """(H, W, D) sums over eight paths; `large(y, x, from_y, from_x)` is the large penalty of a step."""
    height, width, disparities = costs.shape
    total = np.zeros(costs.shape, int)
    for dx, dy in PATHS:
        path = np.zeros(costs.shape, int)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y, x in itertools.product(rows, columns):
            from_y, from_x = y - dy, x - dx
            if not (0 <= from_y < height and 0 <= from_x < width):
                path[y, x] = costs[y, x]
                continue
            before = path[from_y, from_x]
            for d in range(disparities):
                ways = [before[d], before.min() + large(y, x, from_y, from_x)]
                ways += [before[n] + small for n in (d - 1, d + 1) if 0 <= n < disparities]
                path[y, x, d] = int(costs[y, x, d]) + min(ways) - before.min()
        total += path
    return total


def select(total: np.ndarray, tolerance: float, uniqueness: float) -> tuple[np.ndarray, np.ndarray]:
    """Disparity with a parabola fit, and whether it is not the range's end, is unique, and the right view agrees."""
    height, width, disparities = total.shape
    disparity, matched = np.zeros((height, width)), np.zeros((height, width), bool)
    for y, x in np.ndindex(height, width):
        row = total[y, x]
        at = int(row.argmin())
        disparity[y, x] = at
        if 0 < at < disparities - 1 and row[at - 1] + row[at + 1] > 2 * row[at]:
            disparity[y, x] += (row[at - 1] - row[at + 1]) / (2 * (row[at - 1] + row[at + 1] - 2 * row[at]))
        others = [row[d] for d in range(disparities) if abs(d - at) > 1]
        right = round(x - disparity[y, x])
        if right >= 0 and at < disparities - 1 and (not others or min(others) - row[at] >= uniqueness):
            second = min((total[y, right + d, d], d) for d in range(disparities) if right + d < width)[1]
            matched[y, x] = abs(second - disparity[y, x]) <= tolerance
    return disparity, matched


def chain_minimum(candidates: np.ndarray, costs: np.ndarray, price: np.ndarray, scale: float) -> np.ndarray:
    """(K, N): least cost of a chain of N pixels over all labellings that have label k at pixel n. candidates (K, 3, N)."""
    count, _, size = candidates.shape
    best = np.full((count, size), np.inf)
    for labels in itertools.product(range(count), repeat=size):
        energy = sum(costs[k, n] for n, k in enumerate(labels))
        for n in range(1, size):
            difference = np.abs(candidates[labels[n], :, n] - candidates[labels[n - 1], :, n - 1]).sum()
            energy += price[n] * min(difference / scale, 1)
        for n, k in enumerate(labels):
            best[k, n] = min(best[k, n], energy)
    return best


def visible(state: np.ndarray, margin: float) -> np.ndarray:
    """(H, W): no pixel that lands within one pixel of the same place is nearer by more than the margin."""
    _, height, width = state.shape
    y, x = np.mgrid[:height, :width]
    to_x, to_y, disparity = x + state[3], y + state[4], np.maximum(state[0] + state[2], 0)
    seen = np.zeros((height, width), bool)
    for j, i in np.ndindex(height, width):
        at_x, at_y = np.rint(to_x[j, i]), np.rint(to_y[j, i])
        if 0 <= at_x < width and 0 <= at_y < height:
            there = (at_x - np.floor(to_x) <= 1) & (at_x >= np.floor(to_x))
            there &= (at_y - np.floor(to_y) <= 1) & (at_y >= np.floor(to_y))
            seen[j, i] = disparity[j, i] >= disparity[there].max() - margin
    return seen
