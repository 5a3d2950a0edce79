"""Coarse-to-fine minimisation: from nothing, of the paper's energy, and the last fraction of a pixel of a fused state.

* `from_zero`: every level of a pyramid searches disparities in a band around what the level above found, and
  minimises constancy of structure (variational.terms.constancy) and smoothness over flow and change by Gauss-Newton.
* `refine`: Gauss-Newton at full size on the *correction* of a state, which is what is smooth: slanted roads stay slanted
  and jumps stay where they are. Visibility is fixed from the state; rigid pixels are held to their motion.
* `descend_energy`: first-order descent of the consistency energy (variational.energy), coarse to fine.
"""

from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np

from variational.energy import Energy, EnergyConfig
from variational.frames import Frames
from variational.initialise import Start, sample
from variational.jit import side_by_side, total
from variational.matching import MatchingConfig
from variational.minimise import GROUPS, DescendConfig, RelaxConfig, descend, relax
from variational.pyramid import frames_pyramid, pyramid_shapes
from variational.search import match_around
from variational.state import D1, D2, C, flow_of, resize_maps, resize_state
from variational.terms.constancy import Constancy, ConstancyConfig
from variational.visibility import backward_flow, project_visibility, seen_in_right

History = list[dict]


@dataclass(frozen=True)
class FromZeroConfig:
    """Coarse-to-fine minimisation from nothing.

    Parameters
    ----------
    factor : float
        Ratio of the sides of neighbouring levels, in (0, 1).
    smallest : int
        Shortest side of the coarsest level, pixels.
    band_px : float
        Disparities searched at each level on either side of the level above; the coarsest searches a third of its width.
    warps : int
        Linearisations a level.
    most_px : float
        Largest change of an unknown in one of them.
    """

    factor: float = 0.6
    smallest: int = 20
    band_px: float = 4.0
    warps: int = 3
    most_px: float = 1.5
    relax: RelaxConfig = field(default_factory=lambda: RelaxConfig(disparity=0.4, change=0.4, flow=0.4, sweeps=15))


@dataclass(frozen=True)
class RefineConfig:
    """Sub-pixel refinement of a state.

    Parameters
    ----------
    warps : int
        Linearisations; 0 leaves the state as it is.
    most_px : float
        Largest correction.
    pull : float
        Weight of the squared correction of what was measured.
    firm_pull : float
        The same for what its own pixel cannot mend: change and flow of pixels that follow a rigid motion, which thousands
        of points fix better than one, and disparities of unmatched pixels, which were filled from around.
    """

    warps: int = 1
    most_px: float = 1.0
    pull: float = 0.2
    firm_pull: float = 20.0
    relax: RelaxConfig = field(default_factory=lambda: RelaxConfig(disparity=2.0, change=20.0, flow=4.0, sweeps=6))


@dataclass(frozen=True)
class DescentConfig:
    """First-order descent of the consistency energy.

    Parameters
    ----------
    levels : int
        Pyramid levels, each half the size of the one before; 0 leaves the energy out.
    steps
        Of each level.
    """

    levels: int = 0
    steps: DescendConfig = field(default_factory=DescendConfig)


def edge_factors(grey: np.ndarray, sharpness: float = 10.0, least: float = 0.05) -> np.ndarray:
    """(2, H, W) float32 in [least, 1]: smoothness between each pixel and its left, upper neighbour, low at image edges."""
    factors = np.ones((2, *grey.shape), np.float32)
    factors[0, :, 1:] = least + (1 - least) * np.exp(-sharpness * np.abs(np.diff(grey, axis=1)))
    factors[1, 1:] = least + (1 - least) * np.exp(-sharpness * np.abs(np.diff(grey, axis=0)))
    return factors


