"""Recipes: what is trained, on which samples, how. A recipe is a TOML file of `Recipe`'s fields."""

from __future__ import annotations

import json
import platform
import subprocess
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch

import cgsf
from cgsf.config import from_table, to_table
from cgsf.errors import InputError
from cgsf.feedforward import WEIGHTS
from cgsf.formats.files import write_bytes
from learned.augment import AugmentConfig
from learned.ganet import GANetConfig
from learned.hybrid import NetworkName
from learned.pwcnet import PWCNetConfig
from learned.refiner import RefinerConfig
from learned.selector import SelectorConfig
from learned.training import TrainingConfig
from variational.energy import EnergyConfig

NETWORKS = get_args(NetworkName)


@dataclass(frozen=True)
class Recipe:
    """One training run."""

    stage: Literal["flow", "disparity", "refiner", "selector", "joint"]
    """Which network; selector: a refiner that chooses; joint: both networks and the refiner together."""
    cache: str
    """Folder of the samples (`cgsf.sample_cache`)."""
    starts: str = ""
    """Refiner, selector: folder of the states that it starts from (`cgsf.start_cache`). Joint: what networks that are frozen
    would say, in place of running them."""
    weights: str = ""
    """Begin with these (the name of ones that ship, or a .safetensors file) in place of random ones; joint: the
    refiner's."""
    disparity: str = "disparity"
    """Joint: the disparity network to begin with, a name or a file."""
    motion: str = "flow"
    """Joint: the motion network to begin with, a name or a file."""
    held_out: int = 16
    """The cache's first samples are for validation only."""
    further: tuple[str, ...] = ()
    """Folders of further samples to train with, such as real ones with what a method says for truth."""
    further_starts: tuple[str, ...] = ()
    """Refiner, selector: the starts of each of those folders."""
    further_share: float = 0.2
    """How often a sample is one of those."""
    batch: int = 4
    """Samples a step and process."""
    pwcnet: PWCNetConfig = field(default_factory=PWCNetConfig)
    ganet: GANetConfig = field(default_factory=GANetConfig)
    refiner: RefinerConfig = field(default_factory=RefinerConfig)
    selector: SelectorConfig = field(default_factory=SelectorConfig)
    energy: EnergyConfig = field(default_factory=EnergyConfig)
    """Refiner, joint: the energy that the refiner sees and that self-supervision lowers. At test time methods take the
    paper's, the default; another one is for ablations."""
    supervision: Literal["truth", "energy", "both"] = "truth"
    """Refiner, joint: the loss is the error, the consistency energy (no truth needed), or their sum."""
    left2_weight: float = 0.1
    """Refiner, joint: weight of D2's error."""
    reliability_weight: float = 1.0
    """Refiner, joint: weight of the loss that teaches it to tell right values from wrong ones, if it looks at neighbours."""
    steps_before: int = 0
    """Refiner, selector, joint: up to this many steps, drawn for each batch, are made before those that learn, so that it has
    seen its own results and does not spoil them when it is run for longer."""
    robust_px: float = 0.0
    """Errors far above this pull less (`learned.losses.robust`); 0 is the published loss of each stage."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)

    @property
    def cached_networks(self) -> tuple[NetworkName, ...]:
        """Joint: the networks that are frozen and whose outputs are read from the starts."""
        if self.stage != "joint" or not self.starts:
            return ()
        frozen = self.training.frozen
        return tuple(name for name in NETWORKS if f"feedforward.{name}.".startswith(frozen))


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


def claim(folder: Path, recipe: Recipe) -> None:
    """Write ``run.json``, or refuse a folder whose run is another one. Only the number of steps may change."""
    path = folder / "run.json"
    table = to_table(recipe)
    if path.exists():
        try:  # through Recipe, so that fields that are newer than the run have their defaults
            other = to_table(from_table(Recipe, json.loads(path.read_text())["recipe"]))
        except (ValueError, KeyError):
            raise InputError(f"{path} is damaged or of another version; choose another run folder") from None
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
