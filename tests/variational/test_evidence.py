"""Unmatched disparities: what the second time and the surroundings say of them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.variational.scenes import two_layers
from variational.census import OUTSIDE_COST
from variational.evidence import EvidenceConfig, _front, _write_costs, refill
from variational.initialise import initialise
from variational.matching import MatchingConfig

HOLE = (slice(8, 18), slice(30, 70))
"""Of the background, whose disparity is 5; the box's is 13."""


@pytest.fixture(scope="module")
def scene():
    frames = two_layers().frames
    return frames, initialise(frames, "matching", MatchingConfig(max_disparity=31))


def filled(scene, motion=(2, 1), labels=0, **settings):
    """Disparity after a hole was cut into the matches and filled with a wrong value."""
    frames, start = scene
    disparity, matched = start.match1.disparity.copy(), start.match1.matched.copy()
    disparity[HOLE], matched[HOLE] = 13, False
    match1 = replace(start.match1, disparity=disparity, matched=matched)
    homography = np.eye(4)
    homography[:2, 3] = motion
    everywhere = np.full(matched.shape, labels, np.int32)
    before = disparity.copy(), matched.copy()
    config = EvidenceConfig(**settings)
    result = refill(match1, start.match2, frames.grey[0], everywhere, homography[None], MatchingConfig(), config)
    np.testing.assert_array_equal(disparity, before[0])
    np.testing.assert_array_equal(matched, before[1])
    return result, matched


def test_a_hole_in_a_wall_is_wall_again(scene):
    result, _ = filled(scene)
    assert np.median(np.abs(result[HOLE] - 5)) < 0.5
    assert (np.abs(result[HOLE] - 5) > 1).mean() < 0.02


def bits(words1, words2):
    return sum(int(a ^ b).bit_count() for a, b in zip(words1, words2, strict=True))


def plain_costs(disparity, matched, words, labels, homographies, disparities, config):
    """The kernel's twin, a pixel and a disparity at a time; all disparities, of which the kernel takes every so many-th."""
    (left1, right1, left2, right2), (height, width) = words, disparity.shape
    costs = np.empty((height, width, disparities))
    for y, x, d in np.ndindex(costs.shape):
        if matched[y, x]:
            costs[y, x, d] = abs(d - disparity[y, x]) * config.anchor_per_px
            continue
        stereo = bits(left1[:, y, x], right1[:, y, x - d]) if x >= d else OUTSIDE_COST
        landing = [
            disparity[y, i] for i in np.flatnonzero(matched[y])
            if x - d in (np.floor(i - disparity[y, i]), np.ceil(i - disparity[y, i]))
        ]  # fmt: skip
        if landing and x >= d:
            seen = max(landing)
            if d < seen - 1.5:
                stereo = config.hidden_cost
            elif d > seen + 1.5:
                stereo = max(stereo, config.contradicted_cost)
        time = config.unknown_cost
        if labels[y, x] >= 0:
            to_x, to_y, to_d, scale = homographies[labels[y, x]] @ (x, y, d, 1)
            if scale > 0:
                to_x, to_y, in_right = to_x / scale, to_y / scale, (to_x - to_d) / scale
                if 0 <= to_x <= width - 1 and 0 <= to_y <= height - 1:
                    row, column = int(to_y + 0.5), int(to_x + 0.5)
                    time = bits(left1[:, y, x], left2[:, row, column])
                    if -0.5 <= in_right < width - 0.5:
                        time = (time + bits(left1[:, y, x], right2[:, row, int(in_right + 0.5)])) / 2
        away = min(abs(d - disparity[y, x]) * config.background_per_px, config.background_most)
        costs[y, x, d] = stereo + config.time_weight * time + away
    return np.minimum(costs, 255)


@pytest.mark.parametrize("step_px", [1, 2, 3])
def test_costs_equal_their_plain_twin(step_px):
    rng = np.random.default_rng(3)
    height, width, disparities = 7, 19, 9
    f, config = np.float32, EvidenceConfig(time_weight=0.8)
    disparity = rng.uniform(0.2, disparities - 1.2, (height, width)).astype(f)
    matched = rng.random((height, width)) < 0.4
    words = rng.integers(0, 2**62, (4, 2, height, width), np.uint64)
    labels = rng.integers(-1, 2, (height, width)).astype(np.int32)
    homographies = np.stack([np.eye(4)] * 2)
    homographies[:, :2, 3] = [(1.3, -0.6), (-2.2, 1.4)]
    homographies[1, 3, :3] = 0.004, 0.003, -0.05
    homographies = homographies.astype(f)
    front = np.empty((height, width + disparities + step_px), f)
    costs = np.empty((height, width, (disparities - 1) // step_px + 1), np.uint8)
    _front(0, len(front), disparity, matched, front)
    left1, right1, left2, right2 = words
    _write_costs(
        0, len(costs), disparity, matched, front, left1, np.ascontiguousarray(right1[..., ::-1]), left2.reshape(2, -1),
        right2.reshape(2, -1), labels, homographies, step_px, f(config.anchor_per_px), f(config.hidden_cost),
        f(config.contradicted_cost), f(config.time_weight), f(config.unknown_cost), f(config.background_per_px),
        f(config.background_most), costs,
    )  # fmt: skip
    expected = plain_costs(disparity, matched, words, labels, homographies.astype(float), disparities, config)
    assert (np.abs(costs - expected[..., ::step_px]) <= 1).all()  # the kernel rounds down


def test_matched_pixels_keep_their_disparity(scene):
    _, start = scene
    result, matched = filled(scene)
    kept = np.abs(result - start.match1.disparity)[matched]
    assert np.percentile(kept, 95) < 0.25  # a median over 5 x 5 is all that touches them


@pytest.mark.parametrize("motion", [(1e6, 0), (np.nan, 0)])
def test_motions_out_of_the_image_leave_finite_disparities(scene, motion):
    result, _ = filled(scene, motion)
    assert ((result >= 0) & (result <= 31)).all()
    no_motion, _ = filled(scene, labels=-1)
    assert (result[HOLE] == no_motion[HOLE]).mean() > 0.9


@pytest.mark.parametrize("step_px", [1, 2, 3])
def test_steps_between_disparities_are_bridged(scene, step_px):
    """The hole's disparity, 5, lies on the grid of one of these steps alone."""
    result, _ = filled(scene, step_px=step_px)
    assert np.median(np.abs(result[HOLE] - 5)) < 0.4 * step_px


def test_a_step_of_nothing_is_refused():
    with pytest.raises(ValueError, match="step_px must be at least 1"):
        EvidenceConfig(step_px=0)
