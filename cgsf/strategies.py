"""The online strategies side by side: the same starts, the same energy; scores, energy left, steps, seconds.

::

    OUT/STRATEGY/FRAME/scene_flow.npz    the refined state; steps.png beside it on request
    OUT/frames.csv                       a row for every strategy and frame
    OUT/table.md, OUT/config.json        means by strategy; what was compared

Chen et al., table 5.
"""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np

import cgsf
from cgsf.config import to_table
from cgsf.datasets import Dataset, Sample
from cgsf.errors import InputError
from cgsf.evaluate import machine
from cgsf.formats.files import write_bytes
from cgsf.intake import to_frames
from cgsf.metrics import ENDPOINT_ERRORS, OUTLIERS, Scores, score
from cgsf.refined import RefinedConfig, Strategist
from cgsf.scene_flow import SceneFlow
from cgsf.starts import make_start
from cgsf.steps_picture import StepsRecorder, write_steps_picture
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames

StrategyName = Literal["learned", "outputs", "parameters"]


@dataclass(frozen=True)
class Outcome:
    """What a strategy made of a frame.

    Parameters
    ----------
    strategy : str
        "start" for what all of them begin with.
    frame : str
    scores : Scores
        Empty without truth.
    energy : float
        The paper's, mean a pixel, with the visible pixels of the start's backward flow.
    steps : int
    seconds : float
        Of the refinement alone; of a start, its own.
    """

    strategy: str
    frame: str
    scores: Scores
    energy: float
    steps: int
    seconds: float


def compare_strategies(
    dataset: Dataset, out: str | Path, config: RefinedConfig, strategies: Sequence[StrategyName], *,
    video: bool = False, pictures: bool = False, watch: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> list[Outcome]:  # fmt: skip
    """Refine every sample's start by several strategies and write the tables.

    Parameters
    ----------
    dataset : Dataset
        Truth is scored where there is some.
    out : str or Path
        An empty or new folder.
    config : RefinedConfig
        Start and settings; ``config.steps`` of 0 lets each strategy take its own number.
    strategies : sequence of {"learned", "outputs", "parameters"}
    video : bool
        The samples are frames that follow each other, in videos named before the last slash of the samples' names:
        "parameters" adapts as it goes, what it has learned on a frame stays for the next ones of the video.
    pictures : bool
        Write ``steps.png`` (learned, outputs); the times are longer then.
    watch : callable
        Wraps the samples' indices, for a progress bar.

    Returns
    -------
    list of Outcome

    Raises
    ------
    InputError
        If weights are missing, the strategies do not fit the start, or `out` is in use.
    """
    out = Path(out)
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty; give another output folder")
    runners = {name: Strategist(replace(config, strategy=name)) for name in dict.fromkeys(strategies)}
    about = {"version": cgsf.__version__, "settings": to_table(config), "strategies": list(runners), "video": video}
    write_bytes(out / "config.json", (json.dumps(about, indent=1) + "\n").encode())
    _warm_up(to_frames(dataset[0].images), config, list(runners))
    outcomes: list[Outcome] = []
    for _, indices in groupby(watch(range(len(dataset))), lambda index: dataset.names[index].rpartition("/")[0]):
        with ExitStack() as stack:
            if video and "parameters" in runners:
                from learned.strategies import restored

                networks = runners["parameters"].networks
                assert networks is not None
                stack.enter_context(restored(networks))
            for index in indices:
                outcomes += _refine_all(dataset[index], config, runners, out, video, pictures)
    write_bytes(out / "frames.csv", _frames_table(outcomes).encode())
    write_bytes(out / "table.md", f"{machine()}\n\n{strategies_table(outcomes)}\n".encode())
    return outcomes


def strategies_table(outcomes: Sequence[Outcome]) -> str:
    """A Markdown table: measures pooled over pixels, energy, steps and seconds as means over frames."""
    names = [*OUTLIERS, *ENDPOINT_ERRORS]
    lines = ["| strategy | frames | " + " | ".join(names) + " | energy | steps | seconds |"]
    lines.append("|---|---|" + "---:|" * (len(names) + 3))
    for strategy in dict.fromkeys(outcome.strategy for outcome in outcomes):
        chosen = [outcome for outcome in outcomes if outcome.strategy == strategy]
        values = sum((outcome.scores for outcome in chosen), Scores()).values()
        cells = [f"{values[name]:.2f}" if name in values else "" for name in names]
        energy, seconds = (np.mean([getattr(outcome, name) for outcome in chosen]) for name in ("energy", "seconds"))
        lines.append(f"| {strategy} | {len(chosen)} | " + " | ".join(cells)
                     + f" | {energy:.4f} | {chosen[0].steps} | {seconds:.3f} |")  # fmt: skip
    return "\n".join(lines)


def _refine_all(
    sample: Sample, config: RefinedConfig, runners: dict[StrategyName, Strategist], out: Path, video: bool, pictures: bool
) -> Iterator[Outcome]:
    frames = to_frames(sample.images)
    camera = None if sample.calibration is None else sample.calibration.camera()
    begin = time.perf_counter()
    start = make_start(frames, config, camera)
    start_seconds = time.perf_counter() - begin
    energy = Energy(frames, EnergyConfig(), backward_flow=start.backward_flow)

    def outcome(strategy: str, result: SceneFlow, steps: int, seconds: float) -> Outcome:
        state = np.nan_to_num(result.state(), posinf=0, neginf=0)
        scores = Scores() if sample.truth is None else score(result, sample.truth)
        return Outcome(strategy, sample.name, scores, float(energy.value_and_gradient(state)[0].mean()), steps, seconds)

    yield outcome("start", start, 0, start_seconds)
    for name, runner in runners.items():
        recorder = StepsRecorder(runner.steps) if pictures and name != "parameters" else None
        adapting = video and name == "parameters"
        result = runner.adapt(frames, start) if adapting else runner(frames, start, camera, recorder)
        label = "parameters, adapting" if adapting else name
        folder = out / name / sample.name
        folder.mkdir(parents=True, exist_ok=True)
        result.save_maps(folder / "scene_flow.npz")
        if recorder:
            write_steps_picture(folder / "steps.png", recorder.kept, sample.truth)
        yield outcome(label, result, runner.steps, result.seconds["refinement"])


def _warm_up(frames: Frames, config: RefinedConfig, strategies: Sequence[StrategyName]) -> None:
    """One step of each, so that no time contains compilation."""
    start = make_start(frames, config)
    for name in strategies:
        Strategist(replace(config, strategy=name, steps=1))(frames, start)


def _frames_table(outcomes: Sequence[Outcome]) -> str:
    names = [*OUTLIERS, *ENDPOINT_ERRORS]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["strategy", "frame", *names, "energy", "steps", "seconds"])
    for outcome in outcomes:
        values = outcome.scores.values()
        cells = [f"{values[name]:.6g}" if name in values else "" for name in names]
        numbers = (f"{outcome.energy:.6g}", outcome.steps, f"{outcome.seconds:.4g}")
        writer.writerow([outcome.strategy, outcome.frame, *cells, *numbers])
    return text.getvalue()
