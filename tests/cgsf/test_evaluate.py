"""Evaluation: predictions are kept and reused, never mixed; bad frames stop it or are left out."""

import csv
import json

import numpy as np
import pytest

from cgsf import pipelines
from cgsf.datasets import open_dataset
from cgsf.errors import InputError
from cgsf.evaluate import INITIAL, Report, evaluate, report_all
from cgsf.formats import npz
from cgsf.metrics import Scores, score
from cgsf.scene_flow import SceneFlow
from tests.cgsf import scenes


@pytest.fixture
def root(tmp_path, rng):
    for name in ("street_00", "street_01", "teddy"):
        scenes.write_frame(tmp_path / "frames" / name, scenes.plane(rng))
    return tmp_path / "frames"


def rows(out):
    with (out / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def test_several_methods_in_one_table(tmp_path, root):
    dataset = open_dataset("frames", root)
    report = evaluate(dataset, "frames", tmp_path / "out", ["opencv", "zero"])
    found = rows(tmp_path / "out")
    assert [(row["method"], row["set"], row["frame"]) for row in found] == [
        (method, *name.split("/")) for name in dataset.names for method in ("opencv", "zero")
    ]
    for row in found:
        expected = score(SceneFlow.load(tmp_path / "out" / row["method"] / row["set"] / row["frame"]),
                         open_dataset("folder", root / row["frame"])[0].truth)  # fmt: skip
        assert float(row["SF"]) == pytest.approx(expected.values()["SF"], rel=1e-4, abs=1e-9)
        assert float(row["seconds"]) > 0
    assert report.pooled()["street", "zero"] == pytest.approx(
        {"D1": 100, "D2": 100, "F1": 100, "SF": 100, "EPE-D": 8, "EPE-F": np.hypot(5, 3), "EPE-C": 2, "frames": 2}
        | {"seconds": report.pooled()["street", "zero"]["seconds"]}
    )
    assert report.pooled()["teddy", "opencv"]["SF"] < 50
    assert "| street | 2 | opencv |" in (tmp_path / "out" / "table.md").read_text()
    pooled = json.loads((tmp_path / "out" / "scores.json").read_text())["scores"]
    assert {(entry["set"], entry["method"]) for entry in pooled} == set(report.pooled())


def test_scoring_again_solves_nothing(tmp_path, root, monkeypatch):
    dataset = open_dataset("frames", root)
    before = evaluate(dataset, "frames", tmp_path / "out", ["opencv"])
    monkeypatch.setattr(pipelines, "solve", lambda *_: pytest.fail("solved again"))
    after = evaluate(dataset, "frames", tmp_path / "out", ["opencv"])
    assert after.pooled() == before.pooled()


def test_an_interrupted_evaluation_goes_on(tmp_path, root, monkeypatch):
    dataset = open_dataset("frames", root)
    solved, solve = [], pipelines.solve

    def counting(*arguments):
        solved.append(1)
        if len(solved) == 2:
            raise KeyboardInterrupt
        return solve(*arguments)

    monkeypatch.setattr(pipelines, "solve", counting)
    with pytest.raises(KeyboardInterrupt):
        evaluate(dataset, "frames", tmp_path / "out", ["opencv"])
    assert len(evaluate(dataset, "frames", tmp_path / "out", ["opencv"]).frames) == 3
    assert len(solved) == 4


def test_another_configuration_is_refused(tmp_path, root):
    dataset = open_dataset("frames", root)
    evaluate(dataset, "frames", tmp_path / "out", ["opencv"])
    preset = tmp_path / "other.toml"
    preset.write_text("[opencv]\ndisparities = 64\n")
    with pytest.raises(InputError, match=r"another configuration \(settings.disparities was 192 and is 64 now\)"):
        evaluate(dataset, "frames", tmp_path / "out", ["opencv"], str(preset))
    (tmp_path / "full" / "zero").mkdir(parents=True)
    (tmp_path / "full" / "zero" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="something else"):
        evaluate(dataset, "frames", tmp_path / "full", ["zero"])


def test_predictions_of_other_images_are_refused(tmp_path, root, rng):
    evaluate(open_dataset("frames", root), "frames", tmp_path / "out", ["zero"])
    scenes.write_frame(root / "teddy", scenes.plane(rng))
    with pytest.raises(InputError, match=r"teddy.*other images"):
        evaluate(open_dataset("frames", root), "frames", tmp_path / "out", ["zero"])


def test_one_bad_frame(tmp_path, root, caplog):
    (root / "street_01" / "right2.png").write_bytes(b"no image")
    dataset = open_dataset("frames", root)
    with pytest.raises(InputError, match=r"street/street_01: .*right2\.png"):
        evaluate(dataset, "frames", tmp_path / "stop", ["zero"])
    report = evaluate(dataset, "frames", tmp_path / "out", ["zero"], keep_going=True)
    assert list(report.failures) == ["street/street_01"]
    assert [row["frame"] for row in rows(tmp_path / "out")] == ["street_00", "teddy"]
    assert "street_01 left out" in caplog.text


def test_a_set_without_truth_or_without_any_good_frame(tmp_path, root):
    for folder in root.iterdir():
        (folder / "gt.npz").unlink()
    dataset = open_dataset("frames", root)
    with pytest.raises(InputError, match="no truth"):
        evaluate(dataset, "frames", tmp_path / "out", ["zero"])
    with pytest.raises(InputError, match="not a single frame"):
        evaluate(dataset, "frames", tmp_path / "out", ["zero"], keep_going=True)


def test_the_initial_state_is_scored_beside(tmp_path, root, monkeypatch):
    """A method that begins at zero and ends at the truth."""
    state = np.zeros((5, scenes.H, scenes.W), np.float32)
    start = SceneFlow.from_state(state, np.ones(state.shape[1:], bool))
    state = state + np.float32([8, 10, 2, 5, 3])[:, None, None]
    end = SceneFlow.from_state(state, start.visible, seconds={"total": 2.0}, initial=start)
    monkeypatch.setattr(pipelines, "solve", lambda *_: end)
    report = evaluate(open_dataset("frames", root), "frames", tmp_path / "out", ["zero"], initial=True)
    assert report.pooled()["teddy", "zero"]["SF"] == 0
    assert report.pooled()["teddy", "zero" + INITIAL]["SF"] == 100
    assert "seconds" not in report.pooled()["teddy", "zero" + INITIAL]


def test_predictions_of_another_program_can_be_scored(tmp_path, root):
    """scene_flow.npz files that somebody else put there, with nothing beside them."""
    out = tmp_path / "out"
    evaluate(open_dataset("frames", root), "frames", out, ["zero"])
    (out / "zero/teddy/teddy/solved.json").unlink()
    shape = (scenes.H, scenes.W)
    flow = np.broadcast_to(np.float32(scenes.FLOW), (*shape, 2))
    maps = {"disparity1": np.full(shape, 8), "disparity_change": np.full(shape, 2), "flow": flow}
    npz.write_arrays(out / "zero/teddy/teddy/scene_flow.npz", maps)
    report = evaluate(open_dataset("frames", root), "frames", out, ["zero"])
    assert report.pooled()["teddy", "zero"]["SF"] == 0
    assert report.pooled()["street", "zero"]["SF"] == 100


def test_report_over_several_sets(tmp_path, root, rng):
    scenes.write_kitti(tmp_path / "kitti2015", scenes.plane(rng), frames=("000003",))
    report = report_all(tmp_path, tmp_path / "out", ["zero", "opencv"])
    assert [group for group, _ in report.pooled()] == ["kitti2015"] * 2 + ["street"] * 2 + ["teddy"] * 2
    assert (tmp_path / "out" / "zero" / "kitti2015" / "000003" / "scene_flow.npz").is_file()
    with pytest.raises(InputError, match="none of the folders"):
        report_all(tmp_path / "out", tmp_path / "out", ["zero"])


def test_a_table_leaves_unknown_measures_empty():
    report = Report([("m", "s", "f", Scores({"D1": (1.0, 4), "F1": (0.0, 0)}), float("nan"))])
    assert report.table().splitlines()[-1] == "| s | 1 | m | 25.00 |  |  |  |  |  |  |  |  |"
