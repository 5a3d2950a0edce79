"""The family `things`: many objects that float and turn before the walls of a room, as in FlyingThings3D."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from cgsf.synthetic.materials import paint, surface
from cgsf.synthetic.meshes import Mesh, box, ellipsoid, grid, hull, join, lathe, polygon, star, torus, tube
from cgsf.synthetic.scene import CameraPath, Light, Motion, Scene, Sky
from cgsf.synthetic.textures import TextureSource
from variational.camera import StereoCamera

# --- shapes of about unit radius ------------------------------------------------------------------------------------


def _box(rng: np.random.Generator) -> Mesh:
    return box(rng.uniform(0.3, 1.4, 3))


def _plate(rng: np.random.Generator) -> Mesh:
    return box((rng.uniform(0.8, 1.7), rng.uniform(0.8, 1.7), rng.uniform(0.02, 0.15)))


def _stone(rng: np.random.Generator) -> Mesh:
    return hull(rng.standard_normal((int(rng.integers(7, 24)), 3)) * rng.uniform(0.4, 0.7, 3))


def _wedge(rng: np.random.Generator) -> Mesh:
    base = np.array([(-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)]) * rng.uniform(0.4, 0.9, 3)
    top = base * (rng.uniform(0, 0.9), -1, rng.uniform(0, 0.9)) + rng.uniform(-0.3, 0.3, 3)
    return hull(np.concatenate([base, top + 0.01 * rng.standard_normal((4, 3))]))


def _ball(rng: np.random.Generator) -> Mesh:
    return ellipsoid(rng.uniform(0.45, 1.0, 3) if rng.random() < 0.6 else np.full(3, 0.8))


def _pebble(rng: np.random.Generator) -> Mesh:
    return ellipsoid(rng.uniform(0.4, 1.0, 3), power=rng.uniform(0.25, 1.6))


def _blob(rng: np.random.Generator) -> Mesh:
    count = int(rng.integers(3, 8))
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frequency = rng.uniform(2, 9, count)
    return ellipsoid(
        rng.uniform(0.5, 0.9, 3),
        20,
        32,
        bumps=np.column_stack([directions, frequency, rng.uniform(0.1, 0.5, count) / frequency**0.6]),
    )


def _vase(rng: np.random.Generator) -> Mesh:
    count = int(rng.integers(3, 9))
    radius = rng.uniform(0.15, 0.7) * (1 + 0.5 * np.sin(np.linspace(0, rng.uniform(2, 9), count) + rng.uniform(0, 6)))
    return lathe(np.stack([radius, np.linspace(-0.9, 0.9, count)], -1), 24)


def _drum(rng: np.random.Generator) -> Mesh:
    radius = rng.uniform(0.15, 0.8)
    return lathe(np.array([[radius, -0.8], [radius * rng.choice([1, 1, 0.02, 0.5]), 0.8]]) * (1, rng.uniform(0.15, 1)), 24)


def _ring(rng: np.random.Generator) -> Mesh:
    return torus(0.7, rng.uniform(0.04, 0.3))


def _gear(rng: np.random.Generator) -> Mesh:
    return star(int(rng.integers(4, 14)), rng.uniform(0.3, 0.75), 0.9, rng.uniform(0.05, 0.6), rng.choice([0, 0.6]))


def _knot(rng: np.random.Generator) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 81)
    p, q = int(rng.integers(1, 4)), int(rng.integers(2, 6))
    reach = 0.65 + 0.25 * np.cos(q * angle)
    path = np.stack([reach * np.cos(p * angle), reach * np.sin(p * angle), 0.3 * np.sin(q * angle)], -1)
    path[-1] = path[0]
    return tube(path, rng.uniform(0.04, 0.14))


def _frame(rng: np.random.Generator) -> Mesh:
    """The edges of a box: thin bars with much to see through."""
    half, thickness = rng.uniform(0.4, 0.8, 3), rng.uniform(0.015, 0.06)
    bars = []
    for axis in range(3):
        for a in (-1, 1):
            for b in (-1, 1):
                middle = np.insert(np.array([a, b]) * np.delete(half, axis), axis, 0)
                size = np.full(3, 2 * thickness)
                size[axis] = 2 * half[axis] + 2 * thickness
                bars.append(box(size).moved(middle))
    return join(bars)


def _lattice(rng: np.random.Generator) -> Mesh:
    count, thickness = int(rng.integers(3, 9)), rng.uniform(0.01, 0.04)
    bars = [box((1.8, thickness, thickness)).moved((0, y, 0)) for y in np.linspace(-0.8, 0.8, count)]
    bars += [box((thickness, 1.8, thickness)).moved((x, 0, thickness)) for x in np.linspace(-0.8, 0.8, count)]
    return join(bars)


def _seat(rng: np.random.Generator) -> Mesh:
    """A chair or a table: a plate on four legs, with or without a back."""
    width, depth, height, leg = (
        rng.uniform(0.7, 1.2),
        rng.uniform(0.7, 1.2),
        rng.uniform(0.5, 1.0),
        rng.uniform(0.03, 0.08),
    )
    parts = [box((width, 0.08, depth))]
    for x in (-1, 1):
        for z in (-1, 1):
            parts.append(box((leg, height, leg)).moved((x * (width - leg) / 2, height / 2, z * (depth - leg) / 2)))
    if rng.random() < 0.7:
        bars = int(rng.integers(1, 6))
        for place in np.linspace(-1, 1, bars) * (width - leg) / 2 if bars > 1 else [0.0]:
            parts.append(box((leg if bars > 1 else width, height, leg)).moved((place, -height / 2, (depth - leg) / 2)))
    return join(parts)


def _cloth(rng: np.random.Generator) -> Mesh:
    """A waved sheet, seen from both sides."""
    a, b = np.meshgrid(np.linspace(-0.9, 0.9, 21), np.linspace(-0.9, 0.9, 21), indexing="ij")
    depth = np.zeros_like(a)
    for k in range(1, 4):
        depth += 0.25 / k * np.sin(k * (a * rng.normal() + b * rng.normal()) * 3 + rng.uniform(0, 6))
    return grid(np.stack([a, b, depth], -1), np.stack([a, b], -1))


def _letters(rng: np.random.Generator) -> Mesh:
    """A word of block letters made of bars, as on a seven-segment display and beyond."""
    ends = np.array([(-1, -2), (1, -2), (1, 0), (1, 2), (-1, 2), (-1, 0)]) * 0.16
    strokes = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (5, 2), (0, 2), (5, 3), (0, 3), (4, 1)]
    parts, count, thickness = [], int(rng.integers(3, 6)), rng.uniform(0.04, 0.09)
    for letter in range(count):
        for index in rng.choice(len(strokes), int(rng.integers(3, 6)), replace=False):
            start, end = ends[strokes[index][0]], ends[strokes[index][1]]
            along = end - start
            bar = box((float(np.linalg.norm(along)) + thickness, thickness, 0.25))
            turn = Rotation.from_rotvec((0, 0, np.arctan2(along[1], along[0])))
            parts.append(bar.moved((*((start + end) / 2 + ((letter - (count - 1) / 2) * 0.48, 0)), 0), turn))
    return join(parts)


SHAPES: tuple[tuple[float, Callable[[np.random.Generator], Mesh]], ...] = (
    (3, _box), (1.5, _plate), (2, _stone), (1.5, _wedge), (1.5, _ball), (1.5, _pebble), (2.5, _blob), (1.5, _vase),
    (2, _drum), (1, _ring), (1, _gear), (1, _knot), (0.8, _frame), (0.6, _lattice), (1.5, _seat),
    (1, _cloth), (0.8, _letters),
)  # fmt: skip
_WEIGHTS = np.array([weight for weight, _ in SHAPES])


def shape(rng: np.random.Generator, flat: bool = False) -> Mesh:
    """A random shape of about unit radius."""
    return SHAPES[int(rng.choice(len(SHAPES), p=_WEIGHTS / _WEIGHTS.sum()))][1](rng)


# --- the scene ------------------------------------------------------------------------------------------------------


def _size(rng: np.random.Generator, middle: float, spread: float, largest: float) -> float:
    return float(min(middle * np.exp(spread * rng.standard_normal()), largest))


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def things(rng: np.random.Generator, source: TextureSource, height: int, width: int) -> Scene:
    """A scene of the family `things`; see the module."""
    focal = rng.uniform(0.75, 1.15)  # of the image's width
    aspect = height / width
    back_m = rng.uniform(9, 22)
    baseline = rng.uniform(0.012, 0.03) * back_m / focal  # the back wall's disparity: 1.2 to 3 % of the width
    camera = StereoCamera(focal * width, focal * width, (width - 1) / 2, (height - 1) / 2, baseline)

    path = CameraPath(
        np.zeros(3), np.zeros(3), _direction(rng) * (0.6, 0.6, 1.2) * _size(rng, 0.012, 1.0, 0.05) * back_m,
        rng.standard_normal(3) * (1, 1, 0.8) * _size(rng, 0.008, 0.8, 0.04),
    )  # fmt: skip
    bright, warm = rng.uniform(0.6, 1.6), rng.uniform(0.8, 1.2)
    tint = np.array([1 / warm, 1.0, warm])
    light = Light(
        np.array([rng.uniform(-0.4, 0.4) * back_m, -rng.uniform(0.25, 0.6) * back_m, rng.uniform(-0.1, 0.5) * back_m]),
        np.array([0, 0, 0.6 * back_m]), 0.75 * back_m, tint * bright, back_m * rng.uniform(0.6, 2.0),
        tint * rng.uniform(0.15, 0.7), tint * rng.uniform(0.1, 0.5),
    )  # fmt: skip
    sky = Sky(tint * rng.uniform(0.3, 1.2), tint[::-1] * rng.uniform(0.2, 1.0), source.any("clouds"), rng.uniform(0.2, 1.0))
    scene = Scene(camera, path, light, sky)
    _room(scene, rng, source, back_m, focal, aspect)

    count = int(rng.integers(6, 18))
    palette = [surface(source, 1.0) for _ in range(int(rng.integers(8, 14)))]
    for index in range(count):
        depth = float(np.exp(rng.uniform(np.log(0.16), np.log(0.75)))) * back_m
        radius = depth / focal * min(_size(rng, 0.085, 0.5, 0.25), 0.5 * aspect)
        middle = np.array([(rng.uniform(-0.55, 0.55)) / focal, rng.uniform(-0.55, 0.55) * aspect / focal, 1.0]) * depth
        turn = Rotation.from_quat(rng.standard_normal(4))
        mesh = shape(rng).scaled(radius).moved(middle, turn)
        material = palette[int(rng.integers(len(palette)))] if rng.random() < 0.8 else paint(rng, None, 0.6, 0.3)
        if rng.random() < 0.15:
            scene.add(mesh, material)
            continue
        velocity = _direction(rng) * (1, 1, 1.6) * _size(rng, 0.02, 0.9, 0.12) * depth
        spin = _direction(rng) * _size(rng, 0.05, 0.9, 0.35)
        scene.add(mesh, material, Motion(middle, velocity, spin), index + 1)
    return scene


def _room(scene: Scene, rng: np.random.Generator, source: TextureSource, back_m: float, focal: float, aspect: float) -> None:
    """Walls, floor and ceiling, turned against the camera, and things that stand on the floor."""
    turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * (0.12, 0.5, 0.1))
    left, right = -rng.uniform(0.35, 0.9) * back_m / focal, rng.uniform(0.35, 0.9) * back_m / focal
    floor, ceiling = rng.uniform(0.3, 0.6) * back_m * aspect / focal, -rng.uniform(0.4, 0.8) * back_m * aspect / focal
    near = -0.3 * back_m

    def wall(*corners: tuple[float, float, float]) -> None:
        repeat = back_m * rng.uniform(0.12, 0.5)
        material = surface(source, repeat) if rng.random() < 0.8 else paint(rng, None, 0.1)
        scene.add(polygon(np.array(corners)).moved((0, 0, 0), turn), material)

    wall((left, ceiling, back_m), (right, ceiling, back_m), (right, floor, back_m), (left, floor, back_m))
    wall((left, floor, back_m), (right, floor, back_m), (right, floor, near), (left, floor, near))
    if rng.random() < 0.8:
        wall((left, ceiling, near), (right, ceiling, near), (right, ceiling, back_m), (left, ceiling, back_m))
    wall((left, ceiling, near), (left, ceiling, back_m), (left, floor, back_m), (left, floor, near))
    wall((right, ceiling, back_m), (right, ceiling, near), (right, floor, near), (right, floor, back_m))

    for _ in range(int(rng.integers(0, 9))):  # furniture
        size = rng.uniform(0.04, 0.13) * back_m
        mesh = shape(rng).scaled(size)
        foot = float(mesh.points[..., 1].max())
        place = (rng.uniform(left, right), floor - foot, rng.uniform(0.35, 0.95) * back_m)
        yaw = Rotation.from_rotvec((0, rng.uniform(0, 6.3), 0))
        scene.add(mesh.moved((0, 0, 0), yaw).moved(place).moved((0, 0, 0), turn), surface(source, size))
    for _ in range(int(rng.integers(0, 5))):  # pictures on the back wall
        w, h = rng.uniform(0.05, 0.2, 2) * back_m
        x, y = (
            rng.uniform(left + w, right - w) if right - left > 2 * w else 0.0,
            rng.uniform(0.7 * ceiling, 0.5 * floor),
        )
        corners = np.array([(x, y, 0), (x + w, y, 0), (x + w, y + h, 0), (x, y + h, 0)]) + (0, 0, 0.995 * back_m)
        scene.add(polygon(corners).moved((0, 0, 0), turn), surface(source, max(w, h)))
