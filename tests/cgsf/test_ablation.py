"""Ablations from caches: which variants there are, that they are trained and compared, and that they go on."""

import dataclasses
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from cgsf.ablation import variants
from cgsf.cli import main
from cgsf.config import to_table
from cgsf.recipe import Recipe
from cgsf.sample_cache import write_cache
from cgsf.start_cache import write_starts
from cgsf.starts import StartConfig
from learned.augment import AugmentConfig
from learned.refiner import RefinerConfig
from learned.training import TrainingConfig
from tests.cgsf.test_training import NAMES, SIZE, make, toml
from variational.energy import EnergyConfig

SEEN = RefinerConfig(inputs=("state", "loss", "gradient", "image"), layers=((8, 1),), steps=1)


def test_variants_change_what_they_say_and_nothing_else():
    recipe = Recipe("refiner", "cache", refiner=SEEN)
    inputs = {name: variant.refiner.inputs for name, variant in variants(recipe, "inputs").items()}
    assert inputs == {
        "X": ("state", "image"), "X+L": ("state", "loss", "image"), "X+gradient": ("state", "gradient", "image"),
        "X+L+gradient": ("state", "loss", "gradient", "image"),
    }  # fmt: skip
    terms = variants(recipe, "terms")
    assert list(terms) == ["pd", "pf", "df", "pd+pf", "pd+df", "pf+df", "pd+pf+df"]
    assert terms["pd+pf+df"] == recipe
    assert terms["pf"] == dataclasses.replace(recipe, energy=EnergyConfig(stereo_weight=0, coupling_weight=0))


def test_an_ablation_trains_every_variant_and_goes_on(tmp_path: Path):
    cache = write_cache(tmp_path / "cache", NAMES[:2], make, SIZE)
    write_starts(tmp_path / "starts", cache, StartConfig("opencv"))
    recipe = Recipe("refiner", "cache", "starts", held_out=1, batch=1, refiner=SEEN, augment=AugmentConfig(48, 64),
                    training=TrainingConfig(precision="float32", learning_rate=1e-2, warmup=0))  # fmt: skip
    (tmp_path / "recipe.toml").write_text(toml(to_table(recipe)))
    arguments = ["ablate", str(tmp_path / "recipe.toml"), "inputs", "-o", str(tmp_path / "out"), "--steps", "2", "--seeds", "2",
                 "--cache", str(tmp_path / "cache"), "--starts", str(tmp_path / "starts")]  # fmt: skip
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    rows = [line.split(" | ")[0].strip("| ") for line in result.output.splitlines() if line.startswith("| ")]
    assert rows == ["variant", "start", "X", "X+L", "X+gradient", "X+L+gradient"]
    assert (tmp_path / "out" / "table.md").read_text().endswith(result.output)
    logs = [(tmp_path / "out" / "X" / f"seed-{seed}" / "log.jsonl").read_text() for seed in (0, 1)]
    assert logs[0] != logs[1]
    assert json.loads(logs[0].splitlines()[-1])["step"] == 2
    assert CliRunner().invoke(main, arguments).output == result.output
    assert (tmp_path / "out" / "X" / "seed-0" / "log.jsonl").read_text() == logs[0]


@pytest.mark.parametrize("recipe", ["flow", "disparity"])
def test_only_refiners_are_ablated(tmp_path: Path, recipe: str):
    refused = CliRunner().invoke(main, ["ablate", recipe, "inputs", "-o", str(tmp_path)])
    assert (refused.exit_code, 'stage "refiner"' in refused.stderr) == (2, True)
