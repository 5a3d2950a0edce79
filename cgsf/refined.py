"""The methods ``hybrid`` and ``variational+refiner``: some start, then a refinement strategy."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cgsf.errors import InputError
from cgsf.feedforward import FeedforwardConfig, load_network
from cgsf.scene_flow import SceneFlow
from cgsf.starts import StartConfig, make_start, to_batch
from cgsf.steps_picture import StepsRecorder, write_steps_picture
from variational.camera import StereoCamera
from variational.frames import Frames
from variational.terms.visibility import visible_mask

if TYPE_CHECKING:
    from torch import Tensor, nn

    from learned.feedforward import FeedforwardModule
    from learned.hybrid import Watch
    from learned.refiner import Refiner
    from learned.selector import Selector


#: The refiner that ships for each start.
SHIPPED_REFINERS = {
    "feedforward": "refiner-feedforward",
    "variational": "selector-variational",
    "opencv": "selector-variational",
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
    outputs_rate : float
        Adam's step on the state in pixels, for outputs.
    parameters_rate : float
        Adam's step on the weights, for parameters; larger ones unlearn what training has taught.
    steps_picture : str
        Write a picture of every step's energy, gradient and update to this .png file; empty for none.
    """

    strategy: Literal["learned", "outputs", "parameters"] = "learned"
    steps: int = 0
    refiner: str = ""
    outputs_rate: float = 0.02
    parameters_rate: float = 1e-5
    steps_picture: str = ""

    def __post_init__(self) -> None:
        if self.steps < 0 or not (self.outputs_rate > 0 and self.parameters_rate > 0):
            raise ValueError("steps must not be negative, rates must be positive")
        if self.steps_picture and self.strategy == "parameters":
            raise ValueError('strategy "parameters" has no picture of its steps')
        if self.strategy == "parameters" and self.initial != "feedforward":
            raise ValueError('strategy "parameters" adapts networks: it needs initial = "feedforward"')


def run_refined(frames: Frames, config: RefinedConfig, camera: StereoCamera | None = None, progress: Any = None) -> SceneFlow:
    """Scene flow by a start and a refinement strategy."""
    strategy = Strategist(config)
    begin = time.perf_counter()
    start = make_start(frames, config, camera, progress)
    start = replace(start, seconds={**start.seconds, "initial state": time.perf_counter() - begin})
    if progress:
        progress("refinement", 0.95)
    recorder = StepsRecorder(strategy.steps) if config.steps_picture else None
    result = strategy(frames, start, camera, recorder)
    if recorder:
        write_steps_picture(config.steps_picture, recorder.kept)
    return result


class Strategist:
    """A refinement strategy whose refiner or networks are loaded, ready for any number of frames.

    Parameters
    ----------
    config : RefinedConfig

    Raises
    ------
    InputError
        If there are no such weights.
    """

    def __init__(self, config: RefinedConfig) -> None:
        from learned.strategies import StrategyConfig

        self.config = config
        self.refiner = self.networks = None
        if config.strategy == "learned":
            self.refiner = load_refiner(config.refiner or SHIPPED_REFINERS[config.initial]).to(config.device)
        elif config.strategy == "parameters":
            self.networks = load_networks(config.feedforward).to(config.device)
        self.strategy = StrategyConfig(
            config.strategy, config.steps, config.outputs_rate, config.parameters_rate, config.feedforward.precision
        )
        self.steps = self.strategy.count(self.refiner)

    def __call__(
        self, frames: Frames, start: SceneFlow, camera: StereoCamera | None = None, watch: Watch | None = None
    ) -> SceneFlow:
        """The refined start. Masks and confidence are the start's, but for what has moved out of sight."""
        from learned.strategies import apply_strategy

        begin = time.perf_counter()
        batch = to_batch(frames, start, camera).to(self.config.device)
        refined = apply_strategy(self.strategy, batch, self.refiner, self.networks, watch=watch)
        return self.result(start, refined.state, time.perf_counter() - begin)

    def adapt(self, frames: Frames, start: SceneFlow) -> SceneFlow:
        """As a call, for the next frame of a video: the networks stay adapted (strategy parameters only)."""
        from learned.strategies import adapt_frame

        assert self.networks is not None
        begin = time.perf_counter()
        state = adapt_frame(self.strategy, to_batch(frames, start).to(self.config.device), self.networks)
        return self.result(start, state, time.perf_counter() - begin)

    def result(self, start: SceneFlow, state: Tensor, seconds: float) -> SceneFlow:
        """The scene flow of a state (1, 5, H, W) that was made of a start."""
        maps = state[0].float().cpu().numpy()
        assert start.backward_flow is not None
        flow = np.ascontiguousarray(maps[3:].transpose(1, 2, 0))
        return SceneFlow.from_state(
            maps, start.visible & visible_mask(flow, start.backward_flow, 0.01, 0.5), confidence=start.confidence,
            moving=start.moving, camera_motion=start.camera_motion, backward_flow=start.backward_flow,
            seconds={**start.seconds, "refinement": seconds},
            record={**start.record, "strategy": self.config.strategy, "steps": self.steps},
            initial=replace(start, method=f"{self.config.initial} start"),
        )  # fmt: skip


def load_networks(config: FeedforwardConfig) -> FeedforwardModule:
    """Both networks, whose weights may be trained."""
    from learned.feedforward import FeedforwardModule

    return FeedforwardModule(load_network(config.disparity), load_network(config.motion), config.precision).eval()


def load_refiner(name: str) -> Refiner | Selector:
    """A refiner from weights that ship or a file; `InputError` for anything else."""
    import torch

    from learned.refiner import Refiner
    from learned.selector import Selector

    net: nn.Module = load_network(name)
    if not isinstance(net, Refiner | Selector):
        raise InputError(f"{name} holds the weights of a {type(net).__name__}, not of a refiner")
    return net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
