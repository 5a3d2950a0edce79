"""The measures against a second implementation, pixel by pixel in plain Python, and against the rules' edges."""

import importlib.util
import itertools
import math
import os
from pathlib import Path

import numpy as np
import pytest

from cgsf.datasets.sample import Truth
from cgsf.errors import InputError
from cgsf.metrics import Scores, error_maps, fill_background, score
from cgsf.scene_flow import SceneFlow

H, W = 9, 14


def make_estimate(d1, change, flow):
    d1, change, flow = (np.asarray(array, np.float32) for array in (d1, change, flow))
    return SceneFlow(d1, d1.copy(), change, flow, np.ones(d1.shape, bool))


def make_truth(rng, **others):
    d1, d2 = rng.uniform(1, 90, (2, H, W)).astype(np.float32)
    flow = rng.normal(0, 60, (H, W, 2)).astype(np.float32)
    d1[rng.random((H, W)) < 0.2] = np.nan
    d2[rng.random((H, W)) < 0.2] = np.nan
    flow[rng.random((H, W)) < 0.2] = np.nan
    return Truth(d1, d2, flow, **others)


def disturbed(rng, truth):
    """An estimate whose errors lie around both thresholds."""
    d1 = np.nan_to_num(truth.disparity1) + rng.normal(0, 4, (H, W))
    d2 = np.nan_to_num(truth.disparity2) + rng.normal(0, 4, (H, W))
    return make_estimate(d1, d2 - d1, np.nan_to_num(truth.flow) + rng.normal(0, 3, (H, W, 2)))


def slow_score(estimate, truth, masks):
    """Every measure by a loop over pixels; `masks` gives, by measure, the pixels that count."""
    sums = {}
    for y in range(H):
        for x in range(W):
            t1, t2, tf = float(truth.disparity1[y, x]), float(truth.disparity2[y, x]), truth.flow[y, x].astype(float)
            d1, change = float(estimate.disparity1[y, x]), float(estimate.disparity_change[y, x])
            e1, e2 = abs(d1 - t1), abs(d1 + change - t2)
            ef = math.hypot(*(estimate.flow[y, x].astype(float) - tf))
            wrong = {"D1": e1 > 3 and e1 / t1 > 0.05, "D2": e2 > 3 and e2 / t2 > 0.05,
                     "F1": ef > 3 and ef / math.hypot(*tf) > 0.05}  # fmt: skip
            known = {"D1": not math.isnan(t1), "D2": not math.isnan(t2), "F1": not math.isnan(tf[0])}
            wrong["SF"], known["SF"] = any(wrong.values()), all(known.values())
            values = {name: 100.0 * wrong[name] for name in wrong}
            values |= {"EPE-D": e1, "EPE-F": ef, "EPE-C": abs(change - (t2 - t1))}
            known |= {"EPE-D": known["D1"], "EPE-F": known["F1"], "EPE-C": known["D1"] and known["D2"]}
            for name, value in values.items():
                if known[name] and masks[name][y, x]:
                    total, count = sums.get(name, (0.0, 0))
                    sums[name] = total + value, count + 1
    return {name: total / count for name, (total, count) in sums.items()}


def test_equals_the_slow_implementation(rng):
    stereo, flow, change = rng.random((3, H, W)) < 0.7
    objects = rng.integers(0, 3, (H, W))
    truth = make_truth(rng, visible_stereo=stereo, visible_flow=flow, visible_change=change, objects=objects)
    estimate = disturbed(rng, truth)
    values = score(estimate, truth).values()
    names = ("D1", "D2", "F1", "SF", "EPE-D", "EPE-F", "EPE-C")
    regions = {
        "": dict.fromkeys(names, np.ones((H, W), bool)),
        "-bg": dict.fromkeys(names, objects == 0),
        "-fg": dict.fromkeys(names, objects > 0),
        "-noc": {"D1": stereo, "EPE-D": stereo, "F1": flow, "EPE-F": flow, "D2": change, "EPE-C": stereo & change,
                 "SF": stereo & flow & change},
    }  # fmt: skip
    assert set(values) == {name + region for name in names for region in regions}
    for region, masks in regions.items():
        for name, expected in slow_score(estimate, truth, masks).items():
            assert values[name + region] == pytest.approx(expected, rel=1e-5), name + region


def test_both_thresholds_are_strict():
    truth = Truth(disparity1=np.float32([[20, 20, 100, 100, 60]]))
    estimate = make_estimate([[23, 23.01, 104.9, 105.1, 63]], np.zeros((1, 5)), np.zeros((1, 5, 2)))
    assert score(estimate, truth).values()["D1"] == pytest.approx(100 * 2 / 5)


