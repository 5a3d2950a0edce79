"""CPU kernels of what a pixel may choose between, and of what speaks for each choice; `learned.choices` says it plainly."""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import narrow
from learned.elementary import logarithm
from learned.jit import lanes, tasks
from learned.view_kernels import inside


@tasks
def extremes_along(first: int, last: int, disparity: np.ndarray, reach: int, best: np.ndarray, at: np.ndarray) -> None:
    """Least and largest disparity within `reach` columns, and where it is.

    disparity (B, H, W); best (2, B, H, W) float32, the least ones negated; at (2, B, H, W) int64, indices into the flat
    image. Of equal ones the first counts. Tasks: rows of all B together.
    """
    _, height, width = disparity.shape
    row, columns = np.empty(width, np.float32), np.empty(width, np.int64)
    for task in range(first, last):
        b, y = task // height, task % height
        for x in range(width):
            columns[x] = y * width + x
        for k in range(2):
            at[k, b, y] = columns  # where nothing is a number, the pixel itself
            sign = np.float32(2 * k - 1)
            for x in range(width):
                row[x] = sign * disparity[b, y, x]
            best[k, b, y] = -np.inf
            for dx in range(-reach, reach + 1):
                begin, end = max(0, -dx), min(width, width - dx)
                if begin < end:
                    _keep_larger(row[begin + dx :], columns[begin + dx :], best[k, b, y, begin:end], at[k, b, y, begin:end])


@tasks
def extremes_down(first: int, last: int, best: np.ndarray, at: np.ndarray, reach: int, sources: np.ndarray) -> None:
    """The same along columns, of what :func:`extremes_along` found. sources (B, 2, H, W) int64."""
    height, width = best.shape[2:]
    largest = np.empty(width, np.float32)
    for task in range(first, last):
        b, y = task // height, task % height
        for k in range(2):
            largest[:] = -np.inf
            sources[b, k, y] = at[k, b, y]
            for there in range(max(y - reach, 0), min(y + reach + 1, height)):
                _keep_larger(best[k, b, there], at[k, b, there], largest, sources[b, k, y])


@lanes
def _keep_larger(values: np.ndarray, places: np.ndarray, best: np.ndarray, at: np.ndarray) -> None:
    for x in range(best.size):
        larger = values[x] > best[x]
        at[x] = places[x] if larger else at[x]
        best[x] = values[x] if larger else best[x]


