"""Disparity search around what is known: semi-global matching in a band about a prior.

The discrete half of the coarse-to-fine minimisation from nothing: descent follows a gradient of a pixel or two, a search
in a band of a few pixels at every level follows whatever a level can show.
"""

import numpy as np

from variational.jit import over_rows, rowwise
from variational.matching import MatchingConfig, StereoMatch, aggregate, census, fill_background, stereo_costs


@rowwise
def _forbid_outside(first: int, last: int, costs: np.ndarray, prior: np.ndarray, radius: float) -> None:
    _, width, disparities = costs.shape
    for y in range(first, last):
        for x in range(width):
            for d in range(disparities):
                if abs(d - prior[y, x]) > radius:
                    costs[y, x, d] = np.uint8(255)


def match_around(
    left: np.ndarray, right: np.ndarray, prior: np.ndarray, radius_px: float, config: MatchingConfig
) -> StereoMatch:
    """Match a rectified pair in a band of disparities.

    Parameters
    ----------
    left, right : np.ndarray
        (H, W) float32 grey images in [0, 1].
    prior : np.ndarray
        (H, W) disparity to search around, pixels.
    radius_px : float
        Half width of the band; disparities below zero are not searched.
    config : MatchingConfig
        `max_disparity` and `speckle_px` are those of the prior's scale here.

    Returns
    -------
    StereoMatch
    """
    searched = int(min(np.ceil(prior.max() + radius_px), left.shape[1] - 1))
    words_left, words_right = census(left, config.overlook), census(right, config.overlook)
    costs = stereo_costs(words_left, words_right, max(2, searched + 1))
    over_rows(_forbid_outside, len(costs), costs, prior, np.float32(radius_px))
    disparity, matched = aggregate(costs, left, config)
    return StereoMatch(fill_background(disparity, matched), matched, words_left, words_right, searched)
