"""Moving objects that dense flow lost: found again in what no motion explains.

Where no candidate motion makes the images agree, although the pixels should be seen at time 2, something moved in a way
that dense flow could not follow, mostly too far. Patches of each connected surface of such pixels are looked for in left2
(variational.patches) and propose a few motions. Left2 is then seen through each of them, where little is left to move:
dense inverse search measures it, a better fit follows, and so on. Of all these motions the surface takes the one under
which the images agree best, if they agree better than so far by more than chance; one that falls short of this by little
may be a pixel or two beside the truth, and climbs to where they agree better.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter

import cv2
import numpy as np

from variational.frames import Frames
from variational.fusion import FusionConfig, costs_of_ends
from variational.initialise import Start, dense_inverse_search
from variational.patches import Patches, PatchesConfig
from variational.rigid import RigidMotion, apply_homography, displacements, thin
from variational.state import D1, C
from variational.surface_motion import climb, fit_from, translations

logger = logging.getLogger(__name__)

MARGIN = 16
"""Pixels around a surface that dense inverse search sees too."""
PATCHES_PX = 4.0
"""How exactly the patches' places are known: as their pixels, for they turn."""
FLOW_PX = (2.0, 1.0, 1.0, 1.0)
"""How exactly those of dense inverse search are known, the first time and again."""
FOLLOWED = 2
"""Proposals that dense inverse search is spent on."""
PROMISE = 2
"""A motion that so many more rises like the last would not make better than the state's is given up."""
NEARLY = 0.02
"""A motion whose gain falls short of nothing by less may be a little beside the truth."""
MOVED = 300
"""Points of a surface that the steps of its motion are measured at, at most."""
ASTRAY_PX = 2.0
"""A surface whose patches are nearer to where its motion leads is not lost."""
COMPARED = 3000
"""Pixels of a surface at which the images are compared, at most."""
EVEN = 0.02
"""Gradient, an intensity in [0, 1] a pixel, at which dense flow tells half of what there is to tell along it."""
DOUBT = 0.05
"""Share of its word that dense flow keeps where and along what it sees nothing."""
SEES_PX = 9
"""Side of the patches that dense flow sees, in pixels of its own images."""
INDEPENDENT_PX = 10
"""How far apart two comparisons have little in common: census words are 9 pixels wide."""


@dataclass(frozen=True)
class ObjectsConfig:
    """Search for lost objects.

    Parameters
    ----------
    most : int
        Surfaces looked for, those with most matched pixels; 0 leaves the search out.
    cost : float
        A pixel is unexplained if its chosen motion costs more than this (variational.fusion), in [0, 1].
    least_px : int
        Fewest unexplained pixels of a surface that are matched at time 1.
    jump_px : float
        A difference of disparity between neighbours that separates two surfaces.
    places : int
        Patches of a surface that are looked for, at most.
    least_places : int
        Fewest of them that must be found again.
    proposals : int
        Translations that a fit begins with, at most.
    flow_px : int
        Side of the square whose area dense inverse search reduces a surface and its surroundings to.
    patches
        Settings of the patches.
    """

    most: int = 16
    cost: float = 0.45
    least_px: int = 75
    jump_px: float = 1.5
    places: int = 80
    least_places: int = 5
    proposals: int = 6
    flow_px: int = 160
    patches: PatchesConfig = field(default_factory=PatchesConfig)


