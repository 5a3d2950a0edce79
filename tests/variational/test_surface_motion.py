"""Motions of one surface from few points: translations that points propose, fits that bear wrong places and disparities."""

import numpy as np
import pytest

from variational.camera import StereoCamera
from variational.rigid import apply_homography, gauss_newton_step, projected, twist
from variational.surface_motion import CLIMBS_PX, climb, fit_from, translations

PROJECTION = StereoCamera(150.0, 160.0, 90.0, 70.0, 0.5).projection()


def moved_points(motion: np.ndarray, count: int, noise_px: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) x, y, disparity of a tilted surface at both times."""
    random = np.random.default_rng(seed)
    first = random.uniform((60, 40, 0), (110, 90, 0), (count, 3))
    first[:, 2] = 12 + 0.03 * (first[:, 0] - 85) - 0.02 * (first[:, 1] - 65)
    homography = PROJECTION @ motion @ np.linalg.inv(PROJECTION)
    return first, apply_homography(homography, first) + random.normal(0, noise_px, (count, 3))


def distance(motion: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.norm(apply_homography(PROJECTION @ motion @ np.linalg.inv(PROJECTION), first) - second, axis=1)


MOTION = twist(np.array([0.9, -0.4, 0.3, 0.02, 0.15, -0.2]))
SHIFT = twist(np.array([0.9, -0.4, 0.3, 0, 0, 0]))


def test_a_few_points_are_enough_among_many_that_are_wrong() -> None:
    """Of forty, twelve are right, in disparity ten; the others went anywhere, nine of them together."""
    first, second = moved_points(MOTION, 40, noise_px=0.3)
    truth = second.copy()
    random = np.random.default_rng(1)
    second[12:31] += random.uniform(25, 60, (19, 3)) * random.choice((-1, 1), (19, 3))
    second[31:] = first[31:] + (-30, 20, 1)
    second[:2, 2] += 20
    proposed = translations(first, second, PROJECTION, 4.0, 6)
    fits = [fit_from(each, first, second, PROJECTION, 4.0, translates=True) for each in proposed]
    errors = [np.median(distance(fit, first, truth)) for fit in fits if fit is not None]
    assert min(errors) < 1.5
    best = fits[int(np.argmin(errors))]
    assert np.median(distance(fit_from(best, first, second, PROJECTION, 1.0, translates=False), first, truth)) < 0.6


def test_places_count_along_the_directions_in_which_they_tell() -> None:
    """Two thirds lie on level edges and have stayed where they began along x; seen across, up and down, they are right."""
    first, second = moved_points(SHIFT, 90)
    truth = second.copy()
    second[30:, 0] = first[30:, 0]
    telling = np.repeat(np.eye(2)[None], 90, axis=0)
    telling[30:, 0, 0] = 0.05
    fitted = fit_from(np.eye(4), first, second, PROJECTION, 4.0, translates=True, telling=telling)
    plain = fit_from(np.eye(4), first, second, PROJECTION, 4.0, translates=True)
    assert fitted is not None
    assert np.median(distance(fitted, first, truth)) < 0.5
    assert plain is not None
    assert np.median(distance(plain, first, truth)) > 3


def test_a_place_that_tells_half_weighs_a_quarter() -> None:
    """Half of the points are off by 4 px along x: the shift that least squares finds, without turning, is 4 * 0.25 / 1.25."""
    first, _ = moved_points(SHIFT, 60)
    first[:, 2] = 12
    second = first.copy()
    second[::2, 0] += 4
    telling = np.repeat(np.eye(2)[None], 60, axis=0)
    telling[::2, 0, 0] = 0.5
    points, motion = projected(first, np.linalg.inv(PROJECTION)), np.eye(4)
    for _ in range(5):
        step = gauss_newton_step(motion, points, second, PROJECTION, np.ones_like, 1e9, telling)
        assert step is not None
        motion = step
    shift = apply_homography(PROJECTION @ motion @ np.linalg.inv(PROJECTION), first) - first
    np.testing.assert_allclose(shift, np.tile([0.8, 0, 0], (60, 1)), atol=0.06)  # disparity couples a little


def test_translations_are_distinct_and_the_most_agreed_on_comes_first() -> None:
    first, second = moved_points(SHIFT, 30)
    second[:10] = first[:10] + (40, 5, 0)
    proposed = translations(first, second, PROJECTION, 2.0, 6)
    homographies = [PROJECTION @ each @ np.linalg.inv(PROJECTION) for each in proposed]
    ends = np.array([np.median(apply_homography(each, first) - first, axis=0) for each in homographies])
    np.testing.assert_allclose(proposed[0], SHIFT, atol=1e-9)
    assert np.abs(ends[1] - (40, 5, 0)).max() < 3
    apart = np.abs(ends[:, None, :2] - ends[None, :, :2]).max(axis=2) + 99 * np.eye(len(ends))
    assert apart.min() >= 1.5 * 2.0
    assert len(translations(first, second, PROJECTION, 2.0, 1)) == 1


def test_places_propose_where_no_disparity_at_time_2_is_right() -> None:
    across = twist(np.array([0.9, -0.4, 0, 0, 0, 0]))
    first, second = moved_points(across, 20)
    truth = second.copy()
    second[:, 2] = np.random.default_rng(3).uniform(30, 90, 20)
    moved = distance(translations(first, second, PROJECTION, 2.0, 1)[0], first, truth)
    assert np.median(moved) < 1


def test_turning_costs_where_points_do_not_tell() -> None:
    """Three points of a small surface, a pixel wrong: without the penalty they are a wild rotation."""
    first, second = moved_points(SHIFT, 3, seed=4)
    first[:, :2] = 85 + (first[:, :2] - 85) / 12
    second = apply_homography(PROJECTION @ SHIFT @ np.linalg.inv(PROJECTION), first)
    second += np.random.default_rng(2).normal(0, 0.7, (3, 3))
    points = projected(first, np.linalg.inv(PROJECTION))

    def angle(turning: float) -> float:
        motion = SHIFT
        for _ in range(10):
            motion = gauss_newton_step(motion, points, second, PROJECTION, np.ones_like, turning)
        return np.degrees(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)))

    assert angle(0) > 5 * angle(16.0)


def test_a_motion_climbs_to_where_more_is_gained() -> None:
    """Nearly two pixels off along x, one along y, and turned a little."""
    first, second = moved_points(MOTION, 60)
    beside = twist(np.array([0.1, -0.05, 0.02, 0, 0, 0.02])) @ MOTION

    def gain_of(transform: np.ndarray) -> float:
        return -float(np.mean(np.minimum(distance(transform, first, second), 8)))

    gain, found = climb(gain_of(beside), beside, first, PROJECTION, gain_of)
    assert gain == gain_of(found)
    assert gain_of(beside) < -2
    assert gain > -0.7


def test_steps_of_a_climb_move_the_surface_by_their_pixels() -> None:
    """Translations exactly; further coordinates less, where they would turn it far."""
    first, second = moved_points(MOTION, 60)
    tried: list[float] = []

    def gain_of(transform: np.ndarray) -> float:
        tried.append(float(np.sqrt(np.mean(distance(transform, first, second) ** 2))))
        return -1.0

    gain, found = climb(0.0, MOTION, first, PROJECTION, gain_of)
    assert gain == 0
    np.testing.assert_array_equal(found, MOTION)
    moved = np.array(tried).reshape(len(CLIMBS_PX), 6, 2) / np.array(CLIMBS_PX)[:, None, None]
    np.testing.assert_allclose(moved[:, :2], 1, rtol=0.02)
    assert moved.max() < 1.1
    assert (moved > 0.1).all()


def test_what_lies_nowhere_does_not_climb() -> None:
    first, _ = moved_points(MOTION, 20)
    for points, motion in ((first * (1, 1, 0), MOTION), (first, twist(np.array([0, 0, -99.0, 0, 0, 0])))):
        gain, found = climb(0.5, motion, points, PROJECTION, lambda transform: 1.0)
        assert gain == 0.5
        assert found is motion


def test_a_point_in_the_camera_does_not_fix_how_to_climb() -> None:
    """Its derivatives are so much larger than all others' that six coordinates are not told apart."""
    first, _ = moved_points(MOTION, 20)
    nearest = projected(first, np.linalg.inv(PROJECTION))[:, 2].min()
    into = twist(np.array([0, 0, 1e-8 - nearest, 0, 0, 0]))
    gain, found = climb(0.5, into, first, PROJECTION, lambda transform: 1.0)
    assert gain == 0.5
    assert found is into


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_fix_no_motion(count: int) -> None:
    first, second = moved_points(MOTION, count)
    assert climb(0.5, MOTION, first, PROJECTION, lambda transform: 1.0) == (0.5, MOTION)
    assert translations(first, second, PROJECTION, 4.0, 6) == []
    assert fit_from(MOTION, first, second, PROJECTION, 4.0, translates=True) is None


def test_inputs_stay_as_they_are() -> None:
    first, second = moved_points(MOTION, 20)
    motion, before = SHIFT.copy(), (SHIFT.copy(), first.copy(), second.copy())
    translations(first, second, PROJECTION, 4.0, 6)
    fit_from(motion, first, second, PROJECTION, 4.0, translates=True)
    climb(0.0, motion, first, PROJECTION, lambda transform: transform[0, 3])
    for now, then in zip((motion, first, second), before, strict=True):
        np.testing.assert_array_equal(now, then)
