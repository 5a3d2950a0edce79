"""Pictures: the colours mean what the legends say."""

import cv2
import numpy as np
import pytest

from cgsf.datasets.sample import Truth
from cgsf.formats.images import to_unit_range
from cgsf.scene_flow import SceneFlow
from cgsf.visualise import flow_colours, largest_length, overview
from tests.cgsf import scenes


def test_flow_colours():
    directions = np.float32([[0, 0], [4, 0], [0, 4], [-4, 0], [2, 0], [np.nan, 0]])
    white, right, down, left, half, unknown = flow_colours(directions, 4.0).tolist()
    assert white == [255, 255, 255]
    assert right == [255, 0, 0]
    assert left == [0, 255, 255]
    assert down[1] == 255
    assert half == [255, 128, 128]
    assert unknown == [0, 0, 0]


def test_longer_vectors_get_darker_and_the_scale_forgets_a_few():
    colours = flow_colours(np.float32([[4, 0], [16, 0]]), 4.0)
    assert colours[1, 0] < colours[0, 0]
    flow = np.zeros((100, 100, 2), np.float32)
    flow[..., 0], flow[0, 0] = 3, 1000
    assert largest_length(flow) == pytest.approx(3)
    assert largest_length(np.full((2, 2, 2), np.nan)) == 0.1


@pytest.mark.parametrize(("height", "width"), [(40, 120), (90, 60)])
def test_overview_of_everything_and_of_little(rng, height, width):
    images = [to_unit_range(image) for image in scenes.plane(rng, height, width)]
    state = np.full((5, height, width), np.nan, np.float32)
    empty = SceneFlow.from_state(state, np.ones((height, width), bool))
    small = cv2.imdecode(np.frombuffer(overview(images, empty), np.uint8), cv2.IMREAD_COLOR)
    mask = rng.random((height, width)) < 0.5
    full = SceneFlow.from_state(np.nan_to_num(state), mask, moving=~mask, loss=np.ones_like(state[0]),
                                confidence=rng.random((height, width)).astype(np.float32))  # fmt: skip
    truth = Truth(state[0], np.ones_like(state[0]), np.ones((height, width, 2), np.float32))
    large = cv2.imdecode(np.frombuffer(overview(images, full, truth, "title"), np.uint8), cv2.IMREAD_COLOR)
    assert large.shape[0] > small.shape[0] > 100
    assert small.std() > 0
