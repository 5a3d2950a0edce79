"""Scoring methods on a data set: predict and keep, then score.

::

    OUT/METHOD/config.json                          what made the predictions below
    OUT/METHOD/GROUP/FRAME/scene_flow.npz           a prediction; solved.json beside it has the time
    OUT/frames.csv                                  a row for every method and frame
    OUT/scores.json, OUT/table.md                   pooled by group and method
    OUT/stages.md                                   median seconds of every stage
    OUT/confidence.md, OUT/confidence.png           outliers when the least confident pixels are dropped

A frame that has a prediction is not solved again; predictions of another configuration are refused, never mixed. The
group is the data set's name, or what comes before the slash in a sample's name.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import os
import platform
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import cgsf
from cgsf import pipelines, sparsification
from cgsf.config import to_table
from cgsf.datasets import Dataset, Sample, Truth, open_dataset
from cgsf.errors import InputError
from cgsf.formats.files import read_bytes, write_bytes
from cgsf.metrics import ENDPOINT_ERRORS, OUTLIERS, REGIONS, Scores, score
from cgsf.scene_flow import SceneFlow

logger = logging.getLogger(__name__)

INITIAL = "+initial"  # a method's starting state is scored under the method's name with this suffix

#: Data sets of `report_all`, each in a folder of its name.
REPORTED = ("kitti2015", "kitti2012", "frames", "rendered")


@dataclass
class Report:
    """Scores of methods on frames.

    Parameters
    ----------
    frames : list of (method, group, frame, Scores, seconds)
        ``seconds`` is the solving's; NaN where that is not known.
    failures : dict
        One line by frame that could not be scored (with ``keep_going``).
    stages : list of (method, group, seconds by stage)
        Of the frames whose times are known.
    curves : dict
        By (group, method): `cgsf.sparsification.sparsify`, pooled, of the methods that give a confidence.
    """

    frames: list[tuple[str, str, str, Scores, float]] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)
    stages: list[tuple[str, str, dict[str, float]]] = field(default_factory=list)
    curves: dict[tuple[str, str], Scores] = field(default_factory=dict)

    def add(self, method: str, group: str, frame: str, estimate: SceneFlow, truth: Truth, seconds: dict[str, float]) -> None:
        """Score one estimate; `seconds` by stage, may be empty."""
        self.frames.append((method, group, frame, score(estimate, truth), float(seconds.get("total", np.nan))))
        if seconds:
            self.stages.append((method, group, seconds))
        if estimate.confidence is not None:
            self.curves[group, method] = self.curves.get((group, method), Scores()) + sparsification.sparsify(estimate, truth)

    def pooled(self) -> dict[tuple[str, str], dict[str, float]]:
        """By (group, method): measures pooled over pixels, ``seconds`` (the mean) and ``frames`` (how many)."""
        result = {}
        for group, method in dict.fromkeys((row[1], row[0]) for row in self.frames):
            rows = [row for row in self.frames if (row[1], row[0]) == (group, method)]
            scores = sum((row[3] for row in rows), Scores())
            seconds = sum(row[4] for row in rows) / len(rows)
            timed = {"seconds": seconds} if np.isfinite(seconds) else {}
            result[group, method] = {**scores.values(), **timed, "frames": len(rows)}
        return result

    def table(self) -> str:
        """The pooled outliers, endpoint errors and seconds as a Markdown table."""
        names = [*OUTLIERS, "SF-noc", *ENDPOINT_ERRORS, "seconds"]
        lines = ["| set | frames | method | " + " | ".join(names) + " |", "|---|---|---|" + "---:|" * len(names)]
        for (group, method), values in sorted(self.pooled().items(), key=lambda item: item[0][0]):
            cells = [f"{values[name]:.2f}" if np.isfinite(values.get(name, np.nan)) else "" for name in names]
            lines.append(f"| {group} | {values['frames']} | {method} | " + " | ".join(cells) + " |")
        return "\n".join(lines)

    def stage_table(self) -> str:
        """Median seconds of each stage by set and method, as a Markdown table."""
        names = list(dict.fromkeys(name for _, _, seconds in self.stages for name in seconds))
        lines = ["| set | method | " + " | ".join(names) + " |", "|---|---|" + "---:|" * len(names)]
        for group, method in dict.fromkeys((row[1], row[0]) for row in self.stages):
            rows = [seconds for other, of, seconds in self.stages if (of, other) == (group, method)]
            times = [[seconds[name] for seconds in rows if name in seconds] for name in names]
            lines.append(f"| {group} | {method} | " + " | ".join(f"{np.median(t):.3f}" if t else "" for t in times) + " |")
        return "\n".join(lines)

    def write(self, out: str | Path) -> None:
        """Write every table and picture that the module names into `out`."""
        out = Path(out)
        measures = [name + region for region in REGIONS for name in (*OUTLIERS, *ENDPOINT_ERRORS)]
        used = [name for name in measures if any(name in row[3].values() for row in self.frames)]
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["method", "set", "frame", *used, "seconds"])
        for method, group, frame, scores, seconds in self.frames:
            values = scores.values()
            cells = (f"{values[name]:.6g}" if name in values else "" for name in used)
            writer.writerow([method, group, frame, *cells, f"{seconds:.4g}"])
        write_bytes(out / "frames.csv", text.getvalue().encode())
        pooled = [{"set": group, "method": method, **values} for (group, method), values in self.pooled().items()]
        record = {"machine": machine(), "scores": pooled, "failures": self.failures}
        write_bytes(out / "scores.json", (json.dumps(record, indent=1) + "\n").encode())
        write_bytes(out / "table.md", (f"{machine()}\n\n{self.table()}\n").encode())
        if self.stages:
            write_bytes(out / "stages.md", (f"{machine()}\n\n{self.stage_table()}\n").encode())
        if self.curves:
            write_bytes(out / "confidence.md", (sparsification.table(self.curves) + "\n").encode())
            write_bytes(out / "confidence.png", sparsification.picture(self.curves))


def evaluate(
    dataset: Dataset,
    name: str,
    out: str | Path,
    methods: Sequence[str] = ("variational",),
    preset: str = "default",
    *,
    keep_going: bool = False,
    initial: bool = False,
    pictures: bool = False,
    watch: Callable[[Iterable[int]], Iterable[int]] = iter,
    report: Report | None = None,
) -> Report:
    """Predict what is not yet predicted, score everything, write the tables.

    Parameters
    ----------
    dataset : Dataset
        With truth.
    name : str
        The data set's name: the group of samples that name none.
    out : str or Path
        The folder of the results.
    methods : sequence of str
        Keys of :data:`cgsf.pipelines.METHODS`.
    preset : str
    keep_going : bool
        Leave out frames that cannot be read or solved, in place of stopping at the first.
    initial : bool
        Keep and score the state that each method started from, too.
    pictures : bool
        Write ``overview.png`` beside each new prediction.
    watch : callable
        Wraps the frames' indices, for a progress bar.
    report : Report, optional
        Goes on with this one, so that several data sets make one table.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        If a frame has no truth or cannot be solved, or if `out` holds predictions of another configuration.
    """
    out, report = Path(out), report or Report()
    configs = {method: pipelines.load_config(method, preset) for method in methods}
    for method, config in configs.items():
        _claim(out / method, method, config)
    for index in watch(range(len(dataset))):
        sample_name = dataset.names[index]
        group, _, frame = sample_name.rpartition("/")
        group = group or name
        try:
            sample = dataset[index]
            if sample.truth is None:
                raise InputError("has no truth to score with")
            for method, config in configs.items():
                place = Path(group) / frame
                _predict(sample, method, config, out, place, initial, pictures)
                for label in [method, method + INITIAL] if initial else [method]:
                    if (out / label / place / "scene_flow.npz").is_file():
                        prediction = SceneFlow.load(out / label / place)
                        seconds = _solved(out / label / place).get("seconds", {})
                        report.add(label, group, frame, prediction, sample.truth, seconds)
        except InputError as error:
            if not keep_going:
                raise InputError(f"{sample_name}: {error}") from None
            report.failures[sample_name] = str(error)
            logger.warning("%s left out: %s", sample_name, error)
    if not report.frames:
        raise InputError("not a single frame could be scored")
    report.write(out)
    return report


def report_all(
    root: str | Path,
    out: str | Path,
    methods: Sequence[str],
    preset: str = "default",
    *,
    initial: bool = False,
    watch: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Report:
    """`evaluate` on every data set that `root` holds in a folder of its name, all in one table.

    The first frame is solved once by each method beforehand and thrown away, so that all times are warm.
    """
    root, report = Path(root), Report()
    names = [name for name in REPORTED if (root / name).is_dir()]
    if not names:
        raise InputError(f"{root}: holds none of the folders {', '.join(REPORTED)}")
    first = open_dataset(names[0], root / names[0])[0]
    for method in methods:
        pipelines.solve(first.images, method, pipelines.load_config(method, preset), first.calibration)
    for name in names:
        dataset = open_dataset(name, root / name)
        report = evaluate(dataset, name, out, methods, preset, initial=initial, watch=watch, report=report)
    return report


def machine() -> str:
    """The machine in one line: processor, number of threads, version."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), processor)
    except OSError:  # not Linux
        pass
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"cgsf {cgsf.__version__}, {processor}, {threads} threads"


