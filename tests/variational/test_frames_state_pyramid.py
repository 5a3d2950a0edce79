"""Frames, states and pyramids: what they refuse, and the conventions of resizing."""

import numpy as np
import pytest

from variational.frames import Frames
from variational.pyramid import frames_pyramid, image_pyramid, pyramid_shapes, resize_image
from variational.state import D1, D2, C, U, V, enlarge_state, flow_of, resize_state, zero_state


def image(shape=(6, 8, 3), dtype=np.float32, seed=0):
    return np.random.default_rng(seed).random(shape).astype(dtype)


@pytest.mark.parametrize(("bad", "message"), [
    (np.zeros((6, 8, 3), np.uint8), "right1 must be a float32"),
    (np.zeros((6, 8), np.float32), "right1 must have shape"),
    (np.zeros((6, 8, 2), np.float32), "right1 must have shape"),
    (np.zeros((0, 8, 3), np.float32), "right1 is empty"),
    (image().transpose(1, 0, 2), "right1 must be C-contiguous"),
    (image() * 255, r"right1 must be finite and in \[0, 1\]"),
    (np.full((6, 8, 3), np.nan, np.float32), "right1 must be finite"),
    (image((6, 9, 3)), "one size"),
    (image(dtype=np.float64), "one type"),
])
def test_frames_refuse(bad, message):
    with pytest.raises(ValueError, match=message):
        Frames(image(), bad, image(), image())


def test_frames_reversed_and_astype():
    images = [image(seed=i) for i in range(4)]
    frames = Frames(*images)
    assert frames.reversed().left1 is images[2]
    assert frames.reversed().right2 is images[1]
    assert frames.astype(np.float32) is frames
    assert frames.astype(np.float64).dtype == np.float64
    assert frames.shape == (6, 8)


def test_resize_state_scales_each_channel_by_its_own_axis():
    state = zero_state((6, 8))
    state[D1], state[D2], state[C], state[U], state[V] = 1, 2, 3, 4, 5
    resized = resize_state(state, (3, 16))
    assert resized.shape == (5, 3, 16)
    assert [float(resized[i, 1, 3]) for i in range(5)] == [2, 4, 6, 8, 2.5]
    assert np.array_equal(resize_state(state, (6, 8)), state)


def test_resize_state_keeps_a_ramp_in_place():
    """Pixel centres: a linear field stays linear, and shrinking undoes enlarging away from the border."""
    state = np.tile(np.arange(12.0), (5, 10, 1))
    back = resize_state(resize_state(state, (20, 24)), (10, 12))
    assert np.allclose(back[:, :, 1:-1], state[:, :, 1:-1])


def test_flow_of():
    state = np.arange(5.0 * 6).reshape(5, 2, 3)
    assert flow_of(state).shape == (2, 3, 2)
    assert np.array_equal(flow_of(state)[..., 1], state[V])


def test_pyramid_shapes_end():
    assert pyramid_shapes((375, 1242), 0.5, 16)[:3] == [(375, 1242), (188, 621), (94, 310)]
    assert pyramid_shapes((375, 1242), 0.5, 1)[-1][0] == 1
    assert pyramid_shapes((1, 1), 0.9) == [(1, 1)]
    assert all(min(shape) >= 20 for shape in pyramid_shapes((200, 300), 0.8, 20))
    with pytest.raises(ValueError, match="factor"):
        pyramid_shapes((10, 10), 1.0)


@pytest.mark.parametrize("channels", [1, 3])
def test_shrinking_is_anti_aliased(channels):
    """Stripes at the pixel limit become their mean; the mean of the image survives."""
    stripes = np.zeros((16, 16, channels), np.float32)
    stripes[:, ::2] = 1
    assert np.allclose(resize_image(stripes, (8, 8)), 0.5)
    noise = image((21, 33, channels))
    assert resize_image(noise, (7, 11)).mean() == pytest.approx(noise.mean(), rel=1e-5)


def test_pyramids_have_the_sizes_asked_for():
    shapes = pyramid_shapes((37, 53), 0.6, 2)
    levels = frames_pyramid(Frames(*(image((37, 53, 1), seed=i) for i in range(4))), shapes)
    assert [level.shape for level in levels] == shapes
    assert [level.shape[:2] for level in image_pyramid(image((37, 53, 3)), shapes)] == shapes


def test_enlarging_keeps_slopes_and_does_not_smear_jumps():
    """A slanted plane stays one; between two surfaces nothing new appears."""
    state = zero_state((10, 20))
    state[D1] = 8 + 0.25 * np.arange(20)
    state[V] = 1.5
    state[U, :, 11:] = 30
    large = enlarge_state(state, (25, 40))
    inside = slice(1, -1)
    assert np.allclose(large[D1][:, inside], (16 + 0.5 * ((np.arange(40) + 0.5) / 2 - 0.5))[inside], atol=1e-4)
    assert np.allclose(large[V], 1.5 * 25 / 10)
    assert set(np.unique(large[U])) == {0, 60}
    assert len(np.unique(resize_state(state, (25, 40))[U])) > 2