def _seen(state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return seen_in_right(state[D1]), project_visibility(state), seen_in_right(state[D2])


def from_zero(
    frames: Frames, config: FromZeroConfig, constancy: ConstancyConfig, matching: MatchingConfig
) -> tuple[Start, History]:
    """Estimate everything from a zero state.

    Parameters
    ----------
    frames : Frames

    Returns
    -------
    start : Start
        A state with its evidence, as `variational.initialise` makes it by other means.
    history : list of dict
        level (0 the finest), iteration, energy.
    """
    shapes = pyramid_shapes(frames.shape, config.factor, config.smallest)
    pyramid = frames_pyramid(frames, shapes)
    state = np.zeros((5, *shapes[-1]), np.float32)
    history: History = []
    for level in range(len(shapes) - 1, -1, -1):
        images, shape = pyramid[level], shapes[level]
        left1, right1, left2, right2 = images.grey
        coarsest = level == len(shapes) - 1
        state = state if coarsest else resize_state(state, shape)
        band = shape[1] / 3 if coarsest else config.band_px
        area = matching.speckle_px * np.prod(shape) / np.prod(frames.shape)
        scaled = MatchingConfig(**{**matching.__dict__, "speckle_px": int(area) + 1})
        match1 = match_around(left1, right1, state[D1], band, scaled)
        match2 = match_around(left2, right2, state[D2], band, scaled)
        state[D1], state[D2] = cv2.medianBlur(match1.disparity, 5), cv2.medianBlur(match2.disparity, 5)
        state[C] = sample(state[D2], flow_of(state)) - state[D1]
        data = Constancy(images, constancy)
        edges, edges2 = edge_factors(left1), edge_factors(left2)
        pull = np.full((*shape, GROUPS), 1e-3, np.float32)  # enough to fix what nothing else does
        for iteration in range(config.warps):
            systems = data.systems(state, _seen(state))
            relaxed, energy = relax(state, np.zeros_like(state), systems, edges, edges2, pull, config.relax)
            history.append({"level": level, "iteration": iteration, "energy": energy})
            if not np.isfinite(relaxed).all():
                break
            relaxed = state + np.clip(relaxed - state, -config.most_px, config.most_px)
            # The disparities were searched; what is minimised over them here only helps the motion.
            state[C:] = np.stack([cv2.medianBlur(plane, 5) for plane in relaxed[C:]])
    return Start(state, backward_flow(state, -flow_of(state)), match1, match2), history


def refine(
    frames: Frames, state: np.ndarray, rigid: np.ndarray, matched: tuple[np.ndarray, np.ndarray], config: RefineConfig,
    constancy: ConstancyConfig,
) -> tuple[np.ndarray, History]:  # fmt: skip
    """Correct a state by a fraction of a pixel.

    Parameters
    ----------
    frames : Frames
    state : np.ndarray
        (5, H, W) float32; not changed.
    rigid : np.ndarray
        (H, W) bool, pixels that follow a rigid motion.
    matched : tuple of two np.ndarray
        (H, W) bool, pixels of left1 and of left2 whose disparity is a match of their own.

    Returns
    -------
    state : np.ndarray
        (5, H, W), at most `most_px` away from the state given, disparities >= 0.
    history : list of dict
        As of `from_zero`.
    """
    history: History = []
    if config.warps == 0:
        return state, history
    data, edges, edges2, seen = side_by_side(
        partial(Constancy, frames, constancy), partial(edge_factors, frames.grey[0]), partial(edge_factors, frames.grey[2]),
        partial(_seen, state),
    )  # fmt: skip
    pull = np.full((*frames.shape, GROUPS), config.pull, np.float32)
    pull[..., 0][~matched[0]] = config.firm_pull
    pull[..., 1:3][rigid] = config.firm_pull
    pull[..., 3][~matched[1]] = config.firm_pull
    corrected = state
    for iteration in range(config.warps):
        relaxed, energy = relax(corrected, state, data.systems(corrected, seen), edges, edges2, pull, config.relax)
        history.append({"level": 0, "iteration": iteration, "energy": energy})
        if not np.isfinite(relaxed).all():
            break
        corrected = state + np.clip(relaxed - state, -config.most_px, config.most_px)
        corrected[:2] = np.maximum(corrected[:2], 0)
    return corrected, history


def descend_energy(
    frames: Frames, state: np.ndarray, backward: np.ndarray, config: DescentConfig, energy: EnergyConfig
) -> tuple[np.ndarray, History, str]:
    """Minimise the consistency energy by first-order descent, coarse to fine.

    Parameters
    ----------
    frames : Frames
    state : np.ndarray
        (5, H, W) float32; not changed.
    backward : np.ndarray
        (H, W, 2) flow left2 -> left1, for the visible mask.

    Returns
    -------
    state : np.ndarray
        (5, H, W).
    history : list of dict
        As of `from_zero`.
    reason : str
        Why the finest level stopped.
    """
    shapes = [frames.shape]
    while len(shapes) < config.levels:
        shapes.append(((shapes[-1][0] + 1) // 2, (shapes[-1][1] + 1) // 2))
    history: History = []
    reason = "nothing to do"
    for level in range(len(shapes) - 1, -1, -1):
        shape, images = shapes[level], frames_pyramid(frames, shapes[: level + 1])[level]
        sx, sy = shape[1] / frames.shape[1], shape[0] / frames.shape[0]
        planes = resize_maps(np.ascontiguousarray(backward.transpose(2, 0, 1)), shape)
        scaled = planes * np.array([sx, sy], np.float32)[:, None, None]
        oracle = Energy(images, energy, backward_flow=np.ascontiguousarray(scaled.transpose(1, 2, 0)))

        def value_and_gradient(x: np.ndarray, oracle: Energy = oracle) -> tuple[float, np.ndarray]:
            loss, gradient = oracle.value_and_gradient(x)
            return total(loss), gradient

        coarse = np.ascontiguousarray(resize_state(state, shape), np.float32)
        found, energies, reason = descend(value_and_gradient, coarse, config.steps)
        history += [{"level": level, "iteration": i, "energy": value} for i, value in enumerate(energies)]
        # Only the change comes back up: resizing the state itself would blur what this level never touched.
        state = state + resize_state(found - coarse, frames.shape).astype(np.float32)
        state[:2] = np.maximum(state[:2], 0)
    return state, history, reason
