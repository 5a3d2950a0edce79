"""Rigid motions between the two times, fitted to stereo and flow correspondences.

Most of the world moves rigidly, and where two images cannot be compared (occlusion, pixels that leave the view) the
rigid motion of what surrounds them is all there is. A motion T acts on (x, y, disparity, 1) as the homography
``P T P^-1``, P being the camera's projection (Demirdjian and Darrell 2001). Fits are robust: three-point RANSAC on the
image motion, then iteratively re-weighted Gauss-Newton on image motion and disparity together.

Without a calibration the camera is the one under which the correspondences move most rigidly
(`variational.self_calibration`).
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from variational.camera import StereoCamera
from variational.jit import over_rows, rowwise, scalar

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RigidConfig:
    """Rigid-motion proposals.

    Parameters
    ----------
    max_objects : int
        Motions sought beside the camera's; 0 for none.
    tolerance_px : float
        A correspondence follows a motion if its predicted (x, y, disparity) is this close.
    points : int
        Correspondences used in one fit, drawn evenly.
    min_points : int
        A fit to fewer correspondences is not tried.
    min_object : float
        Smallest object, as a share of the image.
    min_inliers : float
        Share of an object's correspondences that its motion must explain.
    """

    max_objects: int = 12
    tolerance_px: float = 2.0
    points: int = 4000
    min_points: int = 60
    min_object: float = 0.0006
    min_inliers: float = 0.5


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of left1 with their place at time 2.

    Parameters
    ----------
    first, second : np.ndarray
        (H, W, 3) float32, (x, y, disparity) at time 1 and 2, in pixels.
    valid : np.ndarray
        (H, W) bool, where both are matched and consistent.
    """

    first: np.ndarray
    second: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """One motion and the points that it was found on.

    Parameters
    ----------
    transform : np.ndarray
        (4, 4) float64; takes a point at time 1 to time 2, both in the left camera's frame.
    homography : np.ndarray
        (4, 4) float64; the same on (x, y, disparity, 1).
    support : np.ndarray
        (H, W) bool, the correspondences that follow it.
    """

    transform: np.ndarray
    homography: np.ndarray
    support: np.ndarray


@rowwise
def _displacements(
    first: int, last: int, homographies: np.ndarray, labels: np.ndarray, disparity: np.ndarray, moved: np.ndarray
) -> None:
    width = disparity.shape[1]
    for y in range(first, last):
        for k in range(len(labels)):
            for x in range(width):
                moved[k, :, y, x] = np.nan
                if labels[k, y, x] < 0:
                    continue
                h, d = homographies[labels[k, y, x]], disparity[y, x]
                scale = h[3, 0] * x + h[3, 1] * y + (h[3, 2] * d + h[3, 3])
                if scale > 0:
                    moved[k, 0, y, x] = (h[2, 0] * x + h[2, 1] * y + (h[2, 2] * d + h[2, 3])) / scale - d
                    moved[k, 1, y, x] = (h[0, 0] * x + h[0, 1] * y + (h[0, 2] * d + h[0, 3])) / scale - x
                    moved[k, 2, y, x] = (h[1, 0] * x + h[1, 1] * y + (h[1, 2] * d + h[1, 3])) / scale - y


