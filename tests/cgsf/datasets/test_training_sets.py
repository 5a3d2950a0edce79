"""Readers of the training data sets on tiny trees, with files beside the right ones that must not be taken."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cgsf.datasets import open_dataset
from cgsf.datasets.check import check_sample
from cgsf.errors import InputError
from cgsf.formats.flo import write_flo
from cgsf.formats.pfm import write_pfm
from cgsf.synthetic import make_sample

SHAPE = (6, 10)


def constant(path: Path, value: int) -> None:
    """An image whose grey value names the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((*SHAPE, 3), value, np.uint8))


def values(*images: np.ndarray) -> list[int]:
    return [round(float(image.mean()) * 255) for image in images]


def pfm(path: Path, value: float, channels: int = 1) -> None:
    shape = SHAPE if channels == 1 else (*SHAPE, channels)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_pfm(path, np.full(shape, value, np.float32))


def scene_flow_video(root: Path, sequence: str, frames: tuple[int, ...]) -> None:
    for frame in frames:
        for render, base in (("clean", 0), ("final", 100)):
            for side, offset in (("left", 0), ("right", 40)):
                constant(root / f"frames_{render}pass/{sequence}/{side}/{frame:04d}.png", base + offset + frame)
        pfm(root / f"disparity/{sequence}/left/{frame:04d}.pfm", 10 + frame)
        pfm(root / f"disparity/{sequence}/right/{frame:04d}.pfm", 90)
        for way, sign in (("into_future", 1), ("into_past", -1)):
            name = "Future" if sign > 0 else "Past"
            pfm(root / f"disparity_change/{sequence}/{way}/left/{frame:04d}.pfm", 0.5 * sign)
            pfm(root / f"disparity_change/{sequence}/{way}/right/{frame:04d}.pfm", 70)
            for side, letter in (("left", "L"), ("right", "R")):
                flow = np.zeros((*SHAPE, 3), np.float32)
                flow[..., 0], flow[..., 1] = 3 * sign + (letter == "R"), -2
                path = root / f"optical_flow/{sequence}/{way}/{side}/OpticalFlowInto{name}_{frame:04d}_{letter}.pfm"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_pfm(path, flow)


@pytest.mark.parametrize(("name", "sequence"), [
    ("flyingthings3d", "TRAIN/A/0000"), ("monkaa", "a_rain_of_stones_x2"), ("driving", "15mm_focallength/scene_forwards/fast"),
])  # fmt: skip
def test_full_releases(tmp_path: Path, name: str, sequence: str) -> None:
    scene_flow_video(tmp_path, sequence, (6, 7, 9))
    constant(tmp_path / f"frames_cleanpass/{sequence}/left/notes.png", 1)
    dataset = open_dataset(name, tmp_path)
    assert dataset.names == [f"{sequence}/0006"]  # 7 has no successor, 9 is the last
    sample = dataset[0]
    assert values(*sample.images) == [6, 46, 7, 47]
    assert sample.truth.disparity1 == pytest.approx(16)
    assert sample.truth.disparity2 == pytest.approx(16.5)
    assert sample.truth.disparity_left2 == pytest.approx(17)
    assert sample.truth.flow[0, 0].tolist() == [3, -2]
    assert sample.calibration.fx == (450 if "15mm" in sequence else 1050)
    assert values(*open_dataset(name, tmp_path, render="final")[0].images) == [106, 146, 107, 147]
    (tmp_path / f"disparity/{sequence}/left/0007.pfm").unlink()
    with pytest.raises(InputError, match=r"left/0007\.pfm"):
        dataset[0]


def test_split_of_flyingthings3d(tmp_path: Path) -> None:
    scene_flow_video(tmp_path, "TRAIN/A/0000", (6, 7))
    scene_flow_video(tmp_path, "TEST/A/0000", (8, 9))
    assert open_dataset("flyingthings3d", tmp_path, split="TEST").names == ["TEST/A/0000/0008"]


def test_subset_turns_the_sign_of_its_disparities(tmp_path: Path) -> None:
    folder = tmp_path / "train"
    for frame in (0, 1, 2):
        constant(folder / f"image_clean/left/{frame:07d}.png", frame)
        constant(folder / f"image_clean/right/{frame:07d}.png", 40 + frame)
        pfm(folder / f"disparity/left/{frame:07d}.pfm", -20.0 - frame)
        pfm(folder / f"disparity/right/{frame:07d}.pfm", 20)
        pfm(folder / f"disparity_change/left/into_past/{frame:07d}.pfm", 9)
        for way, u in (("into_future", 4.0), ("into_past", -4.0)):
            path = folder / f"flow/left/{way}/{frame:07d}.flo"
            path.parent.mkdir(parents=True, exist_ok=True)
            if frame != 1 or way == "into_past":  # frame 1 ends a sequence
                write_flo(path, np.full((*SHAPE, 2), u, np.float32))
        pfm(folder / f"disparity_change/left/into_future/{frame:07d}.pfm", -1)
    dataset = open_dataset("flyingthings3d-subset", tmp_path)
    assert dataset.names == ["0000000"]
    sample = dataset[0]
    assert values(*sample.images) == [0, 40, 1, 41]
    assert sample.truth.disparity1 == pytest.approx(20)
    assert sample.truth.disparity2 == pytest.approx(21)
    assert sample.truth.disparity_left2 == pytest.approx(21)
    assert sample.truth.flow == pytest.approx(4)


