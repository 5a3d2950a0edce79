"""Outliers of what is left when the least confident pixels are dropped."""

from dataclasses import replace

import numpy as np
import pytest

from cgsf.datasets.sample import Truth
from cgsf.evaluate import Report
from cgsf.scene_flow import SceneFlow
from cgsf.sparsification import DROPPED, picture, sparsify, table


def estimate(confidence, disparity):
    state = np.zeros((5, *disparity.shape), np.float32)
    state[0] = disparity
    return replace(SceneFlow.from_state(state, np.ones(disparity.shape, bool)), confidence=confidence.astype(np.float32))


@pytest.fixture
def truth():
    flat = np.full((8, 25), 20.0, np.float32)
    flat[-1] = np.nan  # 175 pixels with truth
    return Truth(disparity1=flat)


def test_an_exact_confidence_drops_the_wrong_pixels_first(truth, rng):
    wrong = np.zeros((8, 25), bool)
    wrong.ravel()[rng.permutation(175)[:35]] = True  # a fifth of what is known
    values = sparsify(estimate(~wrong, np.where(wrong, 30.0, 20.0)), truth).values()
    assert values == pytest.approx({"0": 20.0, "10": 100 * 17 / 157, "20": 0, "30": 0, "40": 0, "50": 0})


def test_a_wrong_confidence_drops_the_right_pixels_first(truth):
    wrong = np.zeros((8, 25), bool)
    wrong[:2] = True
    values = sparsify(estimate(wrong, np.where(wrong, 30.0, 20.0)), truth).values()
    assert values["0"] == pytest.approx(100 * 50 / 175)
    assert values["50"] == pytest.approx(100 * 50 / 87)


def test_report_pools_curves_and_stages(tmp_path, truth):
    report = Report()
    for disparity in (20.0, 30.0):  # one frame all right, one all wrong
        maps = estimate(np.ones((8, 25)), np.full((8, 25), disparity))
        report.add("method", "set", str(disparity), maps, truth, {"start": disparity, "total": 2 * disparity})
    report.write(tmp_path)
    assert "| set | method | " + " | ".join(["50.00"] * len(DROPPED)) + " |" in (tmp_path / "confidence.md").read_text()
    assert table(report.curves) + "\n" == (tmp_path / "confidence.md").read_text()
    assert (tmp_path / "confidence.png").read_bytes()[:8] == picture(report.curves)[:8] == b"\x89PNG\r\n\x1a\n"
    assert "| set | method | 25.000 | 50.000 |" in (tmp_path / "stages.md").read_text()
