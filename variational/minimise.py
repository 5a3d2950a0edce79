"""Minimisers. They know arrays and systems, nothing of images.

`relax` minimises a sum of quadratic forms, one a pixel, and of weighted squared differences of neighbours, by red-black
successive over-relaxation with a 4 x 4 solve at each pixel. `descend` minimises anything that gives a value and a
gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from variational.jit import parallel, prange, scalar, total

GROUPS = 4
"""Channels that are smoothed together: D1; C; u and v; D2."""


@scalar
def _solve4(a: np.ndarray, b: np.ndarray) -> None:
    """b <- A^-1 b by Cholesky's decomposition; a holds the upper triangle by rows and is overwritten."""
    l0 = np.sqrt(a[0])
    l1, l2, l3 = a[1] / l0, a[2] / l0, a[3] / l0
    m1 = np.sqrt(a[4] - l1 * l1)
    m2, m3 = (a[5] - l1 * l2) / m1, (a[6] - l1 * l3) / m1
    n2 = np.sqrt(a[7] - l2 * l2 - m2 * m2)
    n3 = (a[8] - l2 * l3 - m2 * m3) / n2
    o3 = np.sqrt(a[9] - l3 * l3 - m3 * m3 - n3 * n3)
    y0 = b[0] / l0
    y1 = (b[1] - l1 * y0) / m1
    y2 = (b[2] - l2 * y0 - m2 * y1) / n2
    y3 = (b[3] - l3 * y0 - m3 * y1 - n3 * y2) / o3
    b[3] = y3 / o3
    b[2] = (y2 - n3 * b[3]) / n2
    b[1] = (y1 - m2 * b[2] - m3 * b[3]) / m1
    b[0] = (y0 - l1 * b[1] - l2 * b[2] - l3 * b[3]) / l0


@parallel
def _smoothness_weights(
    field: np.ndarray, edges: np.ndarray, edges2: np.ndarray, lambdas: np.ndarray, eps2: float,
    weights: np.ndarray, energy: np.ndarray,
) -> None:  # fmt: skip
    """weights (H, W, 2 * GROUPS): between each pixel and the one to the left, then the one above; 0 at the border."""
    _, height, width = field.shape
    for y in prange(height):
        row = 0.0
        for x in range(width):
            for axis in range(2):
                if (axis == 0 and x == 0) or (axis == 1 and y == 0):
                    for g in range(GROUPS):
                        weights[y, x, 2 * g + axis] = 0
                    continue
                yy, xx = np.int64(y) - axis, x - 1 + axis
                for g in range(GROUPS):
                    if g == 2:
                        square = (field[3, y, x] - field[3, yy, xx]) ** 2 + (field[4, y, x] - field[4, yy, xx]) ** 2
                    else:
                        channel = 0 if g == 0 else (2 if g == 1 else 1)
                        square = (field[channel, y, x] - field[channel, yy, xx]) ** 2
                    root = np.sqrt(square + eps2)
                    strength = lambdas[g] * (edges2[axis, y, x] if g == 3 else edges[axis, y, x])
                    weights[y, x, 2 * g + axis] = strength / root
                    row += strength * root
        energy[y] = row


@parallel
def _sweep(
    field: np.ndarray, systems: np.ndarray, right_side: np.ndarray, weights: np.ndarray, pull: np.ndarray,
    colour: int, omega: float,
) -> None:  # fmt: skip
    """One half sweep over the pixels of one colour; right_side (H, W, 5) is in the order D1, C, u, v, D2."""
    _, height, width = field.shape
    for y in prange(height):
        a, b = np.empty(10, np.float32), np.empty(5, np.float32)
        diagonal = np.empty(GROUPS, np.float32)
        for x in range((y + colour) % 2, width, 2):
            b[:] = right_side[y, x]
            diagonal[:] = pull[y, x]  # towards a correction of zero: nothing on the right side
            for side in range(4):
                axis, step = side // 2, 2 * (side % 2) - 1  # left, right, above, below
                yy, xx = np.int64(y) + step * axis, x + step * (1 - axis)
                if yy < 0 or yy >= height or xx < 0 or xx >= width:
                    continue
                w = weights[max(yy, np.int64(y)), max(xx, x)]
                b[0] += w[axis] * field[0, yy, xx]
                b[1] += w[2 + axis] * field[2, yy, xx]
                b[2] += w[4 + axis] * field[3, yy, xx]
                b[3] += w[4 + axis] * field[4, yy, xx]
                b[4] += w[6 + axis] * field[1, yy, xx]
                for g in range(GROUPS):
                    diagonal[g] += w[2 * g + axis]
            s = systems[y, x]
            for k in range(10):
                a[k] = s[k]
            a[0] += diagonal[0]
            a[4] += diagonal[1]
            a[7] += diagonal[2]
            a[9] += diagonal[2]
            second = b[4] / (s[14] + diagonal[3])
            _solve4(a, b)
            field[0, y, x] += omega * (b[0] - field[0, y, x])
            field[2, y, x] += omega * (b[1] - field[2, y, x])
            field[3, y, x] += omega * (b[2] - field[3, y, x])
            field[4, y, x] += omega * (b[3] - field[4, y, x])
            field[1, y, x] += omega * (second - field[1, y, x])


