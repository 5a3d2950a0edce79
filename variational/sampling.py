"""Bilinear sampling at displaced positions: the scalars that every warping kernel shares.

A position is a pixel plus a displacement, ``x + d``. It is clamped to the image, ``0 <= x + d <= size - 1``; a clamped
coordinate has zero derivative. The derivative elsewhere is that of the interpolant in its cell; on a cell's border the
cell to the right (below) counts, on the image's last column (row) the only one there is.

The *displacement* is clamped and split into whole and fraction, never the sum: x + d would cost float32 its digits
(6e-5 px at x = 600), and the whole part added in integers costs none.
"""

import numpy as np

from variational.jit import real, scalar


@scalar
def cell(displacement: float, coordinate: float, size: float) -> tuple[float, float, bool]:
    """The interpolation cell of one coordinate.

    Parameters
    ----------
    displacement : float
        In pixels; not finite counts as outside.
    coordinate, size : float
        Of the pixel and of the axis, as floats of the displacement's type.

    Returns
    -------
    shift : float
        Whole number: the cell's lower pixel is ``coordinate + shift``, in ``[0, max(size - 2, 0)]``.
    fraction : float
        In [0, 1] from the lower pixel to the next.
    inside : bool
        Whether the position is in the image, borders included; the derivative is zero where it is not.
    """
    one = real(1, displacement)
    low, high = -coordinate, size - one - coordinate
    clamped = displacement if displacement > low else low  # in this order NaN becomes a valid position
    clamped = clamped if clamped < high else high
    shift = np.floor(clamped)
    shift = shift if shift < high else high - one  # the last column belongs to the cell on its left
    shift = shift if shift > low else low
    return shift, clamped - shift, clamped == displacement


@scalar
def interpolate(v00: float, v01: float, v10: float, v11: float, fx: float, fy: float) -> tuple[float, float, float]:
    """Value of the bilinear interpolant and its derivatives along x and y; ``v01`` lies right of ``v00``."""
    top, bottom = v01 - v00, v11 - v10
    left = v00 + fx * top
    down = v10 + fx * bottom - left
    return left + fy * down, top + fy * (bottom - top), down