def test_images_are_pooled_pixel_by_pixel():
    few, many = Truth(disparity1=np.full((1, 1), 9, np.float32)), Truth(disparity1=np.full((1, 3), 9, np.float32))
    wrong = score(make_estimate([[50]], [[0]], np.zeros((1, 1, 2))), few)
    right = score(make_estimate([[9, 9, 9]], np.zeros((1, 3)), np.zeros((1, 3, 2))), many)
    assert (wrong + right).values()["D1"] == 25
    assert (Scores() + wrong).values() == wrong.values()


def test_without_second_disparity_scene_flow_is_disparity_or_flow(rng):
    truth = make_truth(rng)
    values = score(disturbed(rng, truth), Truth(truth.disparity1, None, truth.flow)).values()
    assert set(values) == {"D1", "F1", "SF", "EPE-D", "EPE-F"}


def test_a_perfect_estimate_and_an_empty_one(rng):
    truth = make_truth(rng)
    d1, d2, flow = (np.nan_to_num(array) for array in (truth.disparity1, truth.disparity2, truth.flow))
    perfect = score(make_estimate(d1, d2 - d1, flow), truth).values()
    assert max(perfect.values()) < 1e-4
    empty = np.full((H, W), np.nan)
    nothing = score(make_estimate(empty, empty, np.dstack([empty, empty])), truth).values()
    assert {nothing[name] for name in ("D1", "D2", "F1", "SF")} == {100}


def test_error_maps_know_where_the_truth_is(rng):
    truth = make_truth(rng)
    maps = error_maps(disturbed(rng, truth), truth)
    assert set(maps) == {"D1", "D2", "F1"}
    np.testing.assert_array_equal(np.isnan(maps["D2"]), np.isnan(truth.disparity2))


def test_sizes_must_agree(rng):
    truth = make_truth(rng)
    with pytest.raises(InputError, match="two frames"):
        score(make_estimate(np.ones((W, H)), np.ones((W, H)), np.ones((W, H, 2))), truth)


def kit_fill(values):
    """The official kit's interpolateBackground, loop by loop, on one (H, W, components) map."""
    out, (height, width, _) = values.copy(), values.shape
    for v in range(height):
        valid = [u for u in range(width) if np.isfinite(out[v, u]).all()]
        for a, b in itertools.pairwise(valid):
            for u in range(a + 1, b):
                out[v, u] = np.minimum(out[v, a], out[v, b])
        if valid:
            out[v, : valid[0]], out[v, valid[-1] + 1 :] = out[v, valid[0]], out[v, valid[-1]]
    for u in range(width):
        valid = [v for v in range(height) if np.isfinite(out[v, u]).all()]
        if valid:
            out[: valid[0], u], out[valid[-1] + 1 :, u] = out[valid[0], u], out[valid[-1], u]
    return out


@pytest.mark.parametrize("components", [1, 2])
def test_filling_is_the_official_kits(rng, components):
    values = rng.normal(0, 20, (H, W, components)).astype(np.float32)
    values[rng.random((H, W)) < 0.6] = np.nan
    values[:2], values[-1] = np.nan, np.nan  # rows without any value, at both ends
    before = values.copy()
    filled = fill_background(values if components == 2 else values[..., 0])
    np.testing.assert_array_equal(filled.reshape(values.shape), kit_fill(values))
    np.testing.assert_array_equal(values, before)


def test_filling_an_empty_row_between_and_nothing_at_all():
    values = np.float32([[1, np.nan], [np.nan, np.nan], [np.nan, 4]])
    np.testing.assert_array_equal(fill_background(values), [[1, 1], [1, 1], [4, 4]])
    assert np.isnan(fill_background(np.full((2, 3), np.nan))).all()


DATA = Path(os.environ.get("CGSF_DATA", Path(__file__).parents[3] / "shared" / "data"))


@pytest.mark.skipif(not (DATA.parent / "bench" / "peers.py").exists(), reason="development frames are not here")
def test_equals_an_independent_scorer_on_real_truth(rng):
    spec = importlib.util.spec_from_file_location("peers", DATA.parent / "bench" / "peers.py")
    peers = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(peers)
    seen = 0
    for group, _, _, (d1, d2, flow) in peers.frames():
        if seen and not group.startswith("kitti"):
            continue
        truth = Truth(d1, d2, flow)
        noise = rng.normal(0, 3, (4, *d1.shape)).astype(np.float32)
        change = np.nan_to_num(d2 - d1) if d2 is not None else np.zeros_like(d1)
        estimate = make_estimate(np.nan_to_num(d1) + noise[0], change + noise[1],
                                 np.nan_to_num(flow) + np.moveaxis(noise[2:], 0, -1))  # fmt: skip
        values = score(estimate, truth).values()
        expected = peers.score(estimate.disparity1, estimate.flow, estimate.disparity_change, (d1, d2, flow))
        assert values == pytest.approx(expected, rel=1e-4)
        seen += 1
    assert seen >= 3
