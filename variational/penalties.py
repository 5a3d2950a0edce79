"""Robust penalties of a residual: the absolute value and its smooth neighbour.

``rho(r) = sqrt(r^2 + eps^2)`` (Charbonnier; ``|r|`` at eps = 0, with derivative 0 at its kink r = 0). eps has the unit
of the residual: below it the penalty is quadratic, which second-order minimisers need; above it, linear.
Reference: Charbonnier et al. 1997, doi:10.1109/83.551699.
"""

import numpy as np

from variational.jit import scalar


@scalar
def penalty(residual: float, eps: float) -> tuple[float, float]:
    """``rho(r)`` and its derivative; both NaN where the residual is."""
    if eps > 0:
        value = np.sqrt(residual * residual + eps * eps)
        return value, residual / value
    return abs(residual), np.sign(residual)
