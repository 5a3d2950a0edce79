"""Moving objects that dense flow lost: found again in what no motion explains.

Where no candidate motion makes the images agree, although the pixels should be seen at time 2, something moved in a way
that dense flow could not follow, mostly too far. Patches of each connected surface of such pixels are looked for in left2
(variational.patches) and give it a first rigid motion. Left2 is then seen through that motion, where little is left to
move: dense inverse search measures it, a better fit follows, and so once more. Whether the motion is any good is for the
fusion to say.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from variational.frames import Frames
from variational.initialise import Start, dense_inverse_search
from variational.patches import Patches, PatchesConfig
from variational.rigid import RigidMotion, fit_surface
from variational.state import D1, C

MARGIN = 16
"""Pixels around a surface that dense inverse search sees too."""
COARSE_PX = 4.0
"""How exactly the patches' places are known: as their pixels, for they turn."""
ASTRAY_PX = 2.0
"""A surface whose patches are nearer to where its motion leads is not lost."""
FINE_PX = 2.0
"""How exactly those of dense inverse search are known, the first time."""


@dataclass(frozen=True)
class ObjectsConfig:
    """Search for lost objects.

    Parameters
    ----------
    most : int
        Surfaces looked for, the largest; 0 leaves the search out.
    cost : float
        A pixel is unexplained if its chosen motion costs more than this (variational.fusion), in [0, 1].
    least_px : int
        Fewest unexplained pixels of a surface.
    largest : float
        Share of the image above which a surface is the scene, not an object.
    matched : float
        Least share of its pixels that are matched at time 1.
    jump_px : float
        A difference of disparity between neighbours that separates two surfaces.
    places : int
        Patches of a surface that are looked for, at most.
    least_places : int
        Fewest of them that must be found again.
    seen : float
        Least share of them that must follow the first motion.
    flow_px : int
        Side of the square whose area dense inverse search reduces a surface and its surroundings to.
    least_points : int
        Fewest points of dense inverse search that the last motion is fitted to.
    inliers : float
        Share of its points that a motion must explain.
    patches
        Settings of the patches.
    """

    most: int = 8
    cost: float = 0.45
    least_px: int = 150
    largest: float = 0.1
    matched: float = 0.2
    jump_px: float = 1.5
    places: int = 80
    least_places: int = 5
    seen: float = 0.15
    flow_px: int = 160
    least_points: int = 30
    inliers: float = 0.25
    patches: PatchesConfig = field(default_factory=PatchesConfig)


def unexplained_surfaces(
    disparity: np.ndarray, cost: np.ndarray, visible: np.ndarray, matched: np.ndarray, config: ObjectsConfig
) -> list[np.ndarray]:
    """Connected surfaces of pixels that no motion explains: (H, W) bool masks, the largest first.

    What has no texture is never explained, but neither is it matched at time 1: such surfaces are left out.
    """
    open_ = ((cost > config.cost) & visible).astype(np.uint8)
    open_ = cv2.morphologyEx(open_, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for axis in (0, 1):
        jump = np.abs(np.diff(disparity, axis=axis)) > config.jump_px
        open_[(slice(None),) * axis + (slice(1, None),)][jump] = 0
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(open_, connectivity=4)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    compared = np.bincount(labels[matched], minlength=len(areas))
    areas[(areas > config.largest * labels.size) | (compared < config.matched * areas)] = 0
    areas[0] = 0
    order = np.argsort(-areas, kind="stable")[: config.most]
    return [labels == k for k in order if areas[k] >= config.least_px]


def _flow_at_most(first: np.ndarray, second: np.ndarray, side_px: int) -> np.ndarray:
    """(H, W, 2) dense inverse search, at a reduced size if the images are larger than such a square."""
    height, width = first.shape
    factor = max(1.0, np.sqrt(first.size / side_px**2))
    size = max(MARGIN, round(width / factor)), max(MARGIN, round(height / factor))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (first, second)]
    return cv2.resize(dense_inverse_search(*small), (width, height)) * np.array([width / size[0], height / size[1]], np.float32)


