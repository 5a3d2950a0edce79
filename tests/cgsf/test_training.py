"""From samples on disk to a trained refiner in a pipeline, with small networks; and what is refused on the way."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import cgsf
from cgsf import pipelines
from cgsf.batches import Batches, Source, further_sources
from cgsf.config import to_table
from cgsf.datasets.frames import FrameFolders
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.feedforward import FeedforwardConfig, load_network
from cgsf.recipe import Recipe, read_recipe, with_changes
from cgsf.refined import RefinedConfig, load_refiner, run_refined
from cgsf.sample_cache import SampleCache, write_cache
from cgsf.stages import STAGES
from cgsf.start_cache import StartCache, write_starts
from cgsf.starts import StartConfig, load_start_config
from cgsf.training import export_best, train
from learned.augment import AugmentConfig
from learned.checkpoint import ModelCard, load, save
from learned.pwcnet import PWCNet, PWCNetConfig
from learned.refiner import COMPACT, Refiner
from learned.selector import Selector, SelectorConfig
from learned.training import TrainingConfig
from tests.cgsf import scenes
from tests.cgsf.test_caches import SMALL_GANET, SMALL_PWCNET, weights
from variational.energy import EnergyConfig

ROOT = Path(__file__).parents[2]
SIZE = (64, 96)
NAMES = [f"plane-{i}" for i in range(4)]
SMALL_REFINER = dataclasses.replace(COMPACT, layers=((8, 1),), neighbours=(1,), steps=2)


def make(index: int) -> Sample:
    """A plane that moves: 8 px of disparity, 2 px of change, a known flow."""
    images = [image.astype(np.float32) / 255 for image in scenes.plane(np.random.default_rng(index), 70, 100)]
    whole = np.ones((70, 100), np.float32)
    flow = np.stack([scenes.FLOW[0] * whole, scenes.FLOW[1] * whole], -1)
    truth = Truth(8 * whole, 10 * whole, flow, disparity_left2=10 * whole)
    return Sample(NAMES[index], *images, truth=truth)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    cache = write_cache(folder / "cache", NAMES, make, SIZE)
    write_starts(folder / "starts", cache, StartConfig("variational"))
    return folder


def recipe(folder, stage: str, **changes) -> Recipe:
    small = Recipe(
        stage, str(folder / "cache"), str(folder / "starts"), held_out=1, batch=2, refiner=SMALL_REFINER,
        selector=SelectorConfig(layers=((8, 1),)), pwcnet=SMALL_PWCNET, ganet=SMALL_GANET,
        augment=AugmentConfig(48, 64), training=TrainingConfig(steps=2, log_every=1, checkpoint_every=1, validate_every=2),
    )  # fmt: skip
    return dataclasses.replace(small, **changes)


def test_a_cache_holds_the_samples(folder):
    cache = SampleCache(folder / "cache")
    images, truth = cache[2]
    assert (len(cache), images.shape, truth.shape) == (4, (4, *SIZE, 3), (5, *SIZE))
    np.testing.assert_allclose(images[1], make(2).right1[3:67, 2:98] * 255, atol=0.51)
    np.testing.assert_array_equal(truth[:, 5, 7], [8, 10, 2, *scenes.FLOW])


def test_a_cache_is_continued_where_it_stopped(tmp_path):
    made = []

    def stumbling(index: int) -> Sample:
        if index == 2 and made.count(2) == 0:
            made.append(2)
            raise KeyboardInterrupt
        made.append(index)
        return make(index)

    with pytest.raises(KeyboardInterrupt):
        write_cache(tmp_path, NAMES, stumbling, SIZE)
    assert len(SampleCache(tmp_path)) == 2
    assert len(write_cache(tmp_path, NAMES, stumbling, SIZE)) == 4
    assert made == [0, 1, 2, 2, 3]


def test_starts_are_those_of_the_method(folder):
    starts, cache = StartCache(folder / "starts"), SampleCache(folder / "cache")
    state, backward, evidence, _ = starts[1].values()
    result = pipelines.solve(list(cache[1][0]), "variational", pipelines.load_config("variational"))
    np.testing.assert_array_equal(state, result.state())
    np.testing.assert_array_equal(backward, result.backward_flow.transpose(2, 0, 1))
    assert evidence.min() >= 0
    assert evidence.max() <= 1


@pytest.mark.parametrize("stage", ["flow", "disparity", "refiner", "selector"])
def test_every_stage_trains_and_exports(folder, tmp_path, stage):
    settings = recipe(folder, stage)
    numbers = train(settings, tmp_path / "run")
    assert numbers["step"] == 2
    assert np.isfinite(numbers["score"])
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["recipe"]["stage"] == stage
    assert record["seed"] == 0
    export_best(settings, tmp_path / "run", tmp_path / "net.safetensors")
    assert "2 steps" in (tmp_path / "net.safetensors.md").read_text()


def toml(table: dict, name: str = "") -> str:
    """Plain values and nested tables, enough for a recipe."""
    lines = [f"[{name}]"] if name else []
    lines += [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    lines += [toml(value, f"{name}.{key}" if name else key) for key, value in table.items() if isinstance(value, dict)]
    return "\n".join(lines) + "\n"


def joint(folder, frozen=(), **changes) -> Recipe:
    """A joint recipe that begins with small networks."""
    disparity, motion = weights(folder)
    training = TrainingConfig(steps=2, log_every=1, validate_every=2, frozen=frozen, precision="float32")
    return recipe(folder, "joint", **({"starts": ""} | changes), disparity=disparity, motion=motion, training=training)


def test_joint_training_moves_all_parts_and_exports_them(folder, tmp_path):
    settings = joint(folder)
    numbers = train(settings, tmp_path / "run")
    assert {"SF-0", "SF-1", "SF-2", "energy-0", "start", "end"} <= set(numbers)
    export_best(settings, tmp_path / "run", tmp_path / "net.safetensors")
    before = STAGES["joint"].network(settings)
    for suffix, part in (("disparity", before.feedforward.disparity), ("flow", before.feedforward.motion)):
        trained = load(tmp_path / f"net-{suffix}.safetensors")[0].state_dict()
        assert any(not torch.equal(trained[name], value) for name, value in part.state_dict().items())
    assert load_refiner(str(tmp_path / "net-refiner.safetensors")).correction.weight.abs().max() > 0


@pytest.mark.parametrize("frozen", ["disparity", "motion", ""])
def test_frozen_networks_are_read_from_the_starts(folder, tmp_path, frozen):
    """Their cached states lead to the same training, and their weights and statistics stay."""
    part = "feedforward." + frozen
    plain = joint(folder, (part,), augment=AugmentConfig(*SIZE, 0, 0, False, 0, 0, 0, 0))
    config = load_start_config("feedforward", disparity=plain.disparity, motion=plain.motion, precision="float32")
    write_starts(tmp_path / "starts", SampleCache(folder / "cache"), config)
    cached = dataclasses.replace(plain, starts=str(tmp_path / "starts"))
    assert cached.cached_networks == ((frozen,) if frozen else ("disparity", "motion"))
    ran, read = (train(settings, tmp_path / name) for settings, name in ((plain, "ran"), (cached, "read")))
    assert read["loss"] == pytest.approx(ran["loss"], rel=1e-4)
    before = STAGES["joint"].network(plain).state_dict()
    after = torch.load(tmp_path / "ran" / "best.pt", weights_only=True)["model"]
    assert {name for name in before if name.startswith(part)} <= {n for n in before if torch.equal(before[n], after[n])}
    assert not torch.equal(before["refiner.correction.bias"], after["refiner.correction.bias"])


@pytest.mark.slow
def test_two_processes_train_jointly(folder, tmp_path):
    """Under torchrun, with heads that the joint loss does not reach."""
    (tmp_path / "recipe.toml").write_text(toml(to_table(joint(folder, batch=1))))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "cgsf.cli",
               "train", str(tmp_path / "recipe.toml"), "-o", str(tmp_path / "run")]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2]
    assert np.isfinite(lines[-1]["score"])


def test_further_samples_are_drawn_now_and_then(folder, tmp_path):
    """At their share, of another size, never for validation; the order of the others stays."""
    further = write_cache(tmp_path / "more", ["more-0", "more-1"], make, (60, 80))
    plain = recipe(folder, "flow", starts="", further=(str(further.folder),), further_share=0.5)
    batches = Batches(plain, Source.open(plain.cache), [Source(further)])
    names = [name for index in range(60) for name in batches(index).names]
    drawn = [name for name in names if name.startswith("more")]
    assert 40 < len(drawn) < 80
    assert set(drawn) == set(further.names)
    alone = [name for index in range(60) for name in Batches(plain, Source.open(plain.cache))(index).names]
    assert all(a == b for a, b in zip(alone, names, strict=True) if not b.startswith("more"))
    assert batches(7).names == batches(7).names
    assert np.isfinite(train(plain, tmp_path / "run")["score"])


def test_further_samples_of_a_refiner_bring_their_starts(folder, tmp_path):
    """Of another size, too."""
    further = write_cache(tmp_path / "more", NAMES[:2], make, (60, 80))
    write_starts(tmp_path / "more-starts", further, StartConfig("opencv"))
    folders = {"further": (str(further.folder),), "further_starts": (str(tmp_path / "more-starts"),), "further_share": 1.0}
    settings = recipe(folder, "refiner", **folders)
    sources = further_sources(settings)
    assert Batches(settings, Source.open(settings.cache, settings.starts), sources)(0).start.shape == (2, 5, 48, 64)
    np.testing.assert_array_equal(sources[0][1].start[0], StartCache(tmp_path / "more-starts")[1]["start"])
    assert np.isfinite(train(settings, tmp_path / "run")["score"])
    with pytest.raises(InputError, match="other samples"):
        train(dataclasses.replace(settings, further_starts=(str(folder / "starts"),)), tmp_path / "other")


def test_supervision_without_truth(folder, tmp_path):
    first = train(recipe(folder, "refiner", supervision="energy"), tmp_path / "energy")
    second = train(recipe(folder, "refiner", supervision="both"), tmp_path / "both")
    assert second["loss"] > first["loss"] > 0


@pytest.mark.parametrize("stage", ["refiner", "joint"])
def test_frames_without_truth_train_by_the_energy(folder, tmp_path, stage):
    """From a folder of frames to a lower energy of the frame that is held out."""
    frames = tmp_path / "frames"
    for index in range(2):
        scenes.write_images(frames / f"scene_{index}", scenes.plane(np.random.default_rng(index), 70, 100))
    source = FrameFolders(frames)
    cache = write_cache(tmp_path / "cache", source.names, source.__getitem__, SIZE)
    write_starts(tmp_path / "starts", cache, StartConfig(feedforward=FeedforwardConfig(*weights(tmp_path))))
    settings = joint(folder, cache=str(tmp_path / "cache"), batch=1, supervision="energy")
    training = TrainingConfig(steps=12, learning_rate=5e-4, warmup=0, log_every=1, validate_every=4, precision="float32")
    starts = "" if stage == "joint" else str(tmp_path / "starts")
    settings = dataclasses.replace(settings, stage=stage, starts=starts, training=training)
    settings = dataclasses.replace(settings, augment=AugmentConfig(48, 64, colour=0, noise=0, erase=0))
    train(settings, tmp_path / "run")
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    scores = [line for line in lines if "score" in line]
    assert "SF" not in scores[0]
    assert scores[-1]["score"] == scores[-1]["energy-2"] < scores[-1]["energy-0"]
    assert scores[-1]["score"] < scores[0]["score"]
    with pytest.raises(InputError, match="no truth to learn from"):
        train(dataclasses.replace(settings, supervision="both"), tmp_path / "other")


def test_pictures_for_tensorboard(folder, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    settings = recipe(folder, "refiner")
    train(dataclasses.replace(settings, training=dataclasses.replace(settings.training, tensorboard=True)), tmp_path)
    log = EventAccumulator(str(tmp_path)).Reload()
    (picture,) = log.Images("held out")
    assert (picture.step, picture.width, picture.height) == (2, 3 * SIZE[1], 3 * SIZE[0])
    assert {"loss", "SF-0"} <= set(log.Tags()["scalars"])


@pytest.mark.parametrize("arguments", [("train", "flow"), ("cache", "starts", "--initial", "feedforward")])
def test_threads_bound_every_library(tmp_path, arguments):
    """In a process of its own: torch rounds differently once its pool has been set."""
    program = f"""
