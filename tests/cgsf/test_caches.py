"""Samples and starts on disk, from the command line: what they hold, how they go on, what they refuse."""

import errno
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner, Result

import cgsf
from cgsf.camera_motion import find_homography
from cgsf.cli import main
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.harder import Harder
from cgsf.intake import to_frames
from cgsf.sample_cache import SampleCache
from cgsf.start_cache import StartCache
from cgsf.starts import load_start_config, make_start
from cgsf.synthetic import make_sample
from learned.checkpoint import ModelCard, save
from learned.ganet import GANet, GANetConfig
from learned.pwcnet import PWCNet, PWCNetConfig
from tests.cgsf import scenes

SMALL_GANET = GANetConfig(max_disparity=32, stem=((8, 3, 4),), features=(8,), unets=1, correlation_groups=4, volume=(4, 4),
                          hourglasses=1, aggregated_levels=(0,), full_resolution_head=False)  # fmt: skip
SMALL_PWCNET = PWCNetConfig(pyramid=(4, 4, 8), convolutions=1, decoder=(8,), context=((8, 1),), cosine=True, residual=True)


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["cache", *(str(argument) for argument in arguments)])


def weights(folder: Path, seed: int = 0) -> tuple[str, str]:
    torch.manual_seed(seed)
    save(GANet(SMALL_GANET), folder / "disparity.safetensors", ModelCard("a test"))
    save(PWCNet(SMALL_PWCNET), folder / "flow.safetensors", ModelCard("a test"))
    return str(folder / "disparity.safetensors"), str(folder / "flow.safetensors")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three real-life folders of four images, without truth."""
    root = tmp_path_factory.mktemp("frames")
    for index in range(3):
        scenes.write_images(root / f"scene_{index}", scenes.plane(np.random.default_rng(index), 70, 100))
    return root


class Known:
    """Samples of which everything is known."""

    def __init__(self, *samples: Sample) -> None:
        self.samples, self.names = samples, [sample.name for sample in samples]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.samples[index]


def known_plane(name: str, seed: int = 0) -> Sample:
    """Of 70 x 100 pixels."""
    images = [image.astype(np.float32) / 255 for image in scenes.plane(np.random.default_rng(seed), 70, 100)]
    d1, d2 = (np.full((70, 100), value, np.float32) for value in (8, 10))
    flow = np.ones((70, 100, 2), np.float32) * scenes.FLOW
    return Sample(name, *images, truth=Truth(d1, d2, flow, disparity_left2=d2))


def test_rendered_samples_by_turns(tmp_path: Path):
    arguments = ("samples", "-o", tmp_path / "c", "--family", "things", "--family", "street", "--size", "48x64", "--seed", 7)
    assert call(*arguments, "--count", 3).exit_code == 0
    cache = SampleCache(tmp_path / "c")
    assert cache.names == ["things-000007", "street-000007", "things-000008"]
    expected = make_sample("street", 7, 48, 64)
    np.testing.assert_allclose(cache[1][0][3], 255 * expected.right2, atol=0.51)
    np.testing.assert_array_equal(cache[1][1][0], expected.truth.disparity1)
    again = call(*arguments, "--count", 3)
    assert (again.exit_code, again.output.splitlines()[-1]) == (0, f"{tmp_path / 'c'}: 3 samples of 48 x 64 pixels")


def test_several_workers_write_the_same_files(tmp_path: Path):
    for workers in (1, 2):
        more = ("--family", "things", "--size", "32x48", "--count", 2, "--workers", workers)
        assert call("samples", "-o", tmp_path / str(workers), *more).exit_code == 0
    for name in ("images.npy", "truth.npy", "cache.json"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_samples_of_a_data_set_without_truth(tmp_path: Path, frames: Path):
    made = call("samples", "-o", tmp_path / "c", "--dataset", "frames", "--root", frames, "--size", "64x96")
    assert made.exit_code == 0, made.output
    images, truth = SampleCache(tmp_path / "c")[2]
    np.testing.assert_array_equal(images[0], scenes.plane(np.random.default_rng(2), 70, 100)[0][3:67, 2:98])
    assert np.isnan(truth).all()


def test_what_a_method_is_surest_of_stands_for_the_truth(tmp_path: Path, frames: Path):
    """The solver's maps, where it is surest, of both orders of time; unknown elsewhere."""
    made = call("samples", "-o", tmp_path / "c", "--dataset", "frames", "--root", frames, "--size", "70x100",
                "--truth", "variational", "--keep", 0.5, "--reverse", "--count", 2)  # fmt: skip
    assert made.exit_code == 0, made.output
    cache = SampleCache(tmp_path / "c")
    assert cache.names == ["scene/scene_0", "scene/scene_0-reversed"]
    (images, truth), (swapped, back) = cache[0], cache[1]
    np.testing.assert_array_equal(swapped[[2, 3, 0, 1]], images)
    solved = cgsf.estimate(*images)
    known = np.isfinite(truth)
    assert 0.5 <= known.mean() < 0.6
    assert solved.confidence[known[0]].min() >= solved.confidence[~known[0]].max()
    np.testing.assert_allclose(truth[known], solved.state()[known], atol=1e-5)
    assert np.abs(np.nanmedian(back[3:], (1, 2)) + scenes.FLOW).max() < 0.5
    assert np.abs(np.nanmedian(back[:3], (1, 2)) - (10, 8, -2)).max() < 0.5


