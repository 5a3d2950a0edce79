"""Does the confidence know? Outliers among the pixels that are left when the least confident ones are dropped.

The curve must fall; how far it can fall is bounded by the share that is wrong (Ilg et al., Uncertainty Estimates for
Optical Flow, ECCV 2018, section 5).
"""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np

from cgsf.datasets.sample import Truth
from cgsf.metrics import Scores, outlier_maps
from cgsf.scene_flow import SceneFlow

#: Dropped shares of the pixels, in %.
DROPPED = (0, 10, 20, 30, 40, 50)


def sparsify(estimate: SceneFlow, truth: Truth) -> Scores:
    """SF (F1 or D1 where the data set knows no more) of what is left of one frame, by dropped share in %.

    Parameters
    ----------
    estimate : SceneFlow
        With a confidence.
    truth : Truth

    Returns
    -------
    Scores
        Sums named ``"0"``, ``"10"``, ...; pixels of equal confidence are dropped in the order of the rows.
    """
    assert estimate.confidence is not None
    wrong = next(reversed(outlier_maps(estimate, truth).values()))
    known = ~np.isnan(wrong)
    order = np.argsort(estimate.confidence[known], kind="stable")
    values = wrong[known][order]
    kept = {dropped: values[round(values.size * dropped / 100) :] for dropped in DROPPED}
    return Scores({str(dropped): (float(left.sum()), left.size) for dropped, left in kept.items()})


def table(curves: Mapping[tuple[str, str], Scores]) -> str:
    """By (group, method): a Markdown table, outliers in %."""
    lines = ["| set | method | " + " | ".join(f"{dropped} % dropped" for dropped in DROPPED) + " |"]
    lines.append("|---|---|" + "---:|" * len(DROPPED))
    for (group, method), scores in curves.items():
        values = scores.values()
        lines.append(f"| {group} | {method} | " + " | ".join(f"{values[str(dropped)]:.2f}" for dropped in DROPPED) + " |")
    return "\n".join(lines)


def picture(curves: Mapping[tuple[str, str], Scores]) -> bytes:
    """The same as a PNG: one line for each group and method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    methods = {method for _, method in curves}
    for (group, method), scores in curves.items():
        values = scores.values()
        label = group if len(methods) == 1 else f"{group}, {method}"
        axes.plot(DROPPED, [values[str(dropped)] for dropped in DROPPED], marker="o", markersize=4, label=label)
    axes.set(xlabel="least confident pixels dropped, %", ylabel="outliers among the others, SF in %", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=130)
    return out.getvalue()
