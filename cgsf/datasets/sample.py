"""What a data set gives: four images, the calibration, and the truth as far as it is known."""

from dataclasses import dataclass

import numpy as np

from cgsf.calibration import Calibration


@dataclass(frozen=True)
class Truth:
    """Ground truth on left1's pixel grid, in pixels; NaN where it is unknown.

    Parameters
    ----------
    disparity1 : ndarray (H, W) float32 or None
        Disparity at time 1.
    disparity2 : ndarray (H, W) float32 or None
        Disparity at time 2 of the point that left1 sees at this pixel (D1 + C), on **left1's** grid.
    flow : ndarray (H, W, 2) float32 or None
        Optical flow (u, v) from left1 to left2.
    disparity_left2 : ndarray (H, W) float32 or None
        Disparity of left2, on **left2's** grid.
    visible_stereo, visible_flow, visible_change : ndarray (H, W) bool or None
        True where the point of left1's pixel is seen in right1, in left2, and in both images of time 2. They select
        the pixels of the visible-only scores of D1, of the flow and of D2. Without `visible_change` its place is
        taken by the first two together.
    objects : ndarray (H, W) int or None
        0 on the background, positive on (moving) objects: foreground and background are scored apart.
    """

    disparity1: np.ndarray | None = None
    disparity2: np.ndarray | None = None
    flow: np.ndarray | None = None
    disparity_left2: np.ndarray | None = None
    visible_stereo: np.ndarray | None = None
    visible_flow: np.ndarray | None = None
    visible_change: np.ndarray | None = None
    objects: np.ndarray | None = None


@dataclass(frozen=True)
class Sample:
    """Two rectified stereo pairs and what is known about them.

    Parameters
    ----------
    name : str
        Unique in its data set; may contain ``/``, then it names a folder inside a folder.
    left1, right1, left2, right2 : ndarray (H, W, c) float32
        Images in [0, 1], c = 1 (grey) or 3 (BGR).
    calibration : Calibration or None
    truth : Truth or None
    """

    name: str
    left1: np.ndarray
    right1: np.ndarray
    left2: np.ndarray
    right2: np.ndarray
    calibration: Calibration | None = None
    truth: Truth | None = None

    @property
    def images(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The four images in the order ``left1, right1, left2, right2``."""
        return self.left1, self.right1, self.left2, self.right2
