"""CPU kernel of the refiner's gates: what is let in of each alternative, in one pass over the image."""

from __future__ import annotations

import numpy as np

from learned.jit import tasks


@tasks
def gated_change(first: int, last: int, state: np.ndarray, values: np.ndarray, gates: np.ndarray, divisor: int,
                 out: np.ndarray) -> None:
    """The change of a state, as `learned.refiner` writes it down plainly.

    Parameters
    ----------
    first, last : int
        Rows of all B together; the last is excluded.
    state : np.ndarray
        (B, 5, H, W) float32, pixels.
    values : np.ndarray
        (B, 13, h, w): neighbours' D1, C, u, v; the camera's C, u, v; the second pair's residual; the correction (5).
    gates : np.ndarray
        (B, 5 divisor**2, h, w), with whatever strides: five gates for each pixel of a block, in the order of a pixel shuffle.
    divisor : int
        Side of a block.
    out : np.ndarray
        (B, 5, H, W), the change.
    """
    _, _, height, width = state.shape
    block = divisor * divisor
    for task in range(first, last):
        b, y = task // height, task % height
        row, line = y // divisor, (y % divisor) * divisor
        for x in range(width):
            column, within = x // divisor, line + x % divisor
            near, far = gates[b, within, row, column], gates[b, block + within, row, column]
            motion_near = gates[b, 2 * block + within, row, column]
            motion_camera = gates[b, 3 * block + within, row, column]
            change_far = gates[b, 4 * block + within, row, column]
            residual = values[b, 7, row, column]
            d1 = state[b, 0, y, x]
            out[b, 0, y, x] = near * (values[b, 0, row, column] - d1) + far * residual + values[b, 8, row, column]
            out[b, 1, y, x] = values[b, 9, row, column]
            for i in range(3):
                value = state[b, 2 + i, y, x]
                moved = motion_near * (values[b, 1 + i, row, column] - value)
                moved += motion_camera * (values[b, 4 + i, row, column] - value - moved)
                out[b, 2 + i, y, x] = moved + values[b, 10 + i, row, column]
            out[b, 2, y, x] += change_far * residual
