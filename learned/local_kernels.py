"""CPU kernels of local aggregation, forward and backward: float32, C-contiguous.

The 75 taps are 3 disparities x 5 rows x 5 columns. A tap that falls outside the volume takes the centre's value. Forward,
disparities are innermost: the lanes of the vector registers, with the same weights for all of them. What a neighbour gives
to its own disparity, the next and the one before is summed apart, and the three sums are joined at the end.
"""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import widen
from learned.jit import lanes, tasks

# Columns and rows of a task: five rows of so many columns stay in the second cache.
_COLUMNS, _BAND = 64, 32
_CENTRE = 37  # the tap
_EPSILON = np.float32(1e-12)


@tasks
def local_weights(first: int, last: int, guidance: np.ndarray, out: np.ndarray) -> None:
    """Raw weights (B, H, W, 75), float32 or uint16, divided by their L1 norms, to float32.

    Those of taps beyond the sides of the image go to the centre. The tasks are the rows of all B together.
    """
    _, height, width, _ = guidance.shape
    for task in range(first, last):
        b, y = task // height, task % height
        for x in range(width):
            pixel, own = guidance[b, y, x], out[b, y, x]
            norm = np.float32(0)
            for tap in range(75):
                norm += abs(widen(pixel[tap]))
            _scale(pixel, np.float32(1) / max(norm, _EPSILON), own)
            if not (2 <= y < height - 2 and 2 <= x < width - 2):
                for tap in range(75):
                    if not (0 <= y + tap // 5 % 5 - 2 < height and 0 <= x + tap % 5 - 2 < width):
                        own[_CENTRE] += own[tap]
                        own[tap] = 0


def local_tasks(batch: int, height: int, width: int) -> int:
    """How many tasks ``local_forward`` has."""
    return batch * -(-width // _COLUMNS) * -(-height // _BAND)


@tasks
def local_forward(first: int, last: int, cost: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """out(y, x, d) = sum over the 75 taps of weight(y, x, tap) cost(y + dy, x + dx, d + dd), the centre where outside.

    ``cost`` and ``out`` (B, H, W, D), ``weights`` (B, H, W, 75) of ``local_weights``.
    """
    _, height, width, depth = cost.shape
    strips, bands = (width + _COLUMNS - 1) // _COLUMNS, (height + _BAND - 1) // _BAND
    below, same, above = np.empty(depth, np.float32), np.empty(depth, np.float32), np.empty(depth, np.float32)
    for task in range(first, last):
        b, left, top = task // (strips * bands), task // bands % strips * _COLUMNS, task % bands * _BAND
        for y in range(top, min(top + _BAND, height)):
            for x in range(left, min(left + _COLUMNS, width)):
                own, centre, total = weights[b, y, x], cost[b, y, x], out[b, y, x]
                below[:], same[:], above[:] = 0, 0, 0
                # beyond the sides of the image weights are zero, whatever they are multiplied with
                x0, x1, x3, x4 = max(x - 2, 0), max(x - 1, 0), min(x + 1, width - 1), min(x + 2, width - 1)
                for dy in range(5):
                    row = cost[b, min(max(y + dy - 2, 0), height - 1)]
                    _add_row(row[x0], row[x1], row[x], row[x3], row[x4], own[5 * dy :], below, same, above)
                _join(below, same[1:], above[2:], total[1:])
                beyond_below, beyond_above = np.float32(0), np.float32(0)
                for tap in range(25):
                    beyond_below += own[tap]
                    beyond_above += own[tap + 50]
                end = depth - 1
                total[end] = same[end] + beyond_above * centre[end] + (below[end - 1] if end > 0 else beyond_below * centre[0])
                if end > 0:
                    total[0] = same[0] + beyond_below * centre[0] + above[1]


@lanes
def _scale(pixel: np.ndarray, scale: np.float32, out: np.ndarray) -> None:
    for tap in range(75):
        out[tap] = widen(pixel[tap]) * scale


@lanes
def _add_row(c0: np.ndarray, c1: np.ndarray, c2: np.ndarray, c3: np.ndarray, c4: np.ndarray, w: np.ndarray,
             below: np.ndarray, same: np.ndarray, above: np.ndarray) -> None:
    """What five pixels of a row give to the disparity above each of theirs (``below`` it they are), to it and to that below."""
    b0, b1, b2, b3, b4 = w[0], w[1], w[2], w[3], w[4]
    s0, s1, s2, s3, s4 = w[25], w[26], w[27], w[28], w[29]
    a0, a1, a2, a3, a4 = w[50], w[51], w[52], w[53], w[54]
    for d in range(same.size):
        below[d] += b0 * c0[d] + b1 * c1[d] + b2 * c2[d] + b3 * c3[d] + b4 * c4[d]
        same[d] += s0 * c0[d] + s1 * c1[d] + s2 * c2[d] + s3 * c3[d] + s4 * c4[d]
        above[d] += a0 * c0[d] + a1 * c1[d] + a2 * c2[d] + a3 * c3[d] + a4 * c4[d]


@lanes
def _join(below: np.ndarray, same: np.ndarray, above: np.ndarray, total: np.ndarray) -> None:
    for d in range(above.size):
        total[d] = below[d] + same[d] + above[d]


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
