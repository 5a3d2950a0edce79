"""The ray caster: which triangle does each ray of a camera meet first, and where.

A ray is a position (x, y) in pixels anywhere in the image, not only at pixel centres: the same kernel casts the
truth's rays, the anti-aliasing's, the shadow map's, and those that tell whether another camera sees a point.

A triangle with corners V0 V1 V2 (camera coordinates) meets the ray r = ((x - cx) / fx, (y - cy) / fy, 1) where
``b0 V0 + b1 V1 + b2 V2 = r`` has b >= 0. Solving once per triangle makes each b linear in x and y; ``b0 + b1 + b2`` is
the inverse depth w, and ``b / w`` are the barycentric weights. Nothing is clipped: a triangle that reaches behind the
camera needs no care (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997).
Rays are sorted by the pixel that they fall in, so that a triangle visits only those under it.
"""

import math
from functools import lru_cache

import numpy as np

from variational.jit import rowwise

#: Nothing nearer than this many metres is seen.
NEAR_M = 0.05
#: A ray may miss a triangle's edge by this much relative to its inverse depth: none slips between two triangles.
EDGE_SLACK = 1e-9
#: The same in pixels, for the columns and rows that a triangle is tested on.
EDGE_SLACK_PX = 1e-6
#: Rays that are tested together; arrays of rays end with as many that meet nothing.
LANES = 4


