"""CPU kernel of the refiner's gates: what is let in of each alternative, in one pass over the image."""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import widen
from learned.elementary import hyperbolic_tangent
from learned.jit import lanes, tasks


@tasks
def gated_change(first: int, last: int, state: np.ndarray, mixture: np.ndarray, camera: np.ndarray, residual: np.ndarray,
                 correction: np.ndarray, gates: np.ndarray, most: float, divisor: int, out: np.ndarray) -> None:
    """The change of a state, as `learned.alternatives` writes it down plainly.

    Parameters
    ----------
    first, last : int
        Rows of blocks of all B together; the last is excluded.
    state : np.ndarray
        (B, 5, H, W) float32, pixels.
    mixture, camera, residual : np.ndarray
        (B, 4, h, w): neighbours' D1, C, u, v; (B, 3, h, w): the camera's C, u, v; (B, 1, h, w): the second pair's residual.
    correction : np.ndarray
        (B, 5, h, w) float32 or uint16, with whatever strides: bounded to `most` by a hyperbolic tangent.
    gates : np.ndarray
        (B, 5 divisor**2, h, w), likewise: five gates for each pixel of a block, in the order of a pixel shuffle; their
        hyperbolic tangents count.
    most : float
    divisor : int
        Side of a block.
    out : np.ndarray
        (B, 5, H, W), the change.
    """
    height = state.shape[2]
    rows, columns = mixture.shape[2:]
    block = divisor * divisor
    opened, added = np.empty((5 * block, columns), np.float32), np.empty((5, columns), np.float32)
    for task in range(first, last):
        b, y = task // rows, task % rows
        for x in range(columns):
            for k in range(5):
                added[k, x] = widen(correction[b, k, y, x])
            for k in range(5 * block):
                opened[k, x] = widen(gates[b, k, y, x])
        for k in range(5):
            _bound(added[k], most)
        for k in range(5 * block):
            _bound(opened[k], np.float32(1))
        for within in range(block):
            line, begin = y * divisor + within // divisor, within % divisor
            if line < height:
                _let_in(state[b, :, line, begin::divisor], mixture[b, :, y], camera[b, :, y], residual[b, 0, y], added,
                        opened[within::block], out[b, :, line, begin::divisor])


@lanes
def _bound(row: np.ndarray, most: float) -> None:
    for x in range(row.size):
        row[x] = most * hyperbolic_tangent(row[x] / most)


@lanes
def _let_in(state: np.ndarray, mixture: np.ndarray, camera: np.ndarray, residual: np.ndarray, added: np.ndarray,
            gates: np.ndarray, out: np.ndarray) -> None:
    """One row of one pixel of each block: (5, w) and so on, gates (5, w)."""
    for x in range(state.shape[1]):
        d1, far = state[0, x], residual[x]
        out[0, x] = gates[0, x] * (mixture[0, x] - d1) + gates[1, x] * far + added[0, x]
        out[1, x] = added[1, x]
        for i in range(3):
            value = state[2 + i, x]
            moved = gates[2, x] * (mixture[1 + i, x] - value)
            moved += gates[3, x] * (camera[i, x] - value - moved)
            out[2 + i, x] = moved + added[2 + i, x]
        out[2, x] += gates[4, x] * far
