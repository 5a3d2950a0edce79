"""The demonstration: a small stereo video with exact truth, made, solved, scored and drawn; needs no data."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import cv2
import numpy as np

from cgsf import pipelines
from cgsf.config import to_table
from cgsf.evaluate import INITIAL, Report
from cgsf.formats.files import all_or_nothing
from cgsf.run import write_result
from cgsf.scene_flow import SceneFlow

FAMILY, SEED, HEIGHT, WIDTH = "street", 7, 192, 512


def demo(out: str | Path, method: str = "variational", preset: str = "default") -> Report:
    """Make a stereo video, solve it, score it beside doing nothing and beside the method's own start.

    Parameters
    ----------
    out : str or Path
        Folder for the files of :func:`cgsf.run.run`; the picture has error maps, for the truth is known.
    method, preset : str

    Returns
    -------
    Report
        One frame, two or three methods.
    """
    from cgsf.synthetic import make_sample

    config = pipelines.load_config(method, preset)
    ahead = multiprocessing.get_context("spawn").Process(target=compile_ahead, daemon=True)
    ahead.start()
    with all_or_nothing(out) as folder:
        start = time.perf_counter()
        sample = make_sample(FAMILY, SEED, HEIGHT, WIDTH)
        assert sample.truth is not None  # a made scene knows its truth
        seconds = {"making the scene": time.perf_counter() - start}
        compile_energy()
        ahead.join()
        results: dict[str, SceneFlow] = {"zero": pipelines.solve(sample.images, "zero", None)}
        result = pipelines.solve(sample.images, method, config, sample.calibration)
        if result.initial is not None:
            results[method + INITIAL] = result.initial
        results[method] = result
        seconds |= result.seconds
        record = {"scene": [FAMILY, SEED], "preset": preset, "settings": to_table(config)}
        write_result(folder, sample.images, result, record, seconds, sample.truth)
    report = Report()
    for name, estimate in results.items():
        report.add(name, FAMILY, str(SEED), estimate, sample.truth, estimate.seconds)
    return report


def compile_ahead() -> None:
    """Solve a tiny scene, beside a process that is busy with rendering: afterwards the solver's kernels are on disk.

    A fresh install compiles for more than a minute on one core; so it does on both.
    """
    from variational.camera import StereoCamera
    from variational.frames import Frames
    from variational.solver import solve

    rng = np.random.default_rng(0)
    wall, box = (cv2.GaussianBlur(rng.random((64, 160, 3)), (0, 0), 1.5).astype(np.float32) for _ in range(2))
    moved = ((0, 0), (-4, -12), (2, -3), (-2, -15))  # left1, right1, left2, right2: columns of the wall, of the box
    views = [np.roll(wall, at, 1) for at, _ in moved]
    for view, (_, at) in zip(views, moved, strict=True):
        view[16:48, 60 + at : 100 + at] = box[16:48, 60:100]
    solve(Frames(*views), camera=StereoCamera(100.0, 100.0, 80.0, 32.0, 1.0))


def compile_energy() -> None:
    """The energy's kernels, which the picture's loss map asks for."""
    from variational.energy import Energy
    from variational.frames import Frames

    frames = Frames(*(np.zeros((24, 32, 3), np.float32) for _ in range(4)))
    Energy(frames, backward_flow=np.zeros((24, 32, 2), np.float32)).value_and_gradient(np.zeros((5, 24, 32), np.float32))
