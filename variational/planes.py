"""Planes through surfaces without texture.

A wall of one colour has no matches of its own but for a few, and whatever fills the rest pixel by pixel has nothing to go
by. But it shows where it ends: a connected region of even colour is one surface, or few. Planes fitted to the matched
disparities of such a region (RANSAC, Fischler and Bolles 1981) tell those of its other pixels. A region whose matches
lie on no few planes is left alone.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.jit import over_rows, rowwise

HYPOTHESES = 160
"""Planes tried in one fit: a third of the points on one suffices, for every 27th is right then."""


@dataclass(frozen=True)
class PlanesConfig:
    """Planes of regions of even colour.

    Parameters
    ----------
    most : int
        Planes in a region; 0 leaves them out altogether.
    blur_px : float
        Standard deviation of the smoothing under which colours are compared.
    contrast : float
        A region ends where a channel in [0, 1] changes by this much from one pixel to the next; in grey images by 0.58 of it.
    least_px, least_share : int, float
        Fewest unmatched pixels of a region that is worth a fit, and their least share of it.
    least_matches : int
        Fewest matched pixels.
    margin_px : float
        Matches so near to the region's end are left out, where there are others: windows there also see what is beside it.
    tolerance_px, tolerance : float
        A disparity is on a plane if it is so close, in pixels and as a share of itself: surfaces bend.
    support : float
        Share of the region's matches that a plane needs.
    explained : float
        Share of them that all its planes together need.
    """

    most: int = 2
    blur_px: float = 1.5
    contrast: float = 0.012
    least_px: int = 200
    least_share: float = 0.1
    least_matches: int = 60
    margin_px: float = 4.0
    tolerance_px: float = 1.0
    tolerance: float = 0.02
    support: float = 0.2
    explained: float = 0.5


@rowwise
def _even(first: int, last: int, image: np.ndarray, contrast: np.float32, even: np.ndarray) -> None:
    """even (H, W) uint8: no channel changes much to any of the four neighbours."""
    height, width, channels = image.shape
    for y in range(first, last):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            step = np.float32(0)
            for c in range(channels):
                here = image[y, x, c]
                step = max(step, abs(here - image[y, left, c]), abs(here - image[y, right, c]))
                step = max(step, abs(here - image[above, x, c]), abs(here - image[below, x, c]))
            even[y, x] = step <= contrast


def even_regions(image: np.ndarray, config: PlanesConfig) -> tuple[np.ndarray, np.ndarray]:
    """Connected regions of even colour: (H, W) labels, 0 outside of all, and OpenCV's (N, 5) statistics of the labels."""
    smooth = cv2.GaussianBlur(image.astype(np.float32, copy=False), (0, 0), config.blur_px)
    smooth = smooth.reshape(image.shape)  # OpenCV drops a single channel
    even = np.empty(image.shape[:2], np.uint8)
    contrast = config.contrast * np.sqrt(smooth.shape[2] / 3)  # grey tells less, so it must be more even
    over_rows(_even, len(even), smooth, np.float32(contrast), even)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(even, connectivity=4)
    return labels, statistics


def _fit_plane(points: np.ndarray, tolerance: float, random: np.random.Generator) -> np.ndarray:
    """(a, b, c) of the plane d = a x + b y + c that most of the (N, 3) points (x, y, d) lie on; NaN if there is none."""
    ground = np.column_stack([points[:, :2], np.ones(len(points))])
    origin, p, q = points[random.integers(0, len(points), (3, HYPOTHESES))]
    normal = np.cross(p - origin, q - origin)
    with np.errstate(divide="ignore", invalid="ignore"):  # three points on a line: no plane, and nothing lies on it
        slopes = -normal[:, :2] / normal[:, 2:]
        planes = np.column_stack([slopes, origin[:, 2] - (slopes * origin[:, :2]).sum(axis=1)])
        planes = planes[np.argmax((np.abs(planes @ ground.T - points[:, 2]) < tolerance).sum(axis=1))]
    for _ in range(2):
        near = np.abs(ground @ planes - points[:, 2]) < tolerance
        if np.count_nonzero(near) < 3:
            return np.full(3, np.nan)
        on_it, values = ground[near], points[near, 2]
        planes = np.linalg.lstsq(np.einsum("ni,nj", on_it, on_it), np.einsum("ni,n", on_it, values), rcond=None)[0]
    return planes