def test_harder_variants_keep_what_is_true():
    """Where the truth is known, it leads from image to image, pasted pieces included; nothing else is harder than asked."""
    harder = Harder(Known(known_plane("one", 0), known_plane("two", 1)), 3, (48, 64))
    assert harder.names[3:5] == ["two-harder0", "two-harder1"]
    looked_at = 0
    for index in range(6):
        sample, again = harder[index], harder[index]
        np.testing.assert_array_equal(sample.images, again.images)
        d1, d2, uv = sample.truth.disparity1, sample.truth.disparity2, sample.truth.flow
        assert (d1 >= 8).all()
        x, y = np.meshgrid(np.arange(64, dtype=np.float32), np.arange(48, dtype=np.float32))
        places = ((x - d1, y), (x + uv[..., 0], y + uv[..., 1]), (x + uv[..., 0] - d2, y + uv[..., 1]))
        for image, place in zip(sample.images[1:], places, strict=True):
            there = cv2.remap(image, *(each.astype(np.float32) for each in place), cv2.INTER_LINEAR, borderValue=(np.nan,) * 3)
            pieces = np.isfinite(there).all(-1) & (d1 > 8)
            if pieces.sum() > 50:  # others have moved out of the image
                looked_at += 1
                assert np.median(np.abs(there - sample.left1)[pieces]) < 0.06
    assert looked_at >= 6
    with pytest.raises(InputError, match="do not fill"):
        Harder(Known(known_plane("one")), 1, (80, 64))[0]


def test_half_of_the_harder_variants_are_exposed_wrongly():
    """All four images alike, and as far as white, where no truth is lost."""
    ramp = np.tile(np.linspace(0, 0.6, 64, dtype=np.float32)[:, None], (48, 1, 3))
    images = [ramp.copy() for _ in range(4)]
    zeros = np.zeros((48, 64), np.float32)
    truth = Truth(zeros, zeros, np.zeros((48, 64, 2), np.float32), disparity_left2=zeros)
    harder = Harder(Known(Sample("ramp", *images, truth=truth)), 60, (48, 64))
    light = np.array([[np.median(image[:, 32]) / ramp[0, 32, 0] for image in harder[k].images] for k in range(60)])
    assert 0.3 < (np.abs(light[:, 0] - 1) > 0.1).mean() < 0.6  # a few by less than that
    assert light.min() < 0.4
    assert light.max() > 1.6
    np.testing.assert_allclose(np.median(light / light[:, :1], axis=0), 1, atol=0.03)
    white = np.array([(harder[k].left1 == 1).all(-1).mean() for k in range(60)])
    assert (white[light[:, 0] > 1.9] > 0.1).all()
    assert (white[light[:, 0] < 1.2] < 0.01).all()
    assert all((image == ramp).all() for image in images)


