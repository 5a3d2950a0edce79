"""Fusion: a discrete choice per pixel between candidate motions.

Candidates are whole motion fields, measured flow or rigid proposals. A candidate's cost at a pixel is how badly the
census words of left1 agree with those of left2 and right2 where it leads, averaged over a small window; one that leads
out of the image costs a constant. Measured flow was fitted to the images pixel by pixel; a rigid motion was not, so it
may lead one pixel beside. Neighbours pay for a difference of motion, less across jumps of disparity and edges of the
image. The labelling minimises this along a tree at every pixel (rows first, then the column through it: the "simple tree"
of Bleyer and Gelautz 2008), which dynamic programming does exactly in four sweeps.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from variational.census import BITS, popcount
from variational.jit import inlined, over_bands, over_rows, rowwise, scalar, side_by_side

STRIP = 192
"""Columns that a chain works on at a time: their candidates and costs of two rows stay in the nearest cache, and what
a slice costs to make is shared by enough of them."""
FORBIDDEN = 100.0
"""Cost of a candidate that does not exist at a pixel: finite, so that sums stay finite."""


@dataclass(frozen=True)
class FusionConfig:
    """Choice between motions.

    Parameters
    ----------
    truncation : float
        Share of differing census bits from which a comparison says no more than "different".
    outside_cost : float
        Cost in [0, 1] of leading out of the image.
    good_cost : float
        A rigid motion that costs more at a pixel is compared with the pixels around the place where it leads, too; the
        best counts.
    window : int
        Side of the window that costs are averaged over, pixels, odd.
    motion_scale_px : float
        Difference of motion between neighbours at which they pay the full price.
    jump_cost : float
        That price, where neither disparity nor image has an edge.
    disparity_edge_px, intensity_edge : float
        Jumps at which the price has fallen to a third.
    measured_prior, object_prior : float
        Added to the cost of measured flow, and of a moving object's motion where it was not found: what is rigid and still,
        or was seen to move so, needs no excuse.
    """

    truncation: float = 0.4
    outside_cost: float = 0.4
    good_cost: float = 0.2
    window: int = 7
    motion_scale_px: float = 10.0
    jump_cost: float = 3.0
    disparity_edge_px: float = 1.5
    intensity_edge: float = 0.08
    measured_prior: float = 0.2
    object_prior: float = 0.1


@scalar
def _disagreement(
    words_left1: np.ndarray, words_left2: np.ndarray, words_right2: np.ndarray, y: int, x: int, at_y: int, at_x: int,
    right_x: int, largest: np.float32,
) -> float:  # fmt: skip
    """Share of `largest` by which the words of left1 at (y, x) differ from those at time 2; right_x: from left2 to right2."""
    bits = popcount(words_left1[0, y, x] ^ words_left2[0, at_y, at_x])
    bits += popcount(words_left1[1, y, x] ^ words_left2[1, at_y, at_x])
    cost = min(bits / largest, 1.0)
    if 0 <= at_x + right_x < words_right2.shape[2]:
        bits = popcount(words_left1[0, y, x] ^ words_right2[0, at_y, at_x + right_x])
        bits += popcount(words_left1[1, y, x] ^ words_right2[1, at_y, at_x + right_x])
        cost = 0.5 * (cost + min(bits / largest, 1.0))
    return cost


@rowwise
def _costs(
    first: int, last: int, candidates: np.ndarray, disparity: np.ndarray, words_left1: np.ndarray,
    words_left2: np.ndarray, words_right2: np.ndarray, largest: float, outside: float, good: float,
    costs: np.ndarray,
) -> None:  # fmt: skip
    count, _, height, width = candidates.shape
    for y in range(first, last):
        for k in range(count):
            for x in range(width):
                u, v = candidates[k, 1, y, x], candidates[k, 2, y, x]
                if not np.isfinite(u):
                    costs[k, y, x] = FORBIDDEN
                    continue
                to_x, to_y = int(np.rint(x + u)), int(np.rint(y + v))
                if to_x < 0 or to_x >= width or to_y < 0 or to_y >= height:
                    costs[k, y, x] = outside
                    continue
                right_x = int(np.rint(x + u - disparity[y, x] - candidates[k, 0, y, x])) - to_x
                least = np.float32(1.0)
                for beside in range(1 if k == 0 else 9):  # the place itself first
                    at_x, at_y = to_x + (beside + 1) % 3 - 1, to_y + (beside // 3 + 1) % 3 - 1
                    if least <= good:
                        break
                    if at_x < 0 or at_x >= width or at_y < 0 or at_y >= height:
                        continue
                    cost = _disagreement(words_left1, words_left2, words_right2, y, x, at_y, at_x, right_x, largest)
                    least = min(least, cost)
                costs[k, y, x] = least


@rowwise
def _costs_of_ends(
    first: int, last: int, places: np.ndarray, ends: np.ndarray, words_left1: np.ndarray, words_left2: np.ndarray,
    words_right2: np.ndarray, largest: np.float32, costs: np.ndarray,
) -> None:  # fmt: skip
    height, width = words_left1.shape[1:]
    for n in range(first, last):
        costs[n] = np.nan
        to_x, to_y = np.rint(ends[n, 0]), np.rint(ends[n, 1])
        if to_x >= 0 and to_x < width and to_y >= 0 and to_y < height and np.isfinite(ends[n, 2]):
            right_x = int(np.rint(ends[n, 0] - ends[n, 2]) - to_x)
            costs[n] = 1.0
            for at_y in range(max(int(to_y) - 1, 0), min(int(to_y) + 2, height)):
                for at_x in range(max(int(to_x) - 1, 0), min(int(to_x) + 2, width)):
                    x, y = places[n, 0], places[n, 1]
                    cost = _disagreement(words_left1, words_left2, words_right2, y, x, at_y, at_x, right_x, largest)
                    costs[n] = min(costs[n], cost)


@inlined
def _least_of_two(
    motion: np.ndarray, k: int, motion_from: np.ndarray, m: int, price: np.ndarray, before: np.ndarray, message: np.ndarray
) -> None:
    """message[k] <- its minimum with the costs of label m before plus those of the step from m to k."""
    for x in range(price.size):
        difference = abs(motion[k, 0, x] - motion_from[m, 0, x]) + abs(motion[k, 1, x] - motion_from[m, 1, x])
        difference += abs(motion[k, 2, x] - motion_from[m, 2, x])
        cost = before[m, x] + price[x] * difference
        message[k, x] = cost if cost < message[k, x] else message[k, x]  # NaN: no such candidate, full price


@rowwise
def _pass_message(
    motion: np.ndarray, motion_from: np.ndarray, price: np.ndarray, price_per_px: np.ndarray, before: np.ndarray,
    least: np.ndarray, message: np.ndarray,
) -> None:  # fmt: skip
    """message (K, X): least cost of the chains up to the row before, given each label here, less the least of all.

    motion, motion_from (K, 3, X); before (K, X): costs of the chains that end in the row before.
    """
    count, _, width = motion.shape
    for x in range(width):
        least[x] = before[0, x]
    for k in range(1, count):
        for x in range(width):
            least[x] = min(least[x], before[k, x])
    for k in range(count):
        for x in range(width):
            message[k, x] = least[x] + price[x]
        for m in range(count):
            _least_of_two(motion, k, motion_from, m, price_per_px, before, message)
        for x in range(width):
            message[k, x] -= least[x]


@rowwise
def _add_costs(costs: np.ndarray, message: np.ndarray, upwards: int, before: np.ndarray, out: np.ndarray) -> None:
    """One label of one row of a strip: the chain's cost up to here, and what this direction adds to the result."""
    for x in range(message.size):
        before[x] = message[x] + costs[x]
    if upwards:
        for x in range(message.size):
            out[x] += before[x]
    else:
        for x in range(message.size):
            out[x] = message[x]


