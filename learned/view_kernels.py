"""CPU kernels of what the refiner looks at: one pixel of each block, and all of its inputs in one pass over the image."""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import narrow
from learned.elementary import logarithm
from learned.jit import lanes, tasks

GROUPS = ("loss", "gradient", "deviation", "camera", "residual", "round trip", "camera loss", "within")
"""Inputs that :func:`observe` knows, in the order of its `places`."""

# What brings the energy's map (its photometric terms end at 3) and the gradient (the coupling's is 1 a pixel) to a range
# of about one.
LOSS_SCALE, GRADIENT_SCALE = 0.5, 1.0
LOSS_MOST, GRADIENT_MOST = 20.0, 5.0
#: Ratio of depths at time 2 and 1 below which a point is as good as behind the camera.
LEAST_SCALE = 0.05


@tasks
def pick(first: int, last: int, maps: np.ndarray, divisor: int, out: np.ndarray) -> None:
    """The last pixel of each block of (n, H, W), to (n, h, w); the border's values repeat outside. Tasks: rows of all n."""
    height = maps.shape[1]
    for task in range(first, last):
        i, y = task // out.shape[1], task % out.shape[1]
        _last_of_blocks(maps[i, min(y * divisor + divisor - 1, height - 1)], divisor, divisor - 1, out[i, y])