def _claim(folder: Path, method: str, config: Any) -> None:
    """Mark `folder` as made by this configuration, or refuse it if another one made it."""
    ours = {"version": cgsf.__version__, "method": method, "settings": to_table(config)}
    path = folder / "config.json"
    if not path.exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise InputError(f"{folder}: holds files of something else; give another output folder")
        write_bytes(path, (json.dumps(ours, indent=1) + "\n").encode())
        return
    try:
        theirs = json.loads(read_bytes(path))
    except ValueError:
        raise InputError(f"{path}: damaged; give another output folder") from None
    differing = _differences(json.loads(json.dumps(ours)), theirs)
    if differing:
        raise InputError(f"{folder}: made with another configuration ({differing[0]}); give another output folder")


def _differences(ours: Any, theirs: Any, where: str = "") -> list[str]:
    if isinstance(ours, dict) and isinstance(theirs, dict):
        keys = dict.fromkeys([*ours, *theirs])
        found = [_differences(ours.get(key), theirs.get(key), f"{where}.{key}" if where else key) for key in keys]
        return [line for lines in found for line in lines]
    return [] if ours == theirs else [f"{where} was {theirs!r} and is {ours!r} now"]


def _predict(sample: Sample, method: str, config: Any, out: Path, place: Path, initial: bool, pictures: bool) -> None:
    """Solve one frame unless everything asked for is there already; keep its maps and its time."""
    folder, images = out / method / place, _checksum(sample)
    if (folder / "scene_flow.npz").is_file() and _solved(folder).get("images", images) != images:
        raise InputError(f"{folder}: is the prediction of other images; give another output folder")
    has_initial = not initial or (out / (method + INITIAL) / place / "scene_flow.npz").is_file()
    if (folder / "scene_flow.npz").is_file() and has_initial:
        return
    result = pipelines.solve(sample.images, method, config, sample.calibration)
    if initial and result.initial is not None:
        _keep(result.initial, out / (method + INITIAL) / place, {"images": images})
    if pictures:
        from cgsf.visualise import overview

        shown = replace(result, loss=pipelines.consistency_loss(pipelines.to_frames(sample.images), result))
        write_bytes(folder / "overview.png", overview(sample.images, shown, sample.truth, f"{sample.name}, {method}"))
    _keep(result, folder, {"images": images, "seconds": result.seconds})


def _checksum(sample: Sample) -> int:
    """A number that tells one frame's images from another's."""
    checksum = 0
    for image in sample.images:
        checksum = zlib.crc32(image.tobytes(), checksum)
    return checksum


def _keep(result: SceneFlow, folder: Path, record: dict[str, Any]) -> None:
    """The record first, so that a prediction that is there is whole."""
    write_bytes(folder / "solved.json", (json.dumps(record) + "\n").encode())
    result.save_maps(folder / "scene_flow.npz")


def _solved(folder: Path) -> dict[str, Any]:
    """The record beside a prediction; empty where there is none, as beside other programs' predictions."""
    try:
        record = json.loads((folder / "solved.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
