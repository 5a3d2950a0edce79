"""A picture of a refinement: each step's energy, the gradient's size, what the step changed, and how wrong it is."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cgsf.datasets.sample import Truth
from cgsf.formats.files import write_bytes
from cgsf.metrics import error_maps, score
from cgsf.scene_flow import SceneFlow
from cgsf.visualise import error_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from torch import Tensor

#: The changes are shown up to this size, in pixels.
LARGEST_CHANGE_PX = 5.0
#: No more steps than these are kept and shown, evenly spread.
MOST_STEPS = 11


class Step(NamedTuple):
    """What is known of X_t."""

    number: int
    state: np.ndarray
    """(5, H, W) in pixels."""
    loss: np.ndarray
    """The energy's map, (H, W)."""
    gradient: np.ndarray
    """Of the energy's sum by the state, (5, H, W)."""


class StepsRecorder:
    """Keeps what a strategy's ``watch`` sees of the first sample, for at most `MOST_STEPS` of ``0 ... steps``."""

    def __init__(self, steps: int) -> None:
        self.wanted = {round(t) for t in np.linspace(0, steps, min(steps + 1, MOST_STEPS))}
        self.kept: list[Step] = []

    def __call__(self, step: int, state: Tensor, loss: Tensor | None, gradient: Tensor | None) -> None:
        if step in self.wanted:
            assert loss is not None
            assert gradient is not None
            self.kept.append(Step(step, *(maps[0].float().cpu().numpy().copy() for maps in (state, loss, gradient))))


def write_steps_picture(path: str | Path, steps: Sequence[Step], truth: Truth | None = None) -> None:
    """Write a .png with one row a step.

    Parameters
    ----------
    path : str or Path
    steps : sequence of Step
        At least one.
    truth : Truth, optional
        Adds the largest of the errors of D1, D2 and the flow.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from matplotlib.figure import Figure

    height, width = steps[0].loss.shape
    columns = 3 if truth is None else 4
    figure = Figure(figsize=(5 * columns, len(steps) * (5 * height / width + 0.35)), layout="constrained")
    grid = figure.subplots(len(steps), columns, squeeze=False)
    brightest = max(float(np.percentile(steps[0].loss, 99)), 1e-6)
    for row, step, before in zip(grid, steps, [None, *steps], strict=False):
        size = np.abs(step.gradient).sum(0)
        row[0].imshow(step.loss, cmap="magma", vmin=0, vmax=brightest)
        row[0].set_title(f"step {step.number}: energy, mean {step.loss.mean():.4g}")
        row[1].imshow(size, cmap="viridis", vmin=0, vmax=max(float(np.percentile(size, 99)), 1e-6))
        row[1].set_title("gradient, sum of absolute values")
        if before is not None:
            change = np.abs(step.state - before.state).max(0)
            row[2].imshow(change, cmap="inferno", vmin=0, vmax=LARGEST_CHANGE_PX)
            row[2].set_title(f"largest change, mean {change.mean():.3g} px, shown to {LARGEST_CHANGE_PX:g}")
        if truth is not None:
            _show_error(row[3], step.state, truth)
        for axes in row:
            axes.set_axis_off()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=80)
    write_bytes(path, content.getvalue())


def _show_error(axes: Axes, state: np.ndarray, truth: Truth) -> None:
    estimate = SceneFlow.from_state(state, np.ones(state.shape[1:], bool))
    axes.imshow(error_colours(np.max(list(error_maps(estimate, truth).values()), 0)))
    outliers = score(estimate, truth).values()
    axes.set_title("largest error; " + ", ".join(f"{name} {outliers[name]:.2f} %" for name in ("SF",) if name in outliers))
