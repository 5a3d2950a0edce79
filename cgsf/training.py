"""``train`` makes a run folder of a recipe, or goes on with one.

The run folder holds the resolved recipe, the seed and the program's version, so that a run can be told and repeated
from it alone.
"""

from __future__ import annotations

import json
import os
import pickle
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

from cgsf.batches import Batches, Source, further_sources
from cgsf.errors import InputError
from cgsf.recipe import Recipe, claim
from cgsf.sample_cache import SampleCache
from cgsf.stages import STAGES, HeldOut
from cgsf.threads import bound_threads
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
    if recipe.starts and recipe.stage == "joint" and not recipe.cached_networks:
        raise InputError('starts take the place of networks that are frozen, as training.frozen = ["feedforward"]')
    refines = recipe.stage in ("refiner", "selector")
    if refines and not recipe.starts:
        raise InputError(f"a {recipe.stage} needs starts")
    needs_starts = refines or recipe.cached_networks
    source = Source.open(recipe.cache, recipe.starts if needs_starts else "")
    batches = Batches(recipe, source, further_sources(recipe))
    if batches.count < 1:
        raise InputError(f"{recipe.cache}: {len(source)} samples, of which {recipe.held_out} are held out: none to train with")
    check_truth(recipe, source.cache)
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


def check_truth(recipe: Recipe, cache: SampleCache) -> None:
    """`InputError` if a recipe that learns from the truth gets samples without one."""
    learns_from_truth = recipe.stage in ("flow", "disparity", "selector") or recipe.supervision != "energy"
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