@rowwise
def setup_triangles(
    points: np.ndarray, pose: np.ndarray, culled: np.ndarray, intrinsics: np.ndarray, height: int, width: int,
    corners: np.ndarray, plane: np.ndarray, bounds: np.ndarray,
) -> None:  # fmt: skip
    """Ray equations and bounds of triangles.

    Parameters
    ----------
    points : ndarray (N, 3, 3) float64
        Corners in world coordinates, metres.
    pose : ndarray (4, 4) float64
        World to camera.
    culled : ndarray (N,) bool
        Skip the triangle when it is seen from behind.
    intrinsics : ndarray (4,) float64
        fx, fy, cx, cy in pixels.
    corners : ndarray (N, 3, 3) float64, written
        Camera coordinates in metres.
    plane : ndarray (N, 3, 3) float64, written
        ``b_i = plane[n, i, 0] x + plane[n, i, 1] y + plane[n, i, 2]``.
    bounds : ndarray (N, 4) float64, written
        Lowest and highest x, lowest and highest y in pixels; an empty range for a triangle that no ray meets.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    m = pose
    for n in range(points.shape[0]):
        bounds[n, 0], bounds[n, 1], bounds[n, 2], bounds[n, 3] = 0.0, -1.0, 0.0, -1.0
        v = corners[n]
        for c in range(3):
            x, y, z = points[n, c, 0], points[n, c, 1], points[n, c, 2]
            for i in range(3):
                v[c, i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]
        nearest, farthest = min(v[0, 2], v[1, 2], v[2, 2]), max(v[0, 2], v[1, 2], v[2, 2])
        if farthest < NEAR_M:
            continue
        a0 = v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1]
        a1 = v[1, 2] * v[2, 0] - v[1, 0] * v[2, 2]
        a2 = v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0]
        determinant = v[0, 0] * a0 + v[0, 1] * a1 + v[0, 2] * a2
        if determinant == 0.0 or (culled[n] and determinant > 0.0):
            continue
        low_x, high_x, low_y, high_y = 1e9, -1e9, 1e9, -1e9
        for i in range(3):
            if v[i, 2] >= NEAR_M:
                x, y = fx * v[i, 0] / v[i, 2] + cx, fy * v[i, 1] / v[i, 2] + cy
                low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
        if nearest < NEAR_M:  # where the sides cross the nearest plane
            for i in range(3):
                j = (i + 1) % 3
                if (v[i, 2] >= NEAR_M) != (v[j, 2] >= NEAR_M):
                    s = (NEAR_M - v[i, 2]) / (v[j, 2] - v[i, 2])
                    x = fx * (v[i, 0] + s * (v[j, 0] - v[i, 0])) / NEAR_M + cx
                    y = fy * (v[i, 1] + s * (v[j, 1] - v[i, 1])) / NEAR_M + cy
                    low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
        if high_x < -0.5 or high_y < -0.5 or low_x > width - 0.5 or low_y > height - 0.5:
            continue
        inverse = 1.0 / determinant
        for i in range(3):
            p, q = v[(i + 1) % 3], v[(i + 2) % 3]
            r0 = (p[1] * q[2] - p[2] * q[1]) * inverse
            r1 = (p[2] * q[0] - p[0] * q[2]) * inverse
            r2 = (p[0] * q[1] - p[1] * q[0]) * inverse
            plane[n, i, 0] = r0 / fx
            plane[n, i, 1] = r1 / fy
            plane[n, i, 2] = r2 - r0 * cx / fx - r1 * cy / fy
        bounds[n, 0], bounds[n, 1], bounds[n, 2], bounds[n, 3] = low_x, high_x, low_y, high_y


@rowwise
def cast(
    plane: np.ndarray, bounds: np.ndarray, x: np.ndarray, y: np.ndarray, start: np.ndarray, width: int, reach: float,
    inverse_depth: np.ndarray, hit: np.ndarray,
) -> None:  # fmt: skip
    """Nearest triangle along each ray.

    Parameters
    ----------
    plane, bounds : ndarray
        From `setup_triangles`.
    x, y : ndarray (R + LANES,) float64
        Rays in pixels, sorted by the pixel that they fall in, then NaN.
    start : ndarray (height * width + 1,) int32
        Rays ``start[i] ... start[i + 1] - 1`` fall in pixel i, counted row by row.
    reach : float
        No ray lies farther than this many pixels from its pixel's column and row.
    inverse_depth : ndarray (R + LANES,) float64, written
        1 / Z in 1/m; 0 where nothing is met.
    hit : ndarray (R + LANES,) int32, written
        The triangle; -1 where nothing is met.
    """
    inverse_depth[:] = 0.0
    hit[:] = -1
    height = (start.size - 1) // width
    for n in range(plane.shape[0]):
        if bounds[n, 1] < bounds[n, 0]:
            continue
        left, right = math.ceil(max(bounds[n, 0] - reach, 0.0)), math.floor(min(bounds[n, 1] + reach, width - 1.0))
        top, bottom = math.ceil(max(bounds[n, 2] - reach, 0.0)), math.floor(min(bounds[n, 3] + reach, height - 1.0))
        p00, p01, p02 = plane[n, 0, 0], plane[n, 0, 1], plane[n, 0, 2]
        p10, p11, p12 = plane[n, 1, 0], plane[n, 1, 1], plane[n, 1, 2]
        p20, p21, p22 = plane[n, 2, 0], plane[n, 2, 1], plane[n, 2, 2]
        s0, s1, s2 = -1.0 / p00, -1.0 / p10, -1.0 / p20
        narrow = right - left < LANES
        for row in range(top, bottom + 1):
            first, last = left, right
            if not narrow:  # columns of this row where all b can be positive
                low, high = left - reach, right + reach
                zero = s0 * (p01 * row + p02 + reach * abs(p01))
                low, high = max(low, zero if p00 > 0.0 else low), min(high, zero if p00 < 0.0 else high)
                zero = s1 * (p11 * row + p12 + reach * abs(p11))
                low, high = max(low, zero if p10 > 0.0 else low), min(high, zero if p10 < 0.0 else high)
                zero = s2 * (p21 * row + p22 + reach * abs(p21))
                low, high = max(low, zero if p20 > 0.0 else low), min(high, zero if p20 < 0.0 else high)
                first, last = max(first, math.ceil(low - reach)), min(last, math.floor(high + reach))
            if last < first:
                continue
            begin, end = start[row * width + first], start[row * width + last + 1]
            # Whole vectors and no branch: rays beyond the range cannot meet the triangle, or may as well.
            for k in range((end - begin + LANES - 1) // LANES * LANES):
                ray = np.uint64(begin) + np.uint64(k)
                b0 = p00 * x[ray] + p01 * y[ray] + p02
                b1 = p10 * x[ray] + p11 * y[ray] + p12
                b2 = p20 * x[ray] + p21 * y[ray] + p22
                w = b0 + b1 + b2
                slack = -EDGE_SLACK * w
                nearer = (w > inverse_depth[ray]) & (w * NEAR_M < 1.0) & (b0 >= slack) & (b1 >= slack) & (b2 >= slack)
                inverse_depth[ray] = w if nearer else inverse_depth[ray]
                hit[ray] = n if nearer else hit[ray]


@lru_cache(maxsize=4)
def _grid_rays(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One ray a pixel, through its centre: x, y, start."""
    y, x = np.divmod(np.arange(height * width, dtype=np.int32), np.int32(width))
    end = np.full(LANES, np.nan)
    return np.concatenate([x, end]), np.concatenate([y, end]), np.arange(height * width + 1, dtype=np.int32)


@rowwise
def _edge_rays(edge: np.ndarray, offsets: np.ndarray, x: np.ndarray, y: np.ndarray, start: np.ndarray) -> None:
    """Several rays in each pixel of a mask."""
    count, width = 0, edge.shape[1]
    for row in range(edge.shape[0]):
        for column in range(width):
            start[row * width + column] = count
            if edge[row, column]:
                for k in range(len(offsets)):
                    x[count], y[count] = column + offsets[k, 0], row + offsets[k, 1]
                    count += 1
    start[edge.size] = count
    x[count:] = np.nan
    y[count:] = np.nan


