"""Census, aggregation, selection: against plain twins; signs, borders, threads, inputs."""

import cv2
import numba
import numpy as np
import pytest

from tests import naive_matching
from variational.census import OUTSIDE_COST, census, stereo_costs
from variational.matching import MatchingConfig, _aggregate, _large_steps, aggregate, fill_background, has_evidence, match

SHAPE = (11, 17)


def texture(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).random(shape, dtype=np.float32)
    image = cv2.GaussianBlur(noise, (0, 0), 0.8)
    return (image - image.min()) / (image.max() - image.min())


def pair(disparity: int, shape: tuple[int, int] = (48, 90)) -> tuple[np.ndarray, np.ndarray]:
    """left(x) = right(x - disparity): a wall."""
    wide = texture((shape[0], shape[1] + disparity))
    return np.ascontiguousarray(wide[:, : shape[1]]), np.ascontiguousarray(wide[:, disparity:])


@pytest.mark.parametrize("overlook", [0.0, 0.125])
def test_costs_are_differing_census_bits(overlook: float) -> None:
    left, right = texture(SHAPE, 1), texture(SHAPE, 2)
    costs = stereo_costs(census(left, overlook), census(right, overlook), 6)
    smooth = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in (left, right)]
    for y, x, d in [(0, 0, 0), (0, 3, 2), (5, 9, 4), (10, 16, 5), (7, 5, 5)]:
        expected = naive_matching.census_distance(left, right, x, x - d, y, 1, np.float32(overlook))
        smoothed = np.float32(overlook / np.sqrt(4 * np.pi))  # a Gaussian of one pixel leaves so much of white noise
        expected += naive_matching.census_distance(*smooth, x, x - d, y, 2, smoothed)
        assert costs[y, x, d] == expected
    assert (costs[:, 2, 3:] == OUTSIDE_COST).all()


@pytest.mark.parametrize("shape", [(6, 9, 4), (7, 5, 19), (1, 8, 3)])
def test_aggregation_equals_the_plain_recursion(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(3)
    costs = rng.integers(0, 125, shape).astype(np.uint8)
    grey = rng.random(shape[:2], dtype=np.float32)
    config = MatchingConfig(uniqueness=30)
    large_x, large_y = _large_steps(grey, config)

    def large(y: int, x: int, from_y: int, from_x: int) -> int:
        return int(large_x[y, max(x, from_x)] if y == from_y else large_y[max(y, from_y), x])

    total = naive_matching.aggregate(costs, large, config.small_step)
    expected, expected_matched = naive_matching.select(total, 1.0, config.uniqueness)
    disparity, matched = _aggregate(costs, grey, config)
    np.testing.assert_allclose(disparity, expected, atol=1e-6)
    np.testing.assert_array_equal(matched, expected_matched)


def test_a_recursion_without_diagonals_would_not_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(naive_matching, "PATHS", naive_matching.PATHS[:4])
    with pytest.raises(AssertionError):
        test_aggregation_equals_the_plain_recursion((6, 9, 4))


def test_disparity_is_positive_where_the_right_image_is_shifted_left() -> None:
    left, right = pair(7)
    right_first = match(left, right, MatchingConfig(max_disparity=15))
    inside = right_first.disparity[:, 7:]
    assert np.abs(inside - 7).max() < 0.5
    assert right_first.matched[4:-4, 11:-4].mean() > 0.98
    # Exchanged images have no positive disparity to find: only the mirrored pair has.
    mirrored = match(right[:, ::-1].copy(), left[:, ::-1].copy(), MatchingConfig(max_disparity=15))
    assert np.abs(mirrored.disparity[:, 7:] - 7).max() < 0.5
    assert match(right, left, MatchingConfig(max_disparity=15)).matched.mean() < 0.3


def test_the_range_is_found() -> None:
    left, right = pair(21, (96, 260))
    result = match(left, right, MatchingConfig())
    assert 21 < result.max_disparity < 64
    assert np.abs(result.disparity[:, 21:] - 21).max() < 0.5


def test_the_same_bits_for_one_and_two_threads_and_inputs_unchanged() -> None:
    left, right = pair(5)
    kept = left.copy(), right.copy()
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, min(2, before)):
            numba.set_num_threads(threads)
            results.append(match(left, right, MatchingConfig(max_disparity=12)))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(results[0].disparity, results[1].disparity)
    np.testing.assert_array_equal(results[0].matched, results[1].matched)
    np.testing.assert_array_equal(kept[0], left)
    np.testing.assert_array_equal(kept[1], right)


def test_constant_images_stay_finite() -> None:
    flat = np.full((32, 40), 0.5, np.float32)
    result = match(flat, flat, MatchingConfig())
    np.testing.assert_array_equal(result.disparity, 0)


def test_specks_are_unmatched() -> None:
    costs = np.full((40, 60, 8), 90, np.uint8)
    costs[:, :, 2] = 0
    costs[10:13, 20:23] = 90
    costs[10:13, 20:23, 7] = 0
    config = MatchingConfig(small_step=1, large_step=1)
    _, matched = aggregate(costs, np.zeros((40, 60), np.float32), config)
    assert matched[20:, 10:].all()
    assert not matched[10:13, 20:23].any()


def test_background_fills_from_the_smaller_neighbour_and_empty_rows_from_the_next() -> None:
    disparity = np.array([[0, 5, 0, 0, 9, 0], [0, 0, 0, 0, 0, 0], [0, 0, 3, 0, 0, 0]], np.float32)
    filled = fill_background(disparity, disparity > 0)
    np.testing.assert_array_equal(filled, [[5, 5, 5, 5, 9, 9], [5, 5, 5, 5, 9, 9], [3, 3, 3, 3, 3, 3]])
    assert not fill_background(disparity, np.zeros(disparity.shape, bool)).any()


def test_evidence_is_how_far_the_cost_lies_below_the_average_around() -> None:
    rng = np.random.default_rng(5)
    costs = rng.integers(0, 100, (20, 31, 7), np.uint8)
    disparity = rng.uniform(-0.4, 6.4, (20, 31)).astype(np.float32)
    own = np.empty(disparity.shape)
    for y, x in np.ndindex(own.shape):
        own[y, x] = costs[y, x].mean() - costs[y, x, round(float(disparity[y, x]))]
    padded = np.pad(own, 4, "reflect")
    around = np.array([[padded[y : y + 9, x : x + 9].mean() for x in range(31)] for y in range(20)])
    for least in (-3.0, 0.0, 2.0):
        clear = np.abs(around - least) > 1e-3
        np.testing.assert_array_equal(has_evidence(costs, disparity, least)[clear], (around >= least)[clear])


def test_what_has_no_texture_is_unmatched_though_its_outline_tells_a_disparity() -> None:
    wide = texture((96, 208))
    wide[30:66, 60:140] = 0.5
    left, right = wide[:, :200], np.ascontiguousarray(wide[:, 8:])
    found, kept = (match(left, right, MatchingConfig(31, evidence=least)) for least in (MatchingConfig.evidence, -1e9))
    inside, textured = (slice(42, 54), slice(92, 120)), (slice(4, 22), slice(40, 150))
    assert kept.matched[inside].mean() > 0.5
    assert found.matched[inside].mean() < 0.1
    assert found.matched[textured].mean() > 0.95
    np.testing.assert_array_equal(found.disparity[textured], kept.disparity[textured])


def test_the_end_of_the_range_is_no_match() -> None:
    left, right = pair(12)
    beyond, inside = (match(left, right, MatchingConfig(max_disparity=most)).matched[:, 24:] for most in (12, 13))
    assert not beyond.any()
    assert inside.mean() > 0.9
