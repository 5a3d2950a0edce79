"""The camera's motion found in a scene flow that other things disturb."""

import numpy as np
import pytest

from cgsf.camera_motion import find_homography
from variational.camera import StereoCamera
from variational.rigid import displacements

CAMERA = StereoCamera(300.0, 310.0, 70.0, 44.0, 0.2)
HEIGHT, WIDTH = 90, 140


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State, backward flow and homography of a camera that drives and turns past slanted ground."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    disparity = (3 + 0.12 * y + 0.5 * np.sin(x / 9)).astype(np.float32)
    transform = np.eye(4)
    transform[:3, :3] = [[np.cos(0.02), 0, np.sin(0.02)], [0, 1, 0], [-np.sin(0.02), 0, np.cos(0.02)]]
    transform[:3, 3] = [0.05, -0.02, -0.3]
    homography = CAMERA.projection() @ transform @ np.linalg.inv(CAMERA.projection())
    motion = displacements(homography[None], np.zeros((1, HEIGHT, WIDTH), np.int32), disparity)[0]
    # at time 2 the same functions of the place that a pixel came from
    back = -np.moveaxis(motion[1:], 0, -1)
    second = disparity + motion[0]
    return np.stack([disparity, second, *motion]), back, homography


def predicted(homography: np.ndarray, state: np.ndarray) -> np.ndarray:
    return displacements(homography[None], np.zeros((1, HEIGHT, WIDTH), np.int32), state[0])[0]


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_motion_is_found_amid_moving_things(scene, camera):
    state, back, homography = scene
    disturbed = state.copy()
    disturbed[3:, 20:50, 30:70] += 6.0  # flow there and back no longer agree
    kept = disturbed.copy()
    found = find_homography(disturbed, back, camera)
    np.testing.assert_array_equal(disturbed, kept)
    error = np.linalg.norm(predicted(found, state)[1:] - predicted(homography, state)[1:], axis=0)
    assert np.median(error) < (0.3 if camera else 0.6)


def test_a_camera_that_nothing_tells_of_stands_still(scene):
    state, back, _ = scene
    np.testing.assert_array_equal(find_homography(state, back + 40, CAMERA), np.eye(4))
