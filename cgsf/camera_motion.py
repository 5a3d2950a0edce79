"""The camera's motion in any scene flow: what the refiner may take over where points stand still."""

from __future__ import annotations

import numpy as np

from variational.camera import StereoCamera
from variational.proposals import round_trips
from variational.rigid import RigidConfig, find_motions
from variational.self_calibration import guess_camera
from variational.state import D1, D2, flow_of

# A quarter of the solver's points: six numbers are sought, among candidates that a step of the refiner weighs again.
_CAMERA_ALONE = RigidConfig(max_objects=0, points=1000)
# Every fourth column and row hold more points than that.
_STRIDE = 4


def find_homography(state: np.ndarray, backward_flow: np.ndarray, camera: StereoCamera | None = None) -> np.ndarray:
    """The camera's motion on (x, y, disparity, 1), from a state's D1, its flow, and D2 where the flow leads to.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W), pixels.
    backward_flow : np.ndarray
        (H, W, 2), left2 -> left1, pixels.
    camera : StereoCamera, optional
        Without one, one is guessed: that under which the points move most rigidly.

    Returns
    -------
    np.ndarray
        (4, 4) float64; the identity, a camera that stands still, where no rigid motion explains enough.
    """
    state, backward_flow = np.ascontiguousarray(state, np.float32), np.ascontiguousarray(backward_flow, np.float32)
    matches = round_trips(flow_of(state), backward_flow, state[D1], state[D2], _STRIDE)
    motions = find_motions(matches, camera or guess_camera(matches, _CAMERA_ALONE, state.shape[1:]), _CAMERA_ALONE)
    return motions[0].homography if motions else np.eye(4)
