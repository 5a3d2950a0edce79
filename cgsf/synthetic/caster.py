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

import numpy as np

from variational.jit import rowwise

#: Nothing nearer than this many metres is seen.
NEAR_M = 0.05
#: A ray may miss a triangle's edge by this much relative to its inverse depth: none slips between two triangles.
EDGE_SLACK = 1e-9


@rowwise
def setup_triangles(
    points: np.ndarray, pose: np.ndarray, culled: np.ndarray, intrinsics: np.ndarray, height: int, width: int,
    corners: np.ndarray, plane: np.ndarray, bounds: np.ndarray,
) -> None:  # fmt: skip
    """Ray equations and pixel bounds of triangles.

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
    bounds : ndarray (N, 4) int32, written
        First and last column, first and last row; an empty range for a triangle that no ray meets.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for n in range(points.shape[0]):
        bounds[n, 0], bounds[n, 1], bounds[n, 2], bounds[n, 3] = 0, -1, 0, -1
        v = corners[n]
        for c in range(3):
            for i in range(3):
                x, y, z = points[n, c, 0], points[n, c, 1], points[n, c, 2]
                v[c, i] = pose[i, 0] * x + pose[i, 1] * y + pose[i, 2] * z + pose[i, 3]
        if v[0, 2] < NEAR_M and v[1, 2] < NEAR_M and v[2, 2] < NEAR_M:
            continue
        low_x, high_x, low_y, high_y = 1e9, -1e9, 1e9, -1e9
        for i in range(3):
            j = (i + 1) % 3
            if v[i, 2] >= NEAR_M:
                x, y = fx * v[i, 0] / v[i, 2] + cx, fy * v[i, 1] / v[i, 2] + cy
                low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
            if (v[i, 2] >= NEAR_M) != (v[j, 2] >= NEAR_M):
                s = (NEAR_M - v[i, 2]) / (v[j, 2] - v[i, 2])
                x = fx * (v[i, 0] + s * (v[j, 0] - v[i, 0])) / NEAR_M + cx
                y = fy * (v[i, 1] + s * (v[j, 1] - v[i, 1])) / NEAR_M + cy
                low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
        if high_x < -0.5 or high_y < -0.5 or low_x > width - 0.5 or low_y > height - 0.5:
            continue
        a0 = v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1]
        a1 = v[1, 2] * v[2, 0] - v[1, 0] * v[2, 2]
        a2 = v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0]
        determinant = v[0, 0] * a0 + v[0, 1] * a1 + v[0, 2] * a2
        if determinant == 0.0 or (culled[n] and determinant > 0.0):
            continue
        for i in range(3):
            p, q = v[(i + 1) % 3], v[(i + 2) % 3]
            r0 = (p[1] * q[2] - p[2] * q[1]) / determinant
            r1 = (p[2] * q[0] - p[0] * q[2]) / determinant
            r2 = (p[0] * q[1] - p[1] * q[0]) / determinant
            plane[n, i, 0] = r0 / fx
            plane[n, i, 1] = r1 / fy
            plane[n, i, 2] = r2 - r0 * cx / fx - r1 * cy / fy
        bounds[n, 0] = math.floor(max(low_x, 0.0) + 0.5)
        bounds[n, 1] = min(math.floor(min(high_x, width - 1.0) + 0.5), width - 1)
        bounds[n, 2] = math.floor(max(low_y, 0.0) + 0.5)
        bounds[n, 3] = min(math.floor(min(high_y, height - 1.0) + 0.5), height - 1)


@rowwise
def cast(
    plane: np.ndarray, bounds: np.ndarray, x: np.ndarray, y: np.ndarray, start: np.ndarray, width: int,
    inverse_depth: np.ndarray, hit: np.ndarray,
) -> None:  # fmt: skip
    """Nearest triangle along each ray.

    Parameters
    ----------
    plane, bounds : ndarray
        From `setup_triangles`.
    x, y : ndarray (R,) float64
        Rays in pixels, sorted by the pixel that they fall in.
    start : ndarray (height * width + 1,) int64
        Rays ``start[i] ... start[i + 1] - 1`` fall in pixel i, counted row by row.
    inverse_depth : ndarray (R,) float64, written
        1 / Z in 1/m; 0 where nothing is met.
    hit : ndarray (R,) int32, written
        The triangle; -1 where nothing is met.
    """
    inverse_depth[:] = 0.0
    hit[:] = -1
    for n in range(plane.shape[0]):
        if bounds[n, 1] < bounds[n, 0]:
            continue
        p00, p01, p02 = plane[n, 0, 0], plane[n, 0, 1], plane[n, 0, 2]
        p10, p11, p12 = plane[n, 1, 0], plane[n, 1, 1], plane[n, 1, 2]
        p20, p21, p22 = plane[n, 2, 0], plane[n, 2, 1], plane[n, 2, 2]
        narrow = bounds[n, 1] - bounds[n, 0] < 6
        for row in range(bounds[n, 2], bounds[n, 3] + 1):
            first, last = bounds[n, 0], bounds[n, 1]
            for i in range(0 if narrow else 3):  # columns of this row where b_i can be positive
                slope = plane[n, i, 0]
                reach = plane[n, i, 1] * row + plane[n, i, 2] + 0.5 * abs(plane[n, i, 1])
                if slope > 0.0:
                    first = max(first, int(max(-reach / slope - 0.5, -1.0)))
                elif slope < 0.0:
                    last = min(last, int(min(-reach / slope + 1.5, width * 1.0)))
            if last < first:
                continue
            for ray in range(start[row * width + first], start[row * width + last + 1]):
                b0 = p00 * x[ray] + p01 * y[ray] + p02
                b1 = p10 * x[ray] + p11 * y[ray] + p12
                b2 = p20 * x[ray] + p21 * y[ray] + p22
                w = b0 + b1 + b2
                if w > inverse_depth[ray] and w * NEAR_M < 1.0:
                    slack = -EDGE_SLACK * w
                    if b0 >= slack and b1 >= slack and b2 >= slack:
                        inverse_depth[ray] = w
                        hit[ray] = n


@rowwise
def sort_rays(x: np.ndarray, y: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays sorted by pixel; those outside the image (or NaN) are left out.

    Returns
    -------
    order : ndarray (R',) int64
        Indices of the rays inside, pixel by pixel.
    start : ndarray (height * width + 1,) int64
        Where each pixel's rays begin in `order`.
    """
    cell = np.full(x.size, -1, np.int64)
    start = np.zeros(height * width + 1, np.int64)
    for ray in range(x.size):
        if x[ray] >= -0.5 and x[ray] < width - 0.5 and y[ray] >= -0.5 and y[ray] < height - 0.5:
            cell[ray] = math.floor(y[ray] + 0.5) * width + math.floor(x[ray] + 0.5)
            start[cell[ray] + 1] += 1
    for i in range(height * width):
        start[i + 1] += start[i]
    order = np.empty(start[-1], np.int64)
    place = start[:-1].copy()
    for ray in range(x.size):
        if cell[ray] >= 0:
            order[place[cell[ray]]] = ray
            place[cell[ray]] += 1
    return order, start


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
        self.bounds = np.empty((len(points), 4), np.int32)
        setup_triangles(points, pose, culled, intrinsics, height, width, self.corners, self.plane, self.bounds)

    def _cast(self, x: np.ndarray, y: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inverse_depth, hit = np.empty(x.size), np.empty(x.size, np.int32)
        cast(self.plane, self.bounds, x, y, start, self.width, inverse_depth, hit)
        return inverse_depth, hit

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """What the pixels' centres see.

        Returns
        -------
        inverse_depth : ndarray (H, W) float64
            1 / Z in 1/m; 0 where nothing is met.
        hit : ndarray (H, W) int32
            Triangle, or -1.
        """
        shape = (self.height, self.width)
        y, x = np.divmod(np.arange(self.height * self.width), self.width)
        inverse_depth, hit = self._cast(x.astype(float), y.astype(float), np.arange(x.size + 1))
        return inverse_depth.reshape(shape), hit.reshape(shape)

    def within(self, pixels: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Several rays in each of some pixels.

        Parameters
        ----------
        pixels : ndarray (P,) int
            Numbers ``y * width + x`` of pixels, ascending.
        offsets : ndarray (K, 2) float64
            Positions (x, y) relative to the pixel's centre, within (-0.5, 0.5).

        Returns
        -------
        x, y : ndarray (P * K,) float64
            The rays in pixels.
        hit : ndarray (P * K,) int32
            Triangle, or -1.
        """
        row, column = np.divmod(pixels, self.width)
        x, y = (column[:, None] + offsets[:, 0]).ravel(), (row[:, None] + offsets[:, 1]).ravel()
        count = np.zeros(self.height * self.width + 1, np.int64)
        count[pixels + 1] = len(offsets)
        _, hit = self._cast(x, y, np.cumsum(count))
        return x, y, hit

    def nearest(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Inverse depth (R,) of what rays anywhere meet first; NaN outside the image."""
        order, start = sort_rays(x, y, self.height, self.width)
        inverse_depth = np.full(x.size, np.nan)
        inverse_depth[order], _ = self._cast(x[order], y[order], start)
        return inverse_depth
