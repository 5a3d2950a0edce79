"""One run on four image files: read, solve, write everything that people and other tools want."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cgsf
from cgsf import pipelines
from cgsf.calibration import Calibration
from cgsf.config import to_table
from cgsf.datasets import Truth
from cgsf.formats.files import all_or_nothing, write_bytes
from cgsf.formats.images import read_image, to_bytes
from cgsf.scene_flow import SceneFlow


def run(
    paths: Sequence[str | Path],
    out: str | Path,
    method: str = "variational",
    preset: str = "default",
    calibration: str | Path | None = None,
    progress: pipelines.Progress | None = None,
    device: str | None = None,
    settings: dict[str, Any] | None = None,
) -> SceneFlow:
    """Scene flow of four image files, with all its files.

    Parameters
    ----------
    paths : four paths
        left1, right1, left2, right2.
    out : str or Path
        Folder for ``scene_flow.npz``, ``disp_0.png``, ``disp_1.png``, ``flow.png``, ``overview.png``, ``run.json``, and
        with a calibration ``points.ply``. They appear together at the end, or not at all.
    method, preset : str
        As for :func:`cgsf.estimate`.
    calibration : str or Path, optional
        A calibration file.
    progress : callable, optional
    device : str, optional
        For methods with networks: any device of torch, as cpu, cuda or mps.
    settings : dict, optional
        Replace the preset's settings of the method; values that are None do not.

    Returns
    -------
    SceneFlow

    Raises
    ------
    InputError
        For whatever cannot be read, solved or written.
    """
    config = pipelines.on_device(pipelines.load_config(method, preset), device)
    config = pipelines.with_settings(config, settings or {})
    with all_or_nothing(out) as folder:
        start = time.perf_counter()
        camera = None if calibration is None else Calibration.read(calibration)
        images = [read_image(path) for path in paths]
        seconds = {"reading": time.perf_counter() - start}
        result = pipelines.solve(images, method, config, camera, progress)
        seconds |= result.seconds
        record = {"images": [str(path) for path in paths], "preset": preset, "settings": to_table(config)}
        write_result(folder, images, result, record, seconds)
    return result


def write_result(
    folder: Path,
    images: Sequence[Any],
    result: SceneFlow,
    record: dict[str, Any],
    seconds: dict[str, float],
    truth: Truth | None = None,
) -> None:
    """Write a result with its picture and its ``run.json``; `record` and `seconds` go into the latter."""
    from cgsf.visualise import overview

    frames = pipelines.to_frames(images)
    start = time.perf_counter()
    result = replace(result, loss=pipelines.consistency_loss(frames, result))
    seconds["loss map"] = time.perf_counter() - start
    start = time.perf_counter()
    result.save(folder, to_bytes(frames.left1))
    seconds["writing"] = time.perf_counter() - start
    start = time.perf_counter()
    title = f"{result.method}, solved in {result.seconds['total']:.2f} s"
    write_bytes(folder / "overview.png", overview(images, result, truth, title))
    seconds["picture"] = time.perf_counter() - start
    motion = result.camera_motion
    height, width = result.shape
    content = {
        "version": cgsf.__version__,
        "method": result.method,
        **record,
        "size": [width, height],
        "calibration": None if result.calibration is None else result.calibration.to_dict(),
        "camera_motion": None if motion is None else motion.tolist(),
        "seconds": seconds,
        **result.record,
    }
    write_bytes(folder / "run.json", (json.dumps(content, indent=1, default=float) + "\n").encode())
