"""Moving objects that dense flow lost, by sparse features.

What has texture is found again wherever it went, seen whole or in part: local features around the surfaces that no motion
explains are matched over the whole of left2, and each surface whose features agree gets a rigid fit. What has a shape
but little texture is for variational.objects. Features: SIFT (Lowe 2004).
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from variational.initialise import Start, to_bytes
from variational.rigid import RigidMotion, fit_surface


@dataclass(frozen=True)
class LandmarksConfig:
    """Search for objects by features.

    Parameters
    ----------
    features : int
        Most features in an image, the strongest; 0 leaves the search out.
    ratio : float
        A feature is matched if its best match is this much closer than the second best.
    least_matches : int
        Fewest matched features that a motion is fitted to, and must explain.
    """

    features: int = 2500
    ratio: float = 0.85
    least_matches: int = 6


class Landmarks(NamedTuple):
    """Features of an image: (N, 2) places (x, y) in pixels, (N, 128) float32 descriptions."""

    places: np.ndarray
    words: np.ndarray


def find_landmarks(grey: np.ndarray, config: LandmarksConfig, mask: np.ndarray | None = None) -> Landmarks:
    """The strongest features of a (H, W) image in [0, 1]; of those only what lies in a (H, W) uint8 mask."""
    if config.features == 0:
        return Landmarks(np.empty((0, 2)), np.empty((0, 128), np.float32))
    detector = cv2.SIFT.create(nfeatures=config.features, contrastThreshold=0.01)
    # SIFT doubles an image before it begins: halved, its first octave is the image itself, in a quarter of the time
    half = (grey.shape[1] // 2, grey.shape[0] // 2)
    small = to_bytes(cv2.resize(grey, half, interpolation=cv2.INTER_AREA))
    mask = mask if mask is None else cv2.resize(mask, half, interpolation=cv2.INTER_NEAREST)
    points, words = detector.detectAndCompute(small, mask)
    places = (np.array([point.pt for point in points]).reshape(-1, 2) + 0.5) * (np.array(grey.shape[::-1]) / half) - 0.5
    return Landmarks(places, np.empty((0, 128), np.float32) if words is None else words)


def match_words(words1: np.ndarray, words2: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Descriptions of one image that are much closer to one of another's than to all else of it.

    All pairs at once, by one product of matrices. Descriptions are whole numbers up to 255, so their products are exact in
    float32, in whatever order they are summed.

    Parameters
    ----------
    words1, words2 : np.ndarray
        (N, 128), (M, 128) float32, M >= 2.
    ratio : float
        Least distance of the second best, as a share of which the best's must be less.

    Returns
    -------
    places, partners : np.ndarray
        (n,) indices into the first image's, and into the second's.
    """
    squares1, squares2 = (np.einsum("ij,ij->i", words, words) for words in (words1, words2))
    distances = squares2 - 2 * (words1 @ words2.T)
    partners, rows = distances.argmin(axis=1), np.arange(len(words1))
    best = distances[rows, partners]
    distances[rows, partners] = np.inf
    second = distances.min(axis=1)
    places = np.flatnonzero(best + squares1 < ratio**2 * (second + squares1))
    return places, partners[places]


def find_marked_objects(
    start: Start, disparity: np.ndarray, left1: np.ndarray, landmarks2: Landmarks, surfaces: list[np.ndarray],
    projection: np.ndarray, config: LandmarksConfig,
) -> list[RigidMotion]:  # fmt: skip
    """Rigid motions of surfaces, from sparse features.

    Parameters
    ----------
    start : Start
        For the disparity at time 2.
    disparity : np.ndarray
        (H, W) at time 1, pixels.
    left1 : np.ndarray
        (H, W) grey in [0, 1].
    landmarks2 : Landmarks
        Of left2.
    surfaces : list of np.ndarray
        (H, W) bool masks.
    projection : np.ndarray
        (4, 4) of the camera.

    Returns
    -------
    list of RigidMotion
        One for each surface whose features agree on a motion.
    """
    if not surfaces or len(landmarks2.places) < 2:
        return []
    around = cv2.dilate(np.any(surfaces, axis=0).astype(np.uint8), np.ones((9, 9), np.uint8))
    landmarks1 = find_landmarks(left1, config, around)
    if len(landmarks1.places) < config.least_matches:
        return []
    good, partners = match_words(landmarks1.words, landmarks2.words, config.ratio)
    if len(good) < config.least_matches:
        return []
    at1, at2 = landmarks1.places[good], landmarks2.places[partners]
    x1, y1, x2, y2 = np.rint(np.hstack([at1, at2])).astype(np.intp).T
    first = np.column_stack([at1, disparity[y1, x1]])
    second = np.column_stack([at2, start.match2.disparity[y2, x2]])
    usable = (first[:, 2] > 0.5) & start.match2.matched[y2, x2] & (second[:, 2] > 0.5)
    motions: list[RigidMotion | None] = []
    for surface in surfaces:
        near = cv2.dilate(surface.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        chosen = np.flatnonzero(usable & near[y1, x1])
        if len(chosen) < config.least_matches:
            continue
        motions.append(fit_surface(surface, first[chosen], second[chosen], projection, config.least_matches / len(chosen)))
    return [motion for motion in motions if motion is not None]
