"""The comparison of the online strategies, with small untrained networks on a rendered video."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from cgsf.cli import main
from cgsf.datasets import open_dataset
from cgsf.errors import InputError
from cgsf.metrics import Scores
from cgsf.pipelines import load_config
from cgsf.refined import RefinedConfig, Strategist
from cgsf.scene_flow import SceneFlow
from cgsf.strategies import Outcome, compare_strategies, strategies_table
from learned.checkpoint import ModelCard, save
from learned.refiner import COMPACT, Refiner
from learned.strategies import StrategyConfig
from tests.cgsf.test_caches import weights

VIDEO = {"count": 2, "frames": 3, "height": 32, "width": 48, "antialias": False, "shadows": False}


@pytest.fixture
def preset(tmp_path: Path) -> str:
    disparity, motion = weights(tmp_path)
    torch.manual_seed(1)
    small = dataclasses.replace(COMPACT, layers=((8, 1),), neighbours=(1,))
    save(Refiner(small), tmp_path / "r.safetensors", ModelCard("a test"))
    text = f'[feedforward]\ndisparity = "{disparity}"\nmotion = "{motion}"\n[refined]\nrefiner = "{tmp_path}/r.safetensors"\n'
    (tmp_path / "preset.toml").write_text(text + "parameters_rate = 1e-3\n")
    return str(tmp_path / "preset.toml")


def test_one_command_compares_all_three(tmp_path: Path, preset: str):
    options = []
    for name, value in (VIDEO | {"count": 1, "frames": 2}).items():
        options += ["--option", f"{name}={str(value).lower()}"]
    arguments = ["strategies", "synthetic-things", ".", "-o", str(tmp_path / "out"), "--preset", preset, "--steps", "4",
                 "--pictures", *options]  # fmt: skip
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader((tmp_path / "out" / "frames.csv").read_text().splitlines()))
    assert [row["strategy"] for row in rows] == ["start", "learned", "outputs", "parameters"]
    energy = {row["strategy"]: float(row["energy"]) for row in rows}
    assert energy["learned"] == energy["start"]  # untrained: it changes nothing
    assert max(energy["outputs"], energy["parameters"]) < energy["start"]
    assert all(float(row["seconds"]) > 0 for row in rows)
    frame = tmp_path / "out" / "outputs" / "things-000000"
    assert (frame / "steps.png").read_bytes().startswith(b"\x89PNG")
    assert SceneFlow.load(frame).shape == (32, 48)
    assert not list((tmp_path / "out" / "parameters").rglob("*.png"))
    assert (tmp_path / "out" / "table.md").read_text().strip().endswith(result.output.strip().splitlines()[-1])
    assert json.loads((tmp_path / "out" / "config.json").read_text())["settings"]["steps"] == 4
    again = CliRunner().invoke(main, arguments)
    assert (again.exit_code, "not empty" in again.stderr) == (2, True)


def test_a_video_adapts_as_it_goes_and_the_next_begins_anew(tmp_path: Path, preset: str):
    config = dataclasses.replace(load_config("hybrid", preset), steps=2)
    dataset = open_dataset("synthetic-things", ".", **VIDEO)
    alone, video = (compare_strategies(dataset, tmp_path / str(video), config, ["parameters"], video=video)
                    for video in (False, True))  # fmt: skip
    energies = [[outcome.energy for outcome in outcomes if outcome.strategy != "start"] for outcomes in (alone, video)]
    assert [outcome.frame for outcome in video][::2] == dataset.names
    assert {outcome.strategy for outcome in video} == {"start", "parameters, adapting"}
    assert energies[1][0] == pytest.approx(energies[0][0], rel=1e-6)  # nothing to build on
    assert energies[1][1] < energies[0][1]  # the second frame goes on from the first
    assert energies[1][2] == pytest.approx(energies[0][2], rel=1e-6)  # another video


def test_weights_come_back_after_every_frame(preset: str):
    config = dataclasses.replace(load_config("hybrid", preset), steps=2, strategy="parameters", parameters_rate=0.1)
    strategist = Strategist(config)
    before = {name: value.clone() for name, value in strategist.networks.state_dict().items()}
    sample = open_dataset("synthetic-things", ".", **VIDEO)[0]
    outcomes = [SceneFlow.state(result) for result in _twice(strategist, sample, config)]
    assert all(torch.equal(before[name], value) for name, value in strategist.networks.state_dict().items())
    np.testing.assert_array_equal(*outcomes)


def _twice(strategist: Strategist, sample, config: RefinedConfig):
    from cgsf.intake import to_frames
    from cgsf.starts import make_start

    frames = to_frames(sample.images)
    start = make_start(frames, config)
    return [strategist(frames, start) for _ in range(2)]


def test_the_table_pools_pixels_and_averages_frames():
    scores = [Scores({"SF": (10.0, 100)}), Scores({"SF": (0.0, 300)})]
    outcomes = [Outcome("outputs", str(i), scores[i], energy=1.0 + i, steps=7, seconds=0.5 + i) for i in range(2)]
    assert strategies_table(outcomes).splitlines()[-1] == "| outputs | 2 |  |  |  | 2.50 |  |  |  | 1.5000 | 7 | 1.000 |"


def test_settings_are_those_of_the_strategies():
    config, strategy = RefinedConfig(), StrategyConfig()
    assert (config.outputs_rate, config.parameters_rate) == (strategy.outputs_rate, strategy.parameters_rate)
    with pytest.raises(ValueError, match="rates must be positive"):
        RefinedConfig(outputs_rate=0)


def test_what_cannot_be_compared_is_refused(tmp_path: Path):
    more = ["-o", str(tmp_path / "out"), "--initial", "opencv", "--strategy", "parameters"]
    refused = CliRunner().invoke(main, ["strategies", "synthetic-things", ".", *more])
    assert (refused.exit_code, "needs --initial feedforward" in refused.stderr) == (2, True)
    with pytest.raises(InputError, match="frames at least 2"):
        open_dataset("synthetic-things", ".", frames=1)
