"""The methods ``hybrid`` and ``variational+refiner``: some start, then a refinement strategy."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cgsf.baselines import CompositionConfig, compose
from cgsf.errors import InputError
from cgsf.feedforward import FeedforwardConfig, load_network, run_networks, to_tensor
from cgsf.scene_flow import SceneFlow
from cgsf.start_cache import start_of
from variational.camera import StereoCamera
from variational.frames import Frames
from variational.solver import SolverConfig
from variational.terms.visibility import visible_mask

if TYPE_CHECKING:
    from torch import nn

    from learned.batch import Batch
    from learned.refiner import Refiner


SHIPPED_REFINER = "refiner-variational"


@dataclass(frozen=True)
class RefinedConfig:
    """Start and refinement.

    Parameters
    ----------
    initial : {"feedforward", "variational", "opencv"}
        What makes the start.
    strategy : {"learned", "outputs", "parameters"}
        The trained refiner; gradient descent on the state; gradient descent on the networks' weights (feedforward
        only).
    steps : int
        Refinement steps; 0 takes the strategy's own number.
    refiner : str
        The name of weights that ship (``learned/weights/NAME.safetensors``) or the path of a file; empty takes
        the one that ships, which was trained on the solver's states.
    device : str
        Any device that torch knows, for networks and refiner.
    steps_picture : str
        Write a picture of every step's energy, gradient and update to this .png file; empty for none.
    feedforward, variational, opencv
        Settings of the start.
    """

    initial: Literal["feedforward", "variational", "opencv"] = "feedforward"
    strategy: Literal["learned", "outputs", "parameters"] = "learned"
    steps: int = 0
    refiner: str = ""
    device: str = "cpu"
    steps_picture: str = ""
    feedforward: FeedforwardConfig = field(default_factory=FeedforwardConfig)
    variational: SolverConfig = field(default_factory=SolverConfig)
    opencv: CompositionConfig = field(default_factory=CompositionConfig)

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ValueError("steps must not be negative")
        if self.steps_picture and self.strategy == "parameters":
            raise ValueError('strategy "parameters" has no picture of its steps')
        if self.strategy == "parameters" and self.initial != "feedforward":
            raise ValueError('strategy "parameters" adapts networks: it needs initial = "feedforward"')


def run_refined(frames: Frames, config: RefinedConfig, camera: StereoCamera | None = None, progress: Any = None) -> SceneFlow:
    """Scene flow by a start and a refinement strategy; masks and confidence are the start's, but for what moved."""
    from learned.strategies import StrategyConfig, apply_strategy

    refiner = load_refiner(config.refiner or SHIPPED_REFINER) if config.strategy == "learned" else None
    begin = time.perf_counter()
    start = _START[config.initial](frames, config, camera, progress)
    seconds = {**start.seconds, "initial state": time.perf_counter() - begin}
    if progress:
        progress("refinement", 0.95)
    steps: list[dict[str, np.ndarray]] = []

    def watch(step: int, state: Any, loss: Any, gradient: Any) -> None:
        maps = {"state": state, "loss": loss, "gradient": gradient}
        steps.append({name: value[0].float().cpu().numpy().copy() for name, value in maps.items()})

    networks = None
    if config.strategy == "parameters":
        from learned.feedforward import FeedforwardModule

        disparity, motion = (load_network(name) for name in (config.feedforward.disparity, config.feedforward.motion))
        networks = FeedforwardModule(disparity, motion, config.feedforward.precision).to(config.device)
    batch = to_batch(frames, start).to(config.device)
    strategy = StrategyConfig(config.strategy, config.steps)
    watched = watch if config.steps_picture else None
    refined = apply_strategy(strategy, batch, None if refiner is None else refiner.to(config.device), networks, watch=watched)
    state = refined.state[0].float().cpu().numpy()
    if config.steps_picture:
        from cgsf.steps_picture import write_steps_picture

        write_steps_picture(config.steps_picture, steps)
    backward = start.backward_flow
    visible = (
        start.visible
        if backward is None
        else start.visible & visible_mask(np.ascontiguousarray(state[3:].transpose(1, 2, 0)), backward, 0.01, 0.5)
    )
    seconds["refinement"] = refined.seconds
    record = {**start.record, "strategy": config.strategy, "steps": strategy.count(refiner)}
    return SceneFlow.from_state(
        state, visible, confidence=start.confidence, moving=start.moving, camera_motion=start.camera_motion,
        backward_flow=backward, seconds=seconds, record=record,
        initial=replace(start, method=f"{config.initial} start"),
    )  # fmt: skip


def to_batch(frames: Frames, start: SceneFlow) -> Batch:
    """Frames and a start as tensors; what the start leaves open (NaN) is zero."""
    import torch

    from learned.batch import Batch

    images = torch.stack([to_tensor(image) for image in (frames.left1, frames.right1, frames.left2, frames.right2)], 1)
    state, backward, evidence = (torch.from_numpy(np.ascontiguousarray(maps))[None] for maps in start_of(start))
    return Batch(images, None, state, backward, evidence)


def load_refiner(name: str) -> Refiner:
    """A refiner from weights that ship or a file; `InputError` for anything else."""
    from learned.refiner import Refiner

    net: nn.Module = load_network(name)
    if not isinstance(net, Refiner):
        raise InputError(f"{name} holds the weights of a {type(net).__name__}, not of a refiner")
    return net


def _networks(frames: Frames, config: RefinedConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    return run_networks(frames, replace(config.feedforward, device=config.device), camera, progress)


def _solver(frames: Frames, config: RefinedConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    from cgsf.pipelines import solve_variational

    return solve_variational(frames, config.variational, camera, progress)


def _opencv(frames: Frames, config: RefinedConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    """OpenCV's composition, with a backward flow for the visible mask."""
    reverse = compose(Frames(frames.left2, frames.right2, frames.left1, frames.right1), config.opencv)
    return replace(compose(frames, config.opencv, camera, progress), backward_flow=reverse.flow)


_START = {"feedforward": _networks, "variational": _solver, "opencv": _opencv}