def test_a_pane_is_where_the_truth_says_and_what_it_shows_is_not(monkeypatch: pytest.MonkeyPatch):
    for name in ("_PANES", "_PIECES", "_FLAT_PLACES"):
        monkeypatch.setattr(f"cgsf.harder.{name}", (0, 0))
    for name in ("_MISEXPOSED", "_NOISE", "_GAIN"):
        monkeypatch.setattr(f"cgsf.harder.{name}", 0)
    harder = Harder(Known(known_plane("plane")), 40, (66, 96))
    plain = [harder[k] for k in range(40)]
    monkeypatch.setattr("cgsf.harder._PANES", (1, 1))
    (u, v), d1, d2 = scenes.FLOW, 8, 10
    looked_at = 0
    for before, sample in zip(plain, harder, strict=False):
        changed = [np.abs(now - then).sum(-1) > 1e-4 for now, then in zip(sample.images, before.images, strict=True)]
        x, y, width, height = cv2.boundingRect(changed[0].astype(np.uint8))
        if not (30 < x < 66 - width and 10 < y < 56 - height):  # in view of all images, its reflection too
            continue
        looked_at += 1
        for mask, (right, down) in zip(changed, ((0, 0), (-d1, 0), (u, v), (u - d2, v)), strict=True):
            there = cv2.boundingRect(mask.astype(np.uint8))
            np.testing.assert_allclose(there, (x + right, y + down, width, height), atol=1)
        inside = np.s_[y + 1 : y + height - 1, x + 1 : x + width - 1]
        unlike, unlike_before = (np.abs(each.left1 - np.roll(each.right1, d1, 1))[inside].mean() for each in (sample, before))
        assert unlike > 3 * unlike_before + 0.01
        assert (sample.truth.disparity1 == d1).all()
        assert (sample.truth.disparity2 == d2).all()
        assert (sample.truth.flow == scenes.FLOW).all()
    assert looked_at >= 2


def test_harder_variants_from_the_command_line(tmp_path: Path, frames: Path):
    arguments = ("samples", "--dataset", "frames", "--root", frames, "--size", "48x64", "--harder", 2)
    refused = call(*arguments, "-o", tmp_path / "refused")
    assert refused.exit_code == 2
    assert "has no truth" in refused.stderr
    assert call(*arguments, "-o", tmp_path / "c", "--truth", "variational", "--count", 3).exit_code == 0
    cache = SampleCache(tmp_path / "c")
    assert cache.names == ["scene/scene_0-harder0", "scene/scene_0-harder1", "scene/scene_1-harder0"]
    assert np.isfinite(cache[2][1]).mean() > 0.5


def test_starts_of_the_networks_go_on(tmp_path: Path, frames: Path, monkeypatch: pytest.MonkeyPatch):
    call("samples", "-o", tmp_path / "c", "--dataset", "frames", "--root", frames, "--size", "64x96")
    disparity, motion = weights(tmp_path)
    arguments = ("starts", "-o", tmp_path / "s", "--cache", tmp_path / "c", "--initial", "feedforward",
                 "--disparity", disparity, "--motion", motion)  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr("cgsf.start_cache.make_start", _stopped_after(2))
        assert isinstance(call(*arguments).exception, ZeroDivisionError)
    assert len(StartCache(tmp_path / "s")) == 2
    first = np.array(StartCache(tmp_path / "s")[0]["start"])
    assert call(*arguments).output.splitlines()[-1].endswith("3 starts")
    starts, cache = StartCache(tmp_path / "s"), SampleCache(tmp_path / "c")
    assert starts.names == cache.names
    np.testing.assert_array_equal(starts[0]["start"], first)
    config = load_start_config("feedforward", disparity=disparity, motion=motion)
    expected = make_start(to_frames(list(cache[2][0])), config)
    np.testing.assert_array_equal(starts[2]["start"], expected.state())
    np.testing.assert_array_equal(starts[2]["backward"], expected.backward_flow.transpose(2, 0, 1))
    np.testing.assert_array_equal(starts[2]["evidence"][1], expected.visible)
    weights(tmp_path, seed=1)  # files of the same name, other weights
    assert "made otherwise" in call(*arguments).stderr
    assert not np.array_equal(make_start(to_frames(list(cache[2][0])), config).state(), expected.state())


