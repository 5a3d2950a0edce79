"""A faint pattern that all images have at the same pixels, and how strong it is.

Dither, or whatever else is laid over every picture in the same way, looks alike at no displacement at all: surfaces without
a texture of their own are then matched at disparity 0. It shows in flat parts, where details of left1 come again at the very
same pixels of the three other images, but not some pixels beside.
"""

import logging

import cv2
import numpy as np

logger = logging.getLogger(__name__)

_FLAT = 3 / 255
"""Most that a pixel and its eight neighbours differ by where an image is flat."""
_DETAIL = 8 / 9
"""What is left of white noise's variance without the mean of 3 x 3."""
_CLEAR = 0.15
"""By how much the correlation at the same pixels must exceed those beside."""
_BESIDE_PX = (-3, -2, 2, 3)
"""Along x, where disparities and motions are."""
_FEWEST_PIXELS = 500
_AMPLITUDE = 4.0
"""In standard deviations: two values of an even distribution differ by 3.5 at most."""


def pattern_amplitude(grey: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Largest difference between two pixels that a shared pattern makes.

    Parameters
    ----------
    grey : tuple of four np.ndarray
        left1, right1, left2, right2, each (H, W) float32 in [0, 1].

    Returns
    -------
    float
        In [0, 1]; 0 where nothing is shared, or where too little is flat to tell.
    """
    first, deviation = _flat_details(grey[0]), np.inf
    for other in map(_flat_details, grey[1:]):
        correlation, shared = _correlate(first, other, 0)
        if correlation <= _CLEAR or correlation <= _CLEAR + max(_correlate(first, other, beside)[0] for beside in _BESIDE_PX):
            return 0.0
        deviation = min(deviation, np.sqrt(shared / _DETAIL))
    logger.info("the images share a pattern of %.2f/255 (standard deviation): such differences are overlooked", 255 * deviation)
    return float(_AMPLITUDE * deviation)


def _flat_details(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is finer than 3 x 3 pixels, 0 where the image is not flat, and where it is; (H, W) float32 both."""
    square = np.ones((3, 3), np.uint8)
    flat = (cv2.dilate(image, square) - cv2.erode(image, square) <= _FLAT).astype(np.float32)
    return (image - cv2.blur(image, (3, 3))) * flat, flat


def _correlate(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], dx: int) -> tuple[float, float]:
    """Correlation and covariance of details at x and at x + dx where both are flat; 0, 0 where too few are."""
    width = first[0].shape[1]
    a, flat_a = (plane[:, max(-dx, 0) : width - max(dx, 0)] for plane in first)
    b, flat_b = (plane[:, max(dx, 0) : width - max(-dx, 0)] for plane in second)
    both = np.sum(flat_a * flat_b)
    if both < _FEWEST_PIXELS:
        return 0.0, 0.0
    shared = np.sum(a * b)
    return float(shared / np.sqrt(np.sum(a * a * flat_b) * np.sum(b * b * flat_a) + 1e-30)), float(shared / both)
