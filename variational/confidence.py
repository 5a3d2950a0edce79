"""How far each pixel of a solution can be trusted."""

import cv2
import numpy as np

from variational.state import D1, C


def confidence(
    state: np.ndarray, cost: np.ndarray, matched1: np.ndarray, matched2: np.ndarray, visible: np.ndarray, window: int = 7
) -> np.ndarray:
    """Confidence from what was seen, never from how smooth the result looks.

    Four doubts multiply: the images disagree where the motion leads; the disparity was filled in, not matched; the pixel is
    not seen at time 2 (or what it meets there was not matched); it lies beside a jump of depth, where either side may be meant.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W).
    cost : np.ndarray
        (H, W) in [0, 1], disagreement of the images under the chosen motion (variational.fusion).
    matched1 : np.ndarray
        (H, W) bool, D1 is a match of its own.
    matched2 : np.ndarray
        (H, W) bool, the place that the pixel moves to is matched at time 2.
    visible : np.ndarray
        (H, W) bool, seen at time 2.
    window : int
        Side of the window that looks for a jump, and that the doubts are averaged over; pixels, odd.

    Returns
    -------
    np.ndarray
        (H, W) float32 in [0, 1]; an order, not a probability.
    """
    box = np.ones((window, window), np.uint8)
    share = cv2.blur(matched1.astype(np.float32), (window, window)) * (0.5 + 0.5 * matched1)
    agrees = 1 - np.clip(cost, 0, 1)
    meets = np.where(visible, 0.7 + 0.3 * matched2, 0.5).astype(np.float32)
    jump = cv2.dilate(state[D1], box) - cv2.erode(state[D1], box)
    change = cv2.dilate(state[C], box) - cv2.erode(state[C], box)
    flat = 1 / (1 + (jump + np.abs(change)) / 4)
    return (agrees * (0.2 + 0.8 * share) * meets * (0.4 + 0.6 * flat)).astype(np.float32)