def follow(
    left1: np.ndarray, left2: np.ndarray, surface: np.ndarray, disparity: np.ndarray, homography: np.ndarray,
    config: ObjectsConfig, most_points: int = 2500,
) -> np.ndarray:  # fmt: skip
    """(N, 4) x, y at time 1 and at time 2 of a surface's pixels, measured by dense flow from where a motion leads.

    Parameters
    ----------
    left1, left2 : np.ndarray
        (H, W) float32 grey images in [0, 1].
    surface : np.ndarray
        (H, W) bool.
    disparity : np.ndarray
        (H, W) at time 1, pixels.
    homography : np.ndarray
        (4, 4) of (x, y, disparity, 1), from time 1 to time 2; nearly right.
    config : ObjectsConfig
    most_points : int
        Pixels drawn from the surface, evenly.
    """
    rows, columns = (np.flatnonzero(surface.any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - MARGIN, 0), max(columns[0] - MARGIN, 0)
    part = slice(top, rows[-1] + 1 + MARGIN), slice(left, columns[-1] + 1 + MARGIN)
    middle = np.median(disparity[surface])
    # what lies far before or behind the surface would be torn away from it: moved as if it lay there
    near = np.where(np.abs(disparity[part] - middle) < 0.3 * middle + 5, disparity[part], middle)
    y, x = np.indices(near.shape) + np.array([top, left])[:, None, None]
    moved = np.stack([x, y, near, np.ones_like(near)], axis=-1) @ homography.T
    with np.errstate(all="ignore"):  # points that come to lie beside the camera
        to = np.nan_to_num((moved[..., :2] / moved[..., 3:]).astype(np.float32), posinf=-1, neginf=-1)
    seen = cv2.remap(left2, to, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    flow = _flow_at_most(np.ascontiguousarray(left1[part]), seen, config.flow_px)
    points = np.argwhere(surface[part])
    points = points[np.linspace(0, len(points) - 1, min(most_points, len(points))).astype(np.intp)]
    at = (points[:, ::-1] + flow[points[:, 0], points[:, 1]]).astype(np.float32)
    places = cv2.remap(to, at[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    return np.hstack([points[:, ::-1] + (left, top), places]).astype(np.float64)


def find_objects(
    start: Start, state: np.ndarray, frames: Frames, surfaces: list[np.ndarray], projection: np.ndarray, config: ObjectsConfig
) -> list[RigidMotion]:
    """Rigid motions of surfaces that dense flow lost.

    Parameters
    ----------
    start : Start
        For the disparity at time 2.
    state : np.ndarray
        (5, H, W), pixels; of it D1, and the motion that explains the surfaces badly.
    frames : Frames
    surfaces : list of np.ndarray
        (H, W) bool masks.
    projection : np.ndarray
        (4, 4) of the camera.
    config : ObjectsConfig

    Returns
    -------
    list of RigidMotion
        One for each surface that is seen again and moves rigidly.
    """
    if not surfaces:
        return []
    seen = Patches(frames.left1, frames.left2, config.patches).follow(surfaces, config.places)
    found = zip(surfaces, seen, strict=True)
    motions = (_fit(start, state, frames, surface, *patches, projection, config) for surface, patches in found)
    return [motion for motion in motions if motion is not None]


def _fit(
    start: Start, state: np.ndarray, frames: Frames, surface: np.ndarray, seen: np.ndarray, looked_for: int,
    projection: np.ndarray, config: ObjectsConfig,
) -> RigidMotion | None:  # fmt: skip
    """The motion of a surface, if it is seen again elsewhere than its motion so far leads to, and moves rigidly."""
    disparity = state[D1]
    left1, _, left2, _ = frames.grey
    x, y = np.rint(seen[:, :2]).astype(np.intp).T
    astray = np.abs(seen[:, 2:] - seen[:, :2] - state[C + 1 :, y, x].T).max(axis=1)
    if not len(seen) or np.median(astray) < ASTRAY_PX:
        return None  # a shadow, a highlight: the images disagree, the motion is right
    first, second = _ends(start, disparity, seen, matched=False)
    least = max(config.least_places, config.seen * looked_for)
    for tolerance_px in (COARSE_PX, FINE_PX):
        motion = fit_surface(surface, first, second, projection, least, tolerance_px)
        if motion is None:
            return None
        followed = follow(left1, left2, surface, disparity, motion.homography, config)
        first, second = _ends(start, disparity, followed, matched=tolerance_px == FINE_PX)
        least = config.inliers * len(first)
    return fit_surface(surface, first, second, projection, least) if len(first) >= config.least_points else None


def _ends(
    start: Start, disparity: np.ndarray, followed: np.ndarray, matched: bool, most: int = 250
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) x, y, disparity at both times of points (n, 4), those that are inside; only matched ones at time 2 if asked."""
    size = np.array([disparity.shape[1], disparity.shape[0]] * 2)
    nearest = np.rint(followed)
    inside = ((nearest >= 0) & (nearest < size)).all(axis=1)
    followed = followed[inside]
    x1, y1, x2, y2 = nearest[inside].astype(np.intp).T
    first = np.column_stack([followed[:, :2], disparity[y1, x1]])
    second = np.column_stack([followed[:, 2:], start.match2.disparity[y2, x2]])
    usable = np.flatnonzero((first[:, 2] > 0.5) & (second[:, 2] > 0.5) & (start.match2.matched[y2, x2] | (not matched)))
    chosen = usable[np.linspace(0, len(usable) - 1, min(most, len(usable))).astype(np.intp)]
    return first[chosen], second[chosen]
