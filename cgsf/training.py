"""``train`` makes a run folder of a recipe, or goes on with one.

The run folder holds the resolved recipe, the seed and the program's version, so that a run can be told and repeated
from it alone.
"""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

from cgsf.errors import InputError
from cgsf.recipe import Recipe, claim
from cgsf.sample_cache import SampleCache
from cgsf.stages import STAGES, HeldOut
from cgsf.start_cache import StartCache
from cgsf.threads import bound_threads
from learned.augment import augment
from learned.batch import Batch
from learned.hybrid import Hybrid
from learned.training import TrainingError, fit
from variational.energy import EnergyConfig


def run_recipe(recipe: Recipe, folder: str | Path, seconds: float = float("inf"), threads: int | None = None) -> dict[str, float]:
    """`train` with a bar, on this process alone or as one of those that torchrun has started."""
    several = "WORLD_SIZE" in os.environ
    if threads or several:  # torchrun bounds torch alone
        bound_threads(threads or torch.get_num_threads())
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
    cache = SampleCache(recipe.cache)
    if len(cache) <= recipe.held_out:
        raise InputError(f"{recipe.cache}: {len(cache)} samples, of which {recipe.held_out} are held out: none to train with")
    starts = _starts(recipe.starts, cache) if recipe.stage == "refiner" or recipe.cached_networks else None
    if bool(recipe.rivals) != (recipe.stage == "refiner" and recipe.refiner.rival):
        raise InputError("rivals and a refiner that weighs them (rival = true, stage refiner) go together: give both or neither")
    rivals = _starts(recipe.rivals, cache) if recipe.rivals else None
    if recipe.starts and recipe.stage == "joint" and not starts:
        raise InputError('starts take the place of networks that are frozen, as training.frozen = ["feedforward"]')
    if recipe.further and starts:
        raise InputError("further samples have no starts: they are for the stages flow and disparity")
    batches = Batches(recipe, cache, starts, rivals, [SampleCache(folder) for folder in recipe.further])
    if batches.count < 1:
        raise InputError(f"{recipe.cache}: all of its samples are held out ({recipe.held_out}): none to train with")
    check_truth(recipe, cache)
    claim(folder, recipe)
    torch.manual_seed(recipe.training.seed)
    stage = STAGES[recipe.stage]
    model = stage.network(recipe)
    held_out = HeldOut(recipe, stage, batches.held_out)
    try:
        loss = partial(stage.loss, recipe)
        return fit(model, batches, loss, recipe.training, folder, held_out.validate, seconds, progress, held_out.show)
    except TrainingError as error:
        raise InputError(str(error)) from error


class Batches:
    """``batch_at`` over a cache: every pass shuffles anew, every draw depends on the index alone."""

    def __init__(
        self, recipe: Recipe, cache: SampleCache, starts: StartCache | None = None, rivals: StartCache | None = None,
        further: Sequence[SampleCache] = (),
    ) -> None:  # fmt: skip
        self.recipe, self.cache, self.starts, self.rivals = recipe, cache, starts, rivals
        self.further = [(more, index) for more in further for index in range(len(more))]
        self.count = min(len(source) for source in (cache, starts, rivals) if source is not None) - recipe.held_out

    def __call__(self, index: int) -> Batch:
        recipe, seed = self.recipe, self.recipe.training.seed
        chosen = []
        for position in range(index * recipe.batch, (index + 1) * recipe.batch):
            draw = np.random.default_rng([seed, position, len(self.further)])
            if self.further and draw.random() < recipe.further_share:
                chosen.append(_images_and_truth(*self.further[draw.integers(len(self.further))]))
            else:
                order = np.random.default_rng([seed, position // self.count]).permutation(self.count)
                chosen.append(self.sample(recipe.held_out + int(order[position % self.count])))
        generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
        return Batch.cat([augment(sample, recipe.augment, generator) for sample in chosen])

    def sample(self, index: int) -> Batch:
        """One sample of the cache as a batch; its images are bytes."""
        plain = _images_and_truth(self.cache, index)
        if self.starts is None:
            return plain
        known = {name: torch.from_numpy(np.array(array)[None]) for name, array in self.starts[index].items()}
        rival = None if self.rivals is None else torch.from_numpy(np.array(self.rivals[index]["start"])[None])
        return replace(
            plain, start=known["start"], backward_flow=known["backward"], evidence=known["evidence"], rival=rival,
            homography=known["homography"],
        )  # fmt: skip

    def held_out(self) -> Iterator[Batch]:
        """The samples that are never trained with, whole and unchanged."""
        for index in range(self.recipe.held_out):
            sample = self.sample(index)
            yield replace(sample, images=sample.images.float() / 255)


def _images_and_truth(cache: SampleCache, index: int) -> Batch:
    images, truth = (torch.from_numpy(np.array(array)[None]) for array in cache[index])
    return Batch(images.permute(0, 1, 4, 2, 3), truth, names=(cache.names[index],))


def _starts(folder: str, cache: SampleCache) -> StartCache:
    starts = StartCache(folder)
    if starts.names != cache.names[: len(starts)]:
        raise InputError(f"{folder} was made from other samples than those of {cache.folder}")
    return starts


def check_truth(recipe: Recipe, cache: SampleCache) -> None:
    """`InputError` if a recipe that learns from the truth gets samples without one."""
    learns_from_truth = recipe.stage in ("flow", "disparity") or recipe.supervision != "energy"
    if learns_from_truth and not np.isfinite(cache.truth[len(cache) - 1]).any():
        raise InputError(f'{recipe.cache}: no truth to learn from; refiner and joint can do with supervision = "energy"')


def export_best(recipe: Recipe, folder: str | Path, path: str | Path) -> None:
    """Write the best weights of a run as safetensors, with the recipe's and the run's numbers in the model card; of a
    joint run three files, NAME-disparity, NAME-flow and NAME-refiner."""
    from learned.checkpoint import ModelCard, save

    best = Path(folder) / "best.pt"
    try:
        content = torch.load(best, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise InputError(f"{best}: no weights to export ({error})") from None
    if recipe.energy != EnergyConfig():
        raise InputError("weights that saw another energy than the paper's are for ablations: no method can use them")
    net = STAGES[recipe.stage].network(recipe)
    net.load_state_dict(content["model"])
    lines = [json.loads(line) for line in (Path(folder) / "log.jsonl").read_text().splitlines()]
    scores = [line for line in lines if "score" in line and line["step"] == content["step"]][-1]
    numbers = ", ".join(f"{key} {scores[key]:.4g}" for key in scores if key[0].isupper())
    source = f"the recipe of this name, {content['step']} steps; {recipe.held_out} held-out samples: {numbers}"
    parts: dict[str, nn.Module] = {"": net}
    if isinstance(net, Hybrid):
        networks = net.feedforward
        parts = {"-disparity": networks.disparity, "-flow": networks.motion, "-refiner": net.refiner}  # type: ignore[dict-item]
    for suffix, part in parts.items():
        save(part, str(path).removesuffix(".safetensors") + f"{suffix}.safetensors", ModelCard(source, "Apache-2.0"))
