"""Sides of jumps: a misplaced edge, what must be left alone, the plain twin, threads and inputs."""

import numba
import numpy as np
import pytest

from variational.edges import EdgesConfig, other_sides

SHAPE = (41, 66)
X, Y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
NEAR = X + Y // 3 < 40
TRUTH = np.where(NEAR, 30 + 0.1 * Y, 8 - 0.05 * X).astype(np.float32)


def painted(near: np.ndarray, channels: int = 3, noise: float = 0.01) -> np.ndarray:
    colours = np.where(near[..., None], [0.2, 0.6, 0.4], [0.7, 0.4, 0.5])[..., :channels]
    return (colours + noise * np.random.default_rng(2).standard_normal(colours.shape)).astype(np.float32)


def fattened(by: int) -> np.ndarray:
    """The near side grown over the far one, or shrunk."""
    return np.where(X - by + Y // 3 < 40, 30 + 0.1 * Y, 8 - 0.05 * X).astype(np.float32)


def settle_edges(disparity: np.ndarray, image: np.ndarray, config: EdgesConfig) -> np.ndarray:
    return disparity.ravel()[other_sides(disparity, image, config)]


@pytest.mark.parametrize("by", [-2, -1, 1, 2])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_misplaced_jump_goes_where_the_colour_changes(by: int, channels: int) -> None:
    wrong = fattened(by)
    settled = settle_edges(wrong, painted(NEAR, channels), EdgesConfig())
    assert (abs(wrong - TRUTH) > 3).sum() > 35
    assert (abs(settled - TRUTH) > 3).sum() < 12  # the ends of the jump see little of either side
    np.testing.assert_array_equal(settled[abs(X + Y // 3 - 40) > 6], wrong[abs(X + Y // 3 - 40) > 6])


def test_a_right_jump_stays_and_so_does_one_that_shows_no_colour() -> None:
    np.testing.assert_array_equal(settle_edges(TRUTH, painted(NEAR), EdgesConfig()), TRUTH)
    wrong = fattened(2)
    np.testing.assert_array_equal(settle_edges(wrong, np.full((*SHAPE, 3), 0.5, np.float32), EdgesConfig()), wrong)


def test_a_slope_is_no_jump() -> None:
    road = (60 - 0.7 * Y + 0.01 * X).astype(np.float32)
    np.testing.assert_array_equal(settle_edges(road, painted(NEAR), EdgesConfig()), road)


def test_nothing_is_done_without_reach() -> None:
    wrong = fattened(2)
    np.testing.assert_array_equal(settle_edges(wrong, painted(NEAR), EdgesConfig(reach_px=0)), wrong)


def plain(disparity: np.ndarray, image: np.ndarray, config: EdgesConfig) -> np.ndarray:
    """The same, pixel by pixel."""
    height, width = disparity.shape

    def window(y: int, x: int, reach: int) -> tuple[slice, slice]:
        return slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1)

    jumps = np.array([[np.ptp(disparity[window(y, x, 1)]) > config.jump_px for x in range(width)] for y in range(height)])
    out = disparity.copy()
    for y in range(height):
        for x in range(width):
            if not jumps[window(y, x, config.reach_px - 1)].any():
                continue
            around = disparity[window(y, x, config.reach_px)]
            middle = (around.min() + around.max()) / 2
            votes, certain, best = np.zeros(2), np.zeros(2), [(0.0, 0.0), (0.0, 0.0)]  # far, near
            reach = 2 * (config.window_px // 2)
            for j in range(y - y % 2 - reach, y - y % 2 + reach + 1, 2):
                for i in range(x - x % 2 - reach, x - x % 2 + reach + 1, 2):
                    if 0 <= j < height and 0 <= i < width:
                        alike = max(1 - abs(image[j, i] - image[y, x]).mean() / config.colour, 0)
                        vote = alike**2 * np.exp(-np.hypot(j - y, i - x) / config.distance_px)
                        side = int(disparity[j, i] > middle)
                        clear = not jumps[window(j, i, config.clear_px - 1)].any()
                        votes[side] += vote
                        certain[side] += vote * clear
                        best[side] = max(best[side], (vote * clear, disparity[j, i]))
            other = 1 - int(disparity[y, x] > middle)
            if votes[other] > 0.5 * votes.sum() and certain[other] > config.majority * certain.sum():
                out[y, x] = best[other][1]
    return out


@pytest.mark.parametrize("config", [EdgesConfig(), EdgesConfig(reach_px=3, clear_px=1, window_px=6, majority=0.6)])
@pytest.mark.parametrize("by", [-2, 2])
def test_it_equals_its_plain_twin(by: int, config: EdgesConfig) -> None:
    wrong, image = fattened(by), painted(NEAR, noise=0.08)
    settled = settle_edges(wrong, image, config)
    assert (settled != wrong).sum() > 40
    np.testing.assert_allclose(settled, plain(wrong, image, config), atol=1e-4)


def test_threads_and_inputs() -> None:
    wrong, image = fattened(2), painted(NEAR)
    kept = wrong.copy(), image.copy()
    results, threads = [], numba.get_num_threads()
    try:
        for count in (1, min(2, threads)):
            numba.set_num_threads(count)
            results.append(settle_edges(wrong, image, EdgesConfig()))
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(*results)
    np.testing.assert_array_equal(wrong, kept[0])
    np.testing.assert_array_equal(image, kept[1])


@pytest.mark.parametrize(
    "wrong",
    [{"reach_px": -1}, {"reach_px": 65}, {"clear_px": 0}, {"window_px": 65}, {"colour": 0}, {"distance_px": 0},
     {"majority": 0.4}],
)
def test_settings_out_of_range_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="EdgesConfig"):
        EdgesConfig(**wrong)
