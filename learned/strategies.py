"""The three ways to refine at test time with one energy (Chen et al., table 5): outputs, parameters, learned.

* outputs: gradient descent on the state itself;
* parameters: gradient descent on the networks' weights, on this one sample, which are restored afterwards;
* learned: a few steps of the trained refiner.

All three start from the same state and are told the same energy, so that their results and times can be compared.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from learned.batch import Batch
from learned.feedforward import Precision, mixed_precision
from learned.hybrid import Watch, refine
from learned.oracle import Oracle
from learned.refiner import Refiner
from learned.selector import Selector

StrategyName = Literal["learned", "outputs", "parameters"]

#: The energy of a batch, given its start's backward flow.
MakeOracle = Callable[[Batch], Oracle]


@dataclass(frozen=True)
class StrategyConfig:
    """Which strategy, how far."""

    strategy: StrategyName = "learned"
    """How to refine."""
    steps: int = 0
    """Steps; 0 takes the refiner's own number for learned, 100 for outputs, 50 for parameters."""
    outputs_rate: float = 0.02
    """Adam's step on the state in pixels."""
    parameters_rate: float = 1e-5
    """Adam's step on the weights; larger ones unlearn what training has taught."""
    precision: Precision = "float32"
    """Of the refiner's convolutions, see `learned.feedforward`."""

    def __post_init__(self) -> None:
        if self.steps < 0 or not (self.outputs_rate > 0 and self.parameters_rate > 0):
            raise ValueError("steps must not be negative, rates must be positive")

    def count(self, refiner: Refiner | Selector | None) -> int:
        """The number of steps."""
        return self.steps or {"outputs": 100, "parameters": 50, "learned": refiner.config.steps if refiner else 0}[self.strategy]


@dataclass(frozen=True, eq=False)
class Refined:
    """What a strategy made of a start: the states on the way (first and last at least), its time in seconds."""

    states: list[Tensor]
    seconds: float

    @property
    def state(self) -> Tensor:
        """The result, (B, 5, H, W) in pixels."""
        return self.states[-1]


def _paper_energy(batch: Batch) -> Oracle:
    return Oracle(*batch.frames, batch.backward_flow)


def apply_strategy(
    config: StrategyConfig,
    batch: Batch,
    refiner: Refiner | Selector | None = None,
    networks: nn.Module | None = None,
    make_oracle: MakeOracle = _paper_energy,
    watch: Watch | None = None,
) -> Refined:
    """Refine a batch's start.

    Parameters
    ----------
    config : StrategyConfig
    batch : Batch
        With a start and its backward flow.
    refiner : Refiner, Selector or None
        Needed by learned.
    networks : nn.Module or None
        Needed by parameters: the networks that made the start, ``(left1, right1, left2, right2) -> (state, backward
        flow)``.
    make_oracle : callable
        The energy; the paper's unless given.
    watch : callable or None
        Sees step, state, energy map and gradient, of the last state too; for learned and outputs.
    """
    if batch.start is None:
        raise ValueError("there is no start to refine")
    begin = time.perf_counter()
    oracle, steps = make_oracle(batch), config.count(refiner)
    if config.strategy == "learned":
        if refiner is None:
            raise ValueError("the learned strategy needs a refiner")
        with torch.inference_mode(), mixed_precision(config.precision, batch.images.device):
            states = refine(refiner, batch, oracle, steps, watch).states
    elif config.strategy == "outputs":
        states = [batch.start, descend_outputs(batch.start, oracle, steps, config.outputs_rate, watch)]
    else:
        if networks is None:
            raise ValueError("the strategy parameters needs networks that made the start")
        with restored(networks):
            states = [batch.start, descend_parameters(networks, batch, oracle, steps, config.parameters_rate)]
    return Refined(states, time.perf_counter() - begin)


def descend_outputs(start: Tensor, oracle: Oracle, steps: int, rate: float, watch: Watch | None = None) -> Tensor:
    """Adam on the state itself, (B, 5, H, W), by the analytic gradient."""
    state = start.detach().clone()
    optimizer = torch.optim.Adam([state], rate)
    for step in range(steps):
        loss, state.grad = oracle.features(state)
        if watch:
            watch(step, state, loss, state.grad)
        optimizer.step()
    if watch:
        watch(steps, state, *oracle.features(state))
    return state


def descend_parameters(networks: nn.Module, batch: Batch, oracle: Oracle, steps: int, rate: float) -> Tensor:
    """Adam on the networks' weights, in place, by the energy of their state; returns the last state.

    Normalisation layers keep their statistics: one sample is no batch.
    """
    networks.eval()
    optimizer = torch.optim.Adam(networks.parameters(), rate)
    pixels = batch.images.shape[-2] * batch.images.shape[-1]
    with torch.enable_grad():
        for _ in range(steps):
            optimizer.zero_grad(set_to_none=True)
            state, _ = networks(*batch.frames)
            (oracle.energy(state.float()).sum() / pixels).backward()
            optimizer.step()
    with torch.inference_mode():
        state, _ = networks(*batch.frames)
    return state.float()


@contextmanager
def restored(networks: nn.Module) -> Iterator[None]:
    """Give the weights back as they were, whatever happens inside."""
    kept = copy.deepcopy(networks.state_dict())
    training = networks.training
    try:
        yield
    finally:
        networks.load_state_dict(kept)
        networks.zero_grad(set_to_none=True)
        networks.train(training)


def adapt_video(
    config: StrategyConfig, batches: Iterable[Batch], networks: nn.Module, make_oracle: MakeOracle = _paper_energy
) -> Iterator[Tensor]:
    """Refine a video frame by frame by the strategy parameters, adapting as it goes: what is learned on a frame stays
    for the next ones; the weights are restored when the video ends or is left.

    Parameters
    ----------
    batches : iterable of Batch
        The frames in order; no start is needed, the networks make it.

    Yields
    ------
    Tensor (B, 5, H, W)
        Each frame's state, in pixels, with the weights adapted to all frames so far.
    """
    with restored(networks):
        for batch in batches:
            yield adapt_frame(config, batch, networks, make_oracle)


def adapt_frame(
    config: StrategyConfig, batch: Batch, networks: nn.Module, make_oracle: MakeOracle = _paper_energy
) -> Tensor:
    """One frame of `adapt_video`: its state, (B, 5, H, W) in pixels; the networks stay adapted to it."""
    if config.strategy != "parameters":
        raise ValueError("only the strategy parameters carries anything from frame to frame")
    networks.eval()
    with torch.inference_mode():
        _, backward = networks(*batch.frames)
    batch = replace(batch, backward_flow=backward.float().clone())
    return descend_parameters(networks, batch, make_oracle(batch), config.count(None), config.parameters_rate)
