"""Data sets on tiny trees with distractors: every path belongs to its frame, every missing file is named."""

import cv2
import numpy as np
import pytest

from cgsf.datasets import DATASETS, open_dataset
from cgsf.errors import InputError
from tests.cgsf import scenes


@pytest.fixture
def images(rng):
    return scenes.plane(rng)


@pytest.mark.parametrize("inside", [False, True])
def test_kitti_2015(tmp_path, images, inside):
    scenes.write_kitti(tmp_path, images)
    dataset = open_dataset("kitti2015", tmp_path / "training" if inside else tmp_path)
    assert dataset.names == ["000003", "000007"]
    assert len(dataset) == 2
    for sample, number in zip(dataset, (3, 7), strict=True):
        for image, expected in zip(sample.images, images, strict=True):
            np.testing.assert_allclose(image, expected / 255, atol=1e-6)
        truth = sample.truth
        assert (truth.disparity1[5, 5], truth.disparity2[5, 5]) == (10 + number, 30 + number)
        assert tuple(truth.flow[5, 5]) == (number, -number)
        assert np.isnan(truth.disparity1[0]).all()
        assert np.isnan(truth.disparity2[1]).all()
        assert np.isnan(truth.flow[2]).all()
        assert not truth.visible_stereo[:, :4].any()
        assert truth.visible_stereo[1:, 4:].all()
        assert truth.visible_change[2:, 4:].all()
        assert not truth.visible_change[1].any()
        assert truth.visible_flow[3:, 6:].all()
        assert truth.objects is None
        assert sample.calibration.fy == 700 + number
        assert sample.calibration.baseline_m == 0.5


def test_kitti_2015_objects_and_testing(tmp_path, images):
    scenes.write_kitti(tmp_path, images, frames=("000003",))
    (tmp_path / "training" / "obj_map").mkdir()
    with pytest.raises(InputError, match=r"obj_map/000003_10\.png"):
        open_dataset("kitti2015", tmp_path)[0]
    objects = np.zeros(images[0].shape[:2], np.uint8)
    objects[3, 4] = 2
    cv2.imwrite(str(tmp_path / "training/obj_map/000003_10.png"), objects)
    np.testing.assert_array_equal(open_dataset("kitti2015", tmp_path)[0].truth.objects, objects)
    with pytest.raises(InputError, match="no folder testing"):
        open_dataset("kitti2015", tmp_path, split="testing")
    (tmp_path / "training").rename(tmp_path / "testing")
    assert open_dataset("kitti2015", tmp_path, split="testing")[0].truth is None


def test_kitti_2012(tmp_path, rng):
    scenes.write_kitti(tmp_path, scenes.plane(rng, channels=1), year=2012)
    sample = open_dataset("kitti2012", tmp_path)[1]
    assert sample.name == "000007"
    assert sample.left1.shape == (scenes.H, scenes.W, 1)
    assert sample.truth.disparity2 is None
    assert sample.truth.disparity1[5, 5] == 17
    assert not sample.truth.visible_flow[:, :6].any()
    assert sample.calibration.fy == 707
    with pytest.raises(InputError, match="colored_0"):
        open_dataset("kitti2012", tmp_path, color=True)


@pytest.mark.parametrize("missing", ["image_3/000003_11.png", "disp_occ_1/000003_10.png", "flow_noc/000003_10.png",
                                     "calib_cam_to_cam/000003.txt"])  # fmt: skip
def test_a_missing_file_is_named(tmp_path, images, missing):
    scenes.write_kitti(tmp_path, images)
    (tmp_path / "training" / missing).unlink()
    dataset = open_dataset("kitti2015", tmp_path)
    with pytest.raises(InputError, match=missing):
        dataset[0]
    assert dataset[1].name == "000007"


def test_frame_folders(tmp_path, images):
    for name in ("street_01", "street_00", "teddy"):
        scenes.write_frame(tmp_path / name, images)
    (tmp_path / "notes").mkdir()
    (tmp_path / "left1.png").write_text("a stray file")
    dataset = open_dataset("frames", tmp_path)
    assert dataset.names == ["street/street_00", "street/street_01", "teddy/teddy"]
    sample = dataset[2]
    assert sample.name == "teddy/teddy"
    assert sample.calibration.cx == 50
    assert (sample.truth.disparity2 == 10).all()


def test_folder_truth_and_masks(tmp_path, images):
    shape = images[0].shape[:2]
    hidden, valid, moving = np.zeros(shape, bool), np.ones(shape, bool), np.zeros(shape, bool)
    hidden[2, 3], valid[4, 5], moving[6, 7] = True, False, True
    scenes.write_frame(tmp_path / "a", images, occ_stereo=hidden, occ_flow=~hidden, valid=valid, moving=moving,
                       D_left2=np.full(shape, 4.0))  # fmt: skip
    truth = open_dataset("folder", tmp_path / "a")[0].truth
    assert not truth.visible_stereo[2, 3]
    assert truth.visible_flow.sum() == 1
    assert np.isnan(truth.flow[4, 5]).all()
    assert np.isnan(truth.disparity2).sum() == 1
    assert truth.objects.sum() == truth.objects[6, 7] == 1
    assert (truth.disparity_left2 == 4).all()


def test_folder_takes_any_format_but_one_file_each(tmp_path, images):
    scenes.write_images(tmp_path, images)
    (tmp_path / "left1.png").rename(tmp_path / "spare.png")
    with pytest.raises(InputError, match=r"left1\.png .* found none"):
        open_dataset("folder", tmp_path)[0]
    cv2.imwrite(str(tmp_path / "left1.bmp"), images[0])
    sample = open_dataset("folder", tmp_path)[0]
    assert sample.truth is None
    assert sample.calibration is None
    cv2.imwrite(str(tmp_path / "left1.jpg"), images[0])
    with pytest.raises(InputError, match=r"found left1\.bmp, left1\.jpg"):
        open_dataset("folder", tmp_path)[0]


def test_broken_truth_is_refused(tmp_path, images):
    scenes.write_frame(tmp_path, images, F=np.zeros((5, 6, 2)))
    with pytest.raises(InputError, match="differ in size"):
        open_dataset("folder", tmp_path)[0]


@pytest.mark.parametrize("name", ["kitti2015", "kitti2012", "frames", "folder"])
def test_missing_and_empty_roots(tmp_path, name):
    with pytest.raises(InputError, match="no such folder"):
        open_dataset(name, tmp_path / "nowhere")
    (tmp_path / "training").mkdir()
    with pytest.raises(InputError, match=str(tmp_path)):
        open_dataset(name, tmp_path)[0]


def test_unknown_names():
    with pytest.raises(InputError, match="known are"):
        open_dataset("kitty", ".")
    assert {"kitti2015", "kitti2012", "frames", "rendered", "folder"} <= set(DATASETS)
