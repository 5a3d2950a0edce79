"""The rectified stereo camera, as far as the classical side needs it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo rig: one pinhole camera twice, the right one shifted along +x.

    Parameters
    ----------
    fx, fy : float
        Focal lengths in pixels of the working image.
    cx, cy : float
        Principal point of the left camera in pixels; (0, 0) is the centre of the top-left pixel.
    baseline_m : float
        Distance between the two centres of projection in metres, > 0.

    Notes
    -----
    A point (X, Y, Z) in metres (x right, y down, z forward, left camera) has
    ``x = fx X / Z + cx``, ``y = fy Y / Z + cy`` and disparity ``fx baseline_m / Z``.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "baseline_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"StereoCamera.{name} must be a positive number, got {value}")
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"StereoCamera.{name} must be finite, got {getattr(self, name)}")

    def projection(self) -> np.ndarray:
        """(4, 4) float64 matrix P with ``(x, y, disparity, 1) ~ P (X, Y, Z, 1)`` up to scale."""
        return np.array([[self.fx, 0, self.cx, 0], [0, self.fy, self.cy, 0], [0, 0, 0, self.fx * self.baseline_m], [0, 0, 1, 0]])

    def homography(self, transform: np.ndarray) -> np.ndarray:
        """(4, 4) what a rigid transform (4, 4) of points in metres does to (x, y, disparity, 1)."""
        projection = self.projection()
        homography: np.ndarray = projection @ transform @ np.linalg.inv(projection)
        return homography

    def scaled(self, sx: float, sy: float) -> "StereoCamera":
        """The same camera on an image resized by (sx, sy), pixel centres at integers: ``x' = (x + 0.5) sx - 0.5``."""
        return StereoCamera(self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, self.baseline_m)