@rowwise
def _take_strip(candidates: np.ndarray, y: int, begin: int, motion: np.ndarray) -> None:
    """motion (K, 3, X): row y of the candidates from column `begin` on."""
    count, channels, width = motion.shape
    for k in range(count):
        for i in range(channels):
            for x in range(width):
                motion[k, i, x] = candidates[k, i, y, begin + x]


@rowwise
def _chains(
    first: int, last: int, candidates: np.ndarray, costs: np.ndarray, price: np.ndarray, inverse_scale: np.float32,
    out: np.ndarray,
) -> None:  # fmt: skip
    """out (K, H, W): for every label of every pixel, the least cost of its whole column that has this label there.

    Columns `first` to `last`, a strip. price (H, W): full price between a pixel and the one above it. Exact: dynamic
    programming down and up.
    """
    count, height, size = costs.shape[0], costs.shape[1], last - first
    # Copies of the strip's part of two rows: a view of the planes has strides that the compiler cannot know.
    motions = np.empty((2, count, 3, size), np.float32)
    labels, rows = np.empty((2, count, size), np.float32), np.empty((3, size), np.float32)
    before, message, step, step_per_px, least = labels[0], labels[1], rows[0], rows[1], rows[2]
    for upwards in range(2):
        for i in range(height):
            y = height - 1 - i if upwards else i
            now = i % 2
            _take_strip(candidates, y, first, motions[now])
            if i > 0:
                for x in range(size):
                    step[x] = price[y + upwards, first + x]
                    step_per_px[x] = step[x] * inverse_scale
                _pass_message(motions[now], motions[1 - now], step, step_per_px, before, least, message)
            else:
                message[:] = 0
            for k in range(count):
                _add_costs(costs[k, y, first:last], message[k], upwards, before[k], out[k, y, first:last])


def _strips(columns: int) -> list[int]:
    """Where strips of columns begin and end."""
    return [*range(0, columns, STRIP), columns]


