"""Triangle meshes: a handful of generators from which every object of a scene is put together.

A mesh is a soup of triangles: no shared vertices, so that meshes are joined by concatenation, and every corner carries
its own normal (smooth or flat) and texture coordinates. Metres, x right, y **down**, z forward, as the camera sees.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Mesh:
    """A triangle soup with one material.

    Parameters
    ----------
    points : ndarray (N, 3, 3) float64
        Corners in metres, ``[triangle, corner, xyz]``.
    normals : ndarray (N, 3, 3) float64
        Unit shading normals per corner, outwards.
    uv : ndarray (N, 3, 2) float64
        Texture coordinates in metres on the surface.
    surface : ndarray (N,) int64
        Triangles with the same number make one smooth surface; an image edge is anti-aliased where it changes.
    closed : bool
        The mesh bounds a solid: triangles seen from behind are never visible and are skipped.
    """

    points: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    surface: np.ndarray
    closed: bool = False

    @cached_property
    def surfaces(self) -> int:
        """Number of smooth surfaces."""
        return int(self.surface.max()) + 1

    def moved(self, translation: ArrayLike = (0, 0, 0), rotation: Rotation | None = None) -> "Mesh":
        """The mesh rotated about its origin, then shifted by `translation` metres."""
        if rotation is None:
            return replace(self, points=self.points + np.asarray(translation, float))
        turn = rotation.as_matrix()
        return replace(self, points=self.points @ turn.T + np.asarray(translation, float), normals=self.normals @ turn.T)

    def scaled(self, scale: ArrayLike) -> "Mesh":
        """The mesh stretched along the axes by positive factors; texture coordinates keep metres if it is one."""
        factors = np.broadcast_to(np.asarray(scale, float), 3)
        normals = self.normals / factors
        normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        return replace(self, points=self.points * factors, normals=normals, uv=self.uv * float(np.cbrt(factors.prod())))


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several; the surfaces stay apart. It counts as closed only if all parts are."""
    offsets = np.cumsum([0, *(mesh.surfaces for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.surface + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]),
        all(mesh.closed for mesh in meshes),
    )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = np.empty(np.broadcast(a, b).shape)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def _flat_normals(points: np.ndarray) -> np.ndarray:
    normal = _cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return np.repeat(normal[:, None], 3, axis=1)


def _outwards(mesh: Mesh) -> Mesh:
    """The closed mesh with its corners ordered so that the enclosed volume is positive and normals to match."""
    points = mesh.points
    volume = np.einsum("ni,ni->", points[:, 0], _cross(points[:, 1], points[:, 2]))
    if volume < 0:
        mesh = replace(mesh, points=points[:, ::-1], normals=mesh.normals[:, ::-1], uv=mesh.uv[:, ::-1])
    geometric = _flat_normals(mesh.points)
    sign = np.sign(np.einsum("nci,nci->nc", mesh.normals, geometric))[..., None]
    return replace(mesh, normals=mesh.normals * np.where(sign == 0, 1, sign), closed=True)


def polygon(corners: np.ndarray, uv: np.ndarray | None = None) -> Mesh:
    """A flat polygon, visible from both sides; star-shaped about its mean. `corners` (K, 3) m.

    Without `uv` (K, 2) the texture lies along the polygon's first edge.
    """
    corners = np.asarray(corners, float)
    if uv is None:
        along = corners[1] - corners[0]
        along = along / np.linalg.norm(along)
        normal = _cross(along, corners[2] - corners[0])
        across = _cross(normal / np.linalg.norm(normal), along)
        uv = np.stack([(corners - corners[0]) @ along, (corners - corners[0]) @ across], -1)
    count = len(corners)
    if count <= 4:  # convex in every use: a fan from the first corner needs no extra vertex
        index = np.array([[0, i, i + 1] for i in range(1, count - 1)])
        points, coordinates = corners[index], uv[index]
    else:
        around = np.stack([np.arange(count), np.roll(np.arange(count), -1)], -1)
        middle, uv_middle = corners.mean(0), uv.mean(0)
        points = np.concatenate([np.broadcast_to(middle, (count, 1, 3)), corners[around]], 1)
        coordinates = np.concatenate([np.broadcast_to(uv_middle, (count, 1, 2)), uv[around]], 1)
    return Mesh(points, _flat_normals(points), coordinates, np.zeros(len(points), np.int64))


