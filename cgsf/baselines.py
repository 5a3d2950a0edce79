"""What one would take instead: OpenCV's stereo matching and optical flow put together, no energy, no refinement.

Disparities of both pairs from semi-global matching (Hirschmueller, PAMI 2008), raw with holes filled from the
background or through the weighted-least-squares filter; flow from one of OpenCV's dense methods; the disparity change
is the second disparity sampled at the flow's end, minus the first.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from cgsf.formats.images import to_bytes
from cgsf.metrics import fill_background
from cgsf.scene_flow import SceneFlow
from variational.camera import StereoCamera
from variational.frames import Frames

FLOWS: dict[str, Callable[[], Any]] = {
    "dis": lambda: cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "deepflow": lambda: cv2.optflow.createOptFlow_DeepFlow(),
    "rlof": lambda: cv2.optflow.createOptFlow_DenseRLOF(),
    "farneback": lambda: cv2.FarnebackOpticalFlow.create(numLevels=7, winSize=21),
}


@dataclass(frozen=True)
class CompositionConfig:
    """A composition of OpenCV's methods.

    Parameters
    ----------
    flow : {"dis", "deepflow", "rlof", "farneback"}
        The optical flow.
    filtered : bool
        Filter the disparities by weighted least squares, guided by the image.
    disparities : int
        Largest disparity searched, in pixels; a multiple of 16.
    """

    flow: Literal["dis", "deepflow", "rlof", "farneback"] = "dis"
    filtered: bool = False
    disparities: int = 192


def compose(
    frames: Frames, config: CompositionConfig, camera: StereoCamera | None = None, progress: object = None
) -> SceneFlow:
    """Scene flow by a composition; everything that leaves the image counts as not visible, nothing else does."""
    left1, left2 = to_bytes(frames.left1), to_bytes(frames.left2)
    disparity1 = _disparity(left1, to_bytes(frames.right1), config)
    disparity2 = _disparity(left2, to_bytes(frames.right2), config)
    pair = (left1, left2)  # sparse-to-dense RLOF alone wants colour
    if config.flow != "rlof":
        pair = (cv2.cvtColor(left1, cv2.COLOR_BGR2GRAY), cv2.cvtColor(left2, cv2.COLOR_BGR2GRAY))
    flow = FLOWS[config.flow]().calc(*pair, None)
    y, x = np.indices(disparity1.shape, np.float32)
    x, y = x + flow[..., 0], y + flow[..., 1]
    change = cv2.remap(disparity2, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) - disparity1
    height, width = disparity1.shape
    visible = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return SceneFlow(disparity1, disparity2, change, flow, visible)


def nothing(
    frames: Frames, config: None = None, camera: StereoCamera | None = None, progress: object = None
) -> SceneFlow:
    """The estimate of somebody who does nothing: zero everywhere."""
    return SceneFlow.from_state(np.zeros((5, *frames.shape), np.float32), np.ones(frames.shape, bool))


def _disparity(left: np.ndarray, right: np.ndarray, config: CompositionConfig) -> np.ndarray:
    """Disparity of `left`, (H, W) float32, without holes."""
    count, block = config.disparities, 5
    matcher = cv2.StereoSGBM.create(
        0, count, block, P1=24 * block**2, P2=96 * block**2, disp12MaxDiff=1, uniquenessRatio=5,
        speckleWindowSize=100, speckleRange=2, mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # the matcher gives nothing in its first `count` columns, so these are made of padding
    left, right = (cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_CONSTANT) for image in (left, right))
    if config.filtered:
        weighted = cv2.ximgproc.createDisparityWLSFilter(matcher)  # first, for it switches the matcher's own checks off
        weighted.setLambda(8000)
        weighted.setSigmaColor(1.2)
        other = cv2.ximgproc.createRightMatcher(matcher).compute(right, left)
        raw = weighted.filter(matcher.compute(left, right), left, None, other)
    else:
        raw = matcher.compute(left, right)
    disparity = raw[:, count:].astype(np.float32) / 16
    disparity[disparity <= 0] = np.nan
    if np.isnan(disparity).all():
        return np.ones_like(disparity)
    return np.ascontiguousarray(fill_background(disparity))