@tasks
def observe(first: int, last: int, state: np.ndarray, loss: np.ndarray, gradient: np.ndarray, camera_loss: np.ndarray,
            boxes: np.ndarray, backward: np.ndarray, homography: np.ndarray, places: np.ndarray, divisor: int,
            out: np.ndarray, camera: np.ndarray, residual: np.ndarray) -> None:
    """The refiner's inputs, as `learned.inputs` writes them down plainly.

    Parameters
    ----------
    first, last : int
        Rows of blocks of all B together; the last is excluded.
    state, loss, gradient, camera_loss : np.ndarray
        (B, 5, H, W), (B, H, W), (B, 5, H, W), (B, H, W), float32; what `places` leaves out is not read.
    boxes : np.ndarray
        (B, 5, m, n) float32: means of the picked state, to be interpolated.
    backward : np.ndarray
        (B, 2, H, W) float32: flow left2 -> left1, pixels.
    homography : np.ndarray
        (B, 4, 4) float32.
    places : np.ndarray
        (8,): first channel of each of `GROUPS`, -1 for one that is left out; the camera, the residual, the round trip and
        the differences within blocks are always in.
    divisor : int
        Side of a block.
    out : np.ndarray
        (B, h, w, channels) float32 or uint16; channels of no group become zero.
    camera, residual : np.ndarray
        (B, 3, h, w) and (B, h, w) float32, pixels.
    """
    (height, width), (rows, columns, channels) = state.shape[2:], out.shape[1:]
    one, inf = np.float32(1), np.float32(np.inf)
    seen, own = np.zeros((channels, columns), np.float32), np.empty((5, columns), np.float32)
    sums, mean = np.empty(width, np.float32), np.empty(columns, np.float32)
    left, right, share = _interpolation(columns, boxes.shape[3])
    above, below, share_down = _interpolation(rows, boxes.shape[2])
    at_loss, at_gradient, at_deviation, at_camera, at_residual, at_trip, at_camera_loss, at_within = places
    for task in range(first, last):
        b, y = task // rows, task % rows
        top = y * divisor
        for c in range(5):
            _last_of_blocks(state[b, c, min(top + divisor, height) - 1], divisor, divisor - 1, own[c])
        if at_deviation >= 0:
            for c in range(5):
                _deviation(own[c], boxes[b, c, above[y]], boxes[b, c, below[y]], share_down[y], left, right, share,
                           seen[at_deviation + c])
        moved = camera[b, :, y]
        _camera_motion(own, top + divisor - 1, divisor, homography[b], moved)
        for c in range(3):
            seen[at_camera + c] = moved[c]
            _subtract(seen[at_camera + c], own[2 + c])
        _second_pair(own, top + divisor - 1, divisor, state[b, 1], backward[b], residual[b, y], seen[at_trip])
        seen[at_residual] = residual[b, y]
        if at_camera_loss >= 0:
            _mean_of_blocks(loss[b], top, divisor, -inf, inf, one, sums, mean)
            _mean_of_blocks(camera_loss[b], top, divisor, -inf, inf, one, sums, seen[at_camera_loss])
            _subtract(seen[at_camera_loss], mean)
        channel = at_within
        for c in range(0, 4, 3):  # D1 and u
            for other in range(divisor * divisor - 1):
                row = state[b, c, min(top + other // divisor, height - 1)]
                _last_of_blocks(row, divisor, other % divisor, seen[channel])
                _subtract(seen[channel], own[c])
                channel += 1
        for c in range(channels):
            _signed_log(seen[c])
        if at_loss >= 0:
            _mean_of_blocks(loss[b], top, divisor, -inf, np.float32(LOSS_MOST), np.float32(LOSS_SCALE), sums, seen[at_loss])
        if at_gradient >= 0:
            most = np.float32(GRADIENT_MOST)
            for c in range(5):
                _mean_of_blocks(gradient[b, c], top, divisor, -most, most, np.float32(GRADIENT_SCALE), sums,
                                seen[at_gradient + c])
        for x in range(columns):
            for c in range(channels):
                out[b, y, x, c] = narrow(seen[c, x], out)


@lanes
def _last_of_blocks(row: np.ndarray, divisor: int, last: int, out: np.ndarray) -> None:
    """Pixel `last` of each block of a row; the border's value repeats outside."""
    for x in range(out.size - 1):
        out[x] = row[np.uint64(x * divisor + last)]
    out[out.size - 1] = row[min((out.size - 1) * divisor + last, row.size - 1)]


@lanes
def _mean_of_blocks(maps: np.ndarray, top: int, divisor: int, least: float, most: float, scale: float, sums: np.ndarray,
                    out: np.ndarray) -> None:
    """`scale` times the mean over each block of one row of blocks, of values between `least` and `most`."""
    sums[:] = 0
    for i in range(divisor):
        row = maps[min(top + i, maps.shape[0] - 1)]
        for x in range(sums.size):
            value = row[x]
            value = least if value < least else value
            sums[x] += most if value > most else value
    factor = scale / np.float32(divisor * divisor)
    out[:] = 0
    for j in range(divisor):
        for x in range(out.size - 1):
            out[x] += sums[np.uint64(x * divisor + j)]
        out[out.size - 1] += sums[min((out.size - 1) * divisor + j, sums.size - 1)]
    for x in range(out.size):
        out[x] *= factor


@lanes
def _interpolation(size: int, coarse: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two of `coarse` samples that each of `size` pixels lies between, and the second one's share."""
    lower, upper, share = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.float32)
    for i in range(size):
        position = np.float32(coarse / size) * (np.float32(i) + np.float32(0.5)) - np.float32(0.5)
        position = position if position > 0 else np.float32(0)
        lower[i] = np.int64(position)
        upper[i] = min(lower[i] + 1, coarse - 1)
        share[i] = position - np.float32(lower[i])
    return lower, upper, share


@lanes
def _deviation(row: np.ndarray, above: np.ndarray, below: np.ndarray, share_down: float, left: np.ndarray, right: np.ndarray,
               share: np.ndarray, out: np.ndarray) -> None:
    """A row minus what lies between two rows of boxes."""
    for x in range(out.size):
        a, b = np.uint64(left[x]), np.uint64(right[x])
        begin = above[a] + share_down * (below[a] - above[a])
        end = above[b] + share_down * (below[b] - above[b])
        out[x] = row[x] - (begin + share[x] * (end - begin))


@lanes
def _camera_motion(own: np.ndarray, line: int, divisor: int, h: np.ndarray, out: np.ndarray) -> None:
    """`learned.alternatives.camera_motion` of one row of picked pixels (5, w), on the image's row `line`."""
    least, y = np.float32(LEAST_SCALE), np.float32(line)
    for i in range(own.shape[1]):
        disparity, x = own[0, i], np.float32(i * divisor + divisor - 1)
        depth = h[3, 2] * disparity + (h[3, 0] * x + h[3, 1] * y + h[3, 3])
        scale = np.float32(1) / (least if depth < least else depth)
        change = (h[2, 2] * disparity + (h[2, 0] * x + h[2, 1] * y + h[2, 3])) * scale - disparity
        u = (h[0, 2] * disparity + (h[0, 0] * x + h[0, 1] * y + h[0, 3])) * scale - x
        v = (h[1, 2] * disparity + (h[1, 0] * x + h[1, 1] * y + h[1, 3])) * scale - y
        out[0, i] = change if depth > least else own[2, i]
        out[1, i] = u if depth > least else own[3, i]
        out[2, i] = v if depth > least else own[4, i]


@lanes
def _second_pair(own: np.ndarray, line: int, divisor: int, d2: np.ndarray, backward: np.ndarray, residual: np.ndarray,
                 round_trip: np.ndarray) -> None:
    """`learned.alternatives.second_pair` of one row of picked pixels (5, w), on the image's row `line`."""
    height, width = d2.shape
    for i in range(own.shape[1]):
        u, v = own[3, i], own[4, i]
        x = inside(np.float32(i * divisor + divisor - 1) + u, width)
        y = inside(np.float32(line) + v, height)
        x0, y0 = np.uint64(x), np.uint64(y)
        x1, y1 = min(x0 + np.uint64(1), np.uint64(width - 1)), min(y0 + np.uint64(1), np.uint64(height - 1))
        fx, fy = x - np.float32(x0), y - np.float32(y0)
        there = _between(d2, x0, x1, y0, y1, fx, fy)
        back_u, back_v = _between(backward[0], x0, x1, y0, y1, fx, fy), _between(backward[1], x0, x1, y0, y1, fx, fy)
        residual[i] = there - own[0, i] - own[2, i]
        round_trip[i] = np.sqrt((u + back_u) * (u + back_u) + (v + back_v) * (v + back_v))


@lanes
def inside(position: np.float32, size: int) -> np.float32:
    """The nearest position on an axis of `size` pixels; the last one for NaN."""
    most = np.float32(size - 1)
    position = position if position < most else most
    return position if position > 0 else np.float32(0)


@lanes
def _between(maps: np.ndarray, x0: int, x1: int, y0: int, y1: int, fx: float, fy: float) -> float:
    """Bilinear interpolation."""
    above = maps[y0, x0] + fx * (maps[y0, x1] - maps[y0, x0])
    below = maps[y1, x0] + fx * (maps[y1, x1] - maps[y1, x0])
    return above + fy * (below - above)


@lanes
def _subtract(row: np.ndarray, other: np.ndarray) -> None:
    for x in range(row.size):
        row[x] -= other[x]


@lanes
def _signed_log(row: np.ndarray) -> None:
    """asinh(2 x) / 2, in place."""
    for x in range(row.size):
        size = np.float32(2) * abs(row[x])
        value = np.float32(0.5) * logarithm(size + np.sqrt(size * size + np.float32(1)))
        row[x] = value if row[x] > 0 else -value
