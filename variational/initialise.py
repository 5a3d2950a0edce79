"""Starting states, and everything that is measured once before the minimisation.

Stereo comes from our own matching or from OpenCV's semi-global matching, flow from OpenCV's dense inverse search
(Kroeger et al. 2016), forward and backward. A start also holds what later stages ask of it: which disparities are
matched, and the census words of all four images.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import cv2
import numpy as np

from variational.frames import Frames
from variational.jit import side_by_side
from variational.matching import MatchingConfig, StereoMatch, census, fill_background, find_max_disparity, match

StartName = Literal["matching", "opencv", "zero"]
MIN_SIDE = 16
"""Smallest image side, in pixels, that matching and flow accept."""


@dataclass(frozen=True, eq=False)
class Start:
    """A starting state with its evidence.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W) float32.
    backward_flow : np.ndarray
        (H, W, 2) float32, left2 -> left1.
    match1, match2 : StereoMatch
        The two pairs.
    """

    state: np.ndarray
    backward_flow: np.ndarray
    match1: StereoMatch
    match2: StereoMatch


def to_bytes(grey: np.ndarray) -> np.ndarray:
    """8-bit version of an image in [0, 1], which is all that OpenCV's matchers read."""
    return np.rint(np.clip(grey, 0, 1) * 255).astype(np.uint8)


def sample(plane: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, c) plane sampled bilinearly at p + flow, positions clamped to the image."""
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    return cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def dense_inverse_search(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(H, W, 2) float32 flow from one grey image to another."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return search.calc(to_bytes(first), to_bytes(second), None)


def opencv_match(left: np.ndarray, right: np.ndarray, config: MatchingConfig) -> StereoMatch:
    """OpenCV's semi-global matching, as people use it: block of 5, left-right check, background filling.

    Of the settings it takes the range alone; the census words are for whoever compares them later.
    """
    padded = 16 * int(np.ceil((config.max_disparity + 1) / 16))
    matcher = cv2.StereoSGBM.create(
        0, padded, 5, P1=24 * 25, P2=96 * 25, disp12MaxDiff=1, uniquenessRatio=5, speckleWindowSize=100, speckleRange=2,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    views = [cv2.copyMakeBorder(to_bytes(view), 0, 0, padded, 0, cv2.BORDER_CONSTANT) for view in (left, right)]
    disparity = matcher.compute(*views)[:, padded:].astype(np.float32) / 16
    matched = disparity > 0
    words_left, words_right = census(left, config.overlook), census(right, config.overlook)
    return StereoMatch(fill_background(disparity, matched), matched, words_left, words_right, config.max_disparity)


def initialise(frames: Frames, name: StartName, config: MatchingConfig) -> Start:
    """Make a starting state.

    Parameters
    ----------
    frames : Frames
    name : {"matching", "opencv", "zero"}
        Our census matching and dense inverse search, OpenCV's matching and the same flow, or nothing at all.
    config : MatchingConfig
        Both pairs search one range, the one that suits the first.

    Returns
    -------
    Start
    """
    left1, right1, left2, right2 = frames.grey
    shape = left1.shape
    if name == "zero":
        unknown, nowhere = np.zeros(shape, np.float32), np.zeros(shape, bool)
        words = [census(view, config.overlook) for view in frames.grey]
        nothing = [StereoMatch(unknown, nowhere, words[k], words[k + 1], 0) for k in (0, 2)]
        return Start(np.zeros((5, *shape), np.float32), np.zeros((*shape, 2), np.float32), *nothing)
    searched = config.max_disparity or find_max_disparity(left1, right1, config)
    pair = partial(match if name == "matching" else opencv_match, config=replace(config, max_disparity=searched))
    match1, match2, flow, backward = side_by_side(
        partial(pair, left1, right1), partial(pair, left2, right2),
        partial(dense_inverse_search, left1, left2), partial(dense_inverse_search, left2, left1),
    )  # fmt: skip
    change = sample(match2.disparity, flow) - match1.disparity
    state = np.stack([match1.disparity, match2.disparity, change, flow[..., 0], flow[..., 1]])
    return Start(state, backward, match1, match2)
