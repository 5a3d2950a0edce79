"""The promise that the analytic gradient is right, made checkable by anyone.

Three independent ways to the same numbers: the handwritten kernels (:mod:`variational.energy`), autograd on the twin
(:mod:`learned.consistency`), and central differences of the handwritten energy. They are compared for every term alone
and all together, channel by channel.

A piecewise smooth energy has kinks: cell borders of the bilinear sampler, zeros of the absolute values, SSIM where it
is clipped, positions at the edge of the image. There the three may rightly differ. Such pixels are found from the state
(never from a deviation), left out, and counted; on a random state they may be at most one percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from learned import consistency
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames
from variational.state import CHANNELS

TERMS: dict[str, EnergyConfig] = {
    "stereo": EnergyConfig(stereo_weight=1, flow_weight=0, coupling_weight=0, smoothness_weight=0),
    "flow": EnergyConfig(stereo_weight=0, flow_weight=1, coupling_weight=0, smoothness_weight=0),
    "coupling": EnergyConfig(stereo_weight=0, flow_weight=0, coupling_weight=1, smoothness_weight=0),
    "smoothness": EnergyConfig(stereo_weight=0, flow_weight=0, coupling_weight=0, smoothness_weight=1),
    "all": EnergyConfig(),
}
"""Each term alone, and the paper's energy."""


@dataclass(frozen=True)
class Tolerances:
    """What passes.

    Parameters
    ----------
    gradient : float
        Largest |analytic - autograd|, relative to the largest |gradient| of the channel.
    total : float
        Largest difference of the two sums, relative.
    difference : float
        Largest |analytic - central difference|, relative to the largest |gradient|; float64 only.
    order : float
        Least Taylor order; a right gradient has 2, one that is 1 % wrong 1; float64 only.
    kinks : float
        Largest share of pixels left out, on random states.
    """

    gradient: float
    total: float
    difference: float
    order: float = 1.9
    kinks: float = 0.01


TOLERANCES = {"float64": Tolerances(1e-10, 1e-12, 1e-6), "float32": Tolerances(1e-4, 1e-5, np.inf)}


@dataclass(frozen=True)
class Row:
    """One cell of the table: a term and a channel on one scene.

    Parameters
    ----------
    scene, term, channel : str
        What was compared.
    max_deviation, mean_deviation : float
        Analytic against autograd, relative to the channel's largest gradient, away from kinks.
    difference : float
        Analytic against central differences at sampled pixels away from kinks, relative likewise; NaN in float32.
    order : float
        Taylor order; inf where the remainder is zero (the term is linear there), NaN in float32.
    kinks : float
        Share of the channel's pixels left out.
    total : float
        Relative difference of the term's sums.
    ok : bool
        Within tolerance.
    """

    scene: str
    term: str
    channel: str
    max_deviation: float
    mean_deviation: float
    difference: float
    order: float
    kinks: float
    total: float
    ok: bool

    def as_json(self) -> dict[str, object]:
        """The row for a JSON file, which has no numbers for what is not finite: those become null."""
        hollow = {key: None for key, value in asdict(self).items() if isinstance(value, float) and not
        np.isfinite(value)}
        return asdict(self) | hollow


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames, a state and a backward flow to compare at.

    Parameters
    ----------
    name : str
    frames : Frames
    state : np.ndarray
        ``(5, H, W)``, of the frames' type.
    backward_flow : np.ndarray
        ``(H, W, 2)``.
    random : bool
        Whether the limit on the share of kinks holds; flat regions of real images have more.
    """

    name: str
    frames: Frames
    state: np.ndarray
    backward_flow: np.ndarray
    random: bool


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], low: float, high: float, sigma: float) -> np.ndarray:
    """``(H, W)`` Gaussian-filtered noise, stretched to [low, high]."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
    spread = np.ptp(noise)
    return low + (high - low) * (noise - noise.min()) / (spread if spread > 0 else 1)