def _stopped_after(count: int):
    calls = iter(range(count))

    def make(frames, config):
        if next(calls, None) is None:
            raise ZeroDivisionError
        return make_start(frames, config)

    return make


@pytest.mark.parametrize("initial", ["variational", "opencv"])
def test_starts_of_other_methods(tmp_path: Path, frames: Path, initial: str):
    call("samples", "-o", tmp_path / "c", "--dataset", "frames", "--root", frames, "--size", "64x96", "--count", 1)
    made = call("starts", "-o", tmp_path / "s", "--cache", tmp_path / "c", "--initial", initial)
    assert made.exit_code == 0, made.output
    state, backward, evidence, homography = StartCache(tmp_path / "s")[0].values()
    assert np.abs(np.median(state[3:], (1, 2)) - scenes.FLOW).max() < 0.5
    assert np.abs(np.median(backward, (1, 2)) + scenes.FLOW).max() < 0.5
    assert 0 <= evidence.min() <= evidence.max() <= 1
    np.testing.assert_allclose(homography, find_homography(state, backward.transpose(1, 2, 0)))


def test_refusals_are_one_line(tmp_path: Path, frames: Path, monkeypatch: pytest.MonkeyPatch):
    made = ("samples", "-o", tmp_path / "c", "--family", "things", "--size", "32x48", "--count", 1)
    assert call(*made).exit_code == 0
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "images.npy").write_bytes(b"\x93NUMPY")
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    refused = {
        "other samples": (*made, "--seed", 1),
        "another size": (*made[:-1], 2),
        "give either": made[:3],
        "--truth and --harder are for a data set": (*made, "--truth", "variational"),
        "--harder are for a data set": (*made, "--harder", 2),
        "how sure it is": ("samples", "-o", tmp_path / "g", "--dataset", "frames", "--root", frames, "--size", "64x96",
                           "--truth", "opencv"),
        "as 320x640": ("samples", "-o", tmp_path / "d", "--family", "things", "--size", "32"),
        "unknown family": ("samples", "-o", tmp_path / "d", "--family", "clouds"),
        "cannot be continued": ("samples", "-o", tmp_path / "torn", "--family", "things", "--size", "32x48"),
        "does not fill": ("samples", "-o", tmp_path / "e", "--dataset", "frames", "--root", frames, "--size", "320x640"),
        "is no cache of samples": ("starts", "-o", tmp_path / "s", "--cache", tmp_path, "--initial", "opencv"),
        "no weights": ("starts", "-o", tmp_path / "s", "--cache", tmp_path / "c", "--initial", "feedforward",
                       "--disparity", "nowhere.safetensors"),
        "No space left": ("samples", "-o", tmp_path / "f", "--family", "things", "--size", "32x48"),
    }  # fmt: skip
    for text, arguments in refused.items():
        if text == "No space left":
            monkeypatch.setattr(os, "posix_fallocate", lambda *_: (_ for _ in ()).throw(full))
        result = call(*arguments)
        assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1), result.output
        assert text in result.stderr
    assert list((tmp_path / "f").iterdir()) == []
