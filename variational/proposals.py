"""From a start to a state in which every pixel moves as it was seen to, or as something rigid does.

The order of things: correspondences of the start -> rigid motions; planes for what has no texture -> a choice per pixel
between measured and rigid motion -> unmatched disparities filled again, now with the second time's evidence -> the choice
once more.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from variational.camera import StereoCamera
from variational.census import census
from variational.edges import EdgesConfig, other_sides
from variational.evidence import EvidenceConfig, refill
from variational.frames import Frames
from variational.fusion import FusionConfig, choose, motion_costs
from variational.initialise import Start, sample
from variational.jit import over_rows, rowwise, side_by_side
from variational.matching import MatchingConfig, StereoMatch
from variational.objects import ObjectsConfig, evident, searches, unexplained_surfaces
from variational.planes import PlanesConfig, plane_disparities
from variational.rigid import Correspondences, RigidConfig, RigidMotion, displacements, find_motions
from variational.self_calibration import guess_camera
from variational.state import D1, C, flow_of
from variational.visibility import project_visibility

MEASURED = -1
"""Label of pixels that keep their measured motion; 0 is the camera's, 1, 2, ... the objects'."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A fused state.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W) float32.
    labels : np.ndarray
        (H, W) int: index into `motions`, MEASURED where the start's own motion was kept.
    motions : list of RigidMotion
        The camera's first; empty where no rigid motion was found, and then nothing was changed.
    cost : np.ndarray
        (H, W) float32 in [0, 1]: how badly the census words agree where the chosen motion leads.
    camera : StereoCamera or None
        Whose motions they are, given or guessed; None without motions.
    """

    state: np.ndarray
    labels: np.ndarray
    motions: list[RigidMotion]
    cost: np.ndarray
    camera: StereoCamera | None = None


def keep(start: Start) -> Proposal:
    """The start as it is: nothing proposed."""
    shape = start.state.shape[1:]
    return Proposal(start.state, np.full(shape, MEASURED, np.int32), [], np.zeros(shape, np.float32))


def round_trips(
    flow: np.ndarray, backward_flow: np.ndarray, disparity1: np.ndarray, disparity2: np.ndarray, stride: int = 1,
    tolerance_px: float = 1.0,
) -> Correspondences:  # fmt: skip
    """Where points of left1 went: flow that leads back within `tolerance_px`, with the disparities at both ends.

    Flows are (H, W, 2), disparities (H, W), of left1 and of left2; every `stride`-th row and column is taken.
    """
    height, width = flow.shape[:2]
    flow, disparity1 = flow[::stride, ::stride], disparity1[::stride, ::stride]
    y, x = np.mgrid[:height:stride, :width:stride].astype(np.float32)
    to_x, to_y = x + flow[..., 0], y + flow[..., 1]
    inside = (to_x >= 0) & (to_x <= width - 1) & (to_y >= 0) & (to_y <= height - 1)
    back, second = (
        cv2.remap(plane, to_x, to_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in (backward_flow, disparity2)
    )
    there_and_back = cv2.magnitude(flow[..., 0] + back[..., 0], flow[..., 1] + back[..., 1])
    return Correspondences(
        np.dstack([x, y, disparity1]), np.dstack([to_x, to_y, second]), inside & (there_and_back < tolerance_px)
    )


def correspondences(start: Start) -> Correspondences:
    """Round trips between points that are matched at both times."""
    flow = flow_of(start.state)
    trips = round_trips(flow, start.backward_flow, start.state[D1], start.match2.disparity)
    matched2 = sample(start.match2.matched.astype(np.float32), flow) > 0.99
    return replace(trips, valid=trips.valid & start.match1.matched & matched2)


def nearby(motions: list[RigidMotion], slots: int) -> tuple[np.ndarray, np.ndarray]:
    """(slots, H, W) int: the objects nearest to each pixel, nearest first, MEASURED where there are none near; and bool,
    where the pixel is one of those that the object's motion was found by.

    Near is within half of the object's own size: what moves with it but could not be matched lies around it.
    """
    shape = motions[0].support.shape
    labels, nearest = np.full((slots, *shape), MEASURED, np.int32), np.full((slots, *shape), np.inf, np.float32)
    for index, motion in enumerate(motions[1:], start=1):
        reach = 0.6 * np.sqrt(motion.support.sum()) + 15
        rows, columns = (_span(np.any(motion.support, axis), int(1.1 * reach)) for axis in (1, 0))  # chamfers run short
        distance = cv2.distanceTransform((~motion.support[rows, columns]).astype(np.uint8), cv2.DIST_L2, 3)
        over_rows(_insert, len(distance), distance, reach, index, nearest[:, rows, columns], labels[:, rows, columns])
    return labels[: len(motions) - 1], nearest[: len(motions) - 1] == 0


def with_priors(costs: np.ndarray, found_there: np.ndarray, config: FusionConfig) -> np.ndarray:
    """Costs (K, H, W) of the measured motion, the camera's and K - 2 objects', with what the choice of each must make up for.

    An object's motion is free where it was found, (K - 2, H, W) bool: parts of it that show no texture follow the rest.
    """
    biased = costs.copy()
    biased[0] += config.measured_prior
    biased[2:] += np.where(found_there, np.float32(0), np.float32(config.object_prior))
    return biased


def _span(occupied: np.ndarray, margin: int) -> slice:
    """From the first True to the last, and a margin around."""
    places = np.flatnonzero(occupied)
    return slice(max(places[0] - margin, 0), places[-1] + margin + 1) if len(places) else slice(0, 0)


@rowwise
def _insert(
    first: int, last: int, distance: np.ndarray, reach: float, index: int, nearest: np.ndarray, labels: np.ndarray
) -> None:
    """Put an object into the slots of the pixels in its reach; an earlier one stays ahead at the same distance."""
    slots, _, width = labels.shape
    for y in range(first, last):
        for x in range(width):
            if distance[y, x] > reach or distance[y, x] >= nearest[slots - 1, y, x]:
                continue
            slot = slots - 1
            while slot > 0 and distance[y, x] < nearest[slot - 1, y, x]:
                nearest[slot, y, x], labels[slot, y, x] = nearest[slot - 1, y, x], labels[slot - 1, y, x]
                slot -= 1
            nearest[slot, y, x], labels[slot, y, x] = distance[y, x], index


@rowwise
def _take(
    first: int, last: int, chosen: np.ndarray, candidates: np.ndarray, labels_of: np.ndarray, costs: np.ndarray,
    motion: np.ndarray, labels: np.ndarray, cost: np.ndarray,
) -> None:  # fmt: skip
    """What belongs to the chosen candidate of each pixel: its motion (3, H, W), label and cost (H, W)."""
    width = chosen.shape[1]
    for y in range(first, last):
        for x in range(width):
            k = chosen[y, x]
            for i in range(3):
                motion[i, y, x] = candidates[k, i, y, x]
            labels[y, x], cost[y, x] = labels_of[k, y, x], costs[k, y, x]


def propose(
    start: Start, frames: Frames, camera: StereoCamera | None, matching: MatchingConfig, rigid: RigidConfig,
    objects: ObjectsConfig, planes: PlanesConfig, fusion: FusionConfig, evidence: EvidenceConfig,
    edges: EdgesConfig,
) -> Proposal:  # fmt: skip
    """Fuse the start with rigid motions.

    Parameters
    ----------
    start : Start
    frames : Frames
    camera : StereoCamera or None
        With it the motions are metric; without, see variational.rigid.

    Returns
    -------
    Proposal
    """

    grey = frames.grey[0]

    def search() -> tuple[StereoCamera, list[RigidMotion]]:
        matches = correspondences(start)
        known = camera or guess_camera(matches, rigid)
        return known, find_motions(matches, known, rigid)

    def fill_planes() -> StereoMatch:
        return _with_planes(start.match1, frames.left1, planes)

    (known, motions), match1 = side_by_side(search, fill_planes)
    if not motions:
        return keep(start)
    words = motion_words(start, frames, matching)
    state = start.state.copy()
    state[D1] = match1.disparity
    motions = evident(motions, state[D1], words, fusion)

    def fuse(objects_near: int) -> tuple[np.ndarray, np.ndarray]:
        """Labels and costs under the motions so far; writes the chosen motion to the state."""
        everywhere = np.array([MEASURED, 0])[:, None, None] + np.zeros_like(nothing)
        objects_there, found_there = nearby(motions, objects_near)
        labels_of = np.concatenate([everywhere, objects_there])
        candidates = _candidates(state, start, motions, labels_of)
        costs = motion_costs(candidates, state[D1], words, fusion)
        chosen = choose(candidates, with_priors(costs, found_there, fusion), state[D1], grey, fusion)
        labels, cost = np.empty_like(nothing), np.empty_like(grey)
        over_rows(_take, len(grey), chosen, candidates, labels_of, costs, state[C:], labels, cost)
        return labels, cost

    nothing = keep(start).labels
    labels, cost = fuse(1)
    if not evidence.fill:
        return Proposal(state, labels, motions, cost, known)

    surfaces = unexplained_surfaces(state[D1], cost, project_visibility(state), start.match1.matched, objects)
    homographies = np.stack([motion.homography for motion in motions])
    disparity, *found = side_by_side(
        lambda: refill(match1, start.match2, grey, labels, homographies, matching, evidence),
        *searches(start, state, frames, surfaces, words, known.projection(), objects, fusion),
    )
    if edges.reach_px:
        sides = disparity.ravel()[other_sides(disparity, frames.left1, edges)]
        disparity = cv2.medianBlur(sides, 3)  # each pixel decided for itself
    state[D1] = disparity
    motions += [motion for motion in found if motion is not None]
    labels, cost = fuse(2)
    return Proposal(state, labels, motions, cost, known)


def motion_words(start: Start, frames: Frames, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Census words of left1, left2 and right2 in which nothing is overlooked.

    A pattern that stands still speaks for standing still alone, which few pixels do; faint textures speak for the right motion.
    """
    if config.overlook == 0:
        return start.match1.words_left, start.match2.words_left, start.match2.words_right
    left1, _, left2, right2 = frames.grey
    return census(left1), census(left2), census(right2)


def _with_planes(match: StereoMatch, image: np.ndarray, config: PlanesConfig) -> StereoMatch:
    """A match in which disparities of planes are as good as matched ones where there are none."""
    disparity = plane_disparities(image, match.disparity, match.matched, config)
    planar = np.isfinite(disparity) & ~match.matched
    return replace(match, disparity=np.where(planar, disparity, match.disparity), matched=match.matched | planar)


def _candidates(state: np.ndarray, start: Start, motions: list[RigidMotion], labels_of: np.ndarray) -> np.ndarray:
    """(K, 3, H, W): disparity change, u, v of the measured motion, the camera's, and of the objects near each pixel."""
    candidates = displacements(np.stack([motion.homography for motion in motions]), labels_of, state[D1])
    flow = flow_of(start.state)
    candidates[0, 0] = sample(start.match2.disparity, flow) - state[D1]
    candidates[0, 1:] = start.state[C + 1 :]
    return candidates
