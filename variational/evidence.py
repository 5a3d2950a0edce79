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
from variational.jit import parallel, prange, scalar
from variational.matching import MatchingConfig, StereoMatch, aggregate


@dataclass(frozen=True)
class EvidenceConfig:
    """Filling of unmatched disparities; costs are in census bits, of which a match has 124.

    Parameters
    ----------
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
    small_step : int
        Penalty for a change of disparity by one pixel; larger than for matching, since here there is less to go by.
    """

    anchor_per_px: float = 30.0
    hidden_cost: float = 60.0
    contradicted_cost: float = 90.0
    time_weight: float = 2.0
    unknown_cost: float = 55.0
    background_per_px: float = 6.0
    background_most: float = 30.0
    small_step: int = 100


@parallel
def _front(disparity: np.ndarray, matched: np.ndarray, front: np.ndarray) -> None:
    """front (H, W): largest matched disparity that lands on each pixel of the right image, -1 where none does."""
    height, width = disparity.shape
    for y in prange(height):
        front[y] = -1
        for x in range(width):
            if matched[y, x]:
                at = x - disparity[y, x]
                for to_x in (int(np.floor(at)), int(np.ceil(at))):
                    if to_x >= 0 and disparity[y, x] > front[y, to_x]:
                        front[y, to_x] = disparity[y, x]


@scalar
def _time_cost(
    words_left1: np.ndarray, words_left2: np.ndarray, words_right2: np.ndarray, x: int, y: int, to_x: float,
    to_y: float, to_disparity: float, unknown: np.float32,
) -> np.float32:  # fmt: skip
    """Differing bits at time 2, the mean of both cameras where both see the place."""
    _, height, width = words_left1.shape
    if not (0 <= to_x <= width - 1 and 0 <= to_y <= height - 1):
        return unknown
    i, j = int(to_x + 0.5), int(to_y + 0.5)
    fine, wide = words_left1[0, y, x], words_left1[1, y, x]
    bits = np.float32(popcount(fine ^ words_left2[0, j, i]) + popcount(wide ^ words_left2[1, j, i]))
    i = int(np.rint(to_x - to_disparity))
    if not 0 <= i < width:
        return bits
    return np.float32(0.5) * (bits + popcount(fine ^ words_right2[0, j, i]) + popcount(wide ^ words_right2[1, j, i]))


@parallel
def _write_costs(
    disparity: np.ndarray, matched: np.ndarray, front: np.ndarray, words_left1: np.ndarray, right1_mirrored: np.ndarray,
    words_left2: np.ndarray, words_right2: np.ndarray, labels: np.ndarray, homographies: np.ndarray, anchor: float,
    hidden: np.float32, contradicted: np.float32, time_weight: float, unknown: np.float32, pull: float,
    pull_most: float, costs: np.ndarray,
) -> None:  # fmt: skip
    height, width, disparities = costs.shape
    for y in prange(height):
        for x in range(width):
            row, known = costs[y, x], disparity[y, x]
            if matched[y, x]:
                for d in range(disparities):
                    row[d] = np.uint8(min(abs(np.float32(d) - known) * anchor, np.float32(255)))
                continue
            write_matching_costs(words_left1[:, y], right1_mirrored[:, y], x, row)
            label = labels[y, x]
            h = homographies[max(label, 0)]
            base0, base1, base2, base3 = (
                h[0, 0] * x + h[0, 1] * y + h[0, 3], h[1, 0] * x + h[1, 1] * y + h[1, 3],
                h[2, 0] * x + h[2, 1] * y + h[2, 3], h[3, 0] * x + h[3, 1] * y + h[3, 3],
            )  # fmt: skip
            for d in range(disparities):
                seen = front[y, x - d] if x >= d else np.float32(-1)
                stereo = np.float32(row[d])
                if seen >= 0:
                    stereo = hidden if d < seen - 1.5 else max(contradicted, stereo) if d > seen + 1.5 else stereo
                time = unknown
                scale = base3 + h[3, 2] * d
                if label >= 0 and scale > 0:
                    time = _time_cost(
                        words_left1, words_left2, words_right2, x, y, (base0 + h[0, 2] * d) / scale,
                        (base1 + h[1, 2] * d) / scale, (base2 + h[2, 2] * d) / scale, unknown,
                    )  # fmt: skip
                background = min(abs(d - known) * pull, pull_most)
                row[d] = np.uint8(min(stereo + time_weight * time + background, 255.0))


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
    f = np.float32
    costs = np.empty((*grey.shape, match1.max_disparity + 1), np.uint8)
    front = np.empty(grey.shape, f)
    _front(match1.disparity, match1.matched, front)
    _write_costs(
        match1.disparity, match1.matched, front, match1.words_left, np.ascontiguousarray(match1.words_right[..., ::-1]),
        match2.words_left, match2.words_right, labels.astype(np.int32), homographies.astype(f),
        f(config.anchor_per_px), f(config.hidden_cost), f(config.contradicted_cost), f(config.time_weight),
        f(config.unknown_cost), f(config.background_per_px), f(config.background_most), costs,
    )  # fmt: skip
    filled, _ = aggregate(costs, grey, replace(matching, small_step=config.small_step))
    return cv2.medianBlur(np.where(match1.matched, match1.disparity, filled), 5)
