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
    """The same as a PNG: a panel for each method, a line in it for each group."""
    from matplotlib.figure import Figure

    groups, methods = (list(dict.fromkeys(names)) for names in zip(*curves, strict=True))
    figure = Figure(figsize=(2.2 + 3.6 * len(methods), 3.8), layout="constrained")
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    for axes, method in zip(panels, methods, strict=True):
        for index, group in enumerate(groups):
            if (group, method) in curves:
                values = curves[group, method].values()
                shares = [values[str(dropped)] for dropped in DROPPED]
                axes.plot(DROPPED, shares, color=f"C{index}", marker="o", markersize=4, label=group)
        axes.set(title=method, xlabel="least confident pixels dropped, %", ylim=(0, None))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("outliers among the others, SF in %")
    handles = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside right center", frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=130)
    return out.getvalue()
