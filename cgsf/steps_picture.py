"""A picture of a refinement: each step's energy, the gradient's size, and what the step changed."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cgsf.formats.files import write_bytes

#: The changes are shown up to this size, in pixels.
LARGEST_CHANGE_PX = 5.0


def write_steps_picture(path: str | Path, steps: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Write a .png with one row a step.

    Parameters
    ----------
    path : str or Path
    steps : sequence of mappings
        For t = 0 ... T: ``state`` (5, H, W), ``loss`` (H, W) and ``gradient`` (5, H, W) at X_t.

    Raises
    ------
    ValueError
        Without a step.
    InputError
        If the file cannot be written.
    """
    if not steps:
        raise ValueError("there is no step to show")
    from matplotlib.figure import Figure

    height, width = steps[0]["loss"].shape
    figure = Figure(figsize=(15, len(steps) * (5 * height / width + 0.35)), layout="constrained")
    grid = figure.subplots(len(steps), 3, squeeze=False)
    brightest = max(float(np.percentile(steps[0]["loss"], 99)), 1e-6)
    for t, (row, step) in enumerate(zip(grid, steps, strict=True)):
        size = np.abs(step["gradient"]).sum(0)
        row[0].imshow(step["loss"], cmap="magma", vmin=0, vmax=brightest)
        row[0].set_title(f"step {t}: energy, mean {step['loss'].mean():.4g}")
        row[1].imshow(size, cmap="viridis", vmin=0, vmax=max(float(np.percentile(size, 99)), 1e-6))
        row[1].set_title("gradient, sum of absolute values")
        if t > 0:
            change = np.abs(step["state"] - steps[t - 1]["state"]).max(0)
            row[2].imshow(change, cmap="inferno", vmin=0, vmax=LARGEST_CHANGE_PX)
            row[2].set_title(f"largest change, mean {change.mean():.3g} px, shown to {LARGEST_CHANGE_PX:g}")
        for axes in row:
            axes.set_axis_off()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=80)
    write_bytes(path, content.getvalue())