def displacements(homographies: np.ndarray, labels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Motion that homographies of image-and-disparity space give to each pixel.

    Parameters
    ----------
    homographies : np.ndarray
        (M, 4, 4), see RigidMotion.
    labels : np.ndarray
        (K, H, W) integers: which homography moves the pixel, for K choices at every pixel; negative for none.
    disparity : np.ndarray
        (H, W) at time 1, pixels.

    Returns
    -------
    np.ndarray
        (K, 3, H, W) float32: disparity change, u, v in the state's order; NaN without a label and where a point goes
        behind the camera.
    """
    moved = np.empty((len(labels), 3, *disparity.shape), np.float32)
    over_rows(_displacements, len(disparity), homographies.astype(np.float64), labels, disparity, moved)
    return moved


@rowwise
def _followers(
    first: int, last: int, homography: np.ndarray, before: np.ndarray, after: np.ndarray, candidates: np.ndarray,
    tolerance: float, follows: np.ndarray,
) -> None:  # fmt: skip
    """follows (H, W): the candidates whose predicted (x, y, disparity) is within the tolerance."""
    width, h = candidates.shape[1], homography
    for y in range(first, last):
        for x in range(width):
            follows[y, x] = False
            if candidates[y, x]:
                a, b = before[y, x], after[y, x]
                scale = h[3, 0] * a[0] + h[3, 1] * a[1] + h[3, 2] * a[2] + h[3, 3]
                distance = 0.0
                for i in range(3):
                    distance += ((h[i, 0] * a[0] + h[i, 1] * a[1] + h[i, 2] * a[2] + h[i, 3]) / scale - b[i]) ** 2
                follows[y, x] = distance < tolerance**2


@scalar
def _jump(a: np.ndarray, b: np.ndarray, a_from: np.ndarray, b_from: np.ndarray) -> float:
    """Difference of disparity at time 1 and of motion between two correspondences a -> b."""
    jump = abs(a[2] - a_from[2])
    for i in range(3):
        jump += abs((b[i] - a[i]) - (b_from[i] - a_from[i]))
    return jump


@rowwise
def _continuous(
    first: int, last: int, before: np.ndarray, after: np.ndarray, candidates: np.ndarray, most: float, out: np.ndarray
) -> None:
    """out (H, W) uint8: the candidates without a jump to the pixels on the left and above."""
    width = candidates.shape[1]
    for y in range(first, last):
        for x in range(width):
            smooth = candidates[y, x]
            if smooth and x > 0:
                smooth = _jump(before[y, x], after[y, x], before[y, x - 1], after[y, x - 1]) < most
            if smooth and y > 0:
                smooth = _jump(before[y, x], after[y, x], before[y - 1, x], after[y - 1, x]) < most
            out[y, x] = smooth


def projected(points: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """(N, 3) points in metres -> (N, 3) of x, y, disparity."""
    image = points @ projection[:, :3].T + projection[:, 3]
    return image[:, :3] / image[:, 3:]


def fit_motion(
    first: np.ndarray, second: np.ndarray, projection: np.ndarray, tolerance_px: float = 1.0, iterations: int = 5
) -> np.ndarray | None:
    """Rigid motion between two sets of points in image-and-disparity space.

    Parameters
    ----------
    first, second : np.ndarray
        (N, 3) float64, (x, y, disparity > 0), pixels.
    projection : np.ndarray
        (4, 4), StereoCamera.projection().
    tolerance_px : float
        How exactly the points are known.
    iterations : int
        Gauss-Newton steps after RANSAC.

    Returns
    -------
    np.ndarray or None
        (4, 4) rigid transform; None where no three points agree with others or the points do not fix a motion.
    """
    points = projected(first, np.linalg.inv(projection))
    camera_matrix = np.vstack([projection[:2, :3], [0, 0, 1]])
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points, np.ascontiguousarray(second[:, :2]), camera_matrix, None,
            iterationsCount=200, reprojectionError=tolerance_px, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
    except cv2.error:  # what OpenCV says of degenerate points
        return None
    if not found or inliers is None:
        return None
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return _gauss_newton(transform, points, second, projection, iterations, 0.7 * tolerance_px)


def rigid_derivatives(points: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """(6, 3, N) derivatives of (x, y, disparity) of (N, 3) points by a twist from the left: translation (3), rotation (3)."""
    fx, fy, fb = projection[0, 0], projection[1, 1], projection[2, 3]
    X, Y, Z = points.T
    x, y, inverse = X / Z, Y / Z, 1 / Z
    jacobian = np.zeros((6, 3, len(points)))
    jacobian[0, 0], jacobian[1, 1] = fx * inverse, fy * inverse
    jacobian[2] = -fx * x * inverse, -fy * y * inverse, -fb * inverse**2
    jacobian[3] = -fx * x * y, -fy * (1 + y**2), -fb * y * inverse
    jacobian[4] = fx * (1 + x**2), fy * x * y, fb * x * inverse
    jacobian[5, 0], jacobian[5, 1] = -fx * y, fy * x
    return jacobian


def twist(step: np.ndarray) -> np.ndarray:
    """(4, 4) rigid transform of a twist (6,): translation, then a vector of rotation."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = cv2.Rodrigues(step[3:])[0], step[:3]
    return transform


def gauss_newton_step(
    transform: np.ndarray, points: np.ndarray, second: np.ndarray, projection: np.ndarray,
    weigh: Callable[[np.ndarray], np.ndarray], turning: float = 0.0, telling: np.ndarray | None = None,
) -> np.ndarray | None:  # fmt: skip
    """One step of a rigid transform (4, 4) towards less of the weighed squares of the distance in (x, y, disparity).

    Parameters
    ----------
    transform : np.ndarray
        (4, 4), a twist from the left changes it.
    points : np.ndarray
        (N, 3) at time 1, metres.
    second : np.ndarray
        (N, 3) x, y, disparity at time 2.
    projection : np.ndarray
        (4, 4), StereoCamera.projection().
    weigh : function
        Residuals (N, 3) to their weights (N, 3).
    turning : float
        Weight of the squared angle of rotation, px^2: where the points do not tell, a motion does not turn.
    telling : np.ndarray or None
        (N, 2, 2) symmetric factors of the residuals in (x, y): how much each point's place says, by direction; all if None.

    Returns
    -------
    np.ndarray or None
        (4, 4); None where the points do not fix a motion.
    """
    moved = points @ transform[:3, :3].T + transform[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = projected(moved, projection) - second
        if telling is not None:
            residual[:, :2] = np.einsum("nij,nj->ni", telling, residual[:, :2])
        weight = weigh(residual)
        usable = (moved[:, 2] > 0) & np.isfinite(weight).all(axis=1)
    residual, root = residual[usable], np.sqrt(weight[usable])
    if len(root) < 3:
        return None
    jacobian = rigid_derivatives(moved[usable], projection)
    if telling is not None:
        jacobian[:, :2] = np.einsum("nij,kjn->kin", telling[usable], jacobian[:, :2])
    jacobian = (jacobian * root.T).reshape(6, -1)
    normal, gradient = jacobian @ jacobian.T, jacobian @ (residual * root).T.ravel()
    if turning:
        normal[3:, 3:] += turning * np.eye(3)
        gradient[3:] += turning * cv2.Rodrigues(transform[:3, :3])[0][:, 0]
    scaling = np.sqrt(np.diag(normal))
    if not scaling.all() or np.linalg.cond(normal / np.outer(scaling, scaling)) > 1e12:
        return None
    return twist(-np.linalg.solve(normal, gradient)) @ transform


def _gauss_newton(
    transform: np.ndarray, points: np.ndarray, second: np.ndarray, projection: np.ndarray, iterations: int,
    scale_px: float,
) -> np.ndarray | None:  # fmt: skip
    """Minimise the Geman-McClure penalty of the distance in (x, y, disparity)."""

    def weigh(residual: np.ndarray) -> np.ndarray:
        weight = 1 / (1 + (residual**2).sum(axis=1) / scale_px**2) ** 2
        return np.repeat(weight[:, None], 3, axis=1)

    for _ in range(iterations):
        step = gauss_newton_step(transform, points, second, projection, weigh)
        if step is None:
            return None
        transform = step
    return transform


def thin(valid: np.ndarray, count: int) -> np.ndarray:
    """(n,) flat indices of at most `count` of the set pixels, evenly spread."""
    indices = np.flatnonzero(valid)
    return indices[np.linspace(0, len(indices) - 1, count).astype(np.intp)] if len(indices) > count else indices


def apply_homography(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) points in image-and-disparity space, moved."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return projected(points, homography)


def find_motions(matches: Correspondences, camera: StereoCamera, config: RigidConfig) -> list[RigidMotion]:
    """The camera's motion and those of moving objects.

    The camera's motion is the one that most correspondences follow. What is left over is cut into connected pieces at
    jumps of disparity or motion; every piece that is large enough gets a fit of its own, largest first, and takes the
    correspondences that follow it out of the rest. Pieces that are too small or whose fit explains too little are
    dropped: no object is invented.

    Returns
    -------
    list of RigidMotion
        The camera's first; empty where there are too few correspondences or no rigid motion explains them.
    """
    projection = camera.projection()
    first, second = (m.reshape(-1, 3) for m in (matches.first, matches.second))
    left = matches.valid & (matches.first[..., 2] > 0.5) & (matches.second[..., 2] > 0.5)

    def fit(region: np.ndarray, share: float) -> RigidMotion | None:
        chosen = thin(region, config.points)
        if len(chosen) < config.min_points:
            return None
        transform = fit_motion(first[chosen].astype(np.float64), second[chosen].astype(np.float64), projection)
        if transform is None:
            return None
        homography = camera.homography(transform)
        support = np.empty(region.shape, bool)
        over_rows(_followers, len(left), homography, matches.first, matches.second, left, config.tolerance_px, support)
        if np.count_nonzero(support & region) < share * np.count_nonzero(region):
            return None
        return RigidMotion(transform, homography, support)

    ego = fit(left, config.min_inliers / 2)  # half of the scene may move
    if ego is None:
        logger.info("no rigid camera motion: %d correspondences", np.count_nonzero(left))
        return []
    motions = [ego]
    if not config.max_objects:
        return motions
    left &= ~ego.support
    least = max(config.min_points, config.min_object * left.size)
    pieces, order = _pieces(matches, left, least, config)
    for label in order:
        if len(motions) > config.max_objects:
            break
        region = (pieces == label) & left
        if np.count_nonzero(region) < least:
            continue
        motion = fit(region, config.min_inliers)
        if motion is not None:
            motions.append(RigidMotion(motion.transform, motion.homography, motion.support & (pieces == label)))
            left &= ~motion.support
    return motions


def _pieces(
    matches: Correspondences, left: np.ndarray, least: float, config: RigidConfig
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Connected pieces of the pixels `left`: (H, W) labels, and those of `least` pixels or more, from the largest on."""
    smooth = np.empty(left.shape, np.uint8)
    over_rows(_continuous, len(left), matches.first, matches.second, left, 2 * config.tolerance_px, smooth)
    opened = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    areas = statistics[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[:64]
    return labels, order[areas[order] >= least] + 1
