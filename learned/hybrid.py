"""The loop over refinement steps, from whatever start, and the whole model: networks first, then the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from learned.alternatives import Grid, camera_motion
from learned.batch import Batch
from learned.feedforward import FeedforwardModule, join_state
from learned.inputs import View
from learned.oracle import Oracle
from learned.refiner import Refiner
from learned.selector import Selector

#: Called after each evaluation with the step t, the state X_t, the energy's map and gradient there (None if not
#: needed).
Watch = Callable[[int, Tensor, Tensor | None, Tensor | None], None]


class Refinement(NamedTuple):
    """The way of a refinement."""

    states: list[Tensor]
    """X_0 ... X_T, each (B, 5, H, W) in pixels."""
    reliabilities: list[Tensor | None]
    """Of X_0 ... X_{T-1}: logits (B, 2, h, w), if the refiner propagates."""


def refine(
    refiner: Refiner | Selector,
    batch: Batch,
    oracle: Oracle | None = None,
    steps: int | None = None,
    watch: Watch | None = None,
) -> Refinement:
    """T steps of G from the batch's start.

    Energy and gradient enter as numbers that are not differentiated through (first order); the states are, through all
    steps unless the refiner is configured otherwise.

    Parameters
    ----------
    refiner : Refiner or Selector
    batch : Batch
        With a start; the backward flow (for the visible pixels of the energy) and the evidence belong to the start and
        are held fixed.
    oracle : Oracle or None
        The energy; None takes the paper's.
    steps : int or None
        T; None takes the refiner's own.
    watch : callable or None
        Sees every state with its energy, the last one too.
    """
    if batch.start is None:
        raise ValueError("there is no start to refine")
    steps = refiner.config.steps if steps is None else steps
    if oracle is None and (refiner.config.needs_energy or watch):
        oracle = Oracle(*batch.frames, batch.backward_flow)
    camera_loss = None
    if refiner.config.weighs_energies and steps > 0:
        assert oracle is not None
        camera_loss, _ = oracle.features(still(batch.start, batch.homography))
    prepared = refiner.prepare(batch)
    states, reliabilities = [batch.start], []
    for t in range(steps + 1):
        loss = gradient = None
        if oracle is not None and (watch or (t < steps and refiner.config.needs_energy)):
            loss, gradient = oracle.features(states[-1])
        if watch:
            watch(t, states[-1], loss, gradient)
        if t < steps:
            state = states[-1].detach() if refiner.config.detached else states[-1]
            update = refiner(View(state, loss, gradient, camera_loss, prepared), batch)
            states.append(state + update.change)
            reliabilities.append(update.reliability)
    return Refinement(states, reliabilities)


def still(state: Tensor, homography: Tensor | None) -> Tensor:
    """The state (B, 5, H, W) if nothing moved but the camera, by its homography (B, 4, 4); None leaves it as it is."""
    if homography is None:
        return state
    motion = camera_motion(state, Grid(1).coordinates(state), homography)
    return torch.cat([state[:, :2], motion], 1)


NetworkName = Literal["disparity", "motion"]


@dataclass(frozen=True)
class HybridConfig:
    """How networks and refiner are joined."""

    steps: int | None = None
    """Refinement steps; None takes the refiner's own."""
    cached: tuple[NetworkName, ...] = ()
    """Networks that are not run: the batch's start holds what they say. For frozen ones."""


class Hybrid(nn.Module):
    """X_0 = H(images), then T steps of G; trained jointly, or with a part frozen.

    Parameters
    ----------
    feedforward : nn.Module
        H: ``(left1, right1, left2, right2) -> (state (B, 5, H, W), backward flow (B, 2, H, W))``; with one network
        cached, a `learned.feedforward.FeedforwardModule`.
    refiner : Refiner
        G.
    config : HybridConfig
    find_homographies : callable, optional
        The camera's motions (B, 4, 4) of a start, from its state and backward flow.
    """

    def __init__(
        self, feedforward: nn.Module, refiner: Refiner, config: HybridConfig = HybridConfig(),
        find_homographies: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.feedforward, self.refiner, self.config = feedforward, refiner, config
        self.find_homographies = find_homographies

    def forward(self, batch: Batch, oracle: Oracle | None = None, watch: Watch | None = None) -> Refinement:
        """The refinement of the networks' state."""
        return refine(self.refiner, self.start(batch), oracle, self.config.steps, watch)

    def start(self, batch: Batch) -> Batch:
        """The batch with the networks' state as its start; the backward flow is held fixed."""
        cached = self.config.cached
        if cached and (batch.start is None or batch.backward_flow is None):
            raise ValueError("networks that are not run need a batch with starts")
        if not cached:
            state, backward = self.feedforward(*batch.frames)
        elif len(set(cached)) == len(get_args(NetworkName)):
            return batch
        elif "motion" in cached:
            assert isinstance(self.feedforward, FeedforwardModule)
            state = torch.cat([self.feedforward.disparities(*batch.frames), batch.start[:, 2:]], 1)  # type: ignore[index]
            backward = batch.backward_flow
        else:
            assert isinstance(self.feedforward, FeedforwardModule)
            left1, _, left2, _ = batch.frames
            motion, backward = self.feedforward.motions(left1, left2)
            state = join_state(batch.start[:, :2], motion)  # type: ignore[index]
        state, backward = state.float(), backward.float().detach()
        homography = self.find_homographies(state.detach(), backward) if self.find_homographies else batch.homography
        return replace(batch, start=state, backward_flow=backward, homography=homography)
