"""Dense stereo matching: census transform and semi-global aggregation along eight paths.

The discrete start of everything else: robust where photometric descent has no gradient to follow, exact to about an
eighth of a pixel after the parabola fit. Sources: Zabih and Woodfill 1994 (census), Hirschmueller 2008 (semi-global
matching).

A pixel's matching cost is the number of bits in which two census words differ: one of a 9 x 7 window, one of the same
window spread over twice the area of the smoothed image, which sees through noise on dark roads. Aggregation runs in two
passes, one from the top and one from the bottom: each does four of the eight paths in one sweep and holds two rows of
path costs, so that the only large arrays are the costs (a byte each) and their two sums (two bytes each). The passes
are independent, one thread each, and all is integer arithmetic: the same bits for any number of threads.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import types
from numba.extending import intrinsic

from variational.jit import parallel, prange, rowwise

CENSUS_ROWS, CENSUS_COLUMNS = 3, 4
"""Half window of the census: 7 rows x 9 columns, 62 comparisons in one 64-bit word."""
BITS = 124
"""Largest matching cost: all bits of both words differ. Two random windows differ in about half of them."""
OUTSIDE_COST = 36
"""Cost of a match outside of the right image: more than a good match (about 20), less than a random one (60), so that
surfaces continue across the left border instead of jumping to a wrong match inside."""
UNREACHABLE = 12000
"""Above any path cost, and still inside 16 bits with a penalty added."""


@dataclass(frozen=True)
class MatchingConfig:
    """Stereo matching by census and semi-global aggregation.

    Parameters
    ----------
    max_disparity : int
        Largest disparity searched, in pixels; 0 finds it by searching a third of the width at a quarter of the size.
    small_step, large_step : int
        Penalties for a change of disparity by one pixel and by more, in census bits; raising them smooths.
    edge_contrast : float
        Intensity step in [0, 1] at which the large penalty has fallen to a half: jumps are cheap at image edges.
    consistency_px : float
        A pixel whose match in the right image matches back farther away than this is unmatched.
    uniqueness : float
        A pixel is unmatched unless its second-best disparity (not a neighbour of the best) costs this much more, in
        bits over the eight paths; textureless areas have no such margin.
    speckle_px : int
        Matched regions of fewer pixels than this are unmatched.
    """

    max_disparity: int = 0
    small_step: int = 24
    large_step: int = 400
    edge_contrast: float = 0.12
    consistency_px: float = 1.0
    uniqueness: float = 40.0
    speckle_px: int = 60


@dataclass(frozen=True, eq=False)
class StereoMatch:
    """Disparity of a left image, with what the matching knows about it.

    Parameters
    ----------
    disparity : np.ndarray
        (H, W) float32, pixels, every pixel filled.
    matched : np.ndarray
        (H, W) bool, True where the match is unique and agrees with the right image's; `disparity` is filled elsewhere.
    words_left, words_right : np.ndarray
        (2, H, W) uint64 census words of the two images, for whoever compares them again.
    max_disparity : int
        The range that was searched.
    """

    disparity: np.ndarray
    matched: np.ndarray
    words_left: np.ndarray
    words_right: np.ndarray
    max_disparity: int


@intrinsic
def _add16(typing_context, a, b):  # type: ignore[no-untyped-def]
    """16-bit addition; numba would widen to 64 bits and lose three quarters of every vector."""
    return types.int16(types.int16, types.int16), lambda c, builder, s, v: builder.add(*v)


@intrinsic
def _sub16(typing_context, a, b):  # type: ignore[no-untyped-def]
    """16-bit subtraction."""
    return types.int16(types.int16, types.int16), lambda c, builder, s, v: builder.sub(*v)


@intrinsic
def _min16(typing_context, a, b):  # type: ignore[no-untyped-def]
    """16-bit minimum."""
    signature = types.int16(types.int16, types.int16)
    return signature, lambda c, builder, s, v: builder.select(builder.icmp_signed("<", *v), *v)


@intrinsic
def popcount(typing_context, word):  # type: ignore[no-untyped-def]
    """Number of set bits of a 64-bit word."""
    return types.int64(types.uint64), lambda c, builder, s, v: builder.ctpop(v[0])


@parallel
def _census(image: np.ndarray, spacing: int, words: np.ndarray) -> None:
    height, width = image.shape
    for y in prange(height):
        words[y] = 0
        for dy in range(-CENSUS_ROWS, CENSUS_ROWS + 1):
            other = image[min(max(y + dy * spacing, 0), height - 1)]
            for dx in range(-CENSUS_COLUMNS, CENSUS_COLUMNS + 1):
                if dx == 0 and dy == 0:
                    continue
                for x in range(width):
                    darker = other[min(max(x + dx * spacing, 0), width - 1)] < image[y, x]
                    words[y, x] = (words[y, x] << np.uint64(1)) | np.uint64(darker)


def census(grey: np.ndarray) -> np.ndarray:
    """Census words of a grey image: fine, and twice as wide on the smoothed image.

    Parameters
    ----------
    grey : np.ndarray
        (H, W) float32. Positions outside take the nearest pixel.

    Returns
    -------
    np.ndarray
        (2, H, W) uint64; one bit a neighbour, set where it is darker than the centre.
    """
    words = np.empty((2, *grey.shape), np.uint64)
    _census(np.ascontiguousarray(grey), 1, words[0])
    _census(cv2.GaussianBlur(grey, (0, 0), 1.0), 2, words[1])
    return words


@parallel
def _matching_costs(left: np.ndarray, right_mirrored: np.ndarray, costs: np.ndarray) -> None:
    """costs (H, W, D): differing bits; OUTSIDE_COST where the match lies outside of the right image."""
    height, width, disparities = costs.shape
    for y in prange(height):
        for x in range(width):
            reach = min(x + 1, disparities)
            mirrored = width - 1 - x
            for d in range(reach):
                costs[y, x, d] = popcount(left[0, y, x] ^ right_mirrored[0, y, mirrored + d]) + popcount(
                    left[1, y, x] ^ right_mirrored[1, y, mirrored + d]
                )
            for d in range(reach, disparities):
                costs[y, x, d] = OUTSIDE_COST


@rowwise
def _step(
    cost: np.ndarray, before: np.ndarray, before_best: int, small: int, large: int, out: np.ndarray, total: np.ndarray
) -> np.int16:
    """One pixel of one path: out = cost + min(same, neighbours + P1, best + P2) - best; returns the new best."""
    jump = _add16(before_best, large)
    best = np.int16(UNREACHABLE)
    for d in range(cost.shape[0]):
        near = _add16(_min16(before[d], before[d + 2]), small)
        value = _add16(cost[d], _sub16(_min16(_min16(before[d + 1], near), jump), before_best))
        out[d + 1] = value
        total[d] = _add16(total[d], value)
        best = _min16(best, value)
    return best


@rowwise
def _start(cost: np.ndarray, out: np.ndarray, total: np.ndarray) -> np.int16:
    """A path's first pixel: its cost alone."""
    best = np.int16(UNREACHABLE)
    for d in range(cost.shape[0]):
        out[d + 1] = cost[d]
        total[d] = _add16(total[d], cost[d])
        best = _min16(best, cost[d])
    return best


