"""The renderer's users: options, export to KITTI folders, worker processes, the frozen split, the commands."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from cgsf.cli import main
from cgsf.datasets import open_dataset
from cgsf.datasets.synthetic import SyntheticV1
from cgsf.errors import InputError
from cgsf.synthetic import make_sample, make_video
from cgsf.synthetic.export import write_kitti
from cgsf.synthetic.patterns import KINDS
from cgsf.synthetic.textures import Texture

SIZE = {"height": 48, "width": 96}
#: synthetic-v1, by index: means of left1, right2, disparity1, of the flow's magnitudes along x and y (pixels), share of
#: left1 that is visible in left2.
FINGERPRINTS = {
    0: (0.484622, 0.480733, 33.4256, 12.2743, 0.849177), 13: (0.473269, 0.470448, 42.3267, 7.57462, 0.908611),
    20: (0.536374, 0.554428, 23.2326, 23.2074, 0.717997), 37: (0.251744, 0.244683, 18.3622, 3.03748, 0.952222),
}  # fmt: skip


def digest(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_two_worker_processes_write_the_same_bytes_as_one(tmp_path: Path) -> None:
    write_kitti(tmp_path / "one", "street", 3, seed=5, workers=1, **SIZE)
    write_kitti(tmp_path / "two", "street", 3, seed=5, workers=2, **SIZE)
    assert digest(tmp_path / "one") == digest(tmp_path / "two")


def test_export_is_read_back_as_kitti_and_resumes(tmp_path: Path) -> None:
    assert write_kitti(tmp_path, "things", 1, seed=2, **SIZE) == 1
    note = tmp_path / "training/synthetic/000000.json"
    before = note.stat().st_mtime_ns
    done: list[int] = []
    assert write_kitti(tmp_path, "things", 2, seed=2, progress=done.append, **SIZE) == 1
    assert done == [2]
    assert note.stat().st_mtime_ns == before
    assert json.loads(note.read_text())["seed"] == 2
    dataset = open_dataset("kitti2015", tmp_path)
    assert list(dataset.names) == ["000000", "000001"]
    read, made = dataset[1], make_sample("things", 3, **SIZE)
    np.testing.assert_allclose(read.left2, made.left2, atol=1e-6)  # eight bits: nothing is lost
    np.testing.assert_allclose(read.truth.disparity1, made.truth.disparity1, atol=1 / 256)
    np.testing.assert_allclose(read.truth.flow, made.truth.flow, atol=1 / 64)
    assert np.array_equal(read.truth.visible_flow, made.truth.visible_flow)
    assert read.calibration.baseline_m == pytest.approx(made.calibration.baseline_m)
    with pytest.raises(InputError, match="other scenes"):
        write_kitti(tmp_path, "things", 2, seed=7, **SIZE)


def test_photographs_become_textures(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), rng.integers(0, 256, (40, 60, 3), np.uint8))
    plain = make_sample("things", 0, **SIZE)
    with_photos = make_sample("things", 0, photos=tmp_path, photo_share=1.0, **SIZE)
    assert np.abs(plain.left1 - with_photos.left1).mean() > 0.02
    with pytest.raises(InputError, match="no \\.jpg or \\.png"):
        make_sample("things", 0, photos=tmp_path / "missing", **SIZE)


def test_arguments_out_of_range_say_what_is_wrong() -> None:
    for arguments, message in (
        (("forest", 0, 48, 64), "unknown family"), (("street", -1, 48, 64), "seed"), (("street", 0, 8, 64), "16 x 16"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            make_sample(*arguments)
    with pytest.raises(InputError, match="unknown option 'shiny'"):
        make_sample("street", 0, 48, 64, shiny=True)
    with pytest.raises(InputError, match="at least 2 frames"):
        make_video("street", 0, 48, 64, 1)


def test_sensor_gives_eight_bits_and_noise_differs_between_cameras() -> None:
    sample = make_sample("street", 1, **SIZE)
    for image in sample.images:
        assert image.dtype == np.float32
        np.testing.assert_allclose(image * 255, np.round(image * 255), atol=1e-3)
    assert not np.array_equal(sample.left1, make_sample("street", 1, sensor=False, **SIZE).left1)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_patterns_repeat_without_a_seam(kind: str) -> None:
    image = KINDS[kind](np.random.default_rng(3), 64)
    assert image.shape == (64, 64, 3)
    assert np.isfinite(image).all()
    texture = Texture.of((np.clip(image, 0, 1) * 255).astype(np.uint8))
    assert len(texture.levels) == sum(4**level for level in range(7))
    mean = np.array([texture.levels[-1] >> shift & 255 for shift in (0, 8, 16)])
    np.testing.assert_allclose(mean, 255 * np.clip(image, 0, 1).mean((0, 1)), atol=4)


def test_the_frozen_split_is_as_documented() -> None:
    """A change of the renderer that changes results on the split must not pass unseen."""
    split = SyntheticV1(Path("."))
    assert len(split) == 40
    assert split.names[0] == "street-1000000"
    assert split.names[-1] == "things-1000019"
    for index, expected in FINGERPRINTS.items():
        sample = split[index]
        truth = sample.truth
        assert sample.left1.shape == ((376, 1242, 3) if index < 20 else (384, 640, 3))
        found = [sample.left1.mean(), sample.right2.mean(), truth.disparity1.mean(), np.nanmean(np.abs(truth.flow))]
        assert [*found, truth.visible_flow.mean()] == pytest.approx(expected, rel=1e-4), split.names[index]


def test_commands_synthesize_and_check(tmp_path: Path) -> None:
    run = CliRunner().invoke
    made = run(main, ["synthesize", "-o", str(tmp_path / "k"), "--count", "1", "--height", "64", "--width", "200"])
    assert made.exit_code == 0, made.output
    good = run(main, ["check-dataset", "kitti2015", str(tmp_path / "k")])
    assert good.exit_code == 0, good.output
    assert "1 samples checked, 0 suspect" in good.output
    flow = tmp_path / "k/training/flow_occ/000000_10.png"
    pixels = cv2.imread(str(flow), cv2.IMREAD_UNCHANGED)
    pixels[..., 1:] = 65536 - pixels[..., 1:].astype(np.int64)  # the opposite sign
    cv2.imwrite(str(flow), pixels)
    bad = run(main, ["check-dataset", "kitti2015", str(tmp_path / "k")])
    assert bad.exit_code == 1
    assert "flow" in bad.output
    refused = run(main, ["synthesize", "-o", str(tmp_path), "--family", "street", "--family", "things"])
    assert refused.exit_code == 2


def test_check_dataset_takes_the_options_of_rendered_samples() -> None:
    run = CliRunner().invoke
    size = ["--option", "height=64", "--option", "width=200"]
    good = run(main, ["check-dataset", "synthetic-street", ".", "--option", "count=2", *size])
    assert good.exit_code == 0, good.output
    assert "2 samples checked, 0 suspect" in good.output
    wrong = {"count=two": "count must be a whole number", "gloss=high": "gloss must be a number", "sky=7": "sky must be true or"}
    for option, message in wrong.items():
        refused = run(main, ["check-dataset", "synthetic-street", ".", *size, "--option", "count=1", "--option", option])
        assert refused.exit_code == 2
        assert message in refused.output


@pytest.mark.parametrize("frames", [2, 3])
def test_the_sky_may_be_unknown_as_in_real_frames(frames: int) -> None:
    options = {"count": 1, "seed": 3, "height": 64, "width": 200, "frames": frames}
    whole, without = (open_dataset("synthetic-street", ".", **options, sky=sky) for sky in (True, False))
    for known, real in zip(whole, without, strict=True):
        sky = known.truth.disparity1 == 0
        assert 0 < sky.mean() < 1
        for name in ("disparity1", "disparity2", "flow"):
            before, after = getattr(known.truth, name), getattr(real.truth, name)
            assert np.isnan(after[sky]).all()
            np.testing.assert_array_equal(after[~sky], before[~sky])
        np.testing.assert_array_equal(real.images, known.images)