def grid(points: np.ndarray, uv: np.ndarray, smooth: bool = True) -> Mesh:
    """A surface over a grid of `points` (A, B, 3) m with texture coordinates `uv` (A, B, 2) m: two triangles a cell."""
    along, across = np.empty_like(points), np.empty_like(points)
    along[1:-1], along[0], along[-1] = points[2:] - points[:-2], points[1] - points[0], points[-1] - points[-2]
    across[:, 1:-1], across[:, 0], across[:, -1] = (
        points[:, 2:] - points[:, :-2], points[:, 1] - points[:, 0], points[:, -1] - points[:, -2],
    )  # fmt: skip
    for axis, difference in ((0, along), (1, across)):  # rows or columns that meet again share their normals
        first, last = np.take(points, 0, axis), np.take(points, -1, axis)
        if np.abs(first - last).max() < 1e-9 * (1 + np.abs(first).max()):
            ring = np.take(points, 1, axis) - np.take(points, -2, axis)
            index: list = [slice(None)] * 3
            for end in (0, -1):
                index[axis] = end
                difference[tuple(index)] = ring
    normal = _cross(along, across)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    if not smooth or (length < 1e-12).all():
        normal, length = np.zeros_like(normal), np.zeros_like(length)
    normal = normal / np.maximum(length, 1e-12)

    def corners(values: np.ndarray) -> np.ndarray:
        a, b, c, d = values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]
        return np.stack([np.stack([a, b, c], 2), np.stack([a, c, d], 2)], 2).reshape(-1, 3, values.shape[-1])

    triangles, normals = corners(points), corners(normal)
    flat = _flat_normals(triangles)
    normals = np.where(np.linalg.norm(normals, axis=-1, keepdims=True) < 0.5, flat, normals)
    cells = np.repeat(np.arange(len(triangles) // 2), 2)
    surface = np.zeros(len(triangles), np.int64) if smooth else cells
    area = np.linalg.norm(_cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1)
    keep = area > 1e-14  # a pole's cells degenerate to one triangle
    return Mesh(triangles[keep], normals[keep], corners(uv)[keep], surface[keep])


_CUBE = np.array(  # faces, corners in order round each
    [
        [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)],
        [(1, -1, 1), (-1, -1, 1), (-1, 1, 1), (1, 1, 1)],
        [(-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1)],
        [(1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1)],
        [(-1, -1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1)],
        [(-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)],
    ],
    float,
)
_HALVES = np.array([[0, 2, 1], [0, 3, 2]])
_CUBE_TRIANGLES = np.ascontiguousarray(_CUBE[:, _HALVES].reshape(12, 3, 3))
_CUBE_NORMALS = np.repeat(_CUBE.mean(1), 6, axis=0).reshape(12, 3, 3)
#: Of each corner of the twelve triangles: the side's width and height (as axes), and whether it lies at their far end.
_CUBE_AXES = np.repeat(np.array([(0, 1), (0, 1), (2, 1), (2, 1), (0, 2), (0, 2)]), 6, axis=0).reshape(12, 3, 2)
_CUBE_FAR = np.tile(np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)[_HALVES], (6, 1, 1))


