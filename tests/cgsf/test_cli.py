"""The command line: the files and options that other tools rely on, and bad input in one line with exit code 2."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

import cgsf
from cgsf.cli import COMMANDS, main
from cgsf.formats import npz
from cgsf.formats.images import read_image
from tests.cgsf import scenes

FILES = {"scene_flow.npz", "disp_0.png", "disp_1.png", "flow.png", "overview.png", "run.json"}


@pytest.fixture
def paths(tmp_path, rng):
    return [str(path) for path in scenes.write_images(tmp_path / "in", scenes.plane(rng))]


def call(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def assert_refused(result, message):
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("Error: ")
    assert len(result.stderr.splitlines()) == 1
    assert message in result.stderr


def test_run_writes_the_contract(tmp_path, paths):
    out = tmp_path / "deep" / "out"
    result = call("run", *paths, "-o", out)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == FILES
    arrays = npz.read_arrays(out / "scene_flow.npz")
    shapes = {name: arrays[name].shape for name in ("disparity1", "disparity2", "disparity_change", "flow", "visible")}
    assert set(shapes.values()) == {(scenes.H, scenes.W), (scenes.H, scenes.W, 2)}
    assert arrays["visible"].dtype == bool
    record = json.loads((out / "run.json").read_text())
    assert record["version"] == cgsf.__version__
    assert record["method"] == "variational"
    assert record["settings"]
    seconds = record["seconds"]
    assert {"reading", "total", "writing", "picture"} <= set(seconds)
    assert seconds["total"] > 0
    assert read_image(out / "overview.png").shape[2] == 3


def test_run_with_calibration_and_method(tmp_path, paths):
    (tmp_path / "calib.json").write_text('{"fx": 100, "fy": 110, "cx": 50, "cy": 30, "baseline": 0.5}')
    out = tmp_path / "out"
    more = ("--method", "opencv", "--preset", "fast", "--calibration", tmp_path / "calib.json")
    result = call("run", *paths, "-o", out, *more)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == FILES | {"points.ply"}
    record = json.loads((out / "run.json").read_text())
    assert record["calibration"]["baseline_m"] == 0.5
    assert record["preset"] == "fast"


def test_run_keeps_what_else_is_in_the_folder(tmp_path, paths):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert call("run", *paths, "-o", tmp_path / "out", "--method", "zero").exit_code == 0
    assert call("run", *paths, "-o", tmp_path / "out", "--method", "zero").exit_code == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"notes.txt"}


def spoil(tmp_path, paths, kind):
    """The arguments of a run with one thing wrong, and what the message must contain."""
    out, more = tmp_path / "out", []
    match kind:
        case "missing file":
            paths, message = [paths[0], str(tmp_path / "in/none.png"), *paths[2:]], "none.png: no such file"
        case "no image":
            (tmp_path / "in/right1.png").write_text("hello")
            message = "right1.png: is no image"
        case "truncated":
            content = (tmp_path / "in/left2.png").read_bytes()
            (tmp_path / "in/left2.png").write_bytes(content[: len(content) // 2])
            message = "left2.png: the image is truncated"
        case "sizes":
            cv2.imwrite(paths[3], cv2.imread(paths[3])[:, :-3])
            message = f"right2 {scenes.W - 3} x {scenes.H}"
        case "small":
            for path in paths:
                cv2.imwrite(path, cv2.imread(path)[:12, :12])
            message = "too small"
        case "constant":
            cv2.imwrite(paths[2], np.full((scenes.H, scenes.W, 3), 7, np.uint8))
            message = "left2 is constant"
        case "nan":
            values = np.zeros((scenes.H, scenes.W), np.float32)
            values[3, 4] = np.nan
            paths = [*paths[:3], str(tmp_path / "in/right2.tiff")]
            cv2.imwrite(paths[3], values)
            message = "right2.tiff: the image contains NaN"
        case "output is a file":
            out.write_text("")
            message = "output folder cannot be written"
        case "output in a file":
            (tmp_path / "file").write_text("")
            out, message = tmp_path / "file" / "out", "output folder cannot be written"
        case "method":
            more, message = ["--method", "magic"], "unknown method 'magic'"
        case "preset":
            more, message = ["--preset", "magic"], "unknown preset 'magic'"
        case "no calibration":
            more, message = ["--calibration", tmp_path / "calib.txt"], "calib.txt: no such calibration file"
        case "bad calibration":
            (tmp_path / "calib.txt").write_text("hello")
            more, message = ["--calibration", tmp_path / "calib.txt"], "calib.txt: no calibration found"
    return [*paths, "-o", out, *more], message, out


@pytest.mark.parametrize("kind", ["missing file", "no image", "truncated", "sizes", "small", "constant", "nan",
                                  "output is a file", "output in a file", "method", "preset", "no calibration",
                                  "bad calibration"])  # fmt: skip
def test_bad_input_is_one_line_and_nothing_stays(tmp_path, paths, kind):
    arguments, message, out = spoil(tmp_path, paths, kind)
    assert_refused(call("run", *arguments), message)
    assert not out.is_dir()
    assert not [path for path in tmp_path.rglob("*") if ".part" in path.name]


def test_sixteen_bits_and_grey_are_accepted(tmp_path, paths):
    for path in paths:
        cv2.imwrite(path, cv2.imread(path, cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 257)
    assert call("run", *paths, "-o", tmp_path / "out", "--method", "opencv").exit_code == 0


def test_exchanged_images_are_said_on_stderr(tmp_path, rng):
    left1, right1, left2, right2 = map(str, scenes.write_images(tmp_path / "in", scenes.plane(rng, 192, 320)))
    arguments = ["run", right1, left1, right2, left2, "-o", str(tmp_path / "out"), "--method", "zero"]
    done = subprocess.run([sys.executable, "-m", "cgsf.cli", *arguments], capture_output=True, text=True, check=True)
    assert done.stderr.count("WARNING") == 2
    assert "left1 and right1 look exchanged" in done.stderr


def test_evaluate(tmp_path, rng):
    for name in ("a", "b"):
        scenes.write_frame(tmp_path / "frames" / name, scenes.plane(rng))
    out = tmp_path / "out"
    more = ("--method", "zero", "--method", "opencv", "--pictures")
    result = call("evaluate", "frames", tmp_path / "frames", "-o", out, *more)
    assert result.exit_code == 0, result.output
    assert "| a | 1 | zero | 100.00 |" in result.output
    assert (out / "opencv/b/b/overview.png").is_file()
    (tmp_path / "frames" / "a" / "left1.png").write_bytes(b"")
    arguments = ("evaluate", "frames", tmp_path / "frames", "-o", out, "--method", "zero")
    assert_refused(call(*arguments), "a/a: ")
    going = call(*arguments, "--keep-going")
    assert going.exit_code == 0
    assert "left out a/a" in going.stderr


def test_evaluate_refuses_in_one_line(tmp_path):
    assert_refused(call("evaluate", "kitty", tmp_path, "-o", tmp_path / "out"), "unknown data set 'kitty'")
    assert_refused(call("evaluate", "kitti2015", tmp_path, "-o", tmp_path / "out"), "no folder training")
    assert_refused(call("evaluate", "kitti2015", tmp_path, "-o", "x", "--option", "split"), "NAME=VALUE")
    bad = call("evaluate", "kitti2015", tmp_path, "-o", "x", "--option", "split=nothing")
    assert_refused(bad, "unknown split 'nothing'")


def test_demo(tmp_path):
    result = call("demo", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    lines = [line.split("|") for line in result.output.splitlines() if line.startswith("| street")]
    wrong = {line[3].strip(): float(line[7]) for line in lines}
    assert list(wrong) == ["zero", "variational+initial", "variational"]
    assert wrong["variational"] < wrong["variational+initial"] < wrong["zero"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"points.ply"}


def test_every_command_has_help():
    for name in COMMANDS:
        result = call(name, "--help")
        assert result.exit_code == 0, result.output
    assert all(name in call("--help").output for name in COMMANDS)
    assert call("no-such-command").exit_code == 2
