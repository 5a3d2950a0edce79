"""The methods ``hybrid`` and ``variational+refiner``: some start, then a refinement strategy."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cgsf.errors import InputError
from cgsf.feedforward import load_network
from cgsf.scene_flow import SceneFlow
from cgsf.starts import StartConfig, make_start, to_batch
from variational.camera import StereoCamera
from variational.frames import Frames
from variational.terms.visibility import visible_mask

if TYPE_CHECKING:
    from torch import nn

    from learned.refiner import Refiner


#: The refiner that ships for each start; OpenCV's states are nearest to the solver's.
SHIPPED_REFINERS = {
    "feedforward": "refiner-feedforward",
    "variational": "refiner-variational",
    "opencv": "refiner-variational",
}


@dataclass(frozen=True)
class RefinedConfig(StartConfig):
    """Start and refinement; the fields of `StartConfig`, and:

    Parameters
    ----------
    strategy : {"learned", "outputs", "parameters"}
        The trained refiner; gradient descent on the state; gradient descent on the networks' weights (feedforward
        only).
    steps : int
        Refinement steps; 0 takes the strategy's own number.
    refiner : str
        The name of weights that ship (``learned/weights/NAME.safetensors``) or the path of a file; empty takes
        the one that ships for this start.
    steps_picture : str
        Write a picture of every step's energy, gradient and update to this .png file; empty for none.
    """

    strategy: Literal["learned", "outputs", "parameters"] = "learned"
    steps: int = 0
    refiner: str = ""
    steps_picture: str = ""

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

    refiner = load_refiner(config.refiner or SHIPPED_REFINERS[config.initial]) if config.strategy == "learned" else None
    begin = time.perf_counter()
    start = make_start(frames, config, camera, progress)
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


def load_refiner(name: str) -> Refiner:
    """A refiner from weights that ship or a file; `InputError` for anything else."""
    from learned.refiner import Refiner

    net: nn.Module = load_network(name)
    if not isinstance(net, Refiner):
        raise InputError(f"{name} holds the weights of a {type(net).__name__}, not of a refiner")
    return net