@parallel
def _aggregate(costs: np.ndarray, large_x: np.ndarray, large_y: np.ndarray, small: int, totals: np.ndarray) -> None:
    """totals[k] (H, W, D): sums over four paths each, k = 0 from the top left, k = 1 from the bottom right.

    large_x[y, x] is the large penalty between (x - 1, y) and (x, y), large_y[y, x] between (x, y - 1) and (x, y).
    """
    height, width, disparities = costs.shape
    for k in prange(2):
        total = totals[k]
        cost = np.empty((width, disparities), np.int16)
        # Path costs of this row and the one before: (parity, path, x, d + 1), unreachable beyond both ends of d.
        paths = np.full((2, 3, width, disparities + 2), np.int16(UNREACHABLE), np.int16)
        best = np.zeros((2, 3, width), np.int16)
        along = np.full((2, disparities + 2), np.int16(UNREACHABLE), np.int16)
        along_best = np.int16(0)
        step = 1 - 2 * k
        for i in range(height):
            y = i if k == 0 else height - 1 - i
            now, before = i % 2, (i + 1) % 2
            cost[:] = costs[y]
            for j in range(width):
                x = j if k == 0 else width - 1 - j
                row = total[y, x]
                row[:] = 0
                if j == 0:
                    along_best = _start(cost[x], along[0], row)
                else:
                    large = large_x[y, x] if k == 0 else large_x[y, x + 1]
                    along_best = _step(cost[x], along[(j + 1) % 2], along_best, small, large, along[j % 2], row)
                large = large_y[y, x] if k == 0 or i == 0 else large_y[y + 1, x]
                for r in range(3):
                    from_x = x + (r - 1) * step
                    if i == 0 or from_x < 0 or from_x >= width:
                        best[now, r, x] = _start(cost[x], paths[now, r, x], row)
                    else:
                        come_from, least = paths[before, r, from_x], best[before, r, from_x]
                        best[now, r, x] = _step(cost[x], come_from, least, small, large, paths[now, r, x], row)


