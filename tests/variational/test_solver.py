"""The solver as a whole, on scenes whose truth is known exactly."""

import logging

import cv2
import numba
import numpy as np
import pytest

from tests.variational.scenes import two_layers
from variational.camera import StereoCamera
from variational.confidence import confidence
from variational.descent import DescentConfig
from variational.edges import EdgesConfig
from variational.frames import Frames
from variational.minimise import DescendConfig
from variational.objects import ObjectsConfig
from variational.solver import SolverConfig, solve

CAMERA = StereoCamera(80.0, 80.0, 53.5, 35.5, 0.5)


def _share_right(state, truth, channel):
    return (np.abs(state[channel] - truth[channel]) < 1).mean()


@pytest.mark.parametrize("start", ["matching", "opencv", "zero"])
def test_every_start_is_solved(start):
    scene = two_layers()
    before = [getattr(scene.frames, n).copy() for n in ("left1", "right1", "left2", "right2")]
    solution = solve(scene.frames, SolverConfig(start=start), CAMERA)
    for channel, share in ((0, 0.85), (3, 0.8), (4, 0.8)):
        assert _share_right(solution.state, scene.state, channel) > share, (start, channel)
    for array in (solution.state, solution.confidence, solution.backward_flow, solution.initial_state):
        assert np.isfinite(array).all()
        assert array.dtype == np.float32
    assert solution.visible.dtype == bool
    assert (solution.confidence >= 0).all()
    assert (solution.confidence <= 1).all()
    assert (solution.initial_state == 0).all() == (start == "zero")
    assert solution.reason
    assert solution.history
    for image, name in zip(before, ("left1", "right1", "left2", "right2"), strict=True):
        np.testing.assert_array_equal(image, getattr(scene.frames, name))


def test_the_same_bits_for_one_and_two_threads():
    scene = two_layers()
    states = []
    threads = numba.get_num_threads()
    try:
        for count in (1, min(2, threads)):
            numba.set_num_threads(count)
            states.append(solve(scene.frames, SolverConfig(), CAMERA).state)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(*states)


def test_fewer_pixels_give_the_same_scene_at_full_size():
    scene = two_layers(96, 240)
    full, half = (solve(scene.frames, SolverConfig(most_pixels=most), CAMERA) for most in (0, 96 * 240 // 4))
    for name in ("state", "visible", "confidence", "moving", "initial_state", "backward_flow"):
        assert getattr(half, name).shape == getattr(full, name).shape
    assert np.median(np.abs(half.state - full.state), axis=(1, 2)).max() < 0.5
    assert (half.visible == full.visible).mean() > 0.9
    assert not np.array_equal(half.state, full.state)
    with pytest.raises(ValueError, match="most_pixels must not be negative"):
        SolverConfig(most_pixels=-1)


@pytest.mark.parametrize("most", [0, 96 * 240 // 2])
def test_pixels_beside_a_jump_take_the_side_of_their_colour(most):
    scene = two_layers(96, 240, apart=0.5)
    wrong = []
    for reach in (0, 2):
        state = solve(scene.frames, SolverConfig(most_pixels=most, edges=EdgesConfig(reach_px=reach)), CAMERA).state
        assert state.flags.c_contiguous
        wrong.append((np.abs(state[0] - scene.state[0]) > 3).mean())
    assert wrong[1] < wrong[0]


def test_a_small_image_is_not_shrunk_below_what_the_method_takes():
    frames = Frames(*(np.full((18, 60, 3), 0.5, np.float32) for _ in range(4)))
    assert solve(frames, SolverConfig(most_pixels=300)).state.shape == (5, 18, 60)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images_give_something_finite(value):
    frames = Frames(*(np.full((40, 60, 3), value, np.float32) for _ in range(4)))
    for config in (SolverConfig(), SolverConfig(start="zero"), SolverConfig(start="opencv")):
        solution = solve(frames, config)
        assert np.isfinite(solution.state).all()
        assert solution.camera_motion is None


def test_the_smallest_images_are_solved_and_smaller_ones_refused():
    rng = np.random.default_rng(0)
    make = lambda h, w: Frames(*(rng.random((h, w, 1)).astype(np.float32) for _ in range(4)))  # noqa: E731
    assert np.isfinite(solve(make(16, 16)).state).all()
    assert np.isfinite(solve(make(17, 90)).state).all()
    with pytest.raises(ValueError, match="too small"):
        solve(make(15, 40))


def test_descent_of_the_papers_energy_runs_unchanged():
    scene = two_layers()
    config = SolverConfig(proposals=False, descent=DescentConfig(levels=2, steps=DescendConfig(steps=15)))
    solution = solve(scene.frames, config)
    energies = [h["energy"] for h in solution.history if h["level"] == 0 and "energy" in h]
    assert min(energies) < max(energies)
    assert solution.reason in ("converged", "step limit")


def test_progress_names_every_stage_in_order():
    seen: list[tuple[str, float]] = []
    solution = solve(two_layers().frames, progress=lambda name, fraction: seen.append((name, fraction)))
    assert [name for name, _ in seen] == [*solution.seconds, "done"]
    assert [fraction for _, fraction in seen] == sorted(fraction for _, fraction in seen)


def test_confidence_doubts_what_was_not_seen():
    state = np.zeros((5, 12, 16), np.float32)
    state[0] = 8
    sure, no = np.ones((12, 16), bool), np.zeros((12, 16), bool)
    cost = np.zeros((12, 16), np.float32)
    best = confidence(state, cost, sure, sure, sure)
    np.testing.assert_allclose(best, 1)
    for worse in (
        confidence(state, cost + 0.5, sure, sure, sure), confidence(state, cost, no, sure, sure),
        confidence(state, cost, sure, sure, no), confidence(state, cost, sure, no, sure),
    ):  # fmt: skip
        assert (worse < 0.9).all()
    state[0, :, 8:] = 30
    beside = confidence(state, cost, sure, sure, sure)
    assert beside[6, 8] < beside[6, 2]


def test_no_motion_is_invented_where_nothing_matches(caplog):
    rng = np.random.default_rng(3)
    frames = Frames(*(rng.random((60, 90, 1)).astype(np.float32) for _ in range(4)))
    with caplog.at_level(logging.INFO):
        solution = solve(frames, camera=CAMERA)
    assert solution.camera_motion is None
    assert solution.moving is None


def test_an_object_that_went_far_is_found_again():
    """Far beyond what dense flow follows; without the search it is lost."""
    random = np.random.default_rng(11)
    texture = [cv2.GaussianBlur(random.random(shape, dtype=np.float32), (0, 0), 1.2) for shape in ((200, 400), (48, 64))]
    background, box = (((each - each.min()) / np.ptp(each))[..., None] for each in texture)
    views = []
    for right, down in ((0, 0), (41, -23)):
        for disparity_of_background, disparity_of_box in ((0, 0), (4, 13)):
            view = background[20:180, 40 + disparity_of_background : 360 + disparity_of_background].copy()
            left = 120 + right - disparity_of_box
            view[70 + down : 118 + down, left : left + 64] = box
            views.append(view)
    left1, right1, left2, right2 = views
    camera = StereoCamera(250.0, 250.0, 160.0, 80.0, 0.4)
    errors = []
    for config in (SolverConfig(), SolverConfig(objects=ObjectsConfig(most=0))):
        state = solve(Frames(left1, right1, left2, right2), config, camera).state[:, 76:112, 128:176]
        errors.append(np.median(np.linalg.norm(state[3:] - np.reshape((41, -23), (2, 1, 1)), axis=0)))
    assert errors[0] < 1
    assert errors[1] > 10