def boxes(sizes: ArrayLike, middles: ArrayLike = ((0, 0, 0),)) -> Mesh:
    """Boxes of `sizes` (K, 3) or (3,) m about `middles` (K, 3) m; the texture stands upright on their four sides."""
    sizes, middles = np.asarray(sizes, float).reshape(-1, 3), np.asarray(middles, float)
    points = (_CUBE_TRIANGLES * (sizes / 2)[:, None, None] + middles[:, None, None]).reshape(-1, 3, 3)
    count = len(points) // 12
    uv = (sizes[:, _CUBE_AXES] * _CUBE_FAR).reshape(-1, 3, 2)
    uv = uv if len(uv) == len(points) else np.tile(uv, (count, 1, 1))
    normals = _CUBE_NORMALS if count == 1 else np.tile(_CUBE_NORMALS, (count, 1, 1))
    return Mesh(points, normals, uv, np.arange(12 * count) // 2, True)


def box(size: ArrayLike) -> Mesh:
    """A box of `size` (x, y, z) m about the origin."""
    return boxes(np.asarray(size, float))


def hull(points: np.ndarray) -> Mesh:
    """The convex hull of `points` (K, 3) m, flat faces."""
    shape = ConvexHull(points)
    middle = points[shape.vertices].mean(0)
    planes = [tuple(plane) for plane in np.round(shape.equations, 6).tolist()]
    number = {plane: index for index, plane in enumerate(sorted(set(planes)))}
    first = [planes.index(plane) for plane in number]
    surface = np.array([number[plane] for plane in planes])
    order = np.argsort(surface, kind="stable")
    surface = surface[order]
    triangles, normal = points[shape.simplices[order]], shape.equations[first, :3][surface]
    along = points[shape.simplices[first, 1]] - points[shape.simplices[first, 0]]
    along = (along / np.linalg.norm(along, axis=1, keepdims=True))[surface]
    offset = triangles - middle
    uv = np.stack([np.einsum("nci,ni->nc", offset, along), np.einsum("nci,ni->nc", offset, _cross(normal, along))], -1)
    facing = _cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = (np.einsum("ni,ni->n", facing, normal) < 0)[:, None, None]
    triangles, uv = np.where(inward, triangles[:, ::-1], triangles), np.where(inward, uv[:, ::-1], uv)
    return Mesh(triangles, np.repeat(normal[:, None], 3, axis=1), uv, surface.astype(np.int64), True)


def sweep(profile: Callable[[np.ndarray, np.ndarray], np.ndarray], rings: int, steps: int, uv_size: tuple[float, float]) -> Mesh:
    """A closed surface ``profile(s, t) -> (..., 3)`` for s in [0, 1] (rings) and t in [0, 1] (round), outwards.

    The texture is stretched over `uv_size` metres along s and round t.
    """
    s, t = np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, steps + 1), indexing="ij")
    return _outwards(grid(profile(s, t), np.stack([s * uv_size[0], t * uv_size[1]], -1)))


