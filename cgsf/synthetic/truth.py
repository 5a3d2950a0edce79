"""Exact correspondences between the images of a scene, and what hides what.

The point that a pixel's centre sees is a fixed combination of its triangle's corners; the same combination of the
corners where another camera has them, at another time, is the same point there. Nothing is interpolated on the way.
"""

from typing import NamedTuple

import numpy as np

from cgsf.synthetic.caster import NEAR_M, Caster
from variational.jit import rowwise

#: A point on the image's border stays inside in spite of rounding.
_ROUNDING_PX = 1e-6


class View(NamedTuple):
    """One camera at one moment.

    Parameters
    ----------
    caster : Caster
        The camera and the triangles.
    inverse_depth, hit : ndarray (H, W)
        What the pixels' centres see: 1 / Z in 1/m (0 for the sky) and the triangle (-1).
    """

    caster: Caster
    inverse_depth: np.ndarray
    hit: np.ndarray


@rowwise
def _follow(
    hit: np.ndarray, inverse_depth: np.ndarray, plane: np.ndarray, corners: np.ndarray, turn: np.ndarray,
    intrinsics: np.ndarray, place: np.ndarray, there: np.ndarray,
) -> None:  # fmt: skip
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    point = np.empty(3)
    for row in range(hit.shape[0]):
        for column in range(hit.shape[1]):
            n, w = hit[row, column], inverse_depth[row, column]
            for i in range(3):
                point[i] = 0.0
            if n >= 0:
                for k in range(3):
                    b = plane[n, k, 0] * column + plane[n, k, 1] * row + plane[n, k, 2]
                    for i in range(3):
                        point[i] += b * corners[n, k, i]
            else:  # a direction: it only turns
                rx, ry = (column - cx) / fx, (row - cy) / fy
                for i in range(3):
                    point[i] = turn[i, 0] * rx + turn[i, 1] * ry + turn[i, 2]
            if point[2] <= NEAR_M * w or point[2] <= 0.0:
                place[row, column, 0] = place[row, column, 1] = there[row, column] = np.nan
            else:
                place[row, column, 0] = fx * point[0] / point[2] + cx
                place[row, column, 1] = fy * point[1] / point[2] + cy
                there[row, column] = w / point[2]


def follow(source: View, target: View) -> tuple[np.ndarray, np.ndarray]:
    """Where the target camera sees the points of the source's pixels, hidden or not.

    Returns
    -------
    place : ndarray (H, W, 2) float64
        Position (x, y) in the target image, pixels; NaN for points behind the target camera.
    inverse_depth : ndarray (H, W) float64
        Inverse depth there in 1/m; 0 for the sky.
    """
    place, there = np.empty((*source.hit.shape, 2)), np.empty(source.hit.shape)
    caster = source.caster
    turn = target.caster.pose[:3, :3] @ caster.pose[:3, :3].T
    _follow(source.hit, source.inverse_depth, caster.plane, target.caster.corners, turn, caster.intrinsics, place, there)
    return place, there


@rowwise
def _compare(place: np.ndarray, inverse_depth: np.ndarray, nearest: np.ndarray, visible: np.ndarray) -> None:
    height, width = visible.shape
    for row in range(height):
        for column in range(width):
            x, y = place[row, column, 0], place[row, column, 1]
            inside = x >= -_ROUNDING_PX and y >= -_ROUNDING_PX
            inside = inside and x <= width - 1 + _ROUNDING_PX and y <= height - 1 + _ROUNDING_PX
            visible[row, column] = inside and inverse_depth[row, column] >= nearest[row, column] * (1 - 1e-6)


def seen(target: View, place: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """True where the target camera sees the points from `follow`: inside the image and nothing nearer, (H, W) bool."""
    visible = np.empty(inverse_depth.shape, bool)
    _compare(place, inverse_depth, target.caster.nearest(place), visible)
    return visible