import cv2, numba
from click.testing import CliRunner
from cgsf.cli import main
refused = CliRunner().invoke(main, [*{arguments}, "-o", {str(tmp_path)!r}, "--cache", "nowhere", "--threads", "1"])
import torch
print(refused.exit_code, numba.get_num_threads(), torch.get_num_threads(), cv2.getNumThreads())
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2", "1", "1", "1"]


def test_a_run_of_before_a_new_setting_goes_on(folder, tmp_path):
    settings = recipe(folder, "refiner")
    train(settings, tmp_path)
    record = json.loads((tmp_path / "run.json").read_text())
    del record["recipe"]["energy"]
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert train(with_changes(settings, steps=3), tmp_path)["step"] == 3


def test_another_recipe_does_not_continue_a_run(folder, tmp_path):
    settings = recipe(folder, "refiner")
    train(settings, tmp_path)
    assert train(with_changes(settings, steps=3), tmp_path)["step"] == 3
    with pytest.raises(InputError, match="another recipe"):
        train(dataclasses.replace(settings, left2_weight=0.7), tmp_path)


@pytest.mark.parametrize("method", ["variational+refiner", "hybrid"])
@pytest.mark.parametrize("refiner", [Refiner(SMALL_REFINER), Selector(SelectorConfig(layers=((8, 1),)))])
def test_an_untrained_refiner_leaves_the_solvers_state(tmp_path, method, refiner):
    """From `variational`, whatever the method's own start."""
    save(refiner, tmp_path / "r.safetensors", ModelCard("a test"))
    images = scenes.plane(np.random.default_rng(0), 70, 100)
    settings = {"refiner": str(tmp_path / "r.safetensors"), "steps_picture": str(tmp_path / "s.png")}
    config = pipelines.with_settings(pipelines.load_config(method), settings | {"initial": "variational"})
    refined = pipelines.solve(images, method, config)
    plain = cgsf.estimate(*images)
    np.testing.assert_array_equal(refined.state(), plain.state())
    np.testing.assert_array_equal(refined.initial.state(), plain.state())
    assert refined.record["steps"] == refiner.config.steps
    assert refined.seconds["refinement"] > 0
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


