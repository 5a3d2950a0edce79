"""The camera's motion in any scene flow: what the refiner may take over where points stand still."""

from __future__ import annotations

import cv2
import numpy as np

from variational.camera import StereoCamera
from variational.rigid import Correspondences, RigidConfig, find_motions, guess_camera

# A quarter of the solver's points: six numbers are sought, among candidates that a step of the refiner weighs again.
_CAMERA_ALONE = RigidConfig(max_objects=0, points=1000)
# Every fourth column and row hold more points than that.
_STRIDE = 4
# Flow there and back must agree this well for a pixel to tell anything about the camera, in pixels.
_ROUND_TRIP_PX = 1.0


def find_homography(state: np.ndarray, backward_flow: np.ndarray, camera: StereoCamera | None = None) -> np.ndarray:
    """The camera's motion on (x, y, disparity, 1), from a state's D1, its flow, and D2 where the flow leads to.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W), pixels.
    backward_flow : np.ndarray
        (H, W, 2), left2 -> left1, pixels.
    camera : StereoCamera, optional
        Without one the focal length is that under which the points move most rigidly.

    Returns
    -------
    np.ndarray
        (4, 4) float64; the identity, a camera that stands still, where no rigid motion explains enough.
    """
    height, width = state.shape[1:]
    d1, _, _, u, v = state[:, ::_STRIDE, ::_STRIDE].astype(np.float32)
    x, y = np.meshgrid(*(np.arange(0, side, _STRIDE, dtype=np.float32) for side in (width, height)))
    to_x, to_y = x + u, y + v
    inside = (to_x >= 0) & (to_x <= width - 1) & (to_y >= 0) & (to_y <= height - 1)
    back, d2 = (
        cv2.remap(np.ascontiguousarray(maps, np.float32), to_x, to_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for maps in (backward_flow, state[1])
    )
    there_and_back = np.hypot(u + back[..., 0], v + back[..., 1])
    valid = inside & (there_and_back < _ROUND_TRIP_PX)
    matches = Correspondences(np.dstack([x, y, d1]), np.dstack([to_x, to_y, d2]), valid)
    motions = find_motions(matches, camera or guess_camera(matches, _CAMERA_ALONE, (height, width)), _CAMERA_ALONE)
    return motions[0].homography if motions else np.eye(4)