def _transposed(planes: np.ndarray) -> np.ndarray:
    """(..., W, H) copy of (..., H, W) planes."""
    height, width = planes.shape[-2:]
    turned = np.empty((*planes.shape[:-2], width, height), planes.dtype)
    flat, flat_turned = planes.reshape(-1, height, width), turned.reshape(-1, width, height)

    def turn(first: int, last: int) -> None:
        for k in range(first, last):
            cv2.transpose(flat[k], dst=flat_turned[k])

    over_bands(turn, range(len(flat) + 1))
    return turned


@rowwise
def _cheapest(first: int, last: int, costs: np.ndarray, labels: np.ndarray) -> None:
    """labels (H, W): the first label of least cost."""
    count, _, width = costs.shape
    for y in range(first, last):
        for x in range(width):
            best = np.int32(0)
            for k in range(1, count):
                best = np.int32(k) if costs[k, y, x] < costs[best, y, x] else best
            labels[y, x] = best


def _price(disparity: np.ndarray, grey: np.ndarray, axis: int, config: FusionConfig) -> np.ndarray:
    """(H, W) float32 price of a jump between each pixel and the one before it along `axis`."""
    step = np.exp(-np.abs(np.diff(disparity, axis=axis)) / config.disparity_edge_px)
    contrast = np.exp(-np.abs(np.diff(grey, axis=axis)) / config.intensity_edge)
    price = np.zeros(grey.shape, np.float32)
    price[(slice(None),) * axis + (slice(1, None),)] = config.jump_cost * (0.05 + step * (0.3 + 0.7 * contrast))
    return price


def motion_costs(
    candidates: np.ndarray, disparity: np.ndarray, words: tuple[np.ndarray, np.ndarray, np.ndarray],
    config: FusionConfig,
) -> np.ndarray:  # fmt: skip
    """Cost in [0, 1] of each candidate at each pixel.

    Parameters
    ----------
    candidates : np.ndarray
        (K, 3, H, W) float32: disparity change, u, v; NaN where a candidate does not exist. The measured motion first.
    disparity : np.ndarray
        (H, W) at time 1.
    words : tuple of three np.ndarray
        (2, H, W) uint64 census words of left1, left2 and right2.

    Returns
    -------
    np.ndarray
        (K, H, W) float32; FORBIDDEN where a candidate does not exist.
    """
    costs = np.empty((len(candidates), *disparity.shape), np.float32)
    largest, outside, good = (np.float32(n) for n in (config.truncation * BITS, config.outside_cost, config.good_cost))
    over_rows(_costs, len(disparity), candidates, disparity, *words, largest, outside, good, costs)

    def average(first: int, last: int) -> None:
        for k in range(first, last):
            exists = np.isfinite(candidates[k, 1])
            costs[k] = np.where(exists, cv2.blur(np.minimum(costs[k], 1), (config.window, config.window)), FORBIDDEN)

    over_bands(average, range(len(costs) + 1))
    return costs


def costs_of_ends(
    places: np.ndarray, ends: np.ndarray, words: tuple[np.ndarray, np.ndarray, np.ndarray], config: FusionConfig
) -> np.ndarray:
    """Cost in [0, 1] of single pixels' motions, each the least of the place where it leads and the eight around that.

    Parameters
    ----------
    places : np.ndarray
        (N, 2) int, x and y in left1.
    ends : np.ndarray
        (N, 3) x, y and disparity at time 2.
    words : tuple of three np.ndarray
        See `motion_costs`.

    Returns
    -------
    np.ndarray
        (N,) float32; NaN where a motion leads out of the image.
    """
    costs = np.empty(len(places), np.float32)
    over_rows(_costs_of_ends, len(places), places, ends, *words, np.float32(config.truncation * BITS), costs)
    return costs


def choose(
    candidates: np.ndarray, costs: np.ndarray, disparity: np.ndarray, grey: np.ndarray, config: FusionConfig
) -> np.ndarray:
    """Label of the best candidate at each pixel.

    Parameters
    ----------
    candidates, costs : np.ndarray
        (K, 3, H, W) and (K, H, W), see `motion_costs`, priors added.
    disparity, grey : np.ndarray
        (H, W), whose edges make jumps cheap.

    Returns
    -------
    np.ndarray
        (H, W) int, in 0 ... K - 1.
    """
    inverse_scale = np.float32(1 / config.motion_scale_px)
    turned = _transposed(costs)
    rows, trees = np.empty_like(turned), np.empty_like(costs)
    height, width = grey.shape
    along, down = side_by_side(*(partial(_price, disparity, grey, axis, config) for axis in (1, 0)))
    over_bands(_chains, _strips(height), _transposed(candidates), turned, cv2.transpose(along), inverse_scale, rows)
    over_bands(_chains, _strips(width), candidates, _transposed(rows), down, inverse_scale, trees)
    labels = np.empty(grey.shape, np.int32)
    over_rows(_cheapest, len(labels), trees, labels)
    return labels
