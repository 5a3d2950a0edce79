"""A camera where none is known: the one under which the world moves most rigidly.

A rigid motion of image-and-disparity space needs focal length and principal point; the baseline only scales its
translation and stays arbitrary. The focal length that explains the correspondences best, of a few, is the start of a robust
Gauss-Newton fit of motion, focal length and principal point together. What the motion does not tell (a camera that moves
straight on says nothing about its focal length) is left to what is usual: a prior.

Related: self-calibration of stereo rigs from rigid motion, Hartley and Zisserman, Multiple View Geometry, chapter 19.
"""

import logging
from dataclasses import dataclass
from functools import partial

import numpy as np

from variational.camera import StereoCamera
from variational.jit import side_by_side
from variational.rigid import (
    Correspondences,
    RigidConfig,
    apply_homography,
    fit_motion,
    projected,
    rigid_derivatives,
    thin,
    twist,
)

logger = logging.getLogger(__name__)

FOCAL_LENGTHS = (0.5, 0.8, 1.25, 2.0)
"""Tried to begin with, in widths of the image."""
_BASELINE_M = 0.1  # arbitrary
_LOG_FOCAL = 0.5  # the prior's standard deviation around one width
_CENTRE = 0.04  # that of the principal point around the image's centre, in widths
_INDEPENDENT = 200  # correspondences that count as such against the prior: neighbours err alike
_ITERATIONS = 10
_MOST_STEP = 0.3  # of the focal length's logarithm


@dataclass(frozen=True)
class _Guess:
    """A camera, and a motion under it."""

    camera: StereoCamera
    transform: np.ndarray


def guess_camera(matches: Correspondences, config: RigidConfig, shape: tuple[int, int] | None = None) -> StereoCamera:
    """A camera to fit rigid motions with where none is known.

    Parameters
    ----------
    matches : Correspondences
    config : RigidConfig
    shape : (int, int), optional
        (H, W) of the image, if the correspondences are those of a part of its pixels.

    Returns
    -------
    StereoCamera
        With an arbitrary baseline; of one width's focal length and a centred principal point where too few points move
        rigidly.
    """
    height, width = shape or matches.valid.shape
    usual = StereoCamera(width, width, (width - 1) / 2, (height - 1) / 2, _BASELINE_M)
    chosen = thin(matches.valid & (matches.first[..., 2] > 0.5), config.points)
    if len(chosen) < config.min_points:
        return usual
    first, second = (m.reshape(-1, 3)[chosen].astype(np.float64) for m in (matches.first, matches.second))

    def attempt(focal: float) -> tuple[float, _Guess | None]:
        camera = StereoCamera(focal * width, focal * width, usual.cx, usual.cy, _BASELINE_M)
        transform = fit_motion(first, second, camera.projection())
        if transform is None:
            return np.inf, None
        distance = np.linalg.norm(apply_homography(camera.homography(transform), first) - second, axis=1)
        return float(np.minimum(distance, config.tolerance_px).mean()), _Guess(camera, transform)

    _, best = min(side_by_side(*(partial(attempt, focal) for focal in FOCAL_LENGTHS)), key=lambda tried: tried[0])
    if best is None:
        return usual
    camera = _refine(best, first, second, usual)
    logger.info("guessed a focal length of %.0f px, principal point (%.0f, %.0f)", camera.fx, camera.cx, camera.cy)
    return camera


def camera_derivatives(points: np.ndarray, transform: np.ndarray, camera: StereoCamera) -> np.ndarray:
    """(9, 3, N) derivatives of the moved (x, y, disparity) of (N, 3) points that are known by theirs.

    By a twist from the left (see `variational.rigid.rigid_derivatives`), then the logarithm of fx = fy, cx and cy; points are
    in metres, as `camera` sees them: with another camera the same (x, y, disparity) is another point.
    """
    projection = camera.projection()
    moved = points @ transform[:3, :3].T + transform[:3, 3]
    jacobian = np.empty((9, 3, len(points)))
    jacobian[:6] = rigid_derivatives(moved, projection)
    depth = points[:, 2]
    by_camera = np.zeros((3, 3, len(points)))  # of the points themselves
    by_camera[0, 2] = depth
    by_camera[1, 0] = by_camera[2, 1] = -depth / camera.fx
    by_camera = np.einsum("ij,pjn->pin", transform[:3, :3], by_camera)
    jacobian[6:] = np.einsum("jkn,pjn->pkn", jacobian[:3], by_camera)
    x, y, disparity = projected(moved, projection).T
    jacobian[6] += np.stack([x - camera.cx, y - camera.cy, disparity])
    jacobian[7, 0] += 1
    jacobian[8, 1] += 1
    return jacobian


def _refine(guess: _Guess, first: np.ndarray, second: np.ndarray, usual: StereoCamera, scale_px: float = 0.7) -> StereoCamera:
    """Minimise the Geman-McClure penalty of the distance in (x, y, disparity), and the prior, over motion and camera."""
    camera, transform, width = guess.camera, guess.transform, usual.fx
    precision = np.array([1 / _LOG_FOCAL, 1 / (_CENTRE * width), 1 / (_CENTRE * width)]) ** 2
    for _ in range(_ITERATIONS):
        projection = camera.projection()
        points = projected(first, np.linalg.inv(projection))
        moved = points @ transform[:3, :3].T + transform[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = projected(moved, projection) - second
            weight = 1 / (scale_px * (1 + (residual**2).sum(axis=1) / scale_px**2)) ** 2
            usable = (moved[:, 2] > 0) & np.isfinite(weight)
        residual, root = residual[usable], np.sqrt(weight[usable])
        if len(root) < len(precision) + 6:
            return guess.camera
        jacobian = (camera_derivatives(points[usable], transform, camera) * root).reshape(9, -1)
        normal, slope = jacobian @ jacobian.T, jacobian @ (residual.T * root).ravel()
        share = len(root) / _INDEPENDENT
        off = np.array([np.log(camera.fx / width), camera.cx - usual.cx, camera.cy - usual.cy])
        normal[6:, 6:] += share * np.diag(precision)
        slope[6:] += share * precision * off
        scaling = np.sqrt(np.diag(normal))
        if not scaling.all() or np.linalg.cond(conditioned := normal / np.outer(scaling, scaling)) > 1e12:
            return guess.camera
        step = -np.linalg.solve(conditioned, slope / scaling) / scaling
        transform = twist(step[:6]) @ transform
        focal = camera.fx * np.exp(np.clip(step[6], -_MOST_STEP, _MOST_STEP))
        camera = StereoCamera(focal, focal, camera.cx + step[7], camera.cy + step[8], _BASELINE_M)
    return camera