@tasks
def describe_rows(first: int, last: int, states: np.ndarray, sources: np.ndarray, seen: np.ndarray, front: np.ndarray,
                  evidence: np.ndarray, votes: np.ndarray, least_jump: float, colour_scale: float, step_scale: float,
                  out: np.ndarray) -> None:
    """What speaks for each choice.

    Parameters
    ----------
    first, last : int
        Rows of all B together; the last is excluded.
    states : np.ndarray
        (B, K, 5, H, W) float32: the choices, K = 3.
    sources : np.ndarray
        (B, K - 1, H, W) int64: where all but the first come from, as indices into the flat image.
    seen : np.ndarray
        (B, 4, 5, H * W) float32: colours and scaled gradients of left1, right1, left2, right2.
    front, evidence, votes : np.ndarray
        (B, H, W), (B, 2, H, W), (B, 2, H, W) float32.
    least_jump, colour_scale, step_scale : float
        Jump of disparity below which there is nothing between; factors of differences of colour and of pixels.
    out : np.ndarray
        (B, H, W, channels) float32, or uint16 for bfloat16.
    """
    count, (height, width), channels = states.shape[1], states.shape[3:], out.shape[3]
    rows = np.empty((channels, width), np.float32)
    corners, shares = np.empty((4, width), np.int32), np.empty((2, width), np.float32)
    for task in range(first, last):
        b, y = task // height, task % height
        begin, end = y * width, (y + 1) * width
        for k in range(count):
            d1, change, u, v = states[b, k, 0, y], states[b, k, 2, y], states[b, k, 3, y], states[b, k, 4, y]
            for there in range(1, 4):
                channel = 8 * k + 2 * there - 2
                _lead(d1, change, u, v, there, y, height, corners, shares)
                rows[channel : channel + 2] = 0
                for c in range(5):
                    _add_sampled(seen[b, there, c], seen[b, 0, c, begin:end], corners[0], corners[1], corners[2], corners[3],
                                 shares[0], shares[1], rows[channel + c // 3])
                _limit(rows[channel], colour_scale, np.float32(0.5), np.float32(1 / 3))
                _limit(rows[channel + 1], np.float32(1), np.float32(1), np.float32(1))
            _hide(d1, front[b, y], rows[8 * k + 6], rows[8 * k + 7])
        channel = 8 * count
        _between(states[b, 0, 0, y], states[b, 1, 0, y], states[b, 2, 0, y], least_jump, rows[channel], rows[channel + 1])
        channel += 2
        for j in range(2):
            rows[channel + j] = evidence[b, j, y]
        for j in range(count - 1):
            channel += 2 if j == 0 else 4
            for x in range(width):
                source = sources[b, j, y, x]
                rows[channel, x] = step_scale * np.float32(source // width - y)
                rows[channel + 1, x] = step_scale * np.float32(source % width - x)
                rows[channel + 2, x] = evidence[b, 0, source // width, source % width]
                unlike = np.float32(0)
                for c in range(3):
                    unlike += abs(seen[b, 0, c, source] - seen[b, 0, c, begin + x])
                rows[channel + 3, x] = colour_scale * unlike / np.float32(3)
        channel += 4
        for j in range(2):
            rows[channel + j] = seen[b, 0, 3 + j, begin:end]
            for x in range(width):
                rows[channel + 2 + j, x] = np.float32(2) * votes[b, j, y, x] - np.float32(1)
        for x in range(width):
            for c in range(channels):
                out[b, y, x, c] = narrow(rows[c, x], out)


@lanes
def _lead(d1: np.ndarray, change: np.ndarray, u: np.ndarray, v: np.ndarray, there: int, y: int, height: int,
          corners: np.ndarray, shares: np.ndarray) -> None:
    """Where a row leads in one of the other images: the four pixels around, as indices, and the shares of right and lower."""
    width = d1.size
    for x in range(width):
        fx = np.float32(x)
        at_x = inside(fx - d1[x] if there == 1 else (fx + u[x] if there == 2 else fx + u[x] - d1[x] - change[x]), width)
        at_y = inside(np.float32(y) if there == 1 else np.float32(y) + v[x], height)
        x0, y0 = np.int32(at_x), np.int32(at_y)
        to_right, to_below = 1 if x0 < width - 1 else 0, width if y0 < height - 1 else 0
        corners[0, x] = y0 * width + x0
        corners[1, x] = corners[0, x] + to_right
        corners[2, x] = corners[0, x] + to_below
        corners[3, x] = corners[1, x] + to_below
        shares[0, x], shares[1, x] = at_x - np.float32(x0), at_y - np.float32(y0)


@lanes
def _add_sampled(plane: np.ndarray, own: np.ndarray, corner0: np.ndarray, corner1: np.ndarray, corner2: np.ndarray,
                 corner3: np.ndarray, right: np.ndarray, down: np.ndarray, total: np.ndarray) -> None:
    """Add the absolute difference between a row and what a flat plane has, bilinearly, between four corners."""
    for x in range(total.size):
        a, b = plane[np.uint64(corner0[x])], plane[np.uint64(corner1[x])]
        c, d = plane[np.uint64(corner2[x])], plane[np.uint64(corner3[x])]
        above, below = a + right[x] * (b - a), c + right[x] * (d - c)
        total[x] += abs(above + down[x] * (below - above) - own[x])


@lanes
def _limit(row: np.ndarray, scale: float, most: float, share: float) -> None:
    for x in range(row.size):
        value = share * row[x]
        row[x] = scale * (value if value < most else most)


@lanes
def _hide(d1: np.ndarray, front: np.ndarray, hides: np.ndarray, outside: np.ndarray) -> None:
    """How much nearer than the choice is what the right camera sees there, and whether that lies outside of its image."""
    for x in range(d1.size):
        at = inside(np.float32(x) - d1[x], d1.size)
        left = np.int64(at)
        right = left + 1 if left < d1.size - 1 else left
        seen = front[np.uint64(left)] + (at - np.float32(left)) * (front[np.uint64(right)] - front[np.uint64(left)])
        nearer = np.float32(0.5) * (seen - d1[x])
        size = abs(nearer)
        compressed = np.float32(0.5) * logarithm(size + np.sqrt(size * size + np.float32(1)))  # asinh
        hides[x] = compressed if nearer > 0 else -compressed
        outside[x] = np.float32(1) if np.float32(x) - d1[x] < 0 else np.float32(0)


@lanes
def _between(own: np.ndarray, farthest: np.ndarray, nearest: np.ndarray, least_jump: float, size: np.ndarray,
             share: np.ndarray) -> None:
    """Size of the jump, and where between its sides the state lies; in the middle where there is hardly one."""
    for x in range(own.size):
        jump = nearest[x] - farthest[x]
        size[x] = np.float32(0.5) * logarithm(np.float32(1) + jump)
        place = (own[x] - farthest[x]) / (jump if jump > least_jump else least_jump)
        share[x] = place if jump > least_jump else np.float32(0.5)


@tasks
def votes_of_rows(first: int, last: int, around: np.ndarray, middle: np.ndarray, offsets: np.ndarray, weights: np.ndarray,
                  reach: int, inverse_colour: float, out: np.ndarray) -> None:
    """Share of the pixels around that lie in front, by colour and distance, and of the confident ones.

    Parameters
    ----------
    first, last : int
        Rows of all B together; the last is excluded.
    around : np.ndarray
        (B, 5, H + 2 reach, W + 2 reach) float32: three colours, disparity, confidence squared.
    middle : np.ndarray
        (B, H, W) float32: disparities above it are in front.
    offsets, weights : np.ndarray
        (n, 2) of rows and columns, and (n,) float32.
    reach : int
    inverse_colour : float
        One over the mean difference of the channels from which a pixel has no vote.
    out : np.ndarray
        (B, 2, H, W) float32.
    """
    height, width = middle.shape[1:]
    sums, unlike = np.empty((4, width), np.float32), np.empty(width, np.float32)
    for task in range(first, last):
        b, y = task // height, task % height
        sums[:2] = 1e-6
        sums[2:] = 0
        for n in range(len(weights)):
            there, begin = y + reach + offsets[n, 0], reach + offsets[n, 1]
            for c in range(3):
                _add_difference(around[b, c, y + reach, reach:], around[b, c, there, begin:], c == 0, unlike)
            _add_votes(unlike, around[b, 3, there, begin:], around[b, 4, there, begin:], middle[b, y], weights[n],
                       inverse_colour / np.float32(3), sums[0], sums[1], sums[2], sums[3])
        for x in range(width):
            out[b, 0, y, x], out[b, 1, y, x] = sums[2, x] / sums[0, x], sums[3, x] / sums[1, x]


@lanes
def _add_difference(own: np.ndarray, other: np.ndarray, anew: bool, total: np.ndarray) -> None:
    for x in range(total.size):
        total[x] = (np.float32(0) if anew else total[x]) + abs(other[x] - own[x])


@lanes
def _add_votes(unlike: np.ndarray, disparity: np.ndarray, trust: np.ndarray, middle: np.ndarray, weight: float, scale: float,
               votes: np.ndarray, sure: np.ndarray, votes_in_front: np.ndarray, sure_in_front: np.ndarray) -> None:
    """One voter of each pixel of a row."""
    for x in range(middle.size):
        alike = np.float32(1) - scale * unlike[x]
        alike = alike if alike > 0 else np.float32(0)
        vote = weight * alike * alike
        sure_vote = vote * trust[x]
        in_front = disparity[x] > middle[x]
        votes[x] += vote
        sure[x] += sure_vote
        votes_in_front[x] += vote if in_front else np.float32(0)
        sure_in_front[x] += sure_vote if in_front else np.float32(0)
