"""The Python function: accepted images, refused images, warnings, baselines."""

import logging

import numpy as np
import pytest

import cgsf
from cgsf.calibration import Calibration
from cgsf.pipelines import METHODS
from cgsf.scene_flow import SceneFlow
from tests.cgsf import scenes
from variational.camera import StereoCamera

INSIDE = (slice(16, -16), slice(30, -30))


@pytest.fixture
def images(rng):
    return scenes.plane(rng, 96, 160)


def assert_is_the_plane(result):
    for name, expected in (("disparity1", 8), ("disparity2", 10), ("disparity_change", 2)):
        np.testing.assert_allclose(np.median(getattr(result, name)[INSIDE]), expected, atol=0.2)
    np.testing.assert_allclose(np.median(result.flow[INSIDE], axis=(0, 1)), scenes.FLOW, atol=0.2)


@pytest.mark.parametrize("method", ["variational", "opencv", "opencv-wls-deepflow", "opencv-rlof", "opencv-farneback"])
def test_a_plane(images, method):
    result = cgsf.estimate(*images, method=method)
    assert isinstance(result, SceneFlow)
    assert result.method == method
    assert result.seconds["total"] > 0
    assert np.isfinite(result.state()).all()
    assert_is_the_plane(result)


def test_every_kind_of_image_gives_the_same(images):
    expected = cgsf.estimate(*images, method="opencv").state()
    kinds = {
        "uint16": [image.astype(np.uint16) * 257 for image in images],
        "float64": [image / 255 for image in images],
        "alpha": [np.dstack([image, image[..., :1]]) for image in images],
    }
    for kind, others in kinds.items():
        np.testing.assert_array_equal(cgsf.estimate(*others, method="opencv").state(), expected, err_msg=kind)


def test_grey_and_mixed(images):
    grey = [image[..., 0] for image in images]
    assert_is_the_plane(cgsf.estimate(*grey, method="opencv"))
    same = [np.repeat(image[..., :1], 3, -1) for image in images]
    mixed = cgsf.estimate(grey[0], *same[1:], method="opencv").state()
    np.testing.assert_array_equal(mixed, cgsf.estimate(*grey, method="opencv").state())


def test_images_are_not_changed(images):
    before = [image.copy() for image in images]
    cgsf.estimate(*images, method="opencv")
    for image, copy in zip(images, before, strict=True):
        np.testing.assert_array_equal(image, copy)


def test_calibration_of_every_kind(tmp_path, images):
    path = tmp_path / "calib.json"
    path.write_text('{"fx": 100, "fy": 110, "cx": 50, "cy": 30, "baseline": 0.5}')
    for calibration in (path, str(path), Calibration(100, 110, 50, 30, 0.5), StereoCamera(100, 110, 50, 30, 0.5)):
        result = cgsf.estimate(*images, method="opencv", calibration=calibration)
        assert np.median(result.depth) == pytest.approx(100 * 0.5 / 8, rel=0.05)


def test_zero_does_nothing(images):
    assert not cgsf.estimate(*images, method="zero").state().any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b, c, d: (a, b[:-1], c, d), "one size .*right1 160 x 95"),
        (lambda a, b, c, d: (a, b, c, d[:, :-2]), "right2 158 x 96"),
        (lambda a, b, c, d: [image[:20] for image in (a, b, c, d)], "too small"),
        (lambda a, b, c, d: (a, b, np.full_like(c, 9), d), "left2 is constant"),
        (lambda a, b, c, d: [np.full_like(a, 9)] * 4, "left1 is constant"),
        (lambda a, b, c, d: (a, np.where(np.arange(160)[:, None] == 3, np.nan, b / 255), c, d), "right1: .*NaN"),
        (lambda a, b, c, d: (a, b, c, d.astype(np.int32)), "right2: .*uint8"),
        (lambda a, b, c, d: (a, b, c * 1.0, d), r"left2: .*\[0, 1\]"),
    ],
)
def test_bad_images_are_one_line(images, change, message):
    with pytest.raises(cgsf.InputError, match=message) as caught:
        cgsf.estimate(*change(*images))
    assert "\n" not in str(caught.value)


def test_unknown_method_and_preset(images):
    with pytest.raises(cgsf.InputError, match="unknown method 'magic'; there are variational, opencv"):
        cgsf.estimate(*images, method="magic")
    with pytest.raises(cgsf.InputError, match="unknown preset"):
        cgsf.estimate(*images, preset="magic")


def warnings_of(caplog, *images):
    caplog.clear()
    with caplog.at_level(logging.WARNING, "cgsf"):
        cgsf.estimate(*images, method="zero")
    return [record.message for record in caplog.records]


def test_odd_pairs_are_said(caplog, rng):
    images = left1, right1, left2, right2 = scenes.plane(rng, 192, 320)
    assert warnings_of(caplog, *images) == []
    swapped = warnings_of(caplog, right1, left1, right2, left2)
    assert len(swapped) == 2
    assert all("left and right swapped" in text for text in swapped)
    assert "left2 and right2 look exchanged" in warnings_of(caplog, left1, right1, right2, left2)[0]
    assert "unrectified" in warnings_of(caplog, left1, np.roll(right1, 4, 0), left2, right2)[0]
    assert "same image" in warnings_of(caplog, left1, left1, left2, right2)[0]
    assert "flow can only be zero" in warnings_of(caplog, left1, right1, left1, right1)[0]


def test_registry_names_what_exists():
    import importlib

    for method in METHODS.values():
        for place in filter(None, (method.function, method.config)):
            module, name = place.split(":")
            if not module.startswith("learned"):
                assert hasattr(importlib.import_module(module), name)
