"""Calibration files; every number differs from every other, so that a swap shows."""

import json

import numpy as np
import pytest

from cgsf.calibration import Calibration
from cgsf.errors import InputError
from variational.camera import StereoCamera

NUMBERS = {"fx": 700.0, "fy": 710.0, "cx": 600.5, "cy": 170.25, "baseline": 0.54}


def row(name, fx, fy, cx, cy, shift, colon=":"):
    return f"{name}{colon} {fx} 0 {cx} {shift} 0 {fy} {cy} 0.2 0 0 1 0.003\n"


def test_json(tmp_path):
    (tmp_path / "calib.json").write_text(json.dumps(NUMBERS))
    assert Calibration.read(tmp_path / "calib.json") == Calibration(700, 710, 600.5, 170.25, 0.54)
    (tmp_path / "calib.json").write_text(json.dumps(Calibration(700, 710, 600.5, 170.25, 0.54).to_dict()))
    assert Calibration.read(tmp_path / "calib.json").baseline_m == 0.54


def test_kitti_2015_takes_the_rectified_colour_cameras(tmp_path):
    text = "calib_time: 09-Jan-2012 13:57:47\nS_02: 1392 512\n" + row("P_rect_00", 1, 1, 1, 1, 0)
    text += row("P_rect_01", 1, 1, 1, 1, -5)
    text += row("P_rect_02", 700, 710, 600, 170, 35) + row("P_rect_03", 700, 710, 600, 170, -315)
    (tmp_path / "calib.txt").write_text(text)
    assert Calibration.read(tmp_path / "calib.txt") == Calibration(700, 710, 600, 170, 0.5)


def test_kitti_2012_takes_the_grey_cameras_unless_colour_is_asked_for(tmp_path):
    text = row("P0", 700, 710, 600, 170, 0) + row("P1", 700, 710, 600, 170, -350)
    text += row("P2", 800, 810, 500, 160, 40) + row("P3", 800, 810, 500, 160, -440)
    (tmp_path / "calib.txt").write_text(text)
    assert Calibration.read(tmp_path / "calib.txt") == Calibration(700, 710, 600, 170, 0.5)
    assert Calibration.read(tmp_path / "calib.txt", color=True) == Calibration(800, 810, 500, 160, 0.6)


def test_a_calibration_is_a_stereo_camera():
    calibration = Calibration(700, 710, 600.5, 170.25, 0.54)
    assert isinstance(calibration, StereoCamera)
    assert type(calibration.camera()) is StereoCamera
    assert Calibration.from_camera(calibration.camera()) == calibration
    np.testing.assert_allclose(calibration.depth(np.float32([[54, 0, -1]])), [[7, np.nan, np.nan]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{broken", "broken JSON"),
        ('{"fx": 1, "fy": 1}', "lacks cx, cy, baseline_m"),
        (json.dumps(NUMBERS | {"fx": "wide"}), "fx must be a number"),
        (json.dumps(NUMBERS | {"fx": True}), "fx must be a number"),
        (json.dumps(NUMBERS | {"baseline": -0.5}), "baseline_m must be a positive number"),
        (json.dumps(NUMBERS).replace("0.54", "NaN"), "baseline_m must be a positive number"),
        ("hello", "no calibration found"),
        ("", "no calibration found"),
        (row("P0", 1, 1, 1, 1, 0), "no calibration found"),
        ("P0: 1 2 3\nP1: 1 2 3\n", "twelve numbers"),
        ("P0: a b c\nP1: d e f\n", "twelve numbers"),
        (row("P0", 0, 1, 1, 1, 0) + row("P1", 0, 1, 1, 1, -1), "fx must be a positive number"),
        (row("P0", 7, 7, 1, 1, 0) + row("P1", 7, 7, 1, 1, 4), "baseline_m must be a positive number"),
    ],
)
def test_bad_files_are_one_line(tmp_path, content, message):
    (tmp_path / "calib.txt").write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        Calibration.read(tmp_path / "calib.txt")
    assert str(caught.value).startswith(str(tmp_path / "calib.txt"))
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(InputError, match="no such calibration file"):
        Calibration.read(tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="cannot be read"):
        Calibration.read(tmp_path / "calib.txt")
