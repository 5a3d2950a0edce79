"""Minimisers. They know arrays and systems, nothing of images.

`relax` minimises a sum of quadratic forms, one a pixel, and of weighted squared differences of neighbours, by red-black
successive over-relaxation with a 4 x 4 solve at each pixel, whose matrix is factorised once. `descend` minimises
anything that gives a value and a gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from variational.jit import band_edges, over_bands, over_rows, rowwise, scalar

GROUPS = 4
"""Channels that are smoothed together: D1; C; u and v; D2."""
CHANNELS = (0, 2, 3, 4, 1)
"""The state's channels in the order of a pixel's system and of the fields in here: D1, C, u, v, D2."""
PREPARED = 16
"""Numbers a pixel that sweeps read, one cache line: 10 of a Cholesky factor, 1 / A of D2, 5 right sides."""


@scalar
def _factorise(a: np.ndarray) -> None:
    """Upper triangle (by rows) of a 4 x 4 matrix -> its Cholesky factor, reciprocals on the diagonal."""
    one = np.float32(1)
    a[0] = one / np.sqrt(a[0])
    a[1], a[2], a[3] = a[1] * a[0], a[2] * a[0], a[3] * a[0]
    a[4] = one / np.sqrt(a[4] - a[1] * a[1])
    a[5], a[6] = (a[5] - a[1] * a[2]) * a[4], (a[6] - a[1] * a[3]) * a[4]
    a[7] = one / np.sqrt(a[7] - a[2] * a[2] - a[5] * a[5])
    a[8] = (a[8] - a[2] * a[3] - a[5] * a[6]) * a[7]
    a[9] = one / np.sqrt(a[9] - a[3] * a[3] - a[6] * a[6] - a[8] * a[8])


@rowwise
def _subtract(first: int, last: int, state: np.ndarray, reference: np.ndarray, field: np.ndarray) -> None:
    """field (H + 2, W + 2, 5), zero at its rim: what a state differs by from its reference, pixel by pixel."""
    width = state.shape[2]
    for y in range(first, last):
        for x in range(width):
            for i, channel in enumerate(CHANNELS):
                field[y + 1, x + 1, i] = state[channel, y, x] - reference[channel, y, x]


@rowwise
def _add(first: int, last: int, reference: np.ndarray, field: np.ndarray, state: np.ndarray) -> None:
    width = state.shape[2]
    for y in range(first, last):
        for i, channel in enumerate(CHANNELS):
            for x in range(width):
                state[channel, y, x] = reference[channel, y, x] + field[y + 1, x + 1, i]


@rowwise
def _smoothness_weights(
    first: int, last: int, field: np.ndarray, edges: np.ndarray, edges2: np.ndarray, lambdas: np.ndarray, eps2: float,
    weights: np.ndarray, energy: np.ndarray,
) -> None:  # fmt: skip
    """weights (H + 1, W + 1, 2 * GROUPS), zero at first: of each pixel with the one to the left, then the one above."""
    width = edges.shape[2]
    for y in range(first, last):
        row = 0.0
        for x in range(width):
            here = field[y + 1, x + 1]
            for axis in range(2):
                if (axis == 0 and x == 0) or (axis == 1 and y == 0):
                    continue
                other = field[y + 1 - axis, x + axis]
                for g in range(GROUPS):
                    channel = g if g < 3 else 4
                    square = (here[channel] - other[channel]) ** 2
                    if g == 2:
                        square += (here[3] - other[3]) ** 2
                    root = np.sqrt(square + eps2)
                    strength = lambdas[g] * (edges2[axis, y, x] if g == 3 else edges[axis, y, x])
                    weights[y, x, 2 * g + axis] = strength / root
                    row += strength * root
        energy[y] = row


@rowwise
def _prepare(
    first: int, last: int, field: np.ndarray, systems: np.ndarray, weights: np.ndarray, pull: np.ndarray,
    prepared: np.ndarray, energy: np.ndarray,
) -> None:  # fmt: skip
    """prepared (H, W, PREPARED); adds the energies of data and pull at `field` to those of each row.

    The right side is A z - b for the unknowns z of the field: what A z_new must be where nothing is smooth. The pull
    towards a correction of zero adds nothing to it.
    """
    width = systems.shape[1]
    for y in range(first, last):
        row = 0.0
        for x in range(width):
            s, a, z, p = systems[y, x], prepared[y, x], field[y + 1, x + 1], pull[y, x]
            own, right, below = weights[y, x], weights[y, x + 1], weights[y + 1, x]
            for k in range(10):
                a[k] = s[k]
            a[0] += own[0] + own[1] + right[0] + below[1] + p[0]
            a[4] += own[2] + own[3] + right[2] + below[3] + p[1]
            flow = own[4] + own[5] + right[4] + below[5] + p[2]
            a[7] += flow
            a[9] += flow
            a[10] = np.float32(1) / (s[14] + own[6] + own[7] + right[6] + below[7] + p[3])
            _factorise(a)
            a[11] = s[0] * z[0] + s[1] * z[1] + s[2] * z[2] + s[3] * z[3] - s[10]
            a[12] = s[1] * z[0] + s[4] * z[1] + s[5] * z[2] + s[6] * z[3] - s[11]
            a[13] = s[2] * z[0] + s[5] * z[1] + s[7] * z[2] + s[8] * z[3] - s[12]
            a[14] = s[3] * z[0] + s[6] * z[1] + s[8] * z[2] + s[9] * z[3] - s[13]
            a[15] = s[14] * z[4] - s[15]
            squares = p[0] * z[0] ** 2 + p[1] * z[1] ** 2 + p[2] * (z[2] ** 2 + z[3] ** 2) + p[3] * z[4] ** 2
            row += s[16] + s[17] + np.float32(0.5) * squares
        energy[y] += row


@rowwise
def _relax_row(
    field: np.ndarray, prepared: np.ndarray, weights: np.ndarray, y: int, colour: int, omega: np.float32
) -> None:
    """Relax the pixels of one colour in one row."""
    width = prepared.shape[1]
    for x in range((y + colour) % 2, width, 2):
        a, z = prepared[y, x], field[y + 1, x + 1]
        own, w_right, w_below = weights[y, x], weights[y, x + 1], weights[y + 1, x]
        left, right, above, below = field[y + 1, x], field[y + 1, x + 2], field[y, x + 1], field[y + 2, x + 1]
        b0 = a[11] + own[0] * left[0] + w_right[0] * right[0] + own[1] * above[0] + w_below[1] * below[0]
        b1 = a[12] + own[2] * left[1] + w_right[2] * right[1] + own[3] * above[1] + w_below[3] * below[1]
        b2 = a[13] + own[4] * left[2] + w_right[4] * right[2] + own[5] * above[2] + w_below[5] * below[2]
        b3 = a[14] + own[4] * left[3] + w_right[4] * right[3] + own[5] * above[3] + w_below[5] * below[3]
        b4 = a[15] + own[6] * left[4] + w_right[6] * right[4] + own[7] * above[4] + w_below[7] * below[4]
        b0 = b0 * a[0]
        b1 = (b1 - a[1] * b0) * a[4]
        b2 = (b2 - a[2] * b0 - a[5] * b1) * a[7]
        b3 = (b3 - a[3] * b0 - a[6] * b1 - a[8] * b2) * a[9] * a[9]
        b2 = (b2 - a[8] * b3) * a[7]
        b1 = (b1 - a[5] * b2 - a[6] * b3) * a[4]
        b0 = (b0 - a[1] * b1 - a[2] * b2 - a[3] * b3) * a[0]
        z[0] += omega * (b0 - z[0])
        z[1] += omega * (b1 - z[1])
        z[2] += omega * (b2 - z[2])
        z[3] += omega * (b3 - z[3])
        z[4] += omega * (b4 * a[10] - z[4])


@rowwise
def _sweep(
    first: int, last: int, field: np.ndarray, prepared: np.ndarray, weights: np.ndarray, omega: np.float32
) -> None:
    """Colour 0, and colour 1 a row behind, so that both take one pass through memory.

    Colour 1 of a band's outermost rows is left out: it has to wait for colour 0 of the bands around.
    """
    for step in range(2 * (last - first)):
        colour = step % 2
        y = first + step // 2 - colour
        if colour == 0 or y > first:
            _relax_row(field, prepared, weights, y, colour, omega)


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
    field, rows = np.zeros((height + 2, width + 2, 5), np.float32), np.empty(height)
    weights = np.zeros((height + 1, width + 1, 2 * GROUPS), np.float32)
    prepared = np.empty((height, width, PREPARED), np.float32)
    lambdas = np.array([config.disparity, config.change, config.flow, config.disparity], np.float32)
    over_rows(_subtract, height, state, reference, field)
    over_rows(_smoothness_weights, height, field, edges, edges2, lambdas, np.float32(config.eps_px**2), weights, rows)
    over_rows(_prepare, height, field, systems, weights, pull, prepared, rows)
    bands, omega = band_edges(height), np.float32(config.omega)
    outermost = sorted({row for first, last in pairwise(bands) for row in (first, last - 1)})
    for _ in range(config.sweeps):
        over_bands(_sweep, bands, field, prepared, weights, omega)
        for y in outermost:
            _relax_row(field, prepared, weights, y, 1, omega)
    relaxed = np.empty_like(state)
    over_rows(_add, height, reference, field, relaxed)
    return relaxed, float(rows.cumsum()[-1])


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
