"""What a refiner owes to each of its inputs and to each term of the energy that it sees: the same short training for
every variant, one table.

::

    OUT/VARIANT/seed-N/      a run folder, see `cgsf.training`; an interrupted ablation goes on where it stopped
    OUT/table.md             scores on the held-out samples after the last step

Chen et al., tables 3 and 4.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import write_bytes
from cgsf.metrics import ENDPOINT_ERRORS, OUTLIERS
from cgsf.recipe import Recipe
from cgsf.training import train
from learned.refiner import Input
from variational.energy import EnergyConfig

Subject = Literal["inputs", "terms"]

#: The paper's inputs and terms; whatever else a recipe's refiner sees stays in every variant.
_INPUTS = {"X": "state", "L": "loss", "gradient": "gradient"}
_TERMS = {"pd": "stereo_weight", "pf": "flow_weight", "df": "coupling_weight"}


def variants(recipe: Recipe, subject: Subject) -> dict[str, Recipe]:
    """The recipe's variants by name: the state alone, with the energy's map, with its gradient, with both; or every
    combination of the data terms, smoothness always among them."""
    if subject == "inputs":
        beside = tuple(name for name in recipe.refiner.inputs if name not in _INPUTS.values())
        chosen = [("X",), ("X", "L"), ("X", "gradient"), ("X", "L", "gradient")]
        made = {}
        for names in chosen:
            inputs = cast(tuple[Input, ...], tuple(_INPUTS[name] for name in names) + beside)
            made["+".join(names)] = replace(recipe, refiner=replace(recipe.refiner, inputs=inputs))
        return made
    terms = [kept for count in range(1, len(_TERMS) + 1) for kept in combinations(_TERMS, count)]
    return {"+".join(kept): replace(recipe, energy=_with_terms(recipe.energy, kept)) for kept in terms}


def _with_terms(energy: EnergyConfig, kept: Sequence[str]) -> EnergyConfig:
    off: dict[str, Any] = {weight: 0.0 for name, weight in _TERMS.items() if name not in kept}
    return replace(energy, **off)


def ablate(
    recipe: Recipe, subject: Subject, out: str | Path, steps: int, seeds: int = 1,
    watch: Callable[[Iterable[tuple[str, int]]], Iterable[tuple[str, int]]] = iter,
) -> str:  # fmt: skip
    """Train every variant and compare them.

    Parameters
    ----------
    recipe : Recipe
        Of stage "refiner".
    subject : {"inputs", "terms"}
    out : str or Path
    steps : int
        Length of each run.
    seeds : int
        Runs of each variant, with seeds 0, 1, ...; they tell what is chance.
    watch : callable
        Wraps the (variant, seed) pairs, for a progress bar.

    Returns
    -------
    str
        The Markdown table: means over the seeds, and the range of SF.

    Raises
    ------
    InputError
        If the recipe is not a refiner's, or samples or starts are missing.
    """
    if recipe.stage != "refiner":
        raise InputError(f'an ablation needs a recipe of stage "refiner", not "{recipe.stage}"')
    out, recipes = Path(out), variants(recipe, subject)
    numbers: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}
    for name, seed in watch([(name, seed) for name in recipes for seed in range(seeds)]):
        training = replace(recipe.training, steps=steps, seed=seed, validate_every=steps, log_every=min(steps, 20))
        folder = out / name / f"seed-{seed}"
        train(replace(recipes[name], training=training), folder)
        numbers[name].append(_last_scores(folder))
    table = _table(numbers)
    write_bytes(out / "table.md", f"{subject}, {steps} steps, {seeds} seeds\n\n{table}\n".encode())
    return table


def _last_scores(folder: Path) -> dict[str, float]:
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if "score" in line][-1]


def _table(numbers: dict[str, list[dict[str, float]]]) -> str:
    names = [*OUTLIERS, *ENDPOINT_ERRORS]
    lines = ["| variant | " + " | ".join(names) + " | SF of the seeds |", "|---|" + "---:|" * (len(names) + 1)]
    first = next(iter(numbers.values()))
    cells = [f"{first[0]['SF-0']:.2f}" if name == "SF" and "SF-0" in first[0] else "" for name in names]
    lines.append("| start | " + " | ".join(cells) + " | |")
    for variant, runs in numbers.items():
        lines.append(f"| {variant} | " + " | ".join(_mean(runs, name) for name in names) + f" | {_range(runs)} |")
    return "\n".join(lines)


def _mean(runs: Sequence[dict[str, float]], name: str) -> str:
    values = [run[name] for run in runs if name in run]
    return f"{np.mean(values):.2f}" if values else ""


def _range(runs: Sequence[dict[str, float]]) -> str:
    values = [run["SF"] for run in runs if "SF" in run]
    return f"{min(values):.2f} to {max(values):.2f}" if values else ""