@parallel
def _select(totals: np.ndarray, disparity: np.ndarray, second_view: np.ndarray, margin: np.ndarray) -> None:
    """Smallest sum with a parabola fit; for the right view the smallest along each pixel's diagonal (-1: none)."""
    _, height, width, disparities = totals.shape
    for y in prange(height):
        right_best = np.full(width, np.int16(32767), np.int16)
        second_view[y] = -1
        row = np.empty(disparities, np.int16)
        for x in range(width):
            best = np.int16(32767)
            for d in range(disparities):
                row[d] = _add16(totals[0, y, x, d], totals[1, y, x, d])
                best = _min16(best, row[d])
            at = 0
            while row[at] != best:
                at += 1
            runner_up = np.int16(32767)
            for d in range(at - 1):
                runner_up = _min16(runner_up, row[d])
            for d in range(at + 2, disparities):
                runner_up = _min16(runner_up, row[d])
            margin[y, x] = np.float32(runner_up) - np.float32(best)
            disparity[y, x] = at
            if 0 < at < disparities - 1:
                below, above = np.float32(row[at - 1]), np.float32(row[at + 1])
                curvature = below + above - np.float32(2) * np.float32(best)
                if curvature > 0:
                    disparity[y, x] = at + (below - above) / (np.float32(2) * curvature)
            for d in range(min(x + 1, disparities)):
                if row[d] < right_best[x - d]:
                    right_best[x - d] = row[d]
                    second_view[y, x - d] = d


@parallel
def _consistent(disparity: np.ndarray, second_view: np.ndarray, tolerance: float, out: np.ndarray) -> None:
    """True where the right view's disparity at the matching pixel agrees."""
    height, width = disparity.shape
    for y in prange(height):
        for x in range(width):
            at = int(np.rint(x - disparity[y, x]))
            out[y, x] = at >= 0 and abs(second_view[y, at] - disparity[y, x]) <= tolerance