def fit_planes(points: np.ndarray, config: PlanesConfig, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The few planes that points lie on, the one of most points first.

    Parameters
    ----------
    points : np.ndarray
        (N, 3) float64: x, y, disparity, in pixels.
    config : PlanesConfig
    seed : int
        Of the random hypotheses.

    Returns
    -------
    planes : np.ndarray
        (K, 3): disparity = a x + b y + c; none if they explain too little.
    belongs : np.ndarray
        (N,) index of each point's plane, -1 for none.
    """
    random = np.random.default_rng(seed)
    tolerance = config.tolerance_px + config.tolerance * float(np.median(points[:, 2]))
    belongs, planes = np.full(len(points), -1), []
    for index in range(config.most):
        left = np.flatnonzero(belongs < 0)
        if len(left) < max(config.support * len(points), 3):
            break
        plane = _fit_plane(points[left], tolerance, random)
        on_it = left[np.abs(points[left, :2] @ plane[:2] + plane[2] - points[left, 2]) < tolerance]
        if len(on_it) < config.support * len(points):
            break
        belongs[on_it] = index
        planes.append(plane)
    if np.mean(belongs >= 0) < config.explained:
        return np.empty((0, 3)), np.full(len(points), -1)
    return np.array(planes), belongs


def _nearest(places: np.ndarray, belongs: np.ndarray, count: int, region: np.ndarray) -> np.ndarray:
    """Which of `count` planes has most points around each pixel of a (h, w) region; around: a quarter of its size."""
    if count == 1:
        return np.zeros(np.count_nonzero(region), np.intp)
    side = int(0.25 * np.sqrt(np.count_nonzero(region))) | 1
    votes = np.zeros((count, *region.shape), np.float32)
    for index in range(count):
        mine = places[belongs == index]
        votes[index, mine[:, 1], mine[:, 0]] = 1
        for _ in range(2):
            votes[index] = cv2.blur(votes[index], (side, side), borderType=cv2.BORDER_CONSTANT)
    return votes.argmax(axis=0)[region]


def plane_disparities(
    image: np.ndarray, disparity: np.ndarray, matched: np.ndarray, config: PlanesConfig, most_points: int = 500
) -> np.ndarray:
    """Disparities of regions of even colour, from planes through those that are matched.

    Parameters
    ----------
    image : np.ndarray
        (H, W, channels) float32 in [0, 1].
    disparity : np.ndarray
        (H, W) float32, pixels.
    matched : np.ndarray
        (H, W) bool, where it is measured.
    config : PlanesConfig
    most_points : int
        Matches drawn from a region, evenly.

    Returns
    -------
    np.ndarray
        (H, W) float32, pixels, >= 0; NaN where no plane is known.
    """
    found = np.full(disparity.shape, np.nan, np.float32)
    if config.most == 0:
        return found
    labels, statistics = even_regions(image, config)
    unmatched = np.bincount(labels[~matched], minlength=len(statistics))
    from_edge = cv2.distanceTransform((labels > 0).astype(np.uint8), cv2.DIST_L2, 3)
    worth = np.maximum(config.least_px, config.least_share * statistics[:, cv2.CC_STAT_AREA])
    for label in np.flatnonzero(unmatched >= worth):
        left, top, width, height, area = statistics[label]
        if label == 0 or area - unmatched[label] < config.least_matches:
            continue
        part = slice(top, top + height), slice(left, left + width)
        region = labels[part] == label
        known = region & matched[part]
        inner = known & (from_edge[part] > config.margin_px)
        places = np.argwhere(inner if np.count_nonzero(inner) >= config.least_matches else known)[:, ::-1]
        places = places[np.linspace(0, len(places) - 1, min(most_points, len(places))).astype(np.intp)]
        points = np.column_stack([places, disparity[part][places[:, 1], places[:, 0]]]).astype(np.float64)
        planes, belongs = fit_planes(points, config)
        if len(planes):
            rows, columns = np.nonzero(region)
            chosen = planes[_nearest(places, belongs, len(planes), region)]
            found[part][region] = np.maximum(chosen[:, 0] * columns + chosen[:, 1] * rows + chosen[:, 2], 0)
    return found
