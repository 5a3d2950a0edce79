"""The demonstration: a small stereo video with exact truth, made, solved, scored and drawn; needs no data."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import numpy as np

from cgsf import pipelines
from cgsf.config import to_table
from cgsf.evaluate import INITIAL, Report
from cgsf.formats.files import all_or_nothing
from cgsf.metrics import score
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
        results: dict[str, SceneFlow] = {"zero": pipelines.solve(sample.images, "zero", None)}
        result = pipelines.solve(sample.images, method, config, sample.calibration)
        if result.initial is not None:
            results[method + INITIAL] = result.initial
        results[method] = result
        seconds |= result.seconds
        ahead.join()
        record = {"scene": [FAMILY, SEED], "preset": preset, "settings": to_table(config)}
        write_result(folder, sample.images, result, record, seconds, sample.truth)
    report = Report()
    for name, estimate in results.items():
        took = estimate.seconds.get("total", float("nan"))
        report.frames.append((name, FAMILY, str(SEED), score(estimate, sample.truth), took))
    return report


def compile_ahead() -> None:
    """Compile the kernels of the last stages into the cache on disk, beside a process that is busy with the first ones.

    A fresh install compiles for more than a minute on one core; on two this takes a third of it away.
    """
    from variational.descent import RefineConfig, refine
    from variational.energy import Energy
    from variational.frames import Frames
    from variational.terms.constancy import ConstancyConfig

    height, width = 24, 32
    frames = Frames(*(np.zeros((height, width, 3), np.float32) for _ in range(4)))
    state, everywhere = np.zeros((5, height, width), np.float32), np.ones((height, width), bool)
    refine(frames, state, everywhere, (everywhere, everywhere), RefineConfig(warps=1), ConstancyConfig())
    Energy(frames, backward_flow=np.zeros((height, width, 2), np.float32)).value_and_gradient(state)