def random_state(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A smooth random state whose motion crosses every border, and a backward flow that calls part of it hidden."""
    height, width = shape
    x, y = width / 6 + 0.1, height / 6 + 0.1  # no round numbers: the extremes would sit on the sampler's kinks
    reach = {"D1": (0.1, width / 4 + 0.1), "D2": (0.1, width / 4 + 0.1), "C": (-3.1, 3.1), "u": (-x, x), "v": (-y, y)}
    state = np.stack([smooth_noise(rng, shape, *reach[channel], sigma=max(shape) / 6) for channel in CHANNELS])
    wobble = np.stack([smooth_noise(rng, shape, -1.2, 1.2, 6) for _ in range(2)])
    return state, -(_at_source(state[3:]) + wobble).transpose(1, 2, 0)


def _at_source(flow: np.ndarray) -> np.ndarray:
    """``(2, H, W)`` flow at the pixel that each pixel of left2 comes from, by fixed-point iteration."""
    y, x = np.mgrid[: flow.shape[1], : flow.shape[2]].astype(np.float32)
    u, v = flow.astype(np.float32)
    found = np.stack([u, v])
    for _ in range(10):
        grid = (x - found[0], y - found[1])
        found = np.stack([cv2.remap(plane, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                          for plane in (u, v)])
    return found.astype(np.float64)


def random_scene(size: tuple[int, int], seed: int = 0, channels: int = 3) -> Scene:
    """Textured random images and a random state, float64."""
    rng = np.random.default_rng(seed)
    images = [np.stack([smooth_noise(rng, size, 0.02, 0.98, 1.0) for _ in range(channels)], axis=2) for _ in range(4)]
    return Scene(f"random {size[0]}x{size[1]}", Frames(*images), *random_state(rng, size), random=True)


def frames_scene(name: str, frames: Frames, seed: int = 0) -> Scene:
    """Real images with a random state, float64."""
    state, back = random_state(np.random.default_rng(seed), frames.shape)
    return Scene(name, frames.astype(np.float64), state, back, random=False)


def kink_mask(scene: Scene, config: EnergyConfig, tolerance: float) -> np.ndarray:
    """Pixels of the state whose derivative may not exist within `tolerance` pixels, ``(5, H, W)`` bool."""
    state, left1, right1, left2, right2, back = _tensors(scene)
    d1, d2, change, u, v = state.unbind(1)
    kinks = torch.zeros_like(state, dtype=torch.bool)
    visible = consistency.visible_mask(state[:, 3:], back, config.visible_relative, config.visible_absolute)
    photometric = [([0], left1, right1, -d1, None, config.stereo_weight),
                   ([1], left2, right2, -d2, None, config.stereo_weight),
                   ([3, 4], left1, left2, u, v, config.flow_weight)]
    for channels, target, source, dx, dy, weight in photometric:
        if weight > 0:
            found = _near_cell_border(dx, dy, tolerance) | _photometric_kinks(target, source, dx, dy, config, tolerance)
            kinks[:, channels] |= found[:, None] & (visible[:, None] if dy is not None else True)
    if config.coupling_weight > 0:
        residual = d1 + change - consistency.sample(d2[:, None], u, v)[:, 0]
        zero = visible & (residual.abs() < 4 * tolerance) & (config.charbonnier_px == 0)
        moving = visible & _near_cell_border(u, v, tolerance)
        kinks[:, [0, 2]] |= zero[:, None]
        kinks[:, [3, 4]] |= (zero | moving)[:, None]
        kinks[:, 1] |= _reached(zero, u, v)
    if config.smoothness_weight > 0 and config.charbonnier_px == 0:
        for axis in (-1, -2):
            flat = state.diff(dim=axis).abs() < 4 * tolerance
            size = state.shape[axis]
            kinks.narrow(axis, 0, size - 1).logical_or_(flat)
            kinks.narrow(axis, 1, size - 1).logical_or_(flat)
    return kinks[0].numpy()


def _near_cell_border(dx: Tensor, dy: Tensor | None, tolerance: float) -> Tensor:
    """Positions within `tolerance` of a border between two of the sampler's cells, where its derivative jumps."""
    near = (dx - dx.round()).abs() < tolerance
    return near if dy is None else near | ((dy - dy.round()).abs() < tolerance)


def _photometric_kinks(target: Tensor, source: Tensor, dx: Tensor, dy: Tensor | None, config: EnergyConfig,
                       tolerance: float) -> Tensor:
    """Zeros of |a - b| in any channel, and windows whose SSIM is clipped, with the pixels that they hold."""
    warped = consistency.sample(source, dx, dy)
    found = torch.zeros_like(dx, dtype=torch.bool)
    if config.charbonnier_intensity == 0 and config.ssim_share < 1:
        steepest = source.diff(dim=-1).abs().max() if source.shape[-1] > 1 else torch.zeros(())
        found |= ((warped - target).abs() < tolerance * float(steepest)).any(1) | (warped == target).any(1)
    if config.ssim_share > 0:
        error = consistency.photometric_error(target.transpose(0, 1), warped.transpose(0, 1), 1.0)
        clipped = ((error < 1e-12) | (error > 1 - 1e-12)).any(0, keepdim=True)
        found |= consistency.box_mean(clipped[:, None].to(dx.dtype))[:, 0] > 0
    return found


def _reached(found: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """The pixels of left2's grid that the `found` pixels of left1's sample."""
    grid = torch.zeros_like(u).requires_grad_()
    consistency.sample(grid[:, None], u, v)[:, 0][found].sum().backward()
    return (grid.grad if grid.grad is not None else grid) != 0


def _tensors(scene: Scene) -> tuple[Tensor, ...]:
    """State, four images, backward flow as batched tensors."""
    images = (scene.frames.left1, scene.frames.right1, scene.frames.left2, scene.frames.right2, scene.backward_flow)
    planes = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None] for image in images]
    return torch.from_numpy(scene.state)[None], *planes


