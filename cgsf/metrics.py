"""KITTI's scene flow measures.

An estimate is an **outlier** where its error is above 3 pixels **and** above 5 % of the truth's magnitude:

* D1: disparity at time 1; D2: disparity at time 2 of the same point (D1 + C, on left1's grid); F1: optical flow;
* SF: wrong in any of the three, over pixels where all truths that the data set has are known
  (KITTI 2012 has no second disparity: there SF is D1 or F1).

EPE-D, EPE-F and EPE-C are mean absolute errors of D1, of the flow vector and of the disparity change, in pixels.
A suffix names the pixels: none for all with truth, ``-noc`` for those visible in the other images, ``-bg`` and ``-fg``
for background and objects. Several images are pooled pixel by pixel, as the official kit does. Missing (NaN)
estimates are filled before they are scored, also as the official kit does: see `fill_background`.
Menze and Geiger, Object Scene Flow for Autonomous Vehicles, CVPR 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cgsf.datasets.sample import Truth
from cgsf.errors import InputError
from cgsf.scene_flow import SceneFlow

OUTLIERS = ("D1", "D2", "F1", "SF")
ENDPOINT_ERRORS = ("EPE-D", "EPE-F", "EPE-C")
REGIONS = ("", "-noc", "-bg", "-fg")

_ABSOLUTE_PX = 3.0
_RELATIVE = 0.05


@dataclass(frozen=True)
class Scores:
    """Sums of errors and numbers of pixels by name of the measure; adding two pools their pixels."""

    sums: dict[str, tuple[float, int]] = field(default_factory=dict)

    def __add__(self, other: Scores) -> Scores:
        sums = dict(self.sums)
        for name, (total, count) in other.sums.items():
            before = sums.get(name, (0.0, 0))
            sums[name] = (before[0] + total, before[1] + count)
        return Scores(sums)

    def values(self) -> dict[str, float]:
        """Outliers in %, endpoint errors in pixels; measures without a single pixel are left out."""
        return {
            name: (1 if name.startswith("EPE") else 100) * total / count
            for name, (total, count) in self.sums.items()
            if count
        }


def score(estimate: SceneFlow, truth: Truth) -> Scores:
    """Score one estimate.

    Parameters
    ----------
    estimate : SceneFlow
    truth : Truth
        With NaN where it is unknown; maps that are None are not scored.

    Returns
    -------
    Scores

    Raises
    ------
    InputError
        If the sizes differ.
    """
    errors, outliers = _errors_and_outliers(estimate, truth)
    measures = outliers | errors
    sums = {}
    for region in REGIONS:
        for name, values in measures.items():
            mask = _region(truth, region, name)
            if mask is not None:
                chosen = values[mask & ~np.isnan(values)]
                sums[name + region] = (float(chosen.sum(dtype=np.float64)), chosen.size)
    return Scores(sums)


def outlier_maps(estimate: SceneFlow, truth: Truth) -> dict[str, np.ndarray]:
    """(H, W) maps by name, 1 where the estimate is an outlier, 0 where not, NaN where the truth is unknown; SF last."""
    return _errors_and_outliers(estimate, truth)[1]


def _errors_and_outliers(estimate: SceneFlow, truth: Truth) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    disparity1, flow = fill_background(estimate.disparity1), fill_background(estimate.flow)
    disparity2 = fill_background(estimate.disparity2_on_left1)
    errors, outliers = {}, {}
    if truth.disparity1 is not None:
        errors["EPE-D"], outliers["D1"] = _compare(disparity1, truth.disparity1)
    if truth.disparity2 is not None:
        _, outliers["D2"] = _compare(disparity2, truth.disparity2)
    if truth.flow is not None:
        errors["EPE-F"], outliers["F1"] = _compare(flow, truth.flow)
    if truth.disparity1 is not None and truth.disparity2 is not None:
        errors["EPE-C"], _ = _compare(disparity2 - disparity1, truth.disparity2 - truth.disparity1)
    if "D1" in outliers and "F1" in outliers:
        together = np.stack(list(outliers.values()))  # 0, 1, or NaN where unknown
        outliers["SF"] = np.where(np.isnan(together).any(0), np.nan, together.max(0))
    return errors, outliers


def error_maps(estimate: SceneFlow, truth: Truth) -> dict[str, np.ndarray]:
    """Errors in pixels by name, (H, W) float32 each, NaN where the truth is unknown: ``D1``, ``D2``, ``F1``."""
    pairs = {
        "D1": (estimate.disparity1, truth.disparity1),
        "D2": (estimate.disparity2_on_left1, truth.disparity2),
        "F1": (estimate.flow, truth.flow),
    }
    return {name: _compare(fill_background(got), true)[0] for name, (got, true) in pairs.items() if true is not None}


def _compare(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error in pixels and outlier (0 or 1), both NaN where the truth is unknown; no estimate is an infinite error."""
    if estimate.shape != truth.shape:
        raise InputError(f"the estimate is {estimate.shape[:2]} pixels, the truth {truth.shape[:2]}: two frames")
    difference, magnitude = np.float64(estimate) - truth, np.abs(np.float64(truth))
    if truth.ndim == 3:
        difference, magnitude = np.hypot(*np.moveaxis(difference, -1, 0)), np.hypot(*np.moveaxis(magnitude, -1, 0))
    error = np.where(np.isnan(magnitude), np.nan, np.nan_to_num(np.abs(difference), nan=np.inf))
    wrong = (error > _ABSOLUTE_PX) & (error > _RELATIVE * magnitude)
    return error, np.where(np.isnan(error), np.nan, wrong)


