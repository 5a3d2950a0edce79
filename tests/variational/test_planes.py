"""Planes of even regions: known walls, what must be left alone, threads and inputs."""

import numba
import numpy as np
import pytest

from variational.planes import PlanesConfig, even_regions, fit_planes, plane_disparities

SHAPE = (90, 140)
X, Y = np.meshgrid(np.arange(SHAPE[1], dtype=np.float32), np.arange(SHAPE[0], dtype=np.float32))
WALL = 12 + 0.05 * X - 0.03 * Y


def two_colours() -> np.ndarray:
    """A blue half and an orange half, equally bright to a grey camera."""
    image = np.empty((*SHAPE, 3), np.float32)
    image[:, :70] = 0.8, 0.5, 0.2
    image[:, 70:] = 0.2, 0.5, 0.5
    return image


def sparse(share: float = 0.05, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE) < share


def test_regions_end_where_the_colour_does() -> None:
    labels, statistics = even_regions(two_colours(), PlanesConfig())
    assert len(statistics) == 3
    assert labels[5, 5] != labels[5, 135]
    assert (labels[:, 69:71] == 0).all()


@pytest.mark.parametrize(("channels", "limit"), [(3, 0.6), (1, 0.6 / 3**0.5)])
def test_regions_equal_their_plain_twin(channels: int, limit: float) -> None:
    image = np.random.default_rng(1).random((12, 17, channels), dtype=np.float32)
    config = PlanesConfig(blur_px=1e-3, contrast=0.6)  # as good as no smoothing
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    steps = [abs(image - padded[j : j + 12, i : i + 17]).max(axis=2) for j, i in ((0, 1), (2, 1), (1, 0), (1, 2))]
    even = np.max(steps, axis=0) <= limit
    assert 0.05 < even.mean() < 0.95
    np.testing.assert_array_equal(even_regions(image, config)[0] > 0, even)


def test_a_wall_is_known_from_few_matches_of_which_some_are_wrong() -> None:
    matched = sparse()
    wrong = matched & (sparse(0.3, 1) & (Y > 45))
    disparity = np.where(wrong, 40, np.where(matched, WALL, 0)).astype(np.float32)
    image = np.full((*SHAPE, 1), 0.4, np.float32)
    found = plane_disparities(image, disparity, matched, PlanesConfig())
    assert 0.1 < wrong.sum() / matched.sum() < 0.3
    np.testing.assert_allclose(found, WALL, atol=0.05)


def test_two_surfaces_of_one_colour_are_two_planes() -> None:
    bent = np.where(X < 70, WALL, WALL + 25).astype(np.float32)
    matched = sparse(0.1)
    found = plane_disparities(np.full((*SHAPE, 3), 0.4, np.float32), bent, matched, PlanesConfig())
    away = abs(X - 69.5) > 15
    np.testing.assert_allclose(found[away], bent[away], atol=0.05)


def test_a_region_keeps_to_its_own_matches() -> None:
    step = np.where(X < 70, WALL, WALL + 25).astype(np.float32)
    found = plane_disparities(two_colours(), step, sparse(0.1), PlanesConfig(most=1))
    known = np.isfinite(found)
    assert known[:, 5:60].all()
    assert known[:, 80:135].all()
    np.testing.assert_allclose(found[known], step[known], atol=0.05)


@pytest.mark.parametrize("case", ["random", "no matches", "all matched", "texture", "switched off"])
def test_what_is_not_known_stays_unknown(case: str) -> None:
    random = np.random.default_rng(3)
    disparity = random.uniform(0, 60, SHAPE).astype(np.float32) if case == "random" else WALL
    matched = {"no matches": np.zeros(SHAPE, bool), "all matched": np.ones(SHAPE, bool)}.get(case, sparse())
    image = random.random((*SHAPE, 3), dtype=np.float32) if case == "texture" else np.full((*SHAPE, 3), 0.4, np.float32)
    config = PlanesConfig(most=0) if case == "switched off" else PlanesConfig()
    assert np.isnan(plane_disparities(image, disparity, matched, config)).all()


def test_points_on_a_line_are_no_plane() -> None:
    points = np.column_stack([np.arange(80.0), np.zeros(80), np.full(80, 7.0)])
    planes, belongs = fit_planes(points, PlanesConfig())
    assert np.isfinite(planes).all()  # either nothing, or one that goes through them
    for plane, (x, y, d) in zip(planes[belongs[belongs >= 0]], points[belongs >= 0], strict=True):
        assert abs(plane @ (x, y, 1) - d) < 2


def test_same_bits_for_any_number_of_threads_and_inputs_unchanged() -> None:
    image, matched, before = two_colours(), sparse(), numba.get_num_threads()
    inputs = [array.copy() for array in (image, WALL, matched)]
    try:
        results = []
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            results.append(plane_disparities(image, WALL, matched, PlanesConfig()))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(*results)
    for array, copy in zip((image, WALL, matched), inputs, strict=True):
        np.testing.assert_array_equal(array, copy)
