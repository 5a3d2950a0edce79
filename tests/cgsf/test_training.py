"""From samples on disk to a trained refiner in a pipeline, with small networks; and what is refused on the way."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import cgsf
from cgsf import pipelines
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.refined import RefinedConfig, run_refined
from cgsf.sample_cache import SampleCache, write_cache
from cgsf.start_cache import StartCache, write_starts
from cgsf.starts import StartConfig
from cgsf.training import Recipe, export_best, read_recipe, train, with_changes
from learned.augment import AugmentConfig
from learned.checkpoint import ModelCard, save
from learned.pwcnet import PWCNet, PWCNetConfig
from learned.refiner import COMPACT, Refiner
from learned.training import TrainingConfig
from tests.cgsf import scenes
from tests.cgsf.test_caches import SMALL_GANET, SMALL_PWCNET

SIZE = (64, 96)
NAMES = [f"plane-{i}" for i in range(4)]
SMALL_REFINER = dataclasses.replace(COMPACT, layers=((8, 1),), propagation=(1,), steps=2)


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
        pwcnet=SMALL_PWCNET, ganet=SMALL_GANET,
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
    state, backward, evidence = starts[1]
    result = pipelines.solve(list(cache[1][0]), "variational", pipelines.load_config("variational"))
    np.testing.assert_array_equal(state, result.state())
    np.testing.assert_array_equal(backward, result.backward_flow.transpose(2, 0, 1))
    assert evidence.min() >= 0
    assert evidence.max() <= 1


@pytest.mark.parametrize("stage", ["flow", "disparity", "refiner"])
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


def test_supervision_without_truth(folder, tmp_path):
    first = train(recipe(folder, "refiner", supervision="energy"), tmp_path / "energy")
    second = train(recipe(folder, "refiner", supervision="both"), tmp_path / "both")
    assert second["loss"] > first["loss"] > 0


def test_another_recipe_does_not_continue_a_run(folder, tmp_path):
    settings = recipe(folder, "refiner")
    train(settings, tmp_path)
    assert train(with_changes(settings, steps=3), tmp_path)["step"] == 3
    with pytest.raises(InputError, match="another recipe"):
        train(dataclasses.replace(settings, left2_weight=0.7), tmp_path)


@pytest.mark.parametrize("method", ["variational+refiner", "hybrid"])
def test_an_untrained_refiner_leaves_the_solvers_state(tmp_path, method):
    """From `variational`, whatever the method's own start."""
    save(Refiner(SMALL_REFINER), tmp_path / "r.safetensors", ModelCard("a test"))
    images = scenes.plane(np.random.default_rng(0), 70, 100)
    settings = {"refiner": str(tmp_path / "r.safetensors"), "steps_picture": str(tmp_path / "s.png")}
    config = pipelines.with_settings(pipelines.load_config(method), settings | {"initial": "variational"})
    refined = pipelines.solve(images, method, config)
    plain = cgsf.estimate(*images)
    np.testing.assert_array_equal(refined.state(), plain.state())
    np.testing.assert_array_equal(refined.initial.state(), plain.state())
    assert refined.record["steps"] == 2
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
    refused = {
        "no recipe": lambda: read_recipe("nothing"),
        "no valid TOML": lambda: read_recipe(tmp_path / "bad.toml"),
        "is no cache": lambda: train(recipe(folder, "flow", cache=str(tmp_path)), tmp_path / "run"),
        "is no cache of starts": lambda: train(recipe(folder, "refiner", starts=str(tmp_path)), tmp_path / "other"),
        "held out": lambda: train(recipe(folder, "flow", held_out=4), tmp_path / "third"),
        "not of a refiner": lambda: pipelines.solve(make(0).images, "variational+refiner", config),
        "no weights": lambda: export_best(recipe(folder, "flow"), tmp_path, tmp_path / "x.safetensors"),
        "no setting": lambda: pipelines.with_settings(pipelines.load_config("variational"), {"strategy": "learned"}),
    }
    for text, call in refused.items():
        with pytest.raises(InputError, match=text) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_shipped_recipes_fit_the_shipped_networks():
    for name in ("flow", "disparity", "refiner-variational", "refiner-feedforward"):
        assert read_recipe(name).stage == name.split("-")[0]
    assert dataclasses.replace(read_recipe("refiner-variational").refiner, steps=COMPACT.steps) == COMPACT


def test_one_shuffled_pass_sees_every_sample_once(folder):
    from cgsf.training import Batches

    settings = recipe(folder, "flow", held_out=1, batch=1)
    batches = Batches(settings, SampleCache(folder / "cache"))
    first, second = ([batches(i).names[0] for i in range(start, start + 3)] for start in (0, 3))
    assert sorted(first) == sorted(second) == NAMES[1:]
    assert torch.equal(batches(2).images, batches(2).images)
