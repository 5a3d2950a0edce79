"""Elementary functions of kernels against numpy's."""

import numpy as np

from learned.elementary import exponential, hyperbolic_tangent, logarithm
from learned.jit import tasks


@tasks
def _both(first, last, x, powers, tangents):
    for i in range(first, last):
        powers[i], tangents[i] = exponential(x[i]), hyperbolic_tangent(x[i])


def _evaluate(x):
    powers, tangents = np.empty_like(x), np.empty_like(x)
    _both(0, x.size, x, powers, tangents)
    return powers, tangents


def test_they_are_numpys():
    x = np.linspace(-80, 80, 100_001).astype(np.float32)
    powers, tangents = _evaluate(x)
    np.testing.assert_allclose(powers, np.exp(x.astype(np.float64)), rtol=1e-5)
    np.testing.assert_allclose(tangents, np.tanh(x.astype(np.float64)), atol=4e-7)


def test_what_lies_beyond_float32_stays_finite_and_nan_stays_nan():
    powers, tangents = _evaluate(np.array([-1e9, -np.inf, 1e9, np.inf, np.nan], np.float32))
    assert (powers[:2] < 2e-38).all()
    assert (powers[2:4] > 1e37).all()
    assert np.isfinite(powers[:4]).all()
    np.testing.assert_array_equal(tangents[:4], [-1, -1, 1, 1])
    assert np.isnan(powers[4])
    assert np.isnan(tangents[4])


@tasks
def _logarithms(first, last, x, out):
    for i in range(first, last):
        out[i] = logarithm(x[i])


def test_logarithm_is_numpys_and_nan_stays_nan():
    x = np.concatenate([np.logspace(-37, 38, 10_001), np.linspace(0.5, 2, 10_001)]).astype(np.float32)
    out = np.empty_like(x)
    _logarithms(0, x.size, x, out)
    np.testing.assert_allclose(out, np.log(x.astype(np.float64)), rtol=3e-7, atol=2e-7)
    out = np.empty(2, np.float32)
    _logarithms(0, 2, np.array([np.nan, np.inf], np.float32), out)
    assert np.isnan(out).all()
