"""Does a data set's truth fit its images? A wrong sign, unit or pairing shows as soon as one warps with it.

The truth warps right1, left2 and right2 to left1's grid. If it is right, the warped image is much closer to left1 than
with a wrong truth: the same with the opposite sign, none at all, twice and half of it. A sample passes when its truth
beats them all.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from cgsf.datasets.sample import Sample

#: A truth must beat every wrong variant by this factor; equal residuals (no texture, no motion) are no evidence.
_MARGIN = 1.05
#: Where fewer pixels can be compared, nothing is said.
_FEWEST = 200
_WRONG = {"has the opposite sign": -1.0, "is not this image's": 0.0, "is half of it": 2.0, "is twice of it": 0.5}


@dataclass(frozen=True)
class Finding:
    """What was found for one quantity of a sample.

    Parameters
    ----------
    quantity : str
        ``disparity1``, ``flow``, ``disparity2``.
    residual : float
        Median absolute difference between left1 and the warped image, in [0, 1]; NaN if nothing could be compared.
    complaint : str
        Empty if the truth is the best of all variants.
    """

    quantity: str
    residual: float
    complaint: str


def _warp_error(
    target: np.ndarray, source: np.ndarray, shift: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Absolute difference per pixel after moving `source` by `shift` (H, W, 2), and where it exists."""
    height, width = shift.shape[:2]
    place = np.moveaxis(np.indices((height, width), np.float32)[::-1], 0, -1) + np.nan_to_num(shift).astype(np.float32)
    inside = (place[..., 0] >= 0) & (place[..., 1] >= 0) & (place[..., 0] <= width - 1) & (place[..., 1] <= height - 1)
    warped = cv2.remap(source, place[..., 0], place[..., 1], cv2.INTER_LINEAR).reshape(target.shape)
    return np.abs(warped - target).mean(-1), inside & wanted & np.isfinite(shift).all(-1)


def _judge(
    quantity: str, target: np.ndarray, source: np.ndarray, base: np.ndarray, shift: np.ndarray, wanted: np.ndarray
) -> Finding:
    """Compare ``base + shift`` with ``base + factor * shift`` on the pixels that both can see."""
    error, valid = _warp_error(target, source, base + shift, wanted)
    moved = valid & (np.linalg.norm(np.nan_to_num(shift), axis=-1) > 1.5)
    if moved.sum() < _FEWEST:
        return Finding(quantity, float(np.median(error[valid])) if valid.sum() >= _FEWEST else float("nan"), "")
    rivals = {}
    for name, factor in _WRONG.items():
        other, seen = _warp_error(target, source, base + factor * shift, moved)
        if seen.sum() >= _FEWEST:
            rivals[name] = float(error[seen].mean()) / max(float(other[seen].mean()), 1e-9)
    worst = max(rivals, key=lambda name: rivals[name], default="")
    complaint = ""
    if worst and rivals[worst] > 1 / _MARGIN:
        complaint = (
            f"{quantity}: images fit better if the truth {worst}"
            if rivals[worst] > 1
            else f"{quantity}: not told from a truth that {worst}"
        )
    return Finding(quantity, float(np.median(error[moved])), complaint)


def check_sample(sample: Sample) -> list[Finding]:
    """Findings for every quantity of the truth that a sample has; occluded pixels are left out where that is known."""
    truth = sample.truth
    findings: list[Finding] = []
    if truth is None:
        return findings

    def visible(mask: np.ndarray | None) -> np.ndarray:
        return np.ones(sample.left1.shape[:2], bool) if mask is None else mask

    def sideways(disparity: np.ndarray) -> np.ndarray:
        return np.stack([-disparity, np.zeros_like(disparity)], -1)

    nowhere = np.zeros((*sample.left1.shape[:2], 2), np.float32)
    if truth.disparity1 is not None:
        findings.append(
            _judge(
                "disparity1",
                sample.left1,
                sample.right1,
                nowhere,
                sideways(truth.disparity1),
                visible(truth.visible_stereo),
            )
        )
    if truth.flow is not None:
        findings.append(_judge("flow", sample.left1, sample.left2, nowhere, truth.flow, visible(truth.visible_flow)))
        if truth.disparity2 is not None:
            seen = visible(truth.visible_flow if truth.visible_change is None else truth.visible_change)
            findings.append(
                _judge("disparity2", sample.left1, sample.right2, truth.flow, sideways(truth.disparity2), seen)
            )
    if truth.disparity_left2 is not None:
        everywhere = np.ones(sample.left2.shape[:2], bool)
        findings.append(
            _judge("disparity_left2", sample.left2, sample.right2, nowhere, sideways(truth.disparity_left2), everywhere)
        )
    return findings