def test_outputs_descend_from_opencvs_state():
    images = scenes.plane(np.random.default_rng(0), 70, 100)
    result = run_refined(pipelines.to_frames(images), RefinedConfig(initial="opencv", strategy="outputs", steps=10))
    moved = np.abs(result.state() - result.initial.state())
    assert result.record == {"strategy": "outputs", "steps": 10}
    assert 0.02 < moved.max() < 1  # ten steps of Adam, 0.02 px each


def test_parameters_need_networks():
    with pytest.raises(InputError, match="adapts networks"):
        pipelines.with_settings(pipelines.load_config("variational+refiner"), {"strategy": "parameters"})


def test_bad_input_is_one_clear_line(folder, tmp_path):
    (tmp_path / "bad.toml").write_text("stage = ")
    save(PWCNet(PWCNetConfig(pyramid=(4, 4, 8))), tmp_path / "flow.safetensors", ModelCard("a test"))
    foreign = {"refiner": str(tmp_path / "flow.safetensors")}
    config = pipelines.with_settings(pipelines.load_config("variational+refiner"), foreign)
    energy_run = tmp_path / "energy"
    train(recipe(folder, "refiner", energy=EnergyConfig(0)), energy_run)
    refused = {
        "no recipe": lambda: read_recipe("nothing"),
        "no valid TOML": lambda: read_recipe(tmp_path / "bad.toml"),
        "is no cache": lambda: train(recipe(folder, "flow", cache=str(tmp_path)), tmp_path / "run"),
        "is no cache of starts": lambda: train(recipe(folder, "refiner", starts=str(tmp_path)), tmp_path / "other"),
        "held out": lambda: train(recipe(folder, "flow", held_out=4), tmp_path / "third"),
        "that are frozen": lambda: train(joint(folder, starts=str(folder / "starts")), tmp_path / "fourth"),
        "its further_starts": lambda: train(recipe(folder, "refiner", further=(str(folder / "cache"),)), tmp_path / "fifth"),
        "a refiner needs starts": lambda: train(recipe(folder, "refiner", starts=""), tmp_path / "seventh"),
        "for ablations": lambda: export_best(recipe(folder, "refiner", energy=EnergyConfig(0)), energy_run, "x.safetensors"),
        "not of a refiner": lambda: pipelines.solve(make(0).images, "variational+refiner", config),
        "no weights": lambda: export_best(recipe(folder, "flow"), tmp_path, tmp_path / "x.safetensors"),
        "no setting": lambda: pipelines.with_settings(pipelines.load_config("variational"), {"strategy": "learned"}),
    }
    for text, call in refused.items():
        with pytest.raises(InputError, match=text) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_shipped_recipes_fit_the_shipped_networks():
    names = ("flow", "disparity", "selector-variational", "joint", "refiner-feedforward")
    assert [read_recipe(name).stage for name in names] == ["flow", "disparity", "selector", "joint", "refiner"]
    assert read_recipe("selector-variational").selector == load_network("selector-variational").config
    assert read_recipe("self-supervised").supervision == "energy"
    for name in (*names[3:], "self-supervised"):
        refiner = read_recipe(name).refiner
        assert dataclasses.replace(refiner, steps=COMPACT.steps, inputs=COMPACT.inputs, evidence=0) == COMPACT
        assert set(COMPACT.inputs) <= set(refiner.inputs)


def test_steps_before_lead_to_other_starts(folder):
    """The refiner learns from what it has made of a start, not from the start alone."""
    settings = recipe(folder, "refiner", steps_before=3)
    batch = Batches(settings, Source.open(settings.cache, settings.starts))(0)
    model = STAGES["refiner"].network(settings)
    with torch.no_grad():
        model.correction.bias.fill_(0.5)
    begun = set()
    for seed in range(12):
        torch.manual_seed(seed)
        _, numbers = STAGES["refiner"].loss(settings, model, batch)
        begun.add(round(numbers["start"], 4))
    assert len(begun) == 4


def test_one_shuffled_pass_sees_every_sample_once(folder):
    settings = recipe(folder, "flow", held_out=1, batch=1)
    batches = Batches(settings, Source.open(settings.cache))
    first, second = ([batches(i).names[0] for i in range(start, start + 3)] for start in (0, 3))
    assert sorted(first) == sorted(second) == NAMES[1:]
    assert torch.equal(batches(2).images, batches(2).images)