@rowwise
def _sort_rays(
    place: np.ndarray, height: int, width: int, cell: np.ndarray, start: np.ndarray, order: np.ndarray, x: np.ndarray,
    y: np.ndarray,
) -> int:  # fmt: skip
    """Rays `place` (R, 2) sorted by pixel; those outside the image (or NaN) are left out. Returns how many are left."""
    start[:] = 0
    for ray in range(place.shape[0]):
        u, v = place[ray, 0], place[ray, 1]
        inside = u >= -0.5 and u < width - 0.5 and v >= -0.5 and v < height - 0.5
        cell[ray] = int(v + 0.5) * width + int(u + 0.5) if inside else height * width
        start[cell[ray]] += 1
    total = 0
    for i in range(height * width):  # where the next ray of pixel i goes
        total, start[i] = total + start[i], total
    start[height * width] = total
    for ray in range(place.shape[0]):
        if cell[ray] < height * width:
            k = start[cell[ray]]
            start[cell[ray]] = k + 1
            order[k], x[k], y[k] = ray, place[ray, 0], place[ray, 1]
    for i in range(height * width, 0, -1):  # each has moved to where the next pixel's rays begin
        start[i] = start[i - 1]
    start[0] = 0
    x[total:] = np.nan
    y[total:] = np.nan
    return total


@rowwise
def _unsort(count: int, order: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    """Values of sorted rays back to the rays' own places."""
    for k in range(count):
        out[np.uint32(order[k])] = values[k]


class Caster:
    """The triangles of one moment, ready to be met by one camera's rays.

    Parameters
    ----------
    points : ndarray (N, 3, 3) float64
        Triangles in world coordinates, metres.
    pose : ndarray (4, 4) float64
        World to camera.
    culled : ndarray (N,) bool
        Triangles that are seen from one side only.
    intrinsics : ndarray (4,) float64
        fx, fy, cx, cy in pixels.
    height, width : int
        Image size in pixels.
    """

    def __init__(
        self, points: np.ndarray, pose: np.ndarray, culled: np.ndarray, intrinsics: np.ndarray, height: int, width: int
    ) -> None:
        self.pose, self.intrinsics, self.height, self.width = pose, intrinsics, height, width
        self.corners, self.plane = np.empty_like(points), np.empty_like(points)
        self.bounds = np.empty((len(points), 4))
        setup_triangles(points, pose, culled, intrinsics, height, width, self.corners, self.plane, self.bounds)

    def sight(self) -> np.ndarray:
        """(4, 3): the ray (x, y) is ``s[0] x + s[1] y + s[2]`` in the world, depth 1; ``s[3]`` is the eye, metres."""
        fx, fy, cx, cy = self.intrinsics
        turn = self.pose[:3, :3]
        return np.stack([turn[0] / fx, turn[1] / fy, turn[2] - turn[0] * cx / fx - turn[1] * cy / fy, -self.pose[:3, 3] @ turn])

    def _cast(self, x: np.ndarray, y: np.ndarray, start: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        inverse_depth, hit = np.empty(x.size), np.empty(x.size, np.int32)
        cast(self.plane, self.bounds, x, y, start, self.width, reach + EDGE_SLACK_PX, inverse_depth, hit)
        return inverse_depth, hit

    def _rays(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Room for rays: x, y, start."""
        return np.empty(count + LANES), np.empty(count + LANES), np.empty(self.height * self.width + 1, np.int32)

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """What the pixels' centres see.

        Returns
        -------
        inverse_depth : ndarray (H, W) float64
            1 / Z in 1/m; 0 where nothing is met.
        hit : ndarray (H, W) int32
            Triangle, or -1.
        """
        inverse_depth, hit = self._cast(*_grid_rays(self.height, self.width), 0.0)
        shape = (self.height, self.width)
        return inverse_depth[:-LANES].reshape(shape), hit[:-LANES].reshape(shape)

    def within(self, edge: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """What several rays in each of some pixels meet.

        Parameters
        ----------
        edge : ndarray (H, W) bool
            The pixels.
        offsets : ndarray (K, 2) float64
            Positions (x, y) relative to the pixel's centre, within (-0.5, 0.5).

        Returns
        -------
        hit : ndarray (P * K,) int32
            Triangle, or -1, of all rays of one pixel after the other, row by row.
        """
        rays = self._rays(int(np.count_nonzero(edge)) * len(offsets))
        _edge_rays(edge, offsets, *rays)
        return self._cast(*rays, float(np.abs(offsets).max()))[1][:-LANES]

    def nearest(self, place: np.ndarray) -> np.ndarray:
        """Inverse depth (...) of what rays at `place` (..., 2) px meet first; NaN outside the image."""
        flat = place.reshape(-1, 2)
        x, y, start = self._rays(len(flat))
        order = np.empty(len(flat), np.int32)
        inside = _sort_rays(flat, self.height, self.width, np.empty(len(flat), np.int32), start, order, x, y)
        inverse_depth = np.full(len(flat), np.nan)
        _unsort(inside, order, self._cast(x, y, start, 0.5)[0], inverse_depth)
        return inverse_depth.reshape(place.shape[:-1])