def ellipsoid(radii: ArrayLike, rings: int = 14, steps: int = 24, power: float = 1.0,
              bumps: np.ndarray | None = None) -> Mesh:  # fmt: skip
    """A (super-)ellipsoid about the origin; `power` < 1 is boxy, > 1 pinched.

    Parameters
    ----------
    radii : three floats
        Half axes in metres.
    bumps : ndarray (K, 5), optional
        Waves on the surface: direction (3), frequency, amplitude relative to the radius.
    """
    axes = np.asarray(radii, float)

    def profile(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        def shape(value: np.ndarray) -> np.ndarray:
            return np.sign(value) * np.abs(value) ** power

        latitude, longitude = np.pi * (s - 0.5), 2 * np.pi * t
        around = shape(np.cos(latitude))
        unit = np.stack([around * shape(np.cos(longitude)), shape(np.sin(latitude)), around * shape(np.sin(longitude))], -1)
        unit[..., -1, :] = unit[..., 0, :]
        if bumps is not None:
            waves = sum(wave[4] * np.sin(unit @ wave[:3] * wave[3] + index) for index, wave in enumerate(bumps))
            unit = unit * (1 + np.asarray(waves))[..., None]
        return unit * axes

    mean = float(axes.mean())
    return sweep(profile, rings, steps, (np.pi * mean, 2 * np.pi * mean))


def torus(radius: float, tube: float, rings: int = 14, steps: int = 28) -> Mesh:
    """A ring about the y axis: distance `radius` from the axis to the tube's middle, tube radius `tube`, metres."""

    def profile(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        across = radius + tube * np.cos(2 * np.pi * s)
        return np.stack([across * np.cos(2 * np.pi * t), tube * np.sin(2 * np.pi * s), across * np.sin(2 * np.pi * t)], -1)

    return sweep(profile, rings, steps, (2 * np.pi * tube, 2 * np.pi * radius))


def lathe(outline: np.ndarray, steps: int = 20) -> Mesh:
    """A solid of revolution about the y axis from `outline` (K, 2): radius and y in metres, from one end to the other.

    Ends that do not reach the axis are closed by flat lids; edges of the outline stay sharp.
    """
    outline = np.asarray(outline, float)
    angle = np.linspace(0, 2 * np.pi, steps + 1)
    angle[-1] = 0.0
    bands, travelled = [], 0.0
    ends = [np.array([[0, outline[0, 1]], outline[0]]), np.array([outline[-1], [0, outline[-1, 1]]])]
    for pair in [ends[0], *(outline[i : i + 2] for i in range(len(outline) - 1)), ends[1]]:
        length = float(np.linalg.norm(pair[1] - pair[0]))
        if length < 1e-9:
            continue
        points = np.stack([pair[:, :1] * np.cos(angle), np.repeat(pair[:, 1:], steps + 1, 1), pair[:, :1] * np.sin(angle)], -1)
        turns = np.linspace(0, 2 * np.pi * max(pair[:, 0].max(), 1e-3), steps + 1)
        uv = np.stack(np.broadcast_arrays(turns[None, :], np.array([[travelled], [travelled + length]])), -1)
        bands.append(grid(points, uv))
        travelled += length
    return _outwards(join(bands))


def cylinder(radius: float, height: float, steps: int = 16) -> Mesh:
    """A cylinder along y about the origin, metres."""
    return lathe(np.array([[radius, -height / 2], [radius, height / 2]]), steps)


def tube(path: np.ndarray, radius: float, steps: int = 8) -> Mesh:
    """A round bar of `radius` m along the line `path` (K, 3) m; the path may end where it starts."""
    path = np.asarray(path, float)
    tangent = np.gradient(path, axis=0)
    if np.allclose(path[0], path[-1]):
        tangent[0] = tangent[-1] = path[1] - path[-2]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-12)
    side = np.zeros_like(path)
    side[0] = _cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    for i in range(1, len(path)):  # the frame is carried along, so that it does not twist
        side[i] = side[i - 1] - tangent[i] * (side[i - 1] @ tangent[i])
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-12)
    up = _cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, steps + 1)
    angle[-1] = 0.0
    ring = side[:, None] * np.cos(angle)[:, None] + up[:, None] * np.sin(angle)[:, None]
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))])
    uv = np.stack(np.broadcast_arrays(travelled[:, None], np.linspace(0, 2 * np.pi * radius, steps + 1)), -1)
    bar = grid(path[:, None] + radius * ring, uv)
    outward = np.einsum("nci,nci->nc", bar.normals, _flat_normals(bar.points)) < 0
    return replace(bar, normals=np.where(outward[..., None], -bar.normals, bar.normals))


def star(tips: int, inner: float, outer: float, thickness: float, blunt: float = 0.0) -> Mesh:
    """An extruded star or gear in the xy plane, metres; `blunt` in [0, 1) widens the tips to teeth."""
    step = np.pi / tips
    angle, radius = [], []
    for tip in range(tips):
        centre = 2 * tip * step
        for offset, reach in (
            (-0.5 * blunt, outer),
            (0.5 * blunt, outer),
            (1 - 0.3 * blunt, inner),
            (1 + 0.3 * blunt, inner),
        ):
            angle.append(centre + offset * step)
            radius.append(reach)
    outline = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], -1) * np.array(radius)[:, None]
    outline = outline[np.linalg.norm(outline - np.roll(outline, 1, 0), axis=-1) > 1e-6]
    return extrude(outline, thickness)


def extrude(outline: np.ndarray, thickness: float) -> Mesh:
    """A plate of `thickness` m along z from `outline` (K, 3) m in the xy plane, star-shaped about its mean."""
    outline = np.asarray(outline, float)
    count, front, back = len(outline), outline - (0, 0, thickness / 2), outline + (0, 0, thickness / 2)
    lids = [polygon(front, outline[:, :2]), polygon(back[::-1], outline[::-1, :2])]
    sides = [polygon(np.stack([front[i], front[(i + 1) % count], back[(i + 1) % count], back[i]])) for i in range(count)]
    signed = np.sum(outline[:, 0] * np.roll(outline[:, 1], -1) - np.roll(outline[:, 0], -1) * outline[:, 1])
    if signed > 0:  # one order of the corners, so that all faces look outwards together
        lids = [polygon(front[::-1], outline[::-1, :2]), polygon(back, outline[:, :2])]
    else:
        sides = [polygon(np.stack([back[i], back[(i + 1) % count], front[(i + 1) % count], front[i]])) for i in range(count)]
    return _outwards(join([*lids, *sides]))
