"""How close is close: the tolerances that tests of the energy share, each with its reason."""

EXACT = 1e-12
"""float64 against another order of the same float64 arithmetic, relative to the largest value."""

SINGLE_MAP = 2e-5
"""float32 map against float64: SSIM divides rounding errors of 1e-7 by variances of about 1e-3."""

SINGLE_GRADIENT = 1e-3
"""float32 gradient against float64, relative to the largest entry; see SINGLE_MAP, once more divided."""

TAYLOR_ORDER = 1.9
"""A right gradient leaves a remainder of order 2; one that is 1 % wrong, of order 1."""