def unexplained_surfaces(
    disparity: np.ndarray, cost: np.ndarray, visible: np.ndarray, matched: np.ndarray, config: ObjectsConfig
) -> list[np.ndarray]:
    """Connected surfaces of pixels that no motion explains: (H, W) bool masks, those with most matched pixels first.

    What has no texture is never explained, but neither is it matched at time 1: it does not count. Nor does it speak against
    a surface: a lorry may be plain but for its edges, and nearly as large as the image.
    """
    open_ = ((cost > config.cost) & visible).astype(np.uint8)
    open_ = cv2.morphologyEx(open_, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for axis in (0, 1):
        jump = np.abs(np.diff(disparity, axis=axis)) > config.jump_px
        open_[(slice(None),) * axis + (slice(1, None),)][jump] = 0
    count, labels = cv2.connectedComponents(open_, connectivity=4)
    compared = np.bincount(labels[matched], minlength=count)
    compared[0] = 0
    order = np.argsort(-compared, kind="stable")[: config.most]
    return [labels == k for k in order if compared[k] >= config.least_px]


def evident(
    motions: list[RigidMotion], disparity: np.ndarray, words: tuple[np.ndarray, np.ndarray, np.ndarray], fusion: FusionConfig
) -> list[RigidMotion]:
    """The camera's motion, and those objects' under which the images agree better where they were found.

    Flow that slips along a repeated pattern (windows of a wall) moves as something rigid does. Where the camera's motion leads
    out of the image, nothing speaks against it.

    Parameters
    ----------
    motions : list of RigidMotion
        The camera's first.
    disparity : np.ndarray
        (H, W) at time 1, pixels.
    words
        As for `searches`.
    fusion : FusionConfig
        How motions are compared.

    Returns
    -------
    list of RigidMotion
        In their order; those left out are told in the log.
    """
    camera, *objects = motions

    def gain(motion: RigidMotion) -> float:
        points = _points(disparity, motion.support, COMPARED)
        places = points[:, :2].astype(np.intp)
        ends = (apply_homography(each.homography, points) for each in (camera, motion))
        still, moving = (costs_of_ends(places, each, words, fusion) for each in ends)
        return float(np.nan_to_num(still - moving).sum())  # NaN: outside of the image, where nothing is compared

    kept = [motion for motion in objects if gain(motion) > 0]
    if len(kept) < len(objects):
        logger.info("%d of %d moving objects dropped: nothing shows that they move", len(objects) - len(kept), len(objects))
    return [camera, *kept]


def _flow_at_most(first: np.ndarray, second: np.ndarray, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 2) dense inverse search, at a reduced size if the images are larger than such a square; and what it saw.

    That is (H, W, 3): means over its patches of the squares and the product of the second image's derivatives, dx^2, dx dy, dy^2.
    """
    height, width = first.shape
    factor = max(1.0, np.sqrt(first.size / side_px**2))
    size = max(MARGIN, round(width / factor)), max(MARGIN, round(height / factor))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (first, second)]
    flow = cv2.resize(dense_inverse_search(*small), (width, height)) * np.array([width / size[0], height / size[1]], np.float32)
    dx, dy = (0.5 * cv2.Sobel(small[1], cv2.CV_32F, *order, ksize=1) for order in ((1, 0), (0, 1)))
    tensor = cv2.blur(np.dstack([dx * dx, dx * dy, dy * dy]), (SEES_PX, SEES_PX))
    return flow, cv2.resize(tensor, (width, height))


def telling_of(tensor: np.ndarray) -> np.ndarray:
    """(N, 2, 2) symmetric: how much dense flow tells in each direction, from DOUBT to 1, given dx^2, dx dy, dy^2 (N, 3).

    On an even surface it says no more than where it began, and beside an edge no more than how far that went across itself.
    """
    values, vectors = np.linalg.eigh(tensor[:, [0, 1, 1, 2]].reshape(-1, 2, 2).astype(np.float64))
    values = np.maximum(values, 0)
    told = DOUBT + (1 - DOUBT) * np.sqrt(values / (values + EVEN**2))
    return (vectors * told[:, None]) @ vectors.transpose(0, 2, 1)


def follow(
    left1: np.ndarray, left2: np.ndarray, surface: np.ndarray, disparity: np.ndarray, homography: np.ndarray,
    config: ObjectsConfig, most_points: int = 2500,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Places of a surface's pixels at both times, measured by dense flow from where a motion leads.

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

    Returns
    -------
    places : np.ndarray
        (N, 4) x, y at time 1 and at time 2.
    telling : np.ndarray
        (N, 2, 2), see `telling_of`.
    """
    rows, columns = (np.flatnonzero(surface.any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - MARGIN, 0), max(columns[0] - MARGIN, 0)
    part = slice(top, rows[-1] + 1 + MARGIN), slice(left, columns[-1] + 1 + MARGIN)
    inside = surface[part]
    middle = np.median(disparity[part][inside])
    # what lies far before or behind the surface would be torn away from it: moved as if it lay there
    near = np.where(np.abs(disparity[part] - middle) < 0.3 * middle + 5, disparity[part], middle)
    corner = np.eye(4)
    corner[:2, 3] = left, top
    u, v = displacements((homography @ corner)[None], np.zeros((1, *near.shape), np.int32), near)[0, 1:]
    y, x = np.indices(near.shape, np.float32)
    to = np.nan_to_num(np.dstack([x + u, y + v]), nan=-1, posinf=-1, neginf=-1)  # points that come to lie beside the camera
    seen = cv2.remap(left2, to, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    flow, tensor = _flow_at_most(np.ascontiguousarray(left1[part]), seen, config.flow_px)
    points = np.argwhere(inside)
    points = points[np.linspace(0, len(points) - 1, min(most_points, len(points))).astype(np.intp)]
    at = (points[:, ::-1] + flow[points[:, 0], points[:, 1]]).astype(np.float32)
    places = cv2.remap(to, at[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    ends = np.hstack([points[:, ::-1] + (left, top), places]).astype(np.float64)
    return ends, telling_of(tensor[points[:, 0], points[:, 1]])


def searches(
    start: Start, state: np.ndarray, frames: Frames, surfaces: list[np.ndarray],
    words: tuple[np.ndarray, np.ndarray, np.ndarray], projection: np.ndarray, config: ObjectsConfig, fusion: FusionConfig,
) -> list[Callable[[], RigidMotion | None]]:  # fmt: skip
    """For each surface that dense flow lost, what finds its rigid motion; they do not depend on one another.

    Parameters
    ----------
    start : Start
        For the disparity at time 2.
    state : np.ndarray
        (5, H, W), pixels; of it D1, and the motion that explains the surfaces badly.
    frames : Frames
    surfaces : list of np.ndarray
        (H, W) bool masks.
    words : tuple of three np.ndarray
        (2, H, W) uint64 census words of left1, left2 and right2.
    projection : np.ndarray
        (4, 4) of the camera.
    config : ObjectsConfig
    fusion : FusionConfig
        How motions are compared.

    Returns
    -------
    list of functions
        Each gives the motion of a surface that is seen again elsewhere than its motion so far leads to, and moves rigidly;
        None of another.
    """
    if not surfaces:
        return []

    def find(surface: np.ndarray, seen: np.ndarray) -> RigidMotion | None:
        x, y = np.rint(seen[:, :2]).astype(np.intp).T
        astray = np.abs(seen[:, 2:] - seen[:, :2] - state[C + 1 :, y, x].T).max(axis=1)
        if len(seen) < config.least_places or np.median(astray) < ASTRAY_PX:
            return None  # a shadow, a highlight: the images disagree, the motion is right
        first, second, _ = _ends(start, state[D1], seen, matched=False)
        proposed = translations(first, second, projection, PATCHES_PX, config.proposals)
        gain_of = _judge(state, surface, words, projection, fusion)
        fitted = (fit_from(each, first, second, projection, PATCHES_PX, translates=True) for each in proposed)
        begun = sorted(((gain_of(each), each) for each in fitted if each is not None), key=itemgetter(0), reverse=True)
        improved = (_improved(*each, start, state[D1], frames, surface, projection, gain_of, config) for each in begun[:FOLLOWED])
        gain, best = max(improved, key=itemgetter(0), default=(-np.inf, np.eye(4)))
        if 0 >= gain > -NEARLY:
            gain, best = climb(gain, best, _points(state[D1], surface, MOVED), projection, gain_of)
        return RigidMotion(best, _homography(best, projection), surface) if gain > 0 else None

    patches = Patches(frames.left1, frames.left2, config.patches).follow(surfaces, config.places)
    return [partial(find, *each) for each in zip(surfaces, patches, strict=True)]


def _homography(transform: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """(4, 4) of (x, y, disparity, 1)."""
    return projection @ transform @ np.linalg.inv(projection)


def _improved(
    gain: float, transform: np.ndarray, start: Start, disparity: np.ndarray, frames: Frames, surface: np.ndarray,
    projection: np.ndarray, gain_of: Callable[[np.ndarray], float], config: ObjectsConfig,
) -> tuple[float, np.ndarray]:  # fmt: skip
    """A surface's gain and transform (4, 4), fitted to what dense flow measures from it, as long as the gain rises."""
    left1, _, left2, _ = frames.grey
    for turn, tolerance_px in enumerate(FLOW_PX):
        followed, telling = follow(left1, left2, surface, disparity, _homography(transform, projection), config)
        first, second, chosen = _ends(start, disparity, followed, matched=turn > 0)
        fitted = fit_from(transform, first, second, projection, tolerance_px, translates=False, telling=telling[chosen])
        if fitted is None:
            break
        better = gain_of(fitted)
        rise = better - gain
        if rise <= 0:
            break
        gain, transform = better, fitted
        if gain + PROMISE * rise <= 0:
            break
    return gain, transform


def _judge(
    state: np.ndarray, surface: np.ndarray, words: tuple[np.ndarray, np.ndarray, np.ndarray], projection: np.ndarray,
    config: FusionConfig,
) -> Callable[[np.ndarray], float]:  # fmt: skip
    """How much better the images agree on a surface under a transform (4, 4) than under the state, less a standard error."""
    points = _points(state[D1], surface, COMPARED)
    places = points[:, :2].astype(np.intp)
    x, y = places.T
    change, u, v = state[C:, y, x]
    now = costs_of_ends(places, points + np.column_stack([u, v, change]), words, config)
    now[np.isnan(now)] = config.outside_cost
    error = INDEPENDENT_PX / np.sqrt(np.count_nonzero(surface))

    def gain_of(transform: np.ndarray) -> float:
        ends = apply_homography(_homography(transform, projection), points)
        gain = now - costs_of_ends(places, ends, words, config)
        gain[np.isnan(gain)] = 0  # outside of the image nothing is compared
        return float(gain.mean() - error * gain.std())

    return gain_of


def _points(disparity: np.ndarray, surface: np.ndarray, most: int) -> np.ndarray:
    """(N, 3) x, y, disparity of a surface's pixels, evenly thinned."""
    y, x = np.unravel_index(thin(surface.ravel(), most), surface.shape)
    return np.column_stack([x, y, disparity[y, x]])


def _ends(
    start: Start, disparity: np.ndarray, followed: np.ndarray, matched: bool, most: int = 250
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 3) x, y, disparity at both times of points (n, 4), those that are inside, and their indices (N,).

    Only those that are matched at time 2, if asked.
    """
    size = np.array([disparity.shape[1], disparity.shape[0]] * 2)
    nearest = np.rint(followed)
    inside = np.flatnonzero(((nearest >= 0) & (nearest < size)).all(axis=1))
    followed = followed[inside]
    x1, y1, x2, y2 = nearest[inside].astype(np.intp).T
    first = np.column_stack([followed[:, :2], disparity[y1, x1]])
    second = np.column_stack([followed[:, 2:], start.match2.disparity[y2, x2]])
    usable = np.flatnonzero((first[:, 2] > 0.5) & (second[:, 2] > 0.5) & (start.match2.matched[y2, x2] | (not matched)))
    chosen = usable[np.linspace(0, len(usable) - 1, min(most, len(usable))).astype(np.intp)]
    return first[chosen], second[chosen], inside[chosen]
