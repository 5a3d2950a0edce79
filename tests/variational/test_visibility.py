"""Visibility: the forward-backward and the left-right check, on flows whose answer is known."""

import numpy as np
import pytest

from tests import naive
from variational.terms.visibility import visible_mask, visible_stereo
from variational.visibility import seen_in_right


def test_mask_equals_naive():
    rng = np.random.default_rng(0)
    flow = rng.normal([2, -1], 0.3, (17, 31, 2))
    back = rng.normal([-2, 1], 0.5, flow.shape)
    mask = visible_mask(flow, back, 0.01, 0.5)
    assert 0.02 < mask.mean() < 0.98
    assert np.array_equal(mask, naive.visible_mask(flow, back, 0.01, 0.5))


def test_constant_motion_is_visible_and_tolerances_act():
    flow = np.zeros((9, 14, 2), np.float32)
    flow[..., 0], flow[..., 1] = 2.5, -1
    assert visible_mask(flow, -flow).all()
    assert not visible_mask(flow, flow).any()
    assert not visible_mask(flow, -0.7 * flow).any()
    assert visible_mask(flow, -0.7 * flow, w2=1.0).all()


def test_flows_of_different_shapes_are_refused():
    with pytest.raises(ValueError, match="both flows"):
        visible_mask(np.zeros((4, 5, 2)), np.zeros((4, 6, 2)))


def test_stereo_of_two_planes():
    """A near square before a far wall: the wall is hidden in a strip as wide as the step, on the square's left."""
    left, right = np.full((10, 60), 4.0), np.full((10, 60), 4.0)
    left[:, 30:40] = 10
    right[:, 20:30] = 10
    visible = visible_stereo(left, right)
    assert not visible[:, 24:30].any()
    assert visible[:, 4:24].all()
    assert visible[:, 30:].all()
    assert not visible[:, :4].any()  # matches outside the right image


def test_stereo_without_a_number_is_hidden():
    left = np.full((3, 8), np.nan)
    assert not visible_stereo(left, np.zeros((3, 8))).any()


def test_what_the_right_camera_cannot_see():
    disparity = np.full((4, 20), 2, np.float32)
    disparity[:, 10:15] = 6  # hides the four background pixels to its left
    seen = seen_in_right(disparity)
    for row in seen:
        np.testing.assert_array_equal(np.flatnonzero(~row), [0, 1, 6, 7, 8, 9])


def test_seen_in_right_equals_its_plain_twin():
    disparity = np.random.default_rng(3).uniform(-1, 9, (5, 33)).astype(np.float32)
    margin = 1.0
    expected = np.zeros(disparity.shape, bool)
    for y, row in enumerate(disparity):
        for x, d in enumerate(row):
            to_x = round(float(x - d))
            hiding = [e for i, e in enumerate(row) if to_x in (np.floor(i - e), np.floor(i - e) + 1)]
            expected[y, x] = 0 <= to_x < len(row) and d >= max(hiding, default=-1) - margin
    assert 0.2 < expected.mean() < 0.9
    np.testing.assert_array_equal(seen_in_right(disparity, margin), expected)
