"""``cgsf gradcheck``: passes on the true gradient, names the term of a damaged one, writes what it promises."""

import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from cgsf import gradcheck
from cgsf.cli import main
from variational.energy import EnergyConfig


def run(*arguments):
    return CliRunner().invoke(main, ["gradcheck", "--size", "32x40", *arguments])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_passes(dtype, tmp_path):
    result = run("--dtype", dtype, "--json", str(tmp_path / "table.json"))
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert {row["term"] for row in rows} == set(gradcheck.TERMS)
    assert {row["channel"] for row in rows if row["term"] == "all"} == {"D1", "D2", "C", "u", "v"}
    assert all(row["kinks"] <= 0.01 for row in rows)


@pytest.mark.parametrize("term", ["stereo", "flow", "coupling", "smoothness"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_one_percent_is_reported(term, dtype):
    result = run("--dtype", dtype, "--damage", term)
    assert result.exit_code == 1
    assert f"outside tolerance: {term}\n" in result.output


def test_taylor_and_differences_find_it_without_the_twin():
    """Each of the other two ways sees 1 % on its own."""
    rows, _ = gradcheck.compare(gradcheck.random_scene((24, 30)), "all", damage=0.01)
    assert all(row.order < 1.5 for row in rows)
    assert all(row.difference > 1e-4 for row in rows)


def test_kinks_are_found():
    """Whole displacements and flat regions lie on kinks, and are counted."""
    scene = gradcheck.random_scene((16, 20))
    scene.state[0, 4, 5] = 3.0
    scene.state[3, 8, 9:11] = 0.7
    mask = gradcheck.kink_mask(scene, EnergyConfig(), 1e-6)
    assert mask[0, 4, 5]
    assert mask[3, 8, 9]
    assert mask[3, 8, 10]
    assert mask.mean() < 0.05


def test_real_images_and_pictures(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("left1", "right1", "left2", "right2"):
        noise = gradcheck.smooth_noise(rng, (40, 50), 0, 255, 1.5)
        cv2.imwrite(str(tmp_path / f"{name}.png"), noise.astype(np.uint8))
    result = run("--frames", str(tmp_path), "--terms", "coupling", "-o", str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"gradcheck.json", "random_32x40_coupling.png", f"{tmp_path.name}_coupling.png"}


@pytest.mark.parametrize(("arguments", "message"), [
    (("--terms", "colour"), "unknown term 'colour'"), (("--size", "4x4"), "is not a size"),
    (("--frames", "nowhere"), "no such folder"),
])
def test_bad_input(arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output
