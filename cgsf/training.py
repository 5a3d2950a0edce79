"""Recipes: what is trained, on which samples, how; and ``train``, which makes a run folder of one.

A recipe is a TOML file of `Recipe`'s fields. The run folder holds the resolved recipe, the seed and the program's
version, so that a run can be told and repeated from it alone; with a checkpoint inside it is continued.
"""

from __future__ import annotations

import json
import os
import pickle
import platform
import subprocess
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

import cgsf
from cgsf.config import from_table, to_table
from cgsf.datasets.sample import Truth
from cgsf.errors import InputError
from cgsf.feedforward import WEIGHTS, load_network
from cgsf.formats.files import write_bytes
from cgsf.metrics import Scores, score
from cgsf.sample_cache import SampleCache
from cgsf.scene_flow import SceneFlow
from cgsf.start_cache import StartCache
from learned.augment import AugmentConfig, augment
from learned.batch import Batch
from learned.ganet import GANet, GANetConfig
from learned.hybrid import refine
from learned.losses import disparity_loss, multiscale_motion_loss
from learned.oracle import Oracle
from learned.propagation import reliability_loss
from learned.pwcnet import PWCNet, PWCNetConfig
from learned.refiner import Refiner, RefinerConfig
from learned.state_losses import energy_loss, state_loss
from learned.training import Loss, TrainingConfig, TrainingError, Validate, fit


