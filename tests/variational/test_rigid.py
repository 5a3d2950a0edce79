"""Rigid motions: a known motion comes back, with and without a calibration; what is not rigid is not invented."""

import cv2
import numpy as np
import pytest

from variational.camera import StereoCamera
from variational.rigid import (
    Correspondences,
    RigidConfig,
    _gauss_newton,
    displacements,
    find_motions,
    fit_motion,
    projected,
    rigid_derivatives,
)

HEIGHT, WIDTH = 90, 160
CAMERA = StereoCamera(130.0, 150.0, 70.0, 50.0, 0.5)
CONFIG = RigidConfig()


def transform(rotation: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(np.array(rotation, float))[0], translation
    return matrix


FORWARD = transform((0.004, -0.02, 0.006), (0.1, 0.05, -0.6))
STANDING = np.eye(4)
TURNING = transform((0.01, 0.05, -0.02), (0, 0, 0))


def scene(seed: int = 0) -> np.ndarray:
    """(H, W) disparities of a ground, a wall and a few boxes."""
    rng = np.random.default_rng(seed)
    disparity = np.maximum(3.0, 0.25 * (np.arange(HEIGHT)[:, None] - 45.0)) * np.ones((1, WIDTH))
    for _ in range(6):
        y, x = rng.integers(5, HEIGHT - 30), rng.integers(0, WIDTH - 30)
        disparity[y : y + 25, x : x + 25] = rng.uniform(6, 15)
    return disparity


def move(motion: np.ndarray, disparity: np.ndarray, camera: StereoCamera = CAMERA) -> Correspondences:
    """Exact correspondences, by way of metric points."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    depth = camera.fx * camera.baseline_m / disparity
    points = np.stack([(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth], -1)
    X, Y, Z = np.moveaxis(points @ motion[:3, :3].T + motion[:3, 3], -1, 0)
    second = [camera.fx * X / Z + camera.cx, camera.fy * Y / Z + camera.cy, camera.fx * camera.baseline_m / Z]
    first, second = (np.dstack(m).astype(np.float32) for m in ((x, y, disparity), second))
    return Correspondences(first, second, np.ones((HEIGHT, WIDTH), bool))


def spoil(matches: Correspondences, share: float, noise_px: float = 0.1, seed: int = 1) -> Correspondences:
    rng = np.random.default_rng(seed)
    second = matches.second + rng.normal(0, noise_px, matches.second.shape)
    wrong = rng.random(matches.valid.shape) < share
    second[wrong] += rng.uniform(-30, 30, (np.count_nonzero(wrong), 3))
    return Correspondences(matches.first, second.astype(np.float32), matches.valid)


@pytest.mark.parametrize("motion", [FORWARD, STANDING, TURNING], ids=["forward", "standing", "turning"])
def test_the_camera_motion_is_recovered_among_outliers(motion: np.ndarray) -> None:
    matches = spoil(move(motion, scene()), 0.3)
    kept = matches.second.copy()
    found = find_motions(matches, CAMERA, CONFIG)
    assert len(found) == 1  # outliers make no objects
    assert np.abs(found[0].transform - motion).max() < 0.01
    assert found[0].support.mean() > 0.65
    np.testing.assert_array_equal(kept, matches.second)


def test_swapped_focal_lengths_are_noticed() -> None:
    swapped = StereoCamera(CAMERA.fy, CAMERA.fx, CAMERA.cx, CAMERA.cy, CAMERA.baseline_m)
    found = find_motions(move(TURNING, scene()), swapped, CONFIG)
    assert not found or np.abs(found[0].transform - TURNING).max() > 0.003


def test_displacements_are_the_motion_of_the_points() -> None:
    matches = move(FORWARD, scene())
    projection = CAMERA.projection()
    homography = projection @ FORWARD @ np.linalg.inv(projection)
    labels = np.zeros((2, HEIGHT, WIDTH), np.int32)
    labels[1, 10] = -1
    moved = displacements(homography[None], labels, matches.first[..., 2])
    expected = np.moveaxis(matches.second - matches.first, -1, 0)[[2, 0, 1]]
    np.testing.assert_allclose(moved[0], expected, atol=1e-4)
    assert np.isnan(moved[1, :, 10]).all()
    behind = displacements((projection @ transform((0, 0, 0), (0, 0, -1e4)) @ np.linalg.inv(projection))[None],
                           labels, matches.first[..., 2])  # fmt: skip
    assert np.isnan(behind).all()


def test_a_moving_object_is_found_with_its_own_motion() -> None:
    disparity = scene()
    disparity[30:60, 60:110] = 9 + 0.02 * np.arange(50)
    matches, own = move(FORWARD, disparity), move(transform((0, 0, 0), (0.5, 0, 0)) @ FORWARD, disparity)
    matches.second[30:60, 60:110] = own.second[30:60, 60:110]
    found = find_motions(spoil(matches, 0.01), CAMERA, CONFIG)
    assert len(found) == 2
    assert found[1].support[33:57, 63:107].mean() > 0.8
    assert found[1].support[:25].sum() == 0
    moved = displacements(found[1].homography[None], np.zeros((1, HEIGHT, WIDTH), int), matches.first[..., 2])[0]
    expected = np.moveaxis(matches.second - matches.first, -1, 0)[[2, 0, 1]]
    assert np.abs(moved - expected)[:, 30:60, 60:110].max() < 0.5


def test_one_plane_that_fills_the_view_is_enough() -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    found = find_motions(spoil(move(FORWARD, 8 + 0.02 * x + 0.05 * y), 0.1), CAMERA, CONFIG)
    assert len(found) == 1
    assert np.abs(found[0].transform - FORWARD).max() < 0.02


def test_too_few_points_and_no_rigid_motion_give_none() -> None:
    matches = move(FORWARD, scene())
    few = np.zeros(matches.valid.shape, bool)
    few[40, :20] = True
    assert find_motions(Correspondences(matches.first, matches.second, few), CAMERA, CONFIG) == []
    assert find_motions(spoil(matches, 1.0), CAMERA, CONFIG) == []


def test_points_on_a_line_do_not_fix_a_motion() -> None:
    matches = move(FORWARD, np.full((HEIGHT, WIDTH), 6.0))
    line = np.zeros(matches.valid.shape, bool)
    line[40] = True
    first, second = (m[line].astype(np.float64) for m in (matches.first, matches.second))
    fitted = fit_motion(first, second, CAMERA.projection())
    assert fitted is None or np.isfinite(fitted).all()


def test_derivatives_are_those_of_the_projection() -> None:
    points = np.random.default_rng(3).uniform((-2, -1, 2), (3, 2, 9), (20, 3))
    projection, step = CAMERA.projection(), 1e-6
    found = rigid_derivatives(points, projection)
    for k, unknown in enumerate(np.eye(6)):
        ends = []
        for sign in (1, -1):
            rotation = cv2.Rodrigues(sign * step * unknown[3:])[0]
            ends.append(projected(points @ rotation.T + sign * step * unknown[:3], projection))
        np.testing.assert_allclose(found[k], ((ends[0] - ends[1]) / (2 * step)).T, rtol=1e-5, atol=1e-5)


def test_gauss_newton_descends_to_the_minimum() -> None:
    matches = move(FORWARD, scene())
    first, second = (m.reshape(-1, 3)[::7].astype(np.float64) for m in (matches.first, matches.second))
    projection = CAMERA.projection()
    homogeneous = np.c_[first, np.ones(len(first))] @ np.linalg.inv(projection).T
    points = homogeneous[:, :3] / homogeneous[:, 3:]
    start = transform((0.002, 0.001, -0.001), (0.01, 0.005, 0.01)) @ FORWARD
    errors = []
    for iterations in range(4):
        result = _gauss_newton(start, points, second, projection, iterations, scale_px=0.7)
        assert result is not None
        errors.append(np.abs(result - FORWARD).max())
    assert errors[2] < 0.05 * errors[1] < errors[0]  # faster than linear
