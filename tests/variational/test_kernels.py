"""The small scalars under the terms, and what the compiler makes of them."""

import multiprocessing
import time
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest

from variational.jit import _products_of_matrices, band_edges, over_bands, over_rows, rowwise, side_by_side, total
from variational.penalties import penalty
from variational.sampling import cell, interpolate
from variational.terms.photometric import padded_planes, reflect, window_overlap


@pytest.mark.parametrize(("displacement", "coordinate", "size", "expected"), [
    (0.25, 3, 8, (0, 0.25, True)), (-0.25, 3, 8, (-1, 0.75, True)), (4, 3, 8, (3, 1, True)), (-3, 3, 8, (-3, 0, True)),
    (4.5, 3, 8, (3, 1, False)), (-9, 3, 8, (-3, 0, False)), (np.inf, 3, 8, (3, 1, False)),
    (np.nan, 3, 8, (-3, 0, False)),
    (0, 0, 1, (0, 0, True)), (2, 0, 1, (0, 0, False)),
])
def test_cell(displacement, coordinate, size, expected):
    assert cell(float(displacement), float(coordinate), float(size)) == expected


def test_interpolate_is_bilinear_and_its_derivatives_are_right():
    rng = np.random.default_rng(0)
    corners, (fx, fy), h = rng.random(4), rng.random(2), 1e-6
    value, dx, dy = interpolate(*corners, fx, fy)
    weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    assert value == pytest.approx(weights @ corners)
    assert dx == pytest.approx((interpolate(*corners, fx + h, fy)[0] - interpolate(*corners, fx - h, fy)[0]) / (2 * h))
    assert dy == pytest.approx((interpolate(*corners, fx, fy + h)[0] - interpolate(*corners, fx, fy - h)[0]) / (2 * h))


def test_penalty():
    assert penalty(-3.0, 0.0) == (3, -1)
    assert penalty(0.0, 0.0) == (0, 0)
    assert penalty(3.0, 4.0) == (5, 0.6)
    assert np.isnan(penalty(np.nan, 0.0)).all()


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_window_overlap_is_adjoint_of_reflected_windows(size):
    """<M a, b> = <a, M^T b> for the sum over three pixels with reflection."""
    rng = np.random.default_rng(size)
    a, b = rng.random(size), rng.random(size)
    forward = np.array([sum(a[reflect(i + j, size)] for j in (-1, 0, 1)) for i in range(size)])
    padded = np.concatenate([[0], b, [0]])
    left, centre, right = window_overlap(size, np.float64)
    adjoint = left * padded[:-2] + centre * padded[1:-1] + right * padded[2:]
    assert forward @ b == pytest.approx(a @ adjoint)


def test_padded_planes_reflect():
    image = np.arange(24.0).reshape(2, 4, 3)
    padded = padded_planes(image, np.float64)
    assert padded.shape == (3, 4, 6)
    assert np.array_equal(padded[:, 1:-1, 1:-1], image.transpose(2, 0, 1))
    assert np.array_equal(padded, np.pad(image.transpose(2, 0, 1), ((0, 0), (1, 1), (1, 1)), mode="reflect"))


def test_total_is_a_float64_sum_in_row_order():
    values = np.random.default_rng(0).random((40, 50)).astype(np.float32)
    assert total(values) == pytest.approx(values.astype(np.float64).sum(), rel=1e-13)


def test_bands_cover_every_row_once():
    for height in (1, 2, 47, 48, 375):
        edges = band_edges(height)
        assert edges[0] == 0
        assert edges[-1] == height
        assert (np.diff(edges) > 0).all()


@rowwise
def count(first, last, visits):
    for y in range(first, last):
        for x in range(visits.shape[1]):
            visits[y, x] += 1


def test_every_row_is_visited_once_whoever_else_calls():
    counted = [np.zeros((300, 40), np.int32) for _ in range(8)]
    with ThreadPoolExecutor(4) as callers:
        list(callers.map(lambda visits: [over_rows(count, 300, visits) for _ in range(50)], counted))
    over_bands(count, [0, 7, 8, 100], counted[0])
    assert (counted[0][:100] == 51).all()
    assert (counted[0][100:] == 50).all()
    assert all((visits == 50).all() for visits in counted[1:])


def test_an_error_in_any_band_reaches_the_caller():
    def refuse(first, last, bad):
        time.sleep(0.002)  # so that a helper takes bands too
        if first == bad:
            raise OverflowError(f"band {bad}")

    for bad in range(8):
        with pytest.raises(OverflowError, match=f"band {bad}"):
            over_bands(refuse, range(9), bad)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread has nothing to share")
def test_stages_side_by_side_share_the_threads_also_for_products_of_matrices():
    def products():
        return [library["num_threads"] for library in _products_of_matrices().info()]

    before, threads = products(), numba.get_num_threads()
    numba.set_num_threads(2)
    try:
        shares = side_by_side(*[lambda: (numba.get_num_threads(), products())] * 2)
        with pytest.raises(ZeroDivisionError):
            side_by_side(lambda: 1 / 0, products)
    finally:
        numba.set_num_threads(threads)
    assert before
    assert shares == [(1, [1] * len(before))] * 2
    assert products() == before


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_has_helpers_of_its_own():
    visits = np.zeros((300, 40), np.int32)
    over_rows(count, 300, visits)
    child = multiprocessing.get_context("fork").Process(target=over_rows, args=(count, 300, visits))
    child.start()
    child.join(20)
    assert child.exitcode == 0