@dataclass(frozen=True)
class Recipe:
    """One training run."""

    stage: Literal["flow", "disparity", "refiner"]
    """Which network."""
    cache: str
    """Folder of the samples (`cgsf.sample_cache`)."""
    starts: str = ""
    """Refiner: folder of the states that it starts from (`cgsf.start_cache`)."""
    weights: str = ""
    """Begin with these (the name of ones that ship, or a .safetensors file) in place of random ones."""
    held_out: int = 16
    """The cache's first samples are for validation only."""
    batch: int = 4
    """Samples a step and process."""
    pwcnet: PWCNetConfig = field(default_factory=PWCNetConfig)
    ganet: GANetConfig = field(default_factory=GANetConfig)
    refiner: RefinerConfig = field(default_factory=RefinerConfig)
    supervision: Literal["truth", "energy", "both"] = "truth"
    """Refiner: the loss is the error, the consistency energy (no truth needed), or their sum."""
    left2_weight: float = 0.1
    """Refiner: weight of D2's error."""
    reliability_weight: float = 1.0
    """Refiner: weight of the loss that teaches it to tell right values from wrong ones, if it propagates."""
    robust_px: float = 0.0
    """Refiner: errors far above this pull less; 0 is the paper's absolute error."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)


def read_recipe(recipe: str | Path) -> Recipe:
    """A recipe from a TOML file, or from the name of weights that ship; `InputError` if there is none or it does not
    fit."""
    path = Path(recipe) if str(recipe).endswith(".toml") else WEIGHTS / f"{recipe}.toml"
    try:
        table = tomllib.loads(path.read_text())
    except FileNotFoundError:
        known = ", ".join(sorted(other.stem for other in WEIGHTS.glob("*.toml")))
        raise InputError(f"no recipe {path}; those that ship are {known}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no valid TOML ({error})") from None
    return from_table(Recipe, table)


def with_changes(recipe: Recipe, cache: str | None = None, starts: str | None = None, steps: int | None = None) -> Recipe:
    """The recipe with other folders or another length."""
    training = recipe.training if steps is None else replace(recipe.training, steps=steps)
    return replace(recipe, cache=cache or recipe.cache, starts=starts or recipe.starts, training=training)


def run_recipe(recipe: Recipe, folder: str | Path, seconds: float = float("inf"), threads: int | None = None) -> dict[str, float]:
    """`train` with a bar, on this process alone or as one of those that torchrun has started."""
    if threads:
        torch.set_num_threads(threads)
    several = "WORLD_SIZE" in os.environ
    if several:
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        return train(recipe, folder, seconds, progress=True)
    finally:
        if several:
            dist.destroy_process_group()


def train(recipe: Recipe, folder: str | Path, seconds: float = float("inf"), progress: bool = False) -> dict[str, float]:
    """Run a recipe, or go on with it.

    Parameters
    ----------
    recipe : Recipe
    folder : str or Path
        The run folder; what is written there stands in `learned.training.fit`, beside ``run.json``.
    seconds : float
        Stop, to be continued, after this time.
    progress : bool
        Show a bar.

    Returns
    -------
    dict
        The last numbers of the log.

    Raises
    ------
    InputError
        If the samples are missing, or the folder holds another recipe's run.
    """
    folder = Path(folder)
    _claim(folder, recipe)
    cache = SampleCache(recipe.cache)
    if len(cache) <= recipe.held_out:
        raise InputError(f"{recipe.cache}: {len(cache)} samples, of which {recipe.held_out} are held out: none to train with")
    torch.manual_seed(recipe.training.seed)
    starts = StartCache(recipe.starts) if recipe.stage == "refiner" else None
    if starts and starts.names != cache.names[: len(starts)]:
        raise InputError(f"{recipe.starts} was made from other samples than those of {recipe.cache}")
    batches = Batches(recipe, cache, starts)
    if batches.count < 1:
        raise InputError(f"{recipe.cache}: all of its samples are held out ({recipe.held_out}): none to train with")
    torch.manual_seed(recipe.training.seed)
    model = _NETWORKS[recipe.stage](recipe)
    if recipe.stage != "disparity":  # a layout of two-dimensional convolutions
        model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if recipe.weights:
        _begin_with(model, recipe.weights)
    loss, validate = _STAGES[recipe.stage](recipe, batches)
    try:
        return fit(model, batches, loss, recipe.training, folder, validate, seconds, progress)
    except TrainingError as error:
        raise InputError(str(error)) from error


class Batches:
    """``batch_at`` over a cache: every pass shuffles anew, every draw depends on the index alone."""

    def __init__(self, recipe: Recipe, cache: SampleCache, starts: StartCache | None = None) -> None:
        self.recipe, self.cache, self.starts = recipe, cache, starts
        self.count = min(len(cache), len(cache) if starts is None else len(starts)) - recipe.held_out

    def __call__(self, index: int) -> Batch:
        recipe, seed = self.recipe, self.recipe.training.seed
        chosen = []
        for position in range(index * recipe.batch, (index + 1) * recipe.batch):
            order = np.random.default_rng([seed, position // self.count]).permutation(self.count)
            chosen.append(recipe.held_out + int(order[position % self.count]))
        generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
        return Batch.cat([augment(self.sample(i), recipe.augment, generator) for i in chosen])

    def sample(self, index: int) -> Batch:
        """One sample of the cache as a batch; its images are bytes."""
        images, truth = (torch.from_numpy(np.array(array)[None]) for array in self.cache[index])
        images, names = images.permute(0, 1, 4, 2, 3), (self.cache.names[index],)
        if self.starts is None:
            return Batch(images, truth, names=names)
        start, backward, evidence = (torch.from_numpy(np.array(array)[None]) for array in self.starts[index])
        return Batch(images, truth, start, backward, evidence, names)

    def held_out(self) -> Iterator[Batch]:
        """The samples that are never trained with, whole and unchanged."""
        for index in range(self.recipe.held_out):
            sample = self.sample(index)
            yield replace(sample, images=sample.images.float() / 255)


def _flow_stage(recipe: Recipe, batches: Batches) -> tuple[Loss, Validate]:
    def loss(model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        left1, _, left2, _ = batch.frames
        motions = model.estimate(left1, left2)  # type: ignore[operator]
        return multiscale_motion_loss(motions, _truth(batch)[:, (3, 4, 2)]), {}

    def validate(model: nn.Module) -> dict[str, float]:
        pooled = _Pool()
        for batch in batches.held_out():
            left1, _, left2, _ = batch.frames
            u, v, change = model(left1, left2).unbind(1)
            pooled.add(torch.stack([torch.full_like(u, torch.nan)] * 2 + [change, u, v], 1), _truth(batch))
        values = pooled.values()
        return {"score": values["F1"], "F1": values["F1"], "EPE-F": values["EPE-F"], "EPE-C": values["EPE-C"]}

    return loss, validate


def _disparity_stage(recipe: Recipe, batches: Batches) -> tuple[Loss, Validate]:
    def loss(model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        left1, right1, left2, right2 = batch.frames
        truth = _truth(batch)
        # both pairs of a sample have a truth: every second one from each
        second = (torch.arange(len(batch)) % 2 == 1)[:, None, None]
        left, right = torch.where(second[..., None], left2, left1), torch.where(second[..., None], right2, right1)
        estimates = model.estimate(left, right)  # type: ignore[operator]
        return disparity_loss(estimates, torch.where(second, truth[:, 1], truth[:, 0]), recipe.ganet.max_disparity), {}

    def validate(model: nn.Module) -> dict[str, float]:
        pooled = _Pool()
        for batch in batches.held_out():
            state = torch.full_like(_truth(batch), torch.nan)
            state[:, 0] = model(*batch.frames[:2])
            pooled.add(state, _truth(batch))
        values = pooled.values()
        return {"score": values["D1"], "D1": values["D1"], "EPE-D": values["EPE-D"]}

    return loss, validate


def _refiner_stage(recipe: Recipe, batches: Batches) -> tuple[Loss, Validate]:
    def loss(model: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        oracle = Oracle(*batch.frames, batch.backward_flow)
        assert isinstance(model, Refiner)
        states, reliabilities = refine(model, batch, oracle)
        errors = [state_loss(state.float(), _truth(batch), recipe.left2_weight, recipe.robust_px) for state in states]
        numbers = {"start": float(errors[0].detach()), "end": float(errors[-1].detach())}
        auxiliary = _reliability_loss(model, states, reliabilities, _truth(batch))
        numbers["reliability"] = float(auxiliary.detach())
        errors.append(recipe.reliability_weight * auxiliary)
        total = torch.stack(errors).sum() if recipe.supervision != "energy" else torch.zeros(())
        return (total if recipe.supervision == "truth" else total + energy_loss(states, oracle)), numbers

    def validate(model: nn.Module) -> dict[str, float]:
        assert isinstance(model, Refiner)
        pools = [_Pool() for _ in range(recipe.refiner.steps + 1)]
        for batch in batches.held_out():
            for pool, state in zip(pools, refine(model, batch).states, strict=True):
                pool.add(state, _truth(batch))
        last = pools[-1].values()
        return {"score": last["SF"], **{f"SF-{t}": pool.values()["SF"] for t, pool in enumerate(pools)}, **last}

    return loss, validate


def _reliability_loss(model: Refiner, states: list[Tensor], reliabilities: list[Tensor | None], truth: Tensor) -> Tensor:
    """Mean over the steps; zero for refiners without propagation."""
    total = truth.new_zeros(())
    if model.propagation is not None:
        for state, logits in zip(states, reliabilities, strict=False):
            assert logits is not None
            pick = model.propagation.pick
            total = total + reliability_loss(logits, pick(state.detach()), pick(truth)) / len(reliabilities)
    return total


_NETWORKS = {
    "flow": lambda recipe: PWCNet(recipe.pwcnet),
    "disparity": lambda recipe: GANet(recipe.ganet),
    "refiner": lambda recipe: Refiner(recipe.refiner),
}
_STAGES = {"flow": _flow_stage, "disparity": _disparity_stage, "refiner": _refiner_stage}


def _begin_with(model: nn.Module, name: str) -> None:
    given = load_network(name)
    try:
        model.load_state_dict(given.state_dict())
    except RuntimeError as error:
        raise InputError(f"{name}: weights of another network ({str(error).splitlines()[0]})") from None


def _truth(batch: Batch) -> Tensor:
    assert batch.truth is not None
    return batch.truth


class _Pool:
    """KITTI's measures pooled over the pixels of several samples; a state's NaN channels leave their measures out."""

    def __init__(self) -> None:
        self.scores = Scores()

    def add(self, state: Tensor, truth: Tensor) -> None:
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
        return {name: value for name, value in self.scores.values().items() if "-noc" not in name}


def _claim(folder: Path, recipe: Recipe) -> None:
    """Write ``run.json``, or refuse a folder whose run is another one. Only the number of steps may change."""
    path = folder / "run.json"
    table = to_table(recipe)
    if path.exists():
        try:
            other = json.loads(path.read_text())["recipe"]
        except (ValueError, KeyError):
            raise InputError(f"{path} is damaged; choose another run folder") from None
        if _without_length(other) != _without_length(table):
            raise InputError(f"{folder} holds the run of another recipe; choose another run folder")
    record = {
        "recipe": table,
        "seed": recipe.training.seed,
        "version": cgsf.__version__,
        "commit": _commit(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
    }
    write_bytes(path, json.dumps(record, indent=2).encode())


def _without_length(table: dict[str, Any]) -> dict[str, Any]:
    loose = ("steps", "checkpoint_every", "log_every", "validate_every", "tensorboard")
    return table | {"training": {key: value for key, value in table["training"].items() if key not in loose}}


def _commit() -> str:
    """The git hash of the program, "unknown" outside a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def export_best(recipe: Recipe, folder: str | Path, path: str | Path) -> None:
    """Write the best weights of a run as safetensors, with the recipe's and the run's numbers in the model card."""
    from learned.checkpoint import ModelCard, save

    best = Path(folder) / "best.pt"
    try:
        content = torch.load(best, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise InputError(f"{best}: no weights to export ({error})") from None
    net = _NETWORKS[recipe.stage](recipe)
    net.load_state_dict(content["model"])
    lines = [json.loads(line) for line in (Path(folder) / "log.jsonl").read_text().splitlines()]
    scores = [line for line in lines if "score" in line and line["step"] == content["step"]][-1]
    numbers = ", ".join(f"{key} {scores[key]:.4g}" for key in scores if key[0].isupper())
    source = f"the recipe of this name, {content['step']} steps; {recipe.held_out} held-out samples: {numbers}"
    save(net, path, ModelCard(source, "Apache-2.0"))