@parallel
def _right_side(field: np.ndarray, systems: np.ndarray, out: np.ndarray) -> None:
    """A z - b for the unknowns of `field`: what A z_new must be where nothing is smooth."""
    _, height, width = field.shape
    for y in prange(height):
        for x in range(width):
            s = systems[y, x]
            z0, z1, z2, z3 = field[0, y, x], field[2, y, x], field[3, y, x], field[4, y, x]
            out[y, x, 0] = s[0] * z0 + s[1] * z1 + s[2] * z2 + s[3] * z3 - s[10]
            out[y, x, 1] = s[1] * z0 + s[4] * z1 + s[5] * z2 + s[6] * z3 - s[11]
            out[y, x, 2] = s[2] * z0 + s[5] * z1 + s[7] * z2 + s[8] * z3 - s[12]
            out[y, x, 3] = s[3] * z0 + s[6] * z1 + s[8] * z2 + s[9] * z3 - s[13]
            out[y, x, 4] = s[14] * field[1, y, x] - s[15]


@dataclass(frozen=True)
class RelaxConfig:
    """Smoothness and relaxation.

    Parameters
    ----------
    disparity, change, flow : float
        Smoothness weights of D1 and D2, of C, and of (u, v), per pixel; raising them flattens.
    eps_px : float
        Difference of neighbours below which the penalty is quadratic.
    sweeps : int
        Relaxation sweeps for one system.
    omega : float
        Over-relaxation, in (0, 2).
    """

    disparity: float = 0.15
    change: float = 0.15
    flow: float = 0.15
    eps_px: float = 0.05
    sweeps: int = 20
    omega: float = 1.7


def relax(
    state: np.ndarray, reference: np.ndarray, systems: np.ndarray, edges: np.ndarray, edges2: np.ndarray, pull: np.ndarray,
    config: RelaxConfig,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Minimise the quadratic model around a state, smooth in its difference from a reference.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W) float32, where the systems were made.
    reference : np.ndarray
        (5, H, W); smoothness and pull act on ``state - reference``. Zero makes the state itself smooth.
    systems : np.ndarray
        (H, W, SYSTEM), variational.terms.constancy.
    edges, edges2 : np.ndarray
        (2, H, W) in [0, 1], factor of the smoothness between a pixel and its left, upper neighbour, on left1's and
        left2's grid.
    pull : np.ndarray
        (H, W, GROUPS) float32 > 0, weight of the squared correction: what is certain moves less, and what nothing else
        fixes stays.

    Returns
    -------
    state : np.ndarray
        (5, H, W) float32, new.
    energy : float
        Data, smoothness and pull at the state that came in.
    """
    height, width = state.shape[1:]
    field = state - reference
    weights, rows = np.empty((height, width, 2 * GROUPS), np.float32), np.empty(height)
    lambdas = np.array([config.disparity, config.change, config.flow, config.disparity], np.float32)
    _smoothness_weights(field, edges, edges2, lambdas, np.float32(config.eps_px**2), weights, rows)
    data = systems[..., 16] + systems[..., 17]
    corrections = pull * np.stack([field[0] ** 2, field[2] ** 2, field[3] ** 2 + field[4] ** 2, field[1] ** 2], axis=-1) / 2
    energy = total(data) + float(rows.cumsum()[-1]) + total(corrections.sum(axis=-1))
    right_side = np.empty((height, width, 5), np.float32)
    _right_side(field, systems, right_side)
    for _ in range(config.sweeps):
        for colour in (0, 1):
            _sweep(field, systems, right_side, weights, pull, colour, np.float32(config.omega))
    return reference + field, energy


@dataclass(frozen=True)
class DescendConfig:
    """First-order descent.

    Parameters
    ----------
    steps : int
        Most steps taken.
    step_px : float
        Length of the first steps of each unknown, in pixels; it falls to a tenth along a cosine.
    momentum, memory : float
        Decay of the mean gradient and of the mean square that scales it (Adam's beta1 and beta2).
    tolerance : float
        Stop when the best energy of the last `patience` steps has not fallen by this share.
    patience : int
    """

    steps: int = 60
    step_px: float = 0.2
    momentum: float = 0.8
    memory: float = 0.9
    tolerance: float = 1e-4
    patience: int = 10


def descend(
    value_and_gradient: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray, config: DescendConfig
) -> tuple[np.ndarray, list[float], str]:
    """Minimise anything by gradient steps scaled per unknown (Adam, Kingma and Ba 2015); returns the best state seen.

    Parameters
    ----------
    value_and_gradient : callable
        state -> (energy, gradient of the state's shape).
    start : np.ndarray
        Not changed.

    Returns
    -------
    state : np.ndarray
        Of the lowest energy seen: never worse than the start, never with a NaN that the start has not.
    energies : list of float
        One a step, the start's first.
    reason : str
        "converged", "step limit" or "not finite".
    """
    state, best, best_energy = start.copy(), start, np.inf
    mean, square = np.zeros_like(start), np.zeros_like(start)
    energies: list[float] = []
    for step in range(config.steps + 1):
        energy, gradient = value_and_gradient(state)
        if not (np.isfinite(energy) and np.isfinite(gradient).all()):
            return best, energies, "not finite"
        energies.append(energy)
        if energy < best_energy:
            best, best_energy = state, energy
        if step > config.patience:
            before = min(energies[: -config.patience])
            if before - min(energies) < config.tolerance * abs(before):
                return best, energies, "converged"
        mean = config.momentum * mean + (1 - config.momentum) * gradient
        square = config.memory * square + (1 - config.memory) * gradient**2
        corrected = mean / (1 - config.momentum ** (step + 1))
        scale = np.sqrt(square / (1 - config.memory ** (step + 1))) + 1e-12
        length = config.step_px * (0.55 + 0.45 * np.cos(np.pi * step / max(config.steps, 1)))
        state = (state - length * corrected / scale).astype(start.dtype)
    return best, energies, "step limit"
