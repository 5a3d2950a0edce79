"""The camera's motion in any scene flow: what the refiner may take over where points stand still."""

from __future__ import annotations

import numpy as np

from variational.camera import StereoCamera
from variational.initialise import sample
from variational.rigid import Correspondences, RigidConfig, find_motions, guess_camera

# A quarter of the solver's points: six numbers are sought, among candidates that a step of the refiner weighs again.
_CAMERA_ALONE = RigidConfig(max_objects=0, points=1000)
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
    d1, d2, _, u, v = (np.ascontiguousarray(channel, dtype=np.float32) for channel in state)
    height, width = d1.shape
    flow = np.stack([u, v], -1)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    to_x, to_y = x + u, y + v
    inside = (to_x >= 0) & (to_x <= width - 1) & (to_y >= 0) & (to_y <= height - 1)
    back = sample(np.ascontiguousarray(backward_flow, dtype=np.float32), flow)
    there_and_back = np.linalg.norm(flow + back, axis=-1)
    second = np.dstack([to_x, to_y, sample(d2, flow)])
    matches = Correspondences(np.dstack([x, y, d1]), second, inside & (there_and_back < _ROUND_TRIP_PX))
    motions = find_motions(matches, camera or guess_camera(matches, _CAMERA_ALONE), _CAMERA_ALONE)
    return motions[0].homography if motions else np.eye(4)
