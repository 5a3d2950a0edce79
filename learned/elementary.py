"""Functions of one number for CPU kernels, in operations that LLVM turns into vectors; the C library's it calls one by one."""

from __future__ import annotations

import numpy as np

from learned.jit import lanes

_LOG2_E = np.float32(1.4426950408889634)
# Taylor coefficients of 2**x, to x**6: on [-1/2, 1/2] their error is below float32's.
_POWERS = tuple(np.float32(np.log(2) ** n / f) for n, f in enumerate((1, 1, 2, 6, 24, 120, 720)))
# Of the series of ln((1 + s) / (1 - s)) beyond 2 s.
_INVERSES = tuple(np.float32(1 / n) for n in (3, 5, 7, 9))
_LN_2 = np.float32(np.log(2))
_ROOT_HALF = np.float32(0.5**0.5).view(np.int32)
_MOST = np.float32(126)  # largest power of two, either way: beyond it the result stays what it is there


@lanes
def exponential(x: float) -> float:
    """e**x in float32, to a few units in the last place of x * log2(e); NaN stays NaN."""
    power = x * _LOG2_E
    power = _MOST if power > _MOST else (-_MOST if power < -_MOST else power)
    whole = np.floor(power + np.float32(0.5))
    rest = power - whole
    c0, c1, c2, c3, c4, c5, c6 = _POWERS
    value = c0 + rest * (c1 + rest * (c2 + rest * (c3 + rest * (c4 + rest * (c5 + rest * c6)))))
    return value * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@lanes
def hyperbolic_tangent(x: float) -> float:
    """tanh in float32, to about 1e-7."""
    return np.float32(1) - np.float32(2) / (np.float32(1) + exponential(np.float32(2) * x))


@lanes
def logarithm(x: float) -> np.float32:
    """ln(x) in float32 for x in float32's normal range, to about 1e-7; infinity and NaN give NaN."""
    bits = np.float32(x).view(np.int32)
    exponent = np.int32(np.int32(bits - _ROOT_HALF) >> np.int32(23))
    mantissa = np.int32(bits - np.int32(exponent << np.int32(23))).view(np.float32)  # within a factor of sqrt(2) of one
    s = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    square = s * s
    c3, c5, c7, c9 = _INVERSES
    series = np.float32(2) * (s + s * square * (c3 + square * (c5 + square * (c7 + square * c9))))
    return np.float32(exponent) * _LN_2 + series if x < np.float32(np.inf) else np.float32(np.nan)
