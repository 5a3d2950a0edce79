"""A camera is found from how the world moves past it; what the motion does not tell stays as is usual."""

import numpy as np
import pytest

from tests.variational.test_rigid import CONFIG, FORWARD, HEIGHT, WIDTH, move, scene, spoil, transform
from variational.camera import StereoCamera
from variational.rigid import Correspondences, find_motions, projected
from variational.self_calibration import camera_derivatives, guess_camera

CENTRE = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
TURNING_FORWARD = transform((0.02, 0.06, 0.03), (0.2, 0, -0.8))


def camera(focal: float, right: float = 0.0, down: float = 0.0) -> StereoCamera:
    """A focal length in widths, a principal point beside the centre in pixels."""
    return StereoCamera(focal * WIDTH, focal * WIDTH, CENTRE[0] + right, CENTRE[1] + down, 0.3)


@pytest.mark.parametrize("known", [camera(0.58, 3, -2), camera(0.93), camera(1.7, -2, 3)], ids=["wide", "medium", "long"])
def test_focal_length_and_principal_point_are_found_among_outliers(known: StereoCamera) -> None:
    matches = spoil(move(TURNING_FORWARD, scene(), known), 0.2)
    kept = matches.second.copy()
    guessed = guess_camera(matches, CONFIG)
    np.testing.assert_array_equal(kept, matches.second)
    assert guessed.fx == guessed.fy == pytest.approx(known.fx, rel=0.05)
    assert np.hypot(guessed.cx - known.cx, guessed.cy - known.cy) < 0.012 * known.fx  # an angle of 0.7 degrees
    found = find_motions(matches, guessed, CONFIG)
    assert len(found) == 1
    assert found[0].support.mean() > 0.75
    exact = known.homography(TURNING_FORWARD)
    error = projected(matches.first.reshape(-1, 3), found[0].homography) - projected(matches.first.reshape(-1, 3), exact)
    assert np.abs(error).max() < 0.5


def test_every_tenth_point_of_a_larger_image_counts_from_its_own_centre() -> None:
    known = camera(0.7, 2, 1)
    matches = move(TURNING_FORWARD, scene(), known)
    thinned = Correspondences(matches.first[::2, ::2], matches.second[::2, ::2], matches.valid[::2, ::2])
    guessed = guess_camera(thinned, CONFIG, (HEIGHT, WIDTH))
    assert guessed.fx == pytest.approx(known.fx, rel=0.02)
    assert abs(guessed.cx - known.cx) < 0.5


def test_a_camera_that_moves_straight_on_keeps_the_usual_focal_length() -> None:
    matches = spoil(move(transform((0, 0, 0), (0, 0, -0.8)), scene(), camera(0.58)), 0.1)
    guessed = guess_camera(matches, CONFIG)
    assert 0.6 * WIDTH < guessed.fx < 1.6 * WIDTH  # nothing tells it
    assert np.hypot(guessed.cx - CENTRE[0], guessed.cy - CENTRE[1]) < 1  # the focus of expansion does tell this


def test_too_few_points_and_no_rigid_motion_give_the_usual_camera() -> None:
    matches = move(FORWARD, scene())
    few = np.zeros(matches.valid.shape, bool)
    few[40, :20] = True
    usual = guess_camera(Correspondences(matches.first, matches.second, few), CONFIG)
    assert (usual.fx, usual.fy, usual.cx, usual.cy) == (WIDTH, WIDTH, *CENTRE)
    lost = guess_camera(spoil(matches, 1.0), CONFIG)
    assert 0.2 * WIDTH < lost.fx < 5 * WIDTH


def test_derivatives_are_those_of_the_motion_under_another_camera() -> None:
    first = np.random.default_rng(0).uniform((0, 0, 3), (WIDTH, HEIGHT, 15), (50, 3))
    known = camera(0.7, 4, -3)

    def moved(step: np.ndarray) -> np.ndarray:
        other = StereoCamera(*[known.fx * np.exp(step[0])] * 2, known.cx + step[1], known.cy + step[2], known.baseline_m)
        return projected(first, other.homography(TURNING_FORWARD))

    points = projected(first, np.linalg.inv(known.projection()))
    jacobian = camera_derivatives(points, TURNING_FORWARD, known)
    for k, size in enumerate((1e-5, 1e-3, 1e-3)):
        step = np.zeros(3)
        step[k] = size
        difference = (moved(step) - moved(-step)) / (2 * size)
        np.testing.assert_allclose(jacobian[6 + k].T, difference, rtol=1e-5, atol=1e-6)
