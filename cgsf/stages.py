"""What a recipe's stage trains, by which loss, and how it is scored on held-out samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from cgsf.camera_motion import find_homography
from cgsf.datasets.sample import Truth
from cgsf.errors import InputError
from cgsf.feedforward import load_network
from cgsf.metrics import Scores, score
from cgsf.recipe import Recipe
from cgsf.scene_flow import SceneFlow
from cgsf.visualise import comparison
from learned.alternatives import reliability_loss
from learned.batch import Batch
from learned.feedforward import FeedforwardModule
from learned.ganet import GANet
from learned.hybrid import Hybrid, HybridConfig, refine
from learned.losses import disparity_loss, multiscale_motion_loss
from learned.oracle import Oracle
from learned.pwcnet import PWCNet
from learned.refiner import Refiner
from learned.selector import Selector, selection_loss
from learned.state_losses import energy_loss, state_loss


class Estimates(NamedTuple):
    """What a model says about a batch."""

    states: list[Tensor]
    """X_0 ... X_T, or the one there is, (B, 5, H, W) in pixels; NaN in channels that are not estimated."""
    oracle: Oracle | None = None
    """The energy that belongs to them, if they are whole."""


@dataclass(frozen=True)
class Stage:
    """One kind of training.

    Parameters
    ----------
    network : callable
        The model of a recipe, with the weights that it begins with.
    loss : callable
        ``(recipe, model, batch) -> (scalar, numbers for the log)``.
    estimates : callable
        ``(recipe, model, batch) -> Estimates``.
    measure : str
        The measure that decides which weights are the best.
    """

    network: Callable[[Recipe], nn.Module]
    loss: Callable[[Recipe, nn.Module, Batch], tuple[Tensor, dict[str, float]]]
    estimates: Callable[[Recipe, nn.Module, Batch], Estimates]
    measure: str


class HeldOut:
    """Scores and pictures of a model on the samples that are never trained with.

    Parameters
    ----------
    recipe : Recipe
    stage : Stage
    samples : callable
        The samples, one a batch, anew at each call.
    """

    def __init__(self, recipe: Recipe, stage: Stage, samples: Callable[[], Iterator[Batch]]) -> None:
        self.recipe, self.stage, self.samples = recipe, stage, samples

    def validate(self, model: nn.Module) -> dict[str, float]:
        """KITTI's measures; of several states ``SF-t`` and the mean energy a pixel ``energy-t`` too.

        ``score`` is the stage's measure of the last state, or its energy where no truth is known.
        """
        pools: list[_Pool] = []
        for batch in self.samples():
            states, oracle = self.stage.estimates(self.recipe, model, batch)
            pools = pools or [_Pool() for _ in states]
            for pool, state in zip(pools, states, strict=True):
                pool.add(state, _truth(batch), oracle)
        each = [pool.values() for pool in pools]
        numbers = dict(each[-1])
        for t, values in enumerate(each if len(each) > 1 else []):
            numbers |= {f"{name}-{t}": values[name] for name in ("SF", "energy") if name in values}
        return {"score": numbers.get(self.stage.measure, numbers.get("energy", np.nan)), **numbers}

    def show(self, model: nn.Module) -> dict[str, np.ndarray]:
        """Estimate, truth and error of the first sample."""
        batch = next(self.samples())
        state = self.stage.estimates(self.recipe, model, batch).states[-1]
        return {"held out": comparison(*(maps[0].float().numpy() for maps in (state, _truth(batch))))}


def _flow_loss(recipe: Recipe, model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    left1, _, left2, _ = batch.frames
    motions = cast(PWCNet, model).estimate(left1, left2)
    return multiscale_motion_loss(motions, _truth(batch)[:, (3, 4, 2)], recipe.robust_px), {}


def _flow_states(recipe: Recipe, model: nn.Module, batch: Batch) -> Estimates:
    left1, _, left2, _ = batch.frames
    u, v, change = model(left1, left2).unbind(1)
    return Estimates([torch.stack([torch.full_like(u, torch.nan)] * 2 + [change, u, v], 1)])


def _disparity_loss(recipe: Recipe, model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    left1, right1, left2, right2 = batch.frames
    truth = _truth(batch)
    # both pairs of a sample have a truth: every second one from each
    second = (torch.arange(len(batch)) % 2 == 1)[:, None, None]
    left, right = torch.where(second[..., None], left2, left1), torch.where(second[..., None], right2, right1)
    estimates = cast(GANet, model).estimate(left, right)
    known = torch.where(second, truth[:, 1], truth[:, 0])
    return disparity_loss(estimates, known, recipe.ganet.max_disparity, recipe.robust_px), {}


def _disparity_states(recipe: Recipe, model: nn.Module, batch: Batch) -> Estimates:
    state = torch.full_like(_truth(batch), torch.nan)
    state[:, 0] = model(*batch.frames[:2])
    return Estimates([state])


class _Refined(NamedTuple):
    """A refinement with what it was made by."""

    refiner: Refiner
    oracle: Oracle
    states: list[Tensor]
    reliabilities: list[Tensor | None]


def _refined(recipe: Recipe, model: nn.Module, batch: Batch, before: int = 0) -> _Refined:
    """The refinement of the batch's starts by a refiner, of the networks' states by a hybrid, from the step `before`."""
    if isinstance(model, Hybrid):
        batch, model = model.start(batch), model.refiner
    assert isinstance(model, Refiner)
    oracle = Oracle(*batch.frames, batch.backward_flow, recipe.energy)
    if before:
        with torch.no_grad():
            batch = replace(batch, start=refine(model, batch, oracle, before).states[-1])
    return _Refined(model, oracle, *refine(model, batch, oracle))


def _refinement_loss(recipe: Recipe, model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    before = int(torch.randint(recipe.steps_before + 1, ()))
    refiner, oracle, states, reliabilities = _refined(recipe, model, batch, before)
    if recipe.supervision == "energy":
        return energy_loss(states, oracle), {}
    errors = [state_loss(state.float(), _truth(batch), recipe.left2_weight, recipe.robust_px) for state in states]
    numbers = {"start": float(errors[0].detach()), "end": float(errors[-1].detach())}
    auxiliary = _reliability_loss(refiner, states, reliabilities, _truth(batch))
    numbers["reliability"] = float(auxiliary.detach())
    total = torch.stack([*errors, recipe.reliability_weight * auxiliary]).sum()
    return (total if recipe.supervision == "truth" else total + energy_loss(states, oracle)), numbers


def _refinement_states(recipe: Recipe, model: nn.Module, batch: Batch) -> Estimates:
    refined = _refined(recipe, model, batch)
    return Estimates(refined.states, refined.oracle)


def _selection_loss(recipe: Recipe, model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    selector, before = cast(Selector, model), int(torch.randint(recipe.steps_before + 1, ()))
    with torch.no_grad():
        state = refine(selector, batch, steps=before).states[-1]
    return selection_loss(*selector.weigh(state, batch), _truth(batch), selector.config.least_jump_px), {}


def _selection_states(recipe: Recipe, model: nn.Module, batch: Batch) -> Estimates:
    return Estimates(refine(cast(Selector, model), batch).states)


def _reliability_loss(
    refiner: Refiner, states: list[Tensor], reliabilities: list[Tensor | None], truth: Tensor
) -> Tensor:
    """Mean over the steps; zero for refiners without neighbours."""
    total = truth.new_zeros(())
    if refiner.config.neighbours:
        for state, logits in zip(states, reliabilities, strict=False):
            assert logits is not None
            pick = refiner.grid.pick
            total = total + reliability_loss(logits, pick(state.detach()), pick(truth)) / len(reliabilities)
    return total


def _flow_network(recipe: Recipe) -> nn.Module:
    return _planar(_begin_with(PWCNet(recipe.pwcnet), recipe.weights))


def _disparity_network(recipe: Recipe) -> nn.Module:
    return _begin_with(GANet(recipe.ganet), recipe.weights)


def _refiner_network(recipe: Recipe) -> nn.Module:
    return _planar(_begin_with(Refiner(recipe.refiner), recipe.weights))


def _selector_network(recipe: Recipe) -> nn.Module:
    return _planar(_begin_with(Selector(recipe.selector), recipe.weights))


def _joint_network(recipe: Recipe) -> nn.Module:
    networks = FeedforwardModule(
        load_network(recipe.disparity), _planar(load_network(recipe.motion)), recipe.training.precision
    )
    refiner = cast(Refiner, _refiner_network(recipe))
    return Hybrid(networks, refiner, HybridConfig(cached=recipe.cached_networks), _homographies)


def _homographies(states: Tensor, backward_flows: Tensor) -> Tensor:
    maps = zip(states.float().cpu().numpy(), backward_flows.permute(0, 2, 3, 1).float().cpu().numpy(), strict=True)
    return torch.from_numpy(np.stack([find_homography(state, backward) for state, backward in maps])).to(states.device)


def _begin_with(model: nn.Module, name: str) -> nn.Module:
    if name:
        try:
            model.load_state_dict(load_network(name).state_dict())
        except RuntimeError as error:
            raise InputError(f"{name}: weights of another network ({str(error).splitlines()[0]})") from None
    return model


def _planar(model: nn.Module) -> nn.Module:
    """Channels innermost: the faster layout of two-dimensional convolutions."""
    return model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


STAGES = {
    "flow": Stage(_flow_network, _flow_loss, _flow_states, "F1"),
    "disparity": Stage(_disparity_network, _disparity_loss, _disparity_states, "D1"),
    "refiner": Stage(_refiner_network, _refinement_loss, _refinement_states, "SF"),
    "selector": Stage(_selector_network, _selection_loss, _selection_states, "SF"),
    "joint": Stage(_joint_network, _refinement_loss, _refinement_states, "SF"),
}


def _truth(batch: Batch) -> Tensor:
    assert batch.truth is not None
    return batch.truth


class _Pool:
    """KITTI's measures and the energy pooled over the pixels of several samples; a state's NaN channels leave their
    measures out."""

    def __init__(self) -> None:
        self.scores, self.energy, self.pixels = Scores(), 0.0, 0

    def add(self, state: Tensor, truth: Tensor, oracle: Oracle | None) -> None:
        if oracle is not None:
            self.energy += float(oracle.energy(state).sum())
            self.pixels += state[:, 0].numel()
        known, estimate = (maps[0].float().numpy() for maps in (truth, state))
        d1, _, change, u, v = known
        given = np.isfinite(estimate).any((1, 2))
        part = Truth(
            d1 if given[0] else None,
            d1 + change if given[0] and given[2] else None,
            np.stack([u, v], -1) if given[3] else None,
        )
        self.scores += score(SceneFlow.from_state(estimate, np.ones(d1.shape, bool)), part)
        if given[2] and not given[0]:
            error = np.abs(estimate[2] - change)
            error = error[np.isfinite(error)]
            self.scores += Scores({"EPE-C": (float(error.sum()), error.size)})

    def values(self) -> dict[str, float]:
        values = {name: value for name, value in self.scores.values().items() if "-noc" not in name}
        return values | ({"energy": self.energy / self.pixels} if self.pixels else {})