def analytic(scene: Scene, config: EnergyConfig, damage: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Map and gradient of the handwritten kernels; `damage` is a relative error put into the gradient."""
    loss, gradient = Energy(scene.frames, config, scene.backward_flow).value_and_gradient(scene.state)
    return loss, gradient * scene.state.dtype.type(1 + damage)


def autograd(scene: Scene, config: EnergyConfig) -> tuple[np.ndarray, np.ndarray]:
    """Map and gradient of the twin."""
    state, *rest = _tensors(scene)
    state.requires_grad_()
    loss = consistency.consistency_map(state, *rest, **asdict(config))
    (gradient,) = torch.autograd.grad(loss.sum(), state)
    return loss[0].detach().numpy(), gradient[0].numpy()


def taylor_order(energy: Energy, state: np.ndarray, gradient: np.ndarray, direction: np.ndarray, visible: np.ndarray,
                 steps: Sequence[float] = (1e-4, 5e-5, 2.5e-5)) -> float:
    """Order at which ``E(x + h d) - E(x) - h <g, d>`` falls with h: 2 where g is the gradient, 1 where it is not.

    inf where the remainder is rounding alone. Map differences are summed, not sums subtracted, to keep the digits.
    """
    start, _ = energy.value_and_gradient(state, visible)
    slope = float((gradient * direction).sum())
    remainders = []
    for h in steps:
        loss, _ = energy.value_and_gradient(state + h * direction, visible)
        remainders.append(abs(float((loss - start).sum()) - h * slope))
    if remainders[0] < 1e-10 * steps[0] * float(np.abs(gradient * direction).sum()) + 1e-14:
        return float("inf")
    return float(np.polyfit(np.log(steps), np.log(np.maximum(remainders, 1e-300)), 1)[0])


def central_differences(energy: Energy, state: np.ndarray, pixels: np.ndarray, visible: np.ndarray,
                        h: float = 1e-6) -> np.ndarray:
    """Derivatives of the energy by single entries of the state; `pixels` ``(n, 3)`` of (channel, y, x)."""
    derivatives = np.empty(len(pixels))
    for i, (channel, y, x) in enumerate(pixels):
        maps = []
        for step in (h, -h):
            moved = state.copy()
            moved[channel, y, x] += step
            maps.append(energy.value_and_gradient(moved, visible)[0])
        derivatives[i] = (maps[0] - maps[1]).sum() / (2 * h)
    return derivatives


def compare(scene: Scene, term: str, dtype: str = "float64", damage: float = 0.0, samples: int = 6,
            seed: int = 0) -> tuple[list[Row], np.ndarray]:
    """Compare the three gradients of one term on one scene.

    Parameters
    ----------
    scene : Scene
        In float64.
    term : str
        A key of `TERMS`.
    dtype : str
        "float64" or "float32": the type of the analytic and the autograd gradient.
    damage : float
        Relative error put into the analytic gradient, to see that it is found.
    samples : int
        Pixels a channel for the central differences.
    seed : int
        Of the sampled pixels and the directions.

    Returns
    -------
    rows : list of Row
        One a channel that the term depends on.
    deviation : np.ndarray
        ``(5, H, W)`` |analytic - autograd|, relative to the channel's largest gradient; kinks included.
    """
    config, limits, rng = TERMS[term], TOLERANCES[dtype], np.random.default_rng(seed)
    typed = replace(scene, frames=scene.frames.astype(np.dtype(dtype)), state=scene.state.astype(dtype),
                    backward_flow=scene.backward_flow.astype(dtype))
    loss, gradient = analytic(typed, config, damage)
    twin_loss, twin_gradient = autograd(typed, config)
    total = abs(float(loss.sum(dtype=np.float64)) / float(twin_loss.sum(dtype=np.float64)) - 1)
    exact = dtype == "float64"
    kinks = kink_mask(scene, config, 1e-5)
    wide = kink_mask(scene, config, 5e-4) if exact else kinks  # wide enough for Taylor's steps
    energy, visible = Energy(typed.frames, config), _visible(typed, config)
    scale = np.abs(twin_gradient).max((1, 2), keepdims=True)
    deviation = np.abs(gradient - twin_gradient) / np.where(scale > 0, scale, 1)
    rows = []
    for channel in np.flatnonzero(scale[:, 0, 0] > 0):
        smooth = ~kinks[channel]
        largest, mean = float(deviation[channel][smooth].max()), float(deviation[channel][smooth].mean())
        difference = order = float("nan")
        if exact:
            orders = []
            for _ in range(3):  # along one direction the second-order parts may happen to cancel
                direction = np.zeros_like(typed.state)
                signs = rng.choice([-1, 1], smooth.shape) * ~wide[channel]
                direction[channel] = rng.uniform(0.5, 1, smooth.shape) * signs
                orders.append(taylor_order(energy, typed.state, gradient, direction, visible))
            order = float(np.median(orders))
            pixels = rng.permutation(np.argwhere(smooth))[:samples]
            pixels = np.column_stack([np.full(len(pixels), channel), pixels])
            numeric = central_differences(energy, typed.state, pixels, visible)
            difference = float(np.abs(numeric - gradient[tuple(pixels.T)]).max() / scale[channel, 0, 0])
        share = float(kinks[channel].mean())
        ok = (largest <= limits.gradient and total <= limits.total and not difference > limits.difference
              and not order < limits.order and (share <= limits.kinks or not scene.random))
        rows.append(Row(scene.name, term, CHANNELS[channel], largest, mean, difference, order, share, total, bool(ok)))
    return rows, np.where(kinks, 0, deviation)


def _visible(scene: Scene, config: EnergyConfig) -> np.ndarray:
    """The visible mask, to hold it fixed while the state moves."""
    state, *_, back = _tensors(scene)
    mask = consistency.visible_mask(state[:, 3:], back, config.visible_relative, config.visible_absolute)
    return mask[0].numpy()


def gradcheck(scenes: Sequence[Scene], terms: Sequence[str] = tuple(TERMS), dtype: str = "float64",
              damaged_term: str | None = None, seed: int = 0) -> tuple[list[Row], dict[str, np.ndarray]]:
    """The whole table: every term on every scene.

    `damaged_term` gets a gradient that is 1 % wrong. Returns the rows and the deviation maps, keyed "scene term".
    """
    rows: list[Row] = []
    deviations = {}
    for scene in scenes:
        for term in terms:
            found, deviation = compare(scene, term, dtype, 0.01 if term == damaged_term else 0.0, seed=seed)
            rows += found
            deviations[f"{scene.name} {term}"] = deviation
    return rows, deviations