def _large_steps(grey: np.ndarray, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Large penalties along x and y, (H, W) int16 each, lowered at intensity edges."""
    penalties = []
    for axis in (1, 0):
        contrast = np.zeros_like(grey)
        step = np.abs(np.diff(grey, axis=axis))
        contrast[(slice(None),) * axis + (slice(1, None),)] = step
        lowered = config.large_step / (1 + contrast / config.edge_contrast)
        penalties.append(np.maximum(lowered, 1.5 * config.small_step).astype(np.int16))
    return penalties[0], penalties[1]


def aggregate(costs: np.ndarray, grey: np.ndarray, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Semi-global aggregation of a cost volume.

    Parameters
    ----------
    costs : np.ndarray
        (H, W, D) uint8, cost of each disparity 0 ... D - 1.
    grey : np.ndarray
        (H, W) float32 in [0, 1], the image whose edges lower the penalties.
    config : MatchingConfig

    Returns
    -------
    disparity : np.ndarray
        (H, W) float32 with sub-pixel fit, unfiltered.
    matched : np.ndarray
        (H, W) bool: unique, consistent with the right view, not a speckle.
    """
    shape = costs.shape[:2]
    totals = np.empty((2, *costs.shape), np.int16)
    _aggregate(costs, *_large_steps(grey, config), np.int16(config.small_step), totals)
    disparity, margin = np.empty(shape, np.float32), np.empty(shape, np.float32)
    second_view, matched = np.empty(shape, np.int16), np.empty(shape, bool)
    _select(totals, disparity, second_view, margin)
    _consistent(disparity, second_view, config.consistency_px, matched)
    matched &= margin >= config.uniqueness
    disparity = cv2.medianBlur(disparity, 5)
    regions = np.where(matched, np.minimum(disparity, 2000) * 16, -16).astype(np.int16)
    cv2.filterSpeckles(regions, -16, config.speckle_px, 16)
    return disparity, regions >= 0


def stereo_costs(words_left: np.ndarray, words_right: np.ndarray, disparities: int) -> np.ndarray:
    """Matching costs (H, W, disparities) uint8 of the left image's pixels, in differing census bits."""
    costs = np.empty((*words_left.shape[1:], disparities), np.uint8)
    _matching_costs(words_left, np.ascontiguousarray(words_right[..., ::-1]), costs)
    return costs


def fill_background(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Unknown pixels take the smaller of the nearest known disparities to the left and right in their row.

    What a left image's pixel hides from the right camera lies behind its neighbour: the background continues. A row
    that knows nothing takes the nearest row that does; where nothing is known at all, the result is zero.
    """
    height, width = disparity.shape
    if not known.any():
        return np.zeros_like(disparity)
    columns = np.arange(width)
    left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    from_left = np.where(left >= 0, np.take_along_axis(disparity, np.maximum(left, 0), 1), np.inf)
    from_right = np.where(right < width, np.take_along_axis(disparity, np.minimum(right, width - 1), 1), np.inf)
    filled = np.minimum(from_left, from_right)
    rows = np.flatnonzero(known.any(axis=1))
    nearest = rows[np.abs(rows[None] - np.arange(height)[:, None]).argmin(axis=1)]
    return np.where(known, disparity, filled[nearest]).astype(np.float32)


def find_max_disparity(left: np.ndarray, right: np.ndarray, config: MatchingConfig) -> int:
    """Range to search at full size, pixels: a margin above the largest disparity found at a quarter of the size."""
    height, width = left.shape
    size = (max(1, width // 4), max(1, height // 4))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    searched = max(2, size[0] // 3)
    costs = stereo_costs(census(small[0]), census(small[1]), searched)
    disparity, matched = aggregate(costs, small[0], config)
    found = np.percentile(disparity[matched], 99.8) if matched.any() else searched / 2
    return int(min(width - 1, 16 * np.ceil((4 * found + 8) / 16)))


def match(left: np.ndarray, right: np.ndarray, config: MatchingConfig) -> StereoMatch:
    """Match a rectified pair.

    Parameters
    ----------
    left, right : np.ndarray
        (H, W) float32 grey images in [0, 1].
    config : MatchingConfig

    Returns
    -------
    StereoMatch
        Disparity of the left image.
    """
    searched = config.max_disparity or find_max_disparity(left, right, config)
    words_left, words_right = census(left), census(right)
    costs = stereo_costs(words_left, words_right, max(2, min(searched + 1, left.shape[1])))
    disparity, matched = aggregate(costs, left, config)
    filled = cv2.medianBlur(fill_background(disparity, matched), 5)
    return StereoMatch(filled, matched, words_left, words_right, searched)
