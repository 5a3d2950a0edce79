"""Moving objects that dense flow lost: found as a whole in what no motion explains.

Where no candidate motion makes the images agree, although the pixels should be seen at time 2, something moved in a way
that dense flow could not follow, mostly too far. A connected surface of such pixels is looked for in left2 as a template
(normalised correlation under the surface's mask), and back from there; dense inverse search begins anew from where it is
found, and what that says of the surface's points gets a rigid fit of its own. Whether the motion is any good is for the
fusion to say.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.initialise import Start, dense_inverse_search
from variational.rigid import RigidMotion, fit_surface

MARGIN = 16
"""Pixels around a surface that dense inverse search sees too."""


@dataclass(frozen=True)
class ObjectsConfig:
    """Search for lost objects.

    Parameters
    ----------
    most : int
        Surfaces looked for as templates, the largest; 0 leaves that out.
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
    return_px : float
        A place is believed if what is seen there is found, back at time 1, at most so far along x and y from the surface: as
        left and right are checked. A repeated pattern, or a surface that has left the image, leads elsewhere.
    reach : float
        Largest displacement along x and y, as a share of the image's width.
    template_px : int
        Side of the square whose area a template is reduced to.
    flow_px : int
        The same for dense inverse search on a surface and its surroundings.
    least_points : int
        Fewest points that a motion is fitted to.
    inliers : float
        Share of them that it must explain.
    """

    most: int = 8
    cost: float = 0.45
    least_px: int = 150
    largest: float = 0.1
    matched: float = 0.2
    jump_px: float = 1.5
    return_px: float = 3.0
    reach: float = 0.15
    template_px: int = 32
    flow_px: int = 160
    least_points: int = 30
    inliers: float = 0.4


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
    order = np.argsort(-areas, kind="stable")[:24]
    return [labels == k for k in order if areas[k] >= config.least_px]


def find_template(template: np.ndarray, mask: np.ndarray, image: np.ndarray, side_px: int) -> tuple[int, int] | None:
    """Where in an image something is seen again.

    Parameters
    ----------
    template, mask : np.ndarray
        (h, w) float32 grey values, and bool where they count.
    image : np.ndarray
        (H, W) float32, H >= h, W >= w.
    side_px : int
        Templates larger than such a square are compared at a reduced size.

    Returns
    -------
    tuple of two int or None
        Column and row of the template's corner in the image; None if nothing there can be compared.
    """
    factor = max(1.0, np.sqrt(template.size / side_px**2))
    shapes = [tuple(max(1, round(side / factor)) for side in plane.shape[::-1]) for plane in (template, image)]
    small, where = (
        cv2.resize(plane.astype(np.float32), shapes[0], interpolation=cv2.INTER_AREA) for plane in (template, mask)
    )
    searched = cv2.resize(image, shapes[1], interpolation=cv2.INTER_AREA)
    scores = cv2.matchTemplate(searched, small, cv2.TM_CCOEFF_NORMED, mask=(where > 0.5).astype(np.float32))
    scores[~(np.abs(scores) <= 1.001)] = -1  # not a number, or the quotient of two nothings, where all is flat
    if scores.max() <= 0:
        return None
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    return round(column * image.shape[1] / shapes[1][0]), round(row * image.shape[0] / shapes[1][1])


def _flow_at_most(first: np.ndarray, second: np.ndarray, side_px: int) -> np.ndarray:
    """(H, W, 2) dense inverse search, at a reduced size if the images are larger than such a square."""
    height, width = first.shape
    factor = max(1.0, np.sqrt(first.size / side_px**2))
    size = max(MARGIN, round(width / factor)), max(MARGIN, round(height / factor))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (first, second)]
    return cv2.resize(dense_inverse_search(*small), (width, height)) * np.array([width / size[0], height / size[1]], np.float32)


def _crop(image: np.ndarray, top: int, left: int, height: int, width: int) -> np.ndarray:
    """Part of an image; positions outside take the nearest pixel."""
    rows = np.clip(np.arange(top, top + height), 0, image.shape[0] - 1)
    columns = np.clip(np.arange(left, left + width), 0, image.shape[1] - 1)
    return image[rows[:, None], columns]


def follow(left1: np.ndarray, left2: np.ndarray, surface: np.ndarray, config: ObjectsConfig) -> np.ndarray | None:
    """(N, 4) x, y at time 1 and at time 2 of a surface's pixels, far displacements included; None if it is not seen again.

    Parameters
    ----------
    left1, left2 : np.ndarray
        (H, W) float32 grey images in [0, 1].
    surface : np.ndarray
        (H, W) bool.
    config : ObjectsConfig
    """
    rows, columns = (np.flatnonzero(surface.any(axis=axis)) for axis in (1, 0))
    top, left, height, width = (int(n) for n in (rows[0], columns[0], np.ptp(rows) + 1, np.ptp(columns) + 1))
    part = slice(top, top + height), slice(left, left + width)
    reach = round(config.reach * surface.shape[1])
    searched = _crop(left2, top - reach, left - reach, height + 2 * reach, width + 2 * reach)
    found = find_template(left1[part], surface[part], searched, config.template_px)
    if found is None:
        return None
    right, down = found[0] - reach, found[1] - reach
    again = _crop(left2, top + down, left + right, height, width)
    back = find_template(again, surface[part], _crop(left1, top - reach, left - reach, *searched.shape), config.template_px)
    if back is None or max(abs(back[0] - reach), abs(back[1] - reach)) > config.return_px:
        return None
    top, left, height, width = top - MARGIN, left - MARGIN, height + 2 * MARGIN, width + 2 * MARGIN
    around = _crop(left1, top, left, height, width), _crop(left2, top + down, left + right, height, width)
    flow = _flow_at_most(*around, config.flow_px)
    y, x = np.nonzero(surface)
    places = np.column_stack([x, y])
    return np.hstack([places, places + flow[y - top, x - left].astype(np.float64) + (right, down)])


def find_objects(
    start: Start, disparity: np.ndarray, left1: np.ndarray, left2: np.ndarray, surfaces: list[np.ndarray],
    projection: np.ndarray, config: ObjectsConfig, most_points: int = 250,
) -> list[RigidMotion]:  # fmt: skip
    """Rigid motions of surfaces that dense flow lost.

    Parameters
    ----------
    start, disparity, left1, projection
        As in variational.landmarks.find_marked_objects.
    left2 : np.ndarray
        (H, W) grey in [0, 1].
    surfaces : list of np.ndarray
        (H, W) bool masks, the largest first.
    config : ObjectsConfig
    most_points : int
        Points of a surface that a motion is fitted to, drawn evenly.

    Returns
    -------
    list of RigidMotion
        One for each surface that is seen again and moves rigidly.
    """
    height, width = disparity.shape
    motions: list[RigidMotion | None] = []
    for surface in surfaces[: config.most]:
        followed = follow(left1, left2, surface, config)
        if followed is None:
            continue
        followed = followed[np.linspace(0, len(followed) - 1, min(10 * most_points, len(followed))).astype(np.intp)]
        x1, y1, x2, y2 = np.rint(followed).astype(np.intp).T
        inside = (x2 >= 0) & (x2 < width) & (y2 >= 0) & (y2 < height)
        followed, x1, y1, x2, y2 = followed[inside], x1[inside], y1[inside], x2[inside], y2[inside]
        first = np.column_stack([followed[:, :2], disparity[y1, x1]])
        second = np.column_stack([followed[:, 2:], start.match2.disparity[y2, x2]])
        usable = np.flatnonzero((first[:, 2] > 0.5) & (second[:, 2] > 0.5) & start.match2.matched[y2, x2])
        if len(usable) < config.least_points:
            continue
        chosen = usable[np.linspace(0, len(usable) - 1, min(most_points, len(usable))).astype(np.intp)]
        motions.append(fit_surface(surface, first[chosen], second[chosen], projection, config.inliers))
    return [motion for motion in motions if motion is not None]
