"""Dense stereo matching: semi-global aggregation of census costs along eight paths.

The discrete start of everything else: robust where photometric descent has no gradient to follow, exact to about an
eighth of a pixel after the parabola fit. Source: Hirschmueller 2008, doi:10.1109/TPAMI.2007.1166.

A pixel's matching cost is the number of bits in which two census words differ (variational.census). Aggregation runs in
two sweeps, one from the top and one from the bottom, a thread each. A sweep does four of the eight paths at once and
holds two rows of path costs; the two meet in the middle, and each then completes the sums of the other and selects
while a row is still in the cache. The only large arrays are the costs, a byte, and the sums, two bytes a pixel and
disparity. All is integer arithmetic: the same bits for any number of threads.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import types
from numba.extending import intrinsic

from variational.census import census, stereo_costs
from variational.jit import inlined, over_bands, over_rows, rowwise, scalar

EVIDENCE_SIDE = 9
"""Side of the window that evidence is averaged over: about that of a census word."""
UNREACHABLE = 12000
"""Above any path cost, and still inside 16 bits with a penalty added."""


@dataclass(frozen=True)
class MatchingConfig:
    """Stereo matching by census and semi-global aggregation.

    Parameters
    ----------
    max_disparity : int
        Largest disparity searched, in pixels, which counts as no match itself; 0 finds it by searching a third of the width
        at a quarter of the size.
    small_step, large_step : int
        Penalties for a change of disparity by one pixel and by more, in census bits; raising them smooths.
    edge_contrast : float
        Intensity step in [0, 1] at which the large penalty has fallen to a half: jumps are cheap at image edges.
    consistency_px : float
        A pixel whose match in the right image matches back farther away than this is unmatched.
    uniqueness : float
        A pixel is unmatched unless its second-best disparity (not a neighbour of the best) costs this much more, in
        bits over the eight paths; textureless areas have no such margin.
    evidence : float
        A pixel is unmatched unless the costs around it (9 x 9 pixels, each at its own disparity) lie this many bits below
        those of the average disparity: what has no texture of its own only takes over what its neighbours have.
    speckle_px : int
        Matched regions of fewer pixels than this are unmatched.
    overlook : float
        Differences of intensity up to this, in [0, 1], tell the matching nothing. The solver raises it to the amplitude of
        a pattern that all images share (variational.shared_pattern).
    """

    max_disparity: int = 0
    small_step: int = 24
    large_step: int = 400
    edge_contrast: float = 0.12
    consistency_px: float = 1.0
    uniqueness: float = 40.0
    evidence: float = 3.0
    speckle_px: int = 60
    overlook: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.overlook < 1:
            raise ValueError(f"MatchingConfig.overlook must lie in 0 ... 1, got {self.overlook}")


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


@scalar
def _path_cost(here: int, before: np.ndarray, x: int, d: int, small: int, jump: int, best: int) -> int:
    """here + min(before, neighbours before + small, jump) - best; rows of `before` begin at disparity -1."""
    near = _add16(_min16(before[x, d], before[x, d + 2]), small)
    return _add16(here, _sub16(_min16(_min16(before[x, d + 1], near), jump), best))


@inlined
def _extend(
    costs: np.ndarray, x: int, step: int, parity: int, along: np.ndarray, before1: np.ndarray, before2: np.ndarray,
    before3: np.ndarray, best0: int, best1: int, best2: int, best3: int, small: int, large_x: int, large_y: int,
    now1: np.ndarray, now2: np.ndarray, now3: np.ndarray, totals: np.ndarray,
) -> tuple[np.int16, np.int16, np.int16, np.int16]:  # fmt: skip
    """Pixel x of four paths, the first along the row: adds their costs to its totals, returns their new bests.

    Whole rows are handed over and indexed in here: a slice for each pixel would cost a reference count, which takes as
    long as a dozen disparities.
    """
    jump0, jump1 = _add16(best0, large_x), _add16(best1, large_y)
    jump2, jump3 = _add16(best2, large_y), _add16(best3, large_y)
    least0 = least1 = least2 = least3 = np.int16(UNREACHABLE)
    at, behind, ahead = x + 1, x + 1 - step, x + 1 + step
    for d in range(costs.shape[1]):
        here = np.int16(costs[x, d])
        value0 = _path_cost(here, along, parity, d, small, jump0, best0)
        value1 = _path_cost(here, before1, behind, d, small, jump1, best1)
        value2 = _path_cost(here, before2, at, d, small, jump2, best2)
        value3 = _path_cost(here, before3, ahead, d, small, jump3, best3)
        along[1 - parity, d + 1], now1[at, d + 1], now2[at, d + 1], now3[at, d + 1] = value0, value1, value2, value3
        least0, least1 = _min16(least0, value0), _min16(least1, value1)
        least2, least3 = _min16(least2, value2), _min16(least3, value3)
        totals[x, d] = _add16(totals[x, d], _add16(_add16(value0, value1), _add16(value2, value3)))
    return least0, least1, least2, least3


@rowwise
def _sweep_row(
    costs: np.ndarray, large_x: np.ndarray, large_y: np.ndarray, small: int, step: int, before1: np.ndarray,
    before2: np.ndarray, before3: np.ndarray, before_best: np.ndarray, now1: np.ndarray, now2: np.ndarray,
    now3: np.ndarray, now_best: np.ndarray, along: np.ndarray, totals: np.ndarray,
) -> None:  # fmt: skip
    """Add one row's four path costs to totals (W, D); step = 1 comes from the top left, -1 from the bottom right.

    before*, now* (W + 2, D + 2): path costs of the previous row and of this one. A path begins where the one before it
    is all zeros: then its cost is the pixel's own. Columns 0 and W + 1 stay zero for that. along (2, D + 2): the path
    along the row, of the pixel before and of this one in turn.
    """
    width = costs.shape[0]
    best = np.int16(0)
    along[0, 1:-1] = 0
    for j in range(width):
        x = j if step == 1 else width - 1 - j
        at, behind, ahead = x + 1, x + 1 - step, x + 1 + step
        large = large_x[x if step == 1 else x + 1]
        best1, best2, best3 = before_best[behind, 0], before_best[at, 1], before_best[ahead, 2]
        best, now_best[at, 0], now_best[at, 1], now_best[at, 2] = _extend(
            costs, x, step, j % 2, along, before1, before2, before3, best, best1, best2, best3, small, large, large_y[x],
            now1, now2, now3, totals,
        )  # fmt: skip


@rowwise
def _select_row(
    totals: np.ndarray, tolerance: float, uniqueness: float, right_best: np.ndarray, right_at: np.ndarray,
    disparity: np.ndarray, matched: np.ndarray,
) -> None:  # fmt: skip
    """Smallest total of each pixel of a row, with a parabola fit, and whether it is unique and the right view agrees.

    The range's end is no match: whether the next disparity would cost less was not asked, and a white sky goes there.

    right_best, right_at (W + D): room for the right view, from its right end: the smallest total on the diagonal of
    each of its pixels, and its disparity. Overwrites totals (W, D).
    """
    width, disparities = totals.shape
    right_best[:], right_at[:] = np.int16(32767), np.int16(-1)
    for x in range(width):
        row = totals[x]
        begin = width - 1 - x
        diagonal_best, diagonal_at = right_best[begin : begin + disparities], right_at[begin : begin + disparities]
        best = np.int16(32767)
        for d in range(disparities):
            best = _min16(best, row[d])
            better = row[d] < diagonal_best[d]
            diagonal_at[d] = np.int16(d) if better else diagonal_at[d]
            diagonal_best[d] = _min16(diagonal_best[d], row[d])
        at = 0
        while row[at] != best:
            at += 1
        disparity[x] = at
        if 0 < at < disparities - 1:
            below, above = np.float32(row[at - 1]), np.float32(row[at + 1])
            curvature = below + above - np.float32(2) * np.float32(best)
            if curvature > 0:
                disparity[x] = at + (below - above) / (np.float32(2) * curvature)
        row[max(at - 1, 0) : at + 2] = np.int16(32767)
        runner_up = np.int16(32767)
        for d in range(disparities):
            runner_up = _min16(runner_up, row[d])
        matched[x] = at < disparities - 1 and np.float32(runner_up) - np.float32(best) >= uniqueness
    for x in range(width):
        at = int(np.rint(x - disparity[x]))
        agrees = at >= 0 and abs(right_at[width - 1 - at] - disparity[x]) <= tolerance
        matched[x] = matched[x] and agrees


@rowwise
def _sweep(
    first: int, last: int, half: int, costs: np.ndarray, large_x: np.ndarray, large_y: np.ndarray, small: int,
    tolerance: float, uniqueness: float, paths: np.ndarray, best: np.ndarray, along: np.ndarray, right: np.ndarray,
    totals: np.ndarray, disparity: np.ndarray, matched: np.ndarray,
) -> None:  # fmt: skip
    """One half of sweep k, for k = `first` to `last`; k = 0 goes from the top left, k = 1 from the bottom right.

    A sweep leaves its sums in `totals` (H, W, D), zero at first, on the half that it comes to first, and on the other
    half completes those of its opposite and selects. See :func:`_aggregate` for the other arrays.
    """
    height = costs.shape[0]
    for k in range(first, last):
        meeting = height // 2 if k == 0 else height - height // 2
        for i in range(half * meeting, meeting if half == 0 else height):
            y = i if k == 0 else height - 1 - i
            now, before = i % 2, (i + 1) % 2
            old, new = paths[k, before], paths[k, now]
            _sweep_row(
                costs[y], large_x[y], large_y[y + k], small, 1 - 2 * k, old[0], old[1], old[2], best[k, before],
                new[0], new[1], new[2], best[k, now], along[k], totals[y],
            )  # fmt: skip
            if half == 1:
                _select_row(totals[y], tolerance, uniqueness, right[k, 0], right[k, 1], disparity[y], matched[y])


def _large_steps(grey: np.ndarray, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Large penalties along x (H, W + 1) and y (H + 1, W), int16, lowered at intensity edges; see _aggregate."""
    penalties = []
    for axis in (1, 0):
        step = np.abs(np.diff(grey, axis=axis, prepend=np.float32(0), append=np.float32(0)))
        lowered = config.large_step / (1 + step / np.float32(config.edge_contrast))
        penalties.append(np.maximum(lowered, np.float32(1.5 * config.small_step)).astype(np.int16))
    return penalties[0], penalties[1]


