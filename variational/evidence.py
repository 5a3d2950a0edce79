"""What the second time knows about unmatched disparities.

A pixel that the right camera does not see, or cannot tell, may be seen well at time 2: with the rigid motion of its
surroundings every disparity predicts a place in left2 and right2 to compare with. The matching costs of such pixels are
written anew, and the same semi-global aggregation that matched the pair fills them in from the matched pixels around:

* matched pixels are anchors, they only pay for leaving their disparity;
* stereo: a disparity that would put the pixel behind a matched one is hidden and costs what a random match costs; one
  that would put it in front contradicts what the right camera sees, and costs more;
* time 2: differing census bits against left2 and right2, where the motion leads inside;
* background: a truncated pull towards the row's background (matching.fill_background).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from variational.census import popcount, write_matching_costs
from variational.jit import over_rows, rowwise, scalar
from variational.matching import MatchingConfig, StereoMatch, aggregate


@dataclass(frozen=True)
class EvidenceConfig:
    """Filling of unmatched disparities; costs are in census bits, of which a match has 124.

    Parameters
    ----------
    fill : bool
        False keeps what the matching filled in, and the motions that were chosen first: faster, less accurate.
    anchor_per_px : float
        What a matched pixel pays for each pixel of deviation.
    hidden_cost, contradicted_cost : float
        Cost of lying behind, and least cost of lying in front of, what the right camera sees.
    time_weight : float
        Weight of the comparison with time 2; 0 leaves it out.
    unknown_cost : float
        That comparison's cost where the motion leads out of the image or is not known.
    background_per_px, background_most : float
        Truncated pull towards the background.
    step_px : int
        Disparities that are compared lie so far apart; the best is fitted between them. What is filled in is known to about
        two pixels at best.
    small_step : int
        Penalty for a change of disparity by one step; larger than for matching, since here there is less to go by.
    """

    fill: bool = True
    anchor_per_px: float = 30.0
    hidden_cost: float = 60.0
    contradicted_cost: float = 90.0
    time_weight: float = 2.0
    unknown_cost: float = 55.0
    background_per_px: float = 6.0
    background_most: float = 30.0
    step_px: int = 2
    small_step: int = 100

    def __post_init__(self) -> None:
        if self.step_px < 1:
            raise ValueError(f"EvidenceConfig.step_px must be at least 1, got {self.step_px}")


@rowwise
def _front(first: int, last: int, disparity: np.ndarray, matched: np.ndarray, front: np.ndarray) -> None:
    """front (H, W + D): largest matched disparity that lands on each pixel of the right image, -1 where none does.

    From the image's right end, as the matching costs go through it; the last D columns lie outside.
    """
    width = disparity.shape[1]
    for y in range(first, last):
        front[y] = -1
        for x in range(width):
            if matched[y, x]:
                at = x - disparity[y, x]
                for to_x in (int(np.floor(at)), int(np.ceil(at))):
                    if to_x >= 0 and disparity[y, x] > front[y, width - 1 - to_x]:
                        front[y, width - 1 - to_x] = disparity[y, x]


@scalar
def _inside(position: np.float32, size: np.int32) -> np.int32:
    """The pixel nearest to a position, in the image whatever the position is."""
    nearest = np.floor(position + np.float32(0.5))
    last = np.float32(size - 1)
    nearest = nearest if nearest > 0 else np.float32(0)
    return np.int32(nearest if nearest < last else last)


@rowwise
def _add_evidence(
    row: np.ndarray, front: np.ndarray, known: np.float32, fine: np.uint64, wide: np.uint64, fine_left: np.ndarray,
    wide_left: np.ndarray, fine_right: np.ndarray, wide_right: np.ndarray, width: np.int32, height: np.int32,
    start: tuple, per_px: tuple, step_px: np.int32, hidden: np.float32, contradicted: np.float32, time_weight: np.float32,
    unknown: np.float32, pull: np.float32, pull_most: np.float32,
) -> None:  # fmt: skip
    """Turn one pixel's matching costs (D,) into costs of all evidence.

    fine_*, wide_* (H * W,): words at time 2. start, per_px: the place (x, y, disparity, 1) at time 2 is, but for its
    scale, start + disparity * per_px. No branches and all in float32, so that disparities are worked on in vectors.
    """
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    margin, most = np.float32(1.5), np.float32(255)
    right_end, bottom, beyond = np.float32(width - 1), np.float32(height - 1), np.float32(width) - half
    for d in range(row.size):
        disparity = step_px * np.int32(d)
        fd, stereo, seen = np.float32(disparity), np.float32(row[d]), front[np.uintp(disparity)]
        nearer = stereo if stereo > contradicted else contradicted
        compared = hidden if fd < seen - margin else (nearer if fd > seen + margin else stereo)
        stereo = compared if seen >= zero else stereo
        scale = start[3] + per_px[3] * fd
        ahead = scale > zero
        inverse = one / (scale if ahead else one)
        to_x, to_y = (start[0] + per_px[0] * fd) * inverse, (start[1] + per_px[1] * fd) * inverse
        in_right = to_x - (start[2] + per_px[2] * fd) * inverse
        begin = _inside(to_y, height) * width
        at, at_right = begin + _inside(to_x, width), begin + _inside(in_right, width)
        bits = np.float32(np.int32(popcount(fine ^ fine_left[at]) + popcount(wide ^ wide_left[at])))
        bits_right = np.float32(np.int32(popcount(fine ^ fine_right[at_right]) + popcount(wide ^ wide_right[at_right])))
        both = (in_right >= -half) & (in_right < beyond)
        bits = half * (bits + bits_right) if both else bits
        inside = (to_x >= zero) & (to_x <= right_end) & (to_y >= zero) & (to_y <= bottom) & ahead
        away = abs(fd - known) * pull
        cost = stereo + time_weight * (bits if inside else unknown) + (away if away < pull_most else pull_most)
        row[d] = np.uint8(np.int32(cost if cost < most else most))


@rowwise
def _write_costs(
    first: int, last: int, disparity: np.ndarray, matched: np.ndarray, front: np.ndarray, words_left1: np.ndarray,
    right1_mirrored: np.ndarray, words_left2: np.ndarray, words_right2: np.ndarray, labels: np.ndarray,
    homographies: np.ndarray, step_px: int, anchor: float, hidden: np.float32, contradicted: np.float32, time_weight: float,
    unknown: np.float32, pull: float, pull_most: float, costs: np.ndarray,
) -> None:  # fmt: skip
    """words_left2, words_right2: (2, H * W)."""
    height, width, disparities = costs.shape
    most, reach = np.float32(255), int(min(255 / anchor, disparities)) + 2
    for y in range(first, last):
        fy = np.float32(y)
        for x in range(width):
            row, known = costs[y, x], disparity[y, x]
            if matched[y, x]:
                row[:] = np.uint8(255)
                middle = int(known) // step_px
                for d in range(max(middle - reach, 0), min(middle + reach + 1, disparities)):
                    row[d] = np.uint8(min(abs(np.float32(step_px * d) - known) * anchor, most))
                continue
            write_matching_costs(words_left1, right1_mirrored, y, x, step_px, costs)
            h, fx = homographies[max(labels[y, x], 0)], np.float32(x)
            start = (
                h[0, 0] * fx + h[0, 1] * fy + h[0, 3], h[1, 0] * fx + h[1, 1] * fy + h[1, 3],
                h[2, 0] * fx + h[2, 1] * fy + h[2, 3], h[3, 0] * fx + h[3, 1] * fy + h[3, 3],
            )  # fmt: skip
            if labels[y, x] < 0:  # no motion: behind the camera, where nothing is compared
                start = (np.float32(0), np.float32(0), np.float32(0), np.float32(-np.inf))
            _add_evidence(
                row, front[y, width - 1 - x :], known, words_left1[0, y, x], words_left1[1, y, x], words_left2[0],
                words_left2[1], words_right2[0], words_right2[1], np.int32(width), np.int32(height), start,
                (h[0, 2], h[1, 2], h[2, 2], h[3, 2]), np.int32(step_px), hidden, contradicted, time_weight, unknown, pull,
                pull_most,
            )  # fmt: skip


def refill(
    match1: StereoMatch, match2: StereoMatch, grey: np.ndarray, labels: np.ndarray, homographies: np.ndarray,
    matching: MatchingConfig, config: EvidenceConfig,
) -> np.ndarray:  # fmt: skip
    """Disparity at time 1 with its unmatched pixels filled by the evidence of both times.

    Parameters
    ----------
    match1, match2 : StereoMatch
        The two pairs.
    grey : np.ndarray
        (H, W) left1.
    labels : np.ndarray
        (H, W) integers: which of the homographies moves each pixel; negative where none does.
    homographies : np.ndarray
        (M, 4, 4), M >= 1, of (x, y, disparity, 1) from time 1 to time 2.

    Returns
    -------
    np.ndarray
        (H, W) float32, pixels; matched pixels keep their disparity but for a median over 5 x 5.
    """
    f, step_px = np.float32, config.step_px
    costs = np.empty((*grey.shape, match1.max_disparity // step_px + 1), np.uint8)
    front = np.empty((grey.shape[0], grey.shape[1] + step_px * costs.shape[2]), f)
    over_rows(_front, len(front), match1.disparity, match1.matched, front)
    over_rows(
        _write_costs, len(costs), match1.disparity, match1.matched, front, match1.words_left,
        np.ascontiguousarray(match1.words_right[..., ::-1]), match2.words_left.reshape(2, -1),
        match2.words_right.reshape(2, -1), labels.astype(np.int32), homographies.astype(f),
        step_px, f(config.anchor_per_px), f(config.hidden_cost), f(config.contradicted_cost), f(config.time_weight),
        f(config.unknown_cost), f(config.background_per_px), f(config.background_most), costs,
    )  # fmt: skip
    filled, _ = aggregate(costs, grey, replace(matching, small_step=config.small_step))
    return cv2.medianBlur(np.where(match1.matched, match1.disparity, f(step_px) * filled), 5)
