"""CPU kernels of local aggregation: float32, C-contiguous, forward and backward.

The 75 taps are 3 disparities x 5 rows x 5 columns. A tap that falls outside the volume takes the centre's value, so the
border has loops of its own, and the inside has none of their questions.
"""

from __future__ import annotations

import numpy as np

from learned.jit import lanes, tasks

# Disparities that share the loads of their weights.
_ROWS = 4


@tasks
def local_forward(first: int, last: int, cost: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """out(d, y, x) = sum over the 75 taps of weight(tap, y, x) cost(d + dd, y + dy, x + dx), the centre where outside.

    Shapes (B, D, H, W), (B, 75, H, W), (B, D, H, W); the tasks are the rows of all B together.
    """
    _, depth, height, width = cost.shape
    for task in range(first, last):
        b, y = task // height, task % height
        inside = 2 <= y < height - 2 and width > 4
        # disparities from 1 on that are worked on together
        end = 1 + max(0, depth - 2) // _ROWS * _ROWS if inside else 1
        for d in range(1, end, _ROWS):
            out[b, d : d + _ROWS, y] = 0
            for dy in range(5):
                _four_disparities(cost, weights, b, d, y, dy, out)
            for k in range(d, d + _ROWS):
                for x in (0, 1, width - 2, width - 1):
                    out[b, k, y, x] = _pixel(cost, weights, b, k, y, x)
        _border_row(cost, weights, b, 0, y, out)
        for d in range(end, depth):
            _border_row(cost, weights, b, d, y, out)


@lanes
def _four_disparities(cost: np.ndarray, weights: np.ndarray, b: int, d: int, y: int, dy: int, out: np.ndarray) -> None:
    """Add row ``dy`` of the window at disparities d ... d + 3, except to the two outermost columns on either side."""
    # unsigned: for a signed index numba asks whether it is negative, and nothing is vectorised
    row, source = np.uint64(y), np.uint64(y + dy - 2)
    for x in range(2, cost.shape[3] - 2):
        at = np.uint64(x)
        t0, t1, t2, t3 = out[b, d, row, at], out[b, d + 1, row, at], out[b, d + 2, row, at], out[b, d + 3, row, at]
        for dx in range(5):
            tap, there = dy * 5 + dx, np.uint64(x + dx - 2)
            below, same, above = weights[b, tap, row, at], weights[b, tap + 25, row, at], weights[b, tap + 50, row, at]
            c0, c1, c2 = cost[b, d - 1, source, there], cost[b, d, source, there], cost[b, d + 1, source, there]
            c3, c4, c5 = cost[b, d + 2, source, there], cost[b, d + 3, source, there], cost[b, d + 4, source, there]
            t0 += below * c0 + same * c1 + above * c2
            t1 += below * c1 + same * c2 + above * c3
            t2 += below * c2 + same * c3 + above * c4
            t3 += below * c3 + same * c4 + above * c5
        out[b, d, row, at], out[b, d + 1, row, at], out[b, d + 2, row, at], out[b, d + 3, row, at] = t0, t1, t2, t3


@lanes
def _pixel(cost: np.ndarray, weights: np.ndarray, b: int, d: int, y: int, x: int) -> np.float32:
    _, depth, height, width = cost.shape
    total = np.float32(0)
    for tap in range(75):
        dd, yy, xx = d + tap // 25 - 1, y + tap // 5 % 5 - 2, x + tap % 5 - 2
        inside = 0 <= dd < depth and 0 <= yy < height and 0 <= xx < width
        total += weights[b, tap, y, x] * (cost[b, dd, yy, xx] if inside else cost[b, d, y, x])
    return total


@lanes
def _border_row(cost: np.ndarray, weights: np.ndarray, b: int, d: int, y: int, out: np.ndarray) -> None:
    _, depth, height, width = cost.shape
    out[b, d, y] = 0
    for tap in range(75):
        dd, yy, dx = d + tap // 25 - 1, y + tap // 5 % 5 - 2, tap % 5 - 2
        begin, end = _inside(dx, width) if 0 <= dd < depth and 0 <= yy < height else (width, width)
        weight, centre, total = weights[b, tap, y], cost[b, d, y], out[b, d, y]
        if begin < end:
            _multiply_add(weight[begin:end], cost[b, dd, yy, begin + dx :], total[begin:])
        _multiply_add(weight[:begin], centre, total)
        _multiply_add(weight[end:], centre[end:], total[end:])


@tasks
def local_backward(first: int, last: int, cost: np.ndarray, weights: np.ndarray, gradient: np.ndarray,
                   to_cost: np.ndarray, to_weights: np.ndarray) -> None:
    """Gradients with respect to the costs and to the normalised weights, both added to zeros.

    A row of the costs is gathered from the rows that looked at it, so that no two tasks write to one place.
    """
    _, depth, height, width = cost.shape
    for task in range(first, last):
        b, y = task // height, task % height
        for d in range(depth):
            own, centre, total = gradient[b, d, y], cost[b, d, y], to_cost[b, d, y]
            for tap in range(75):
                offset_d, offset_y, dx = tap // 25 - 1, tap // 5 % 5 - 2, tap % 5 - 2
                begin, end = _inside(dx, width)
                weight, to_weight = weights[b, tap, y], to_weights[b, tap, y]
                looker_d, looker_y = d - offset_d, y - offset_y
                if 0 <= looker_d < depth and 0 <= looker_y < height and begin < end:
                    _multiply_add(weights[b, tap, looker_y, begin:end], gradient[b, looker_d, looker_y, begin:],
                                  total[begin + dx :])
                dd, yy = d + offset_d, y + offset_y
                if 0 <= dd < depth and 0 <= yy < height:
                    if begin < end:
                        _multiply_add(own[begin:end], cost[b, dd, yy, begin + dx :], to_weight[begin:])
                else:
                    begin = end = width
                _multiply_add(own[:begin], weight, total)
                _multiply_add(own[end:], weight[end:], total[end:])
                _multiply_add(own[:begin], centre, to_weight)
                _multiply_add(own[end:], centre[end:], to_weight[end:])


@lanes
def _inside(dx: int, width: int) -> tuple[int, int]:
    """Begin and end of the x for which x + dx is inside too; both ``width`` if there are none."""
    begin, end = max(0, -dx), min(width, width - dx)
    return (begin, end) if begin < end else (width, width)


@lanes
def _multiply_add(a: np.ndarray, b: np.ndarray, total: np.ndarray) -> None:
    """total += a b, for the length of a."""
    for x in range(a.size):
        total[x] += a[x] * b[x]
