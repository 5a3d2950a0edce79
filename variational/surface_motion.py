"""Rigid motions of one surface from few, coarse and partly wrong correspondences.

Three points of a small surface, known to a few pixels, fix a rotation that is mostly noise, and a fit that begins there
ends there. So fits begin with translations, one from each point, which all points judge; rotation comes in step by step,
under a penalty that tightens, and a disparity at time 2 that is wrong leaves the point's place its weight.

What correspondences leave, a pixel or two, the images themselves can tell: a motion climbs to where they agree better.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from variational.rigid import apply_homography, gauss_newton_step, projected, rigid_derivatives, twist

SPREAD = 2.0
"""A point follows a translation to so many times its tolerance: the surface may turn."""
APART = 1.5
"""Translations that move the surface alike to so many times the tolerance are one."""
COARSE_TO_FINE = (4.0, 2.0)
"""Scales of the penalty before the last, in tolerances, for a motion that only translates so far."""
SCALE, STEPS = 0.7, 4
"""The last scale, in tolerances, and steps with it."""
TURN = 0.5
"""Rotation that weighs as much as one point at the penalty's scale, rad."""
CLIMBS_PX = (2.0, 1.0)
"""How far the steps of `climb` move the surface: each in turn, to either side of six motions."""
LARGEST_TURN = 0.05
"""A step turns the surface no farther, however little that moves it, rad; times its pixels."""


def translations(
    first: np.ndarray, second: np.ndarray, projection: np.ndarray, tolerance_px: float, most: int
) -> list[np.ndarray]:
    """Translations that points propose, those that most others agree with first.

    Parameters
    ----------
    first, second, projection, tolerance_px
        As for `variational.rigid.fit_motion`.
    most : int
        Translations returned, at most; each moves the surface elsewhere in the image than those before.

    Returns
    -------
    list of np.ndarray
        (4, 4) transforms; none for fewer than three points.
    """
    if len(first) < 3:
        return []
    back = np.linalg.inv(projection)
    points = projected(first, back)
    level = np.column_stack([second[:, :2], first[:, 2]])  # as far away as before: disparities at time 2 may be wrong
    steps = np.concatenate([projected(second, back) - points, projected(level, back) - points])
    moved = apply_homography(projection, (points + steps[:, None]).reshape(-1, 3)).reshape(len(steps), len(first), 3)
    weight = _weigh_apart(moved - second, SPREAD * tolerance_px, power=1)
    votes = np.nan_to_num(weight[..., 0] + weight[..., 2]).sum(axis=1)
    ends = np.median(moved[..., :2] - first[:, :2], axis=1)
    found: list[np.ndarray] = []
    while len(found) < most and votes.max(initial=0) > 0:
        best = votes.argmax()
        transform = np.eye(4)
        transform[:3, 3] = steps[best]
        found.append(transform)
        votes[~(np.abs(ends - ends[best]).max(axis=1) >= APART * tolerance_px)] = 0
    return found


def fit_from(
    transform: np.ndarray, first: np.ndarray, second: np.ndarray, projection: np.ndarray, tolerance_px: float,
    translates: bool, telling: np.ndarray | None = None,
) -> np.ndarray | None:  # fmt: skip
    """The rigid motion near a first one that points follow best.

    Parameters
    ----------
    transform : np.ndarray
        (4, 4), nearly right.
    first, second, projection, tolerance_px
        As for `translations`.
    translates : bool
        Whether the first motion knows no rotation yet.
    telling
        As for `variational.rigid.gauss_newton_step`.

    Returns
    -------
    np.ndarray or None
        (4, 4); None where the points do not fix a motion.
    """
    points = projected(first, np.linalg.inv(projection))
    for scale in (COARSE_TO_FINE if translates else ()) + (SCALE,) * STEPS:
        scale_px = scale * tolerance_px
        weigh = partial(_weigh_apart, scale_px=scale_px)
        step = gauss_newton_step(transform, points, second, projection, weigh, (scale_px / TURN) ** 2, telling)
        if step is None:
            return None
        transform = step
    return transform


def _weigh_apart(residual: np.ndarray, scale_px: float, power: int = 2) -> np.ndarray:
    """(..., 3): Geman-McClure weights of the place, and of the disparity where the place is right."""
    place = 1 / (1 + (residual[..., :2] ** 2).sum(axis=-1) / scale_px**2) ** power
    return np.stack([place, place, place / (1 + residual[..., 2] ** 2 / scale_px**2) ** power], axis=-1)


def climb(
    gain: float, transform: np.ndarray, first: np.ndarray, projection: np.ndarray, gain_of: Callable[[np.ndarray], float]
) -> tuple[float, np.ndarray]:
    """A motion nearby that gains more: a coordinate search, whose coordinates move the surface one pixel each.

    Flow of a surface that is plain but for an edge is a pixel or two beside the truth; so little decides whether the images
    agree. Translations come first, and each further coordinate, rotations at last, is what the ones before it cannot do.

    Parameters
    ----------
    gain, transform
        What it gains; (4, 4).
    first
        As for `translations`: points of the surface, at time 1.
    projection
        As for `translations`.
    gain_of : function
        Of a transform.

    Returns
    -------
    tuple of float and np.ndarray
        The larger gain and its transform; those given, if nothing nearby gains more.
    """
    points = projected(first[first[:, 2] > 0], np.linalg.inv(projection))
    for step_px in CLIMBS_PX:
        moved = points @ transform[:3, :3].T + transform[:3, 3]
        moved = moved[moved[:, 2] > 0]
        if len(moved) < 3:
            break
        derivatives = rigid_derivatives(moved, projection).reshape(6, -1)
        normal = derivatives @ derivatives.T / len(moved)
        normal[3:, 3:] += np.eye(3) / LARGEST_TURN**2
        try:
            steps = step_px * np.linalg.inv(np.linalg.cholesky(normal))  # rows: each moves the points by a mean square of one
        except np.linalg.LinAlgError:
            break  # a point in the camera: nothing tells six coordinates apart
        for step in steps:
            for there in (twist(step) @ transform, twist(-step) @ transform):
                better = gain_of(there)
                if better > gain:
                    gain, transform = better, there
                    break
    return gain, transform