def _region(truth: Truth, region: str, name: str) -> np.ndarray | None:
    """The pixels of a region for one measure; None if the data set does not know them."""
    known = next(array for array in (truth.disparity1, truth.flow, truth.disparity2) if array is not None)
    if region == "":
        return np.ones(known.shape[:2], bool)
    if region in ("-bg", "-fg"):
        return None if truth.objects is None else (truth.objects > 0) == (region == "-fg")
    stereo, flow, change = truth.visible_stereo, truth.visible_flow, truth.visible_change
    if change is None and stereo is not None and flow is not None:
        change = stereo & flow
    needed = {
        "D1": (stereo,), "EPE-D": (stereo,), "D2": (change,), "EPE-C": (stereo, change), "F1": (flow,),
        "EPE-F": (flow,), "SF": (stereo, flow) if truth.disparity2 is None else (stereo, flow, change),
    }[name]  # fmt: skip
    masks = [mask for mask in needed if mask is not None]
    return np.logical_and.reduce(masks) if len(masks) == len(needed) else None


def fill_background(values: np.ndarray) -> np.ndarray:
    """Fill NaN as the official kit does (``interpolateBackground`` of its io_disp.h and io_flow.h).

    A gap in a row takes the smaller of its two ends (component by component), a gap at the image's border the one end
    that it has, rows above the first and below the last filled row take these rows. The kit leaves empty rows between
    filled ones empty; here they take the row above.

    Parameters
    ----------
    values : ndarray (H, W) or (H, W, 2)

    Returns
    -------
    ndarray
        Of the same shape and type; the input itself if it has no NaN, all NaN if it has nothing else.
    """
    known = np.isfinite(values) if values.ndim == 2 else np.isfinite(values).all(-1)
    if known.all():
        return values
    height, width = known.shape
    columns = np.arange(width)
    left = np.maximum.accumulate(np.where(known, columns, -1), 1)
    right = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], 1)[:, ::-1]
    row = np.arange(height)[:, None]
    ends = [values[row, np.clip(index, 0, width - 1)].copy() for index in (left, right)]
    ends[0][left < 0] = np.inf
    ends[1][right == width] = np.inf
    filled = np.minimum(*ends)
    rows = np.flatnonzero(known.any(1))
    if rows.size == 0:
        return np.full_like(values, np.nan)
    source = rows[np.maximum(np.searchsorted(rows, np.arange(height), "right") - 1, 0)]
    return filled[source]