CALIBRATION = (
    "P_rect_00: 700 0 600 0 0 700 170 0 0 0 1 0\n"
    "P_rect_02: 700 0 600 45 0 700 170 0 0 0 1 0\nP_rect_03: 700 0 600 -333 0 700 170 0 0 0 1 0\n"
)


def test_kitti_raw_leaves_out_every_drive_of_the_mapping(tmp_path: Path) -> None:
    date = tmp_path / "2011_09_26"
    for drive in (1, 5):
        for camera, base in (("image_00", 190), ("image_02", 0), ("image_03", 50)):
            for frame in (3, 4, 6):
                constant(date / f"2011_09_26_drive_{drive:04d}_sync/{camera}/data/{frame:010d}.png", base + 10 * drive + frame)
    (date / "calib_cam_to_cam.txt").write_text(CALIBRATION)
    mapping = tmp_path / "train_mapping.txt"
    mapping.write_text("2011_09_26 2011_09_26_drive_0005_sync 0000000010\n\n2011_09_28 2011_09_28_drive_0002_sync 0000000099\n")
    dataset = open_dataset("kitti-raw", tmp_path)
    assert dataset.names == ["2011_09_26/2011_09_26_drive_0001_sync/0000000003"]
    assert values(*dataset[0].images) == [13, 63, 14, 64]
    assert dataset[0].calibration.baseline_m == pytest.approx(378 / 700)
    assert dataset[0].truth is None
    mapping.write_text("2011_09_26 drive 5\n")
    with pytest.raises(InputError, match="line 1"):
        open_dataset("kitti-raw", tmp_path)
    mapping.unlink()
    with pytest.raises(InputError, match="development kit"):
        open_dataset("kitti-raw", tmp_path)


def test_sintel(tmp_path: Path) -> None:
    training = tmp_path / "training"
    for number in (1, 2):
        for kind, base in (("clean_left", 0), ("clean_right", 50), ("final_left", 100), ("final_right", 150)):
            constant(training / kind / f"alley_1/frame_{number:04d}.png", base + number)
        code = np.zeros((*SHAPE, 3), np.uint8)
        code[...] = (128, 32, 5 + number)  # B, G, R
        hidden, outside = np.eye(*SHAPE, dtype=np.uint8) * 255, np.zeros(SHAPE, np.uint8)
        for folder, pixels in (("disparities", code), ("occlusions", hidden), ("outofframe", outside)):
            (training / folder / "alley_1").mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(training / folder / f"alley_1/frame_{number:04d}.png"), pixels)
    (training / "disparities_viz/alley_1").mkdir(parents=True)
    sample = open_dataset("sintel", tmp_path)[0]
    assert values(*sample.images) == [1, 51, 2, 52]
    assert sample.truth.disparity1 == pytest.approx(4 * 6 + 32 / 64 + 128 / 16384)
    assert sample.truth.disparity_left2 == pytest.approx(4 * 7 + 32 / 64 + 128 / 16384)
    assert sample.truth.flow is None
    assert np.array_equal(sample.truth.visible_stereo, ~np.eye(*SHAPE, dtype=bool))
    (training / "flow/alley_1").mkdir(parents=True)
    write_flo(training / "flow/alley_1/frame_0001.flo", np.full((*SHAPE, 2), 2.0, np.float32))
    assert open_dataset("sintel", tmp_path, render="final")[0].truth.flow == pytest.approx(2)


def test_middlebury(tmp_path: Path) -> None:
    for scene, doffs in (("Adirondack-perfect", 32.8), ("Level-perfect", 0)):
        constant(tmp_path / scene / "im0.png", 10)
        constant(tmp_path / scene / "im1.png", 20)
        constant(tmp_path / scene / "im1E.png", 99)  # the other exposure
        disparity = np.full(SHAPE, 12.5, np.float32)
        disparity[0, 0] = np.inf
        write_pfm(tmp_path / scene / "disp0.pfm", disparity)
        write_pfm(tmp_path / scene / "disp1.pfm", disparity * 3)
        (tmp_path / scene / "calib.txt").write_text(
            "cam0=[4161.2 0 1445.5; 0 4161.5 984.6; 0 0 1]\ncam1=[4161.2 0 1470; 0 4161.5 984.6; 0 0 1]\n"
            f"doffs={doffs}\nbaseline=176.252\nndisp=280\n"
        )
    (tmp_path / "readme").mkdir()
    dataset = open_dataset("middlebury2014", tmp_path)
    assert dataset.names == ["Adirondack-perfect", "Level-perfect"]
    first, second = dataset[0], dataset[1]
    assert values(*first.images) == [10, 20, 10, 20]
    assert np.isnan(first.truth.disparity1[0, 0])
    assert first.truth.disparity1[1, 1] == 12.5
    assert first.calibration is None
    assert second.calibration.fy == pytest.approx(4161.5)
    assert second.calibration.baseline_m == pytest.approx(0.176252)


@pytest.mark.parametrize("damage", ["sign", "half", "pairing", "change"])
def test_check_finds_a_damaged_truth(damage: str) -> None:
    sample = make_sample("street", 12, 96, 192, sensor=False)
    assert not any(finding.complaint for finding in check_sample(sample))
    truth = sample.truth
    broken = {
        "sign": replace(sample, truth=replace(truth, disparity1=-truth.disparity1)),
        "half": replace(sample, truth=replace(truth, flow=0.5 * truth.flow)),
        "pairing": replace(sample, left2=sample.left1),
        "change": replace(sample, truth=replace(truth, disparity2=0 * truth.disparity2 + 0.5 * truth.disparity1)),
    }[damage]
    assert any(finding.complaint for finding in check_sample(broken))
