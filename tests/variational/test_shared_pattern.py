"""A pattern that all images share: its amplitude, what only looks like it, and a solve that is not misled by it."""

import logging

import cv2
import numpy as np
import pytest

from variational.census import census
from variational.frames import Frames
from variational.initialise import initialise
from variational.matching import MatchingConfig
from variational.proposals import motion_words
from variational.shared_pattern import pattern_amplitude
from variational.solver import SolverConfig, solve
from variational.state import D1

SHAPE, DISPARITY, LEVEL = (96, 168), 12, 1 / 255
DEVIATION = 0.5 * LEVEL
WALL = (slice(24, 72), slice(40, 120))


def texture(shape: tuple[int, int], seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random(shape, dtype=np.float32)
    return 0.2 + 0.5 * cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.0), None, 0, 1, cv2.NORM_MINMAX)


def pattern(seed: int) -> np.ndarray:
    """An even distribution of the deviation above."""
    return (np.sqrt(12) * DEVIATION * (np.random.default_rng(seed).random(SHAPE) - 0.5)).astype(np.float32)


def white_wall(views: list[np.ndarray]) -> list[np.ndarray]:
    """Four views of a textured plane at a disparity of 12, with a wall without a texture hanging on it."""
    room = texture((SHAPE[0], SHAPE[1] + DISPARITY), 1)
    room[WALL[0], WALL[1].start : WALL[1].stop] = 0.8
    left, right = room[:, : SHAPE[1]], room[:, DISPARITY:]
    return [scene + view for scene, view in zip((left, right, left, right), views, strict=True)]


def frames(images: list[np.ndarray]) -> Frames:
    return Frames(*(np.ascontiguousarray(image[..., None]) for image in images))


def test_amplitude_is_four_deviations_and_is_told(caplog: pytest.LogCaptureFixture) -> None:
    images = frames(white_wall([pattern(0)] * 4)).grey
    before = [image.copy() for image in images]
    with caplog.at_level(logging.INFO):
        assert pattern_amplitude(images) == pytest.approx(4 * DEVIATION, rel=0.1)
    assert "share a pattern of 0.5" in caplog.text
    for image, copy in zip(images, before, strict=True):
        np.testing.assert_array_equal(image, copy)


@pytest.mark.parametrize("of_its_own", [1, 2, 3])
def test_noise_of_its_own_in_one_image_is_no_shared_pattern(of_its_own: int) -> None:
    views = [pattern(0)] * 4
    views[of_its_own] = pattern(1)
    assert pattern_amplitude(frames(white_wall(views)).grey) == 0


def test_a_clean_scene_and_a_scene_far_away_have_none() -> None:
    assert pattern_amplitude(frames(white_wall([np.zeros(SHAPE, np.float32)] * 4)).grey) == 0
    far = cv2.GaussianBlur(texture(SHAPE, 3), (0, 0), 6.0)  # all four the same, and smooth: alike beside as well
    assert pattern_amplitude((far, far, far, far)) == 0


def test_too_little_that_is_flat_tells_nothing() -> None:
    scene = texture(SHAPE, 1)
    assert pattern_amplitude(frames([scene + pattern(0)] * 4).grey) == 0
    scene[:20, :20] = 0.5  # 324 pixels whose neighbours are flat, too
    assert pattern_amplitude(frames([scene + pattern(0)] * 4).grey) == 0
    scene[20:30, :20] = 0.5
    assert pattern_amplitude(frames([scene + pattern(0)] * 4).grey) > 0


@pytest.mark.parametrize("most_pixels", [0, SHAPE[0] * SHAPE[1] // 2])
def test_a_white_wall_is_not_matched_by_the_pattern(monkeypatch: pytest.MonkeyPatch, most_pixels: int) -> None:
    images, config = frames(white_wall([pattern(0)] * 4)), SolverConfig(most_pixels=most_pixels)
    error = np.abs(solve(images, config).state[D1][WALL] - DISPARITY)
    assert (error > 3).mean() < 0.1
    monkeypatch.setattr("variational.solver.pattern_amplitude", lambda grey: 0.0)
    misled = np.abs(solve(images, config).state[D1][WALL] - DISPARITY)
    assert (misled > 3).mean() > 0.4, "the scene no longer shows what the pattern does"


@pytest.mark.parametrize("overlook", [0.0, 4 * DEVIATION])
def test_motions_are_compared_with_nothing_overlooked(overlook: float) -> None:
    images, config = frames(white_wall([pattern(0)] * 4)), MatchingConfig(overlook=overlook)
    start = initialise(images, "matching", config)
    for words, image in zip(motion_words(start, images, config), (images.grey[k] for k in (0, 2, 3)), strict=True):
        np.testing.assert_array_equal(words, census(image))
    assert (start.match1.words_left == census(images.grey[0], overlook)).all()


def test_a_smaller_size_overlooks_what_averaging_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    images = frames(white_wall([pattern(0)] * 4))
    told = []
    monkeypatch.setattr("variational.solver.initialise", lambda frames, name, config: told.append(config.overlook) or 1 / 0)
    monkeypatch.setattr("variational.solver.pattern_amplitude", lambda grey: 0.02 if grey[0].shape == SHAPE else 0.0)
    with pytest.raises(ZeroDivisionError):
        solve(images, SolverConfig(most_pixels=SHAPE[0] * SHAPE[1] // 4))
    assert told == [pytest.approx(0.01)]


@pytest.mark.parametrize("overlook", [-0.1, 1.0, float("nan")])
def test_differences_larger_than_the_range_are_refused(overlook: float) -> None:
    with pytest.raises(ValueError, match=r"MatchingConfig.overlook must lie in 0 \.\.\. 1"):
        MatchingConfig(overlook=overlook)