def _aggregate(costs: np.ndarray, grey: np.ndarray, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Both sweeps: disparity and matched of :func:`aggregate`, but for its median and its speckles."""
    (_, width, disparities), small = costs.shape, np.int16(config.small_step)
    totals = np.zeros(costs.shape, np.int16)
    disparity, matched = np.empty(costs.shape[:2], np.float32), np.empty(costs.shape[:2], bool)
    tolerance, uniqueness = np.float32(config.consistency_px), np.float32(config.uniqueness)
    # Penalties between (x - 1, y) and (x, y), and between (x, y - 1) and (x, y); for the first step of k = 1, one more.
    large_x, large_y = _large_steps(grey, config)
    # Path costs of two rows: (k, parity, path, x + 1, d + 1), unreachable beyond both ends of d, zero before the start.
    paths = np.full((2, 2, 3, width + 2, disparities + 2), UNREACHABLE, np.int16)
    paths[..., 1:-1] = 0
    best = np.zeros((2, 2, width + 2, 3), np.int16)
    along = np.full((2, 2, disparities + 2), UNREACHABLE, np.int16)
    right = np.empty((2, 2, width + disparities), np.int16)
    for half in range(2):
        over_bands(
            _sweep, range(3), half, costs, large_x, large_y, small, tolerance, uniqueness, paths, best, along, right, totals,
            disparity, matched,
        )  # fmt: skip
    return disparity, matched


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
        (H, W) float32 with sub-pixel fit, after a median over 5 x 5.
    matched : np.ndarray
        (H, W) bool: unique, consistent with the right view, not a speckle.
    """
    disparity, matched = _aggregate(costs, grey, config)
    disparity = cv2.medianBlur(disparity, 5)
    regions = np.where(matched, np.minimum(disparity, 2000) * 16, -16).astype(np.int16)
    cv2.filterSpeckles(regions, -16, config.speckle_px, 16)
    return disparity, regions >= 0


@rowwise
def _evidence(first: int, last: int, costs: np.ndarray, disparity: np.ndarray, evidence: np.ndarray) -> None:
    """evidence (H, W): by how many bits the cost at each pixel's disparity lies below the mean over all disparities."""
    width, disparities = costs.shape[1:]
    for y in range(first, last):
        for x in range(width):
            row, total = costs[y, x], np.int32(0)
            for d in range(disparities):
                total += np.int32(row[d])
            at = min(max(int(np.rint(disparity[y, x])), 0), disparities - 1)
            evidence[y, x] = np.float32(total) / np.float32(disparities) - np.float32(row[at])


def has_evidence(costs: np.ndarray, disparity: np.ndarray, least: float) -> np.ndarray:
    """Where the costs around a pixel speak for the disparities there; see `MatchingConfig.evidence`.

    Parameters
    ----------
    costs : np.ndarray
        (H, W, D) uint8, cost of each disparity 0 ... D - 1.
    disparity : np.ndarray
        (H, W) float32, pixels.
    least : float
        Bits.

    Returns
    -------
    np.ndarray
        (H, W) bool.
    """
    evidence = np.empty(disparity.shape, np.float32)
    over_rows(_evidence, len(costs), costs, disparity, evidence)
    around: np.ndarray = cv2.blur(evidence, (EVIDENCE_SIDE, EVIDENCE_SIDE)) >= least
    return around


@rowwise
def _fill_rows(first: int, last: int, disparity: np.ndarray, known: np.ndarray, filled: np.ndarray) -> None:
    width = disparity.shape[1]
    for y in range(first, last):
        nearest = np.float32(np.inf)
        for x in range(width):
            nearest = disparity[y, x] if known[y, x] else nearest
            filled[y, x] = nearest
        nearest = np.float32(np.inf)
        for x in range(width - 1, -1, -1):
            nearest = disparity[y, x] if known[y, x] else nearest
            filled[y, x] = min(filled[y, x], nearest)


def fill_background(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Unknown pixels take the smaller of the nearest known disparities to the left and right in their row.

    What a left image's pixel hides from the right camera lies behind its neighbour: the background continues. A row
    that knows nothing takes the nearest row that does; where nothing is known at all, the result is zero.
    """
    if not known.any():
        return np.zeros_like(disparity)
    filled = np.empty_like(disparity)
    over_rows(_fill_rows, len(filled), disparity, known, filled)
    full, empty = np.flatnonzero(known.any(axis=1)), np.flatnonzero(~known.any(axis=1))
    filled[empty] = filled[full[np.abs(full[None] - empty[:, None]).argmin(axis=1)]]
    return filled


def find_max_disparity(left: np.ndarray, right: np.ndarray, config: MatchingConfig) -> int:
    """Range to search at full size, pixels: a margin above the largest disparity found at a quarter of the size."""
    height, width = left.shape
    size = (max(1, width // 4), max(1, height // 4))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    searched = max(2, size[0] // 3)
    costs = stereo_costs(census(small[0]), census(small[1]), searched)
    disparity, matched = aggregate(costs, small[0], config)
    found = np.percentile(disparity[matched], 99.8) if matched.any() else searched / 2
    return int(min(width, 16 * np.ceil((4 * found + 9) / 16)) - 1)  # so that the disparities fill whole vectors


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
    words_left, words_right = census(left, config.overlook), census(right, config.overlook)
    costs = stereo_costs(words_left, words_right, max(2, min(searched + 1, left.shape[1])))
    disparity, matched = aggregate(costs, left, config)
    matched &= has_evidence(costs, disparity, config.evidence)
    filled = cv2.medianBlur(fill_background(disparity, matched), 5)
    return StereoMatch(filled, matched, words_left, words_right, searched)
