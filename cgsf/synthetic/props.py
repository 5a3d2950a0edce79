"""Things that stand and move in streets. They stand on y = 0 and face +z, metres.

A prop is a handful of pieces with named materials. Building its meshes takes milliseconds, so each kind has a fixed
number of shapes, made when first asked for; every copy in a scene has its own materials, place and motion.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from cgsf.synthetic.meshes import Mesh, box, boxes, cylinder, ellipsoid, hull, join, lathe, polygon, tube
from cgsf.synthetic.scene import Material, Motion, Scene

_SEED = 20_190_613
_ACROSS = Rotation.from_rotvec((0, 0, np.pi / 2))  # the y axis laid along x


@dataclass(frozen=True)
class Piece:
    """A mesh of a prop with the name of its material.

    A piece with a `pivot` (3,) m turns about the x axis through it: `roll` radians per metre that the prop travels
    (wheels), or `swing` radians per frame (legs).
    """

    material: str
    mesh: Mesh
    pivot: tuple[float, float, float] | None = None
    roll: float = 0.0
    swing: float = 0.0


Prop = tuple[Piece, ...]


@dataclass(frozen=True)
class Placement:
    """Where a prop stands and how it moves.

    Parameters
    ----------
    foot : ndarray (3,)
        World coordinates at time 0, metres.
    yaw : float
        Turn about the vertical, radians.
    speed : float
        Metres per frame along the prop's own +z.
    yaw_rate : float
        Radians per frame.
    object_id : int
        0 for what stands still.
    """

    foot: tuple[float, float, float]
    yaw: float = 0.0
    speed: float = 0.0
    yaw_rate: float = 0.0
    object_id: int = 0

    def put(self, scene: Scene, prop: Prop, materials: Mapping[str, Material]) -> None:
        """Add a copy of a prop to the scene."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        place = np.array(
            [(cos, 0, sin, self.foot[0]), (0, 1, 0, self.foot[1]), (-sin, 0, cos, self.foot[2]), (0, 0, 0, 1)], float
        )
        velocity = place[:3, 2] * self.speed
        whole = Motion(place[:3, 3], velocity, np.array([0, self.yaw_rate, 0])) if self.object_id else None
        for piece in prop:
            motion, rate = whole, piece.roll * self.speed + piece.swing
            if whole is not None and piece.pivot is not None and rate and not self.yaw_rate:
                motion = Motion(place[:3, :3] @ piece.pivot + place[:3, 3], velocity, place[:3, 0] * rate)
            scene.add(piece.mesh, materials[piece.material], motion, self.object_id, place)


def _shapes(count: int) -> Callable[[Callable[[np.random.Generator], Prop]], Callable[[np.random.Generator], Prop]]:
    """Turn a builder of random props into one that draws from `count` shapes, each built once."""

    def decorate(build: Callable[[np.random.Generator], Prop]) -> Callable[[np.random.Generator], Prop]:
        @cache
        def shape(variant: int) -> Prop:
            return build(np.random.default_rng([_SEED, *build.__name__.encode(), variant]))

        return lambda rng: shape(int(rng.integers(count)))

    return decorate


# --- vehicles: body, glass, dark, rim, white, red, plate, load ------------------------------------------------------


def _wheel(hub: tuple[float, float, float], radius: float, tread: float) -> list[Piece]:
    """A tyre and its spokes, on the outside of the vehicle."""
    outside = (hub[0] + np.sign(hub[0]) * (tread / 2 + 0.005), hub[1], hub[2])
    spokes = [
        box((0.015, radius * 1.25, 0.07)).moved(outside, Rotation.from_rotvec((angle, 0, 0)))
        for angle in np.arange(3) * np.pi / 3
    ]
    return [
        Piece("dark", cylinder(radius, tread, 16).moved(hub, _ACROSS), hub, 1 / radius),
        Piece("rim", join(spokes), hub, 1 / radius),
    ]


@_shapes(48)
def car(rng: np.random.Generator) -> Prop:
    """A passenger car, estate or van: body, glass house, pillars, wheels, lamps, plates, mirrors."""
    kind = rng.random()
    length, width, height = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.9), rng.uniform(1.38, 1.6)
    hood, trunk = rng.uniform(0.9, 1.35), rng.uniform(0.25, 0.9)
    if kind < 0.2:  # van
        length, height, hood, trunk = (
            rng.uniform(4.5, 5.5),
            rng.uniform(1.8, 2.3),
            rng.uniform(0.4, 0.9),
            rng.uniform(0.0, 0.15),
        )
    elif kind < 0.5:  # estate or hatchback
        trunk = rng.uniform(0.0, 0.25)
    waist, clear, x, z = height * rng.uniform(0.55, 0.64), rng.uniform(0.16, 0.26), width / 2, length / 2

    def slab(*levels: tuple[float, float, float, float]) -> Mesh:
        """Hull of rectangles (height, half width, z from, z to)."""
        return hull(np.array([(side * w, -y, end) for y, w, rear, front in levels for side in (-1, 1) for end in (rear, front)]))

    dip = rng.uniform(0.02, 0.12)
    lower = slab(
        (clear, x * 0.93, -z + 0.14, z - 0.18), (clear + 0.22, x, -z, z), (clear + 0.36, x, -z, z - 0.01),
        (waist - 0.16, x, -z + 0.03, z - 0.07),
    )  # fmt: skip
    upper = slab(
        (waist - 0.18, x * 0.995, -z + 0.03, z - 0.07),
        (waist, x * 0.93, -z + 0.1, z - hood),
        (waist - dip, x * 0.88, -z + 0.12, z - 0.3),
    )
    rake_front, rake_rear = rng.uniform(0.45, 0.85), rng.uniform(0.1, 0.7) if kind > 0.2 else 0.1
    front, rear = z - hood, -z + trunk + 0.05
    roof = (rear + rake_rear, front - rake_front)
    glass = slab((waist - 0.03, x * 0.92, rear, front), (height - 0.05, x * 0.74, *roof))
    top = slab(
        (height - 0.1, x * 0.765, roof[0] - 0.07, roof[1] + 0.08),
        (height - 0.03, x * 0.72, roof[0] + 0.05, roof[1] - 0.05),
        (height, x * 0.5, roof[0] + 0.25, roof[1] - 0.2),
    )  # fmt: skip
    pillars = []
    for side in (-1, 1):
        for z_low, z_high in ((front, roof[1]), (rear, roof[0]), ((front + rear) / 2, sum(roof) / 2)):
            path = np.array([(side * x * 0.93, -waist + 0.05, z_low), (side * x * 0.755, -height + 0.06, z_high)])
            pillars.append(tube(path, 0.045, 5))
    mirrors = boxes((0.18, 0.13, 0.1), [(side * (x + 0.06), -waist - 0.05, front - 0.25) for side in (-1, 1)])
    ends = ((z - 0.03, "white"), (-z + 0.02, "red"))
    lamp_height = waist * rng.uniform(0.75, 0.85)
    lamp_size = (rng.uniform(0.2, 0.42), rng.uniform(0.1, 0.22), 0.12)
    pieces = [
        Piece("body", join([lower, upper, top])), Piece("body", join(pillars)), Piece("glass", glass),
        Piece("body" if rng.random() < 0.7 else "dark", mirrors),
        Piece("dark", boxes((width * 0.9, 0.14, 0.1), [(0, -clear - 0.1, end) for end, _ in ends])),
        Piece("dark", box((width * 0.8, 0.1, length * 0.9)).moved((0, -clear, 0))),
        Piece("plate", boxes((0.52, 0.12, 0.05), [(0, -0.5, end + 0.03 * np.sign(end)) for end, _ in ends])),
    ]  # fmt: skip
    pieces += [Piece(name, boxes(lamp_size, [(s * (x - 0.26), -lamp_height, end) for s in (-1, 1)])) for end, name in ends]
    radius = rng.uniform(0.29, 0.36)
    for side in (-1, 1):
        for axle in (-z + 0.75, z - 0.8):
            pieces += _wheel((side * (x - 0.08), -radius, axle), radius, 0.2)
    return tuple(pieces)


@_shapes(24)
def truck(rng: np.random.Generator) -> Prop:
    """A lorry or bus: a large box on wheels behind a cab."""
    length, width, height = rng.uniform(5.5, 12), rng.uniform(2.1, 2.5), rng.uniform(2.4, 3.6)
    low, high = rng.uniform(0.4, 0.6), min(height, rng.uniform(2.2, 3.0))
    nose = np.array(
        [(s * width * 0.48, -y, z) for s in (-1, 1) for y, z in ((low, 0), (low, 1.75), (1.3, 1.8), (high, 1.5), (high, 0))]
    )
    pane = box((width * 0.9, 0.35 * high, 0.05)).moved((0, -0.72 * high, length / 2 - 0.14), Rotation.from_rotvec((-0.2, 0, 0)))
    lamps = [(s * (width / 2 - 0.25), -0.85, -length / 2) for s in (-1, 1)]
    pieces = [
        Piece("load", box((width, height - 0.9, length - 1.8)).moved((0, -(height + 0.9) / 2, -0.9))),
        Piece("body", hull(nose).moved((0, 0, length / 2 - 1.85))), Piece("glass", pane),
        Piece("dark", box((width * 0.8, 0.3, length - 0.6)).moved((0, -0.75, -0.1))),
        Piece("red", boxes((0.25, 0.2, 0.06), lamps)),
        Piece("plate", box((0.52, 0.12, 0.05)).moved((0, -0.7, -length / 2))),
        Piece("rim", box((width, 0.12, 0.12)).moved((0, -0.5, -length / 2 + 0.1))),
    ]  # fmt: skip
    radius = rng.uniform(0.42, 0.52)
    for axle in (length / 2 - 1.2, -length / 2 + 1.2, -length / 2 + 2.4)[: 2 if length < 8 else 3]:
        for side in (-1, 1):
            pieces += _wheel((side * (width / 2 - 0.17), -radius, axle), radius, 0.3)
    return tuple(pieces)


# --- people: coat, trousers, skin, hair, and dark, rim for the bicycle ----------------------------------------------


def _human(rng: np.random.Generator, riding: bool) -> list[Piece]:
    tall, lift = rng.uniform(1.55, 1.9), 0.25 if riding else 0.0
    hip, chest, head = 0.5 * tall + lift, 0.7 * tall + lift, 0.93 * tall + lift
    pieces = [
        Piece(
            "coat",
            ellipsoid((rng.uniform(0.18, 0.25), 0.17 * tall, rng.uniform(0.11, 0.16)), 8, 12, 0.8).moved((0, -chest, 0)),
        ),
        Piece("skin", ellipsoid((0.085, 0.12, 0.1), 8, 10).moved((0, -head, 0))),
        Piece("hair", ellipsoid((0.095, 0.07, 0.11), 6, 10).moved((0, -head - 0.04 * tall, -0.01))),
    ]
    lean, rate = (rng.uniform(0.05, 0.45), rng.uniform(-0.2, 0.2)) if not riding else (0.3, 0.0)
    for side in (-1, 1):
        angle, thigh = side * lean, (side * 0.09, -hip, 0.0)
        foot = (side * 0.1, -hip + 0.48 * tall * np.cos(angle), 0.48 * tall * np.sin(angle))
        pieces.append(Piece("trousers", tube(np.array([thigh, foot]), 0.075, 7), thigh, swing=side * rate))
        pieces.append(
            Piece(
                "trousers",
                box((0.09, 0.08, 0.25)).moved((foot[0], foot[1] + 0.02, foot[2] + 0.06)),
                thigh,
                swing=side * rate,
            )
        )
        hand = (side * 0.26, -(0.62 if riding else 0.55) * tall - lift, 0.45 if riding else -0.3 * tall * np.sin(angle))
        pieces.append(Piece("coat", tube(np.array([(side * 0.2, -0.81 * tall - lift, 0), hand]), 0.05, 6)))
    return pieces


@_shapes(32)
def person(rng: np.random.Generator) -> Prop:
    """A walker; the legs swing."""
    return tuple(_human(rng, riding=False))


@_shapes(16)
def cyclist(rng: np.random.Generator) -> Prop:
    """A rider on two thin wheels."""
    angle = np.linspace(0, 2 * np.pi, 21)
    angle[-1] = 0.0
    rings = [np.stack([np.zeros(21), 0.33 * np.sin(angle) - 0.34, 0.33 * np.cos(angle) + axle], -1) for axle in (-0.5, 0.55)]
    bars = ([(0, -0.34, -0.5), (0, -0.85, -0.15)], [(0, -0.34, 0.55), (0, -1.0, 0.4)],
            [(0, -0.8, -0.15), (0, -0.8, 0.42)], [(0, -0.35, 0.0), (0, -0.8, 0.42)],
            [(-0.25, -1.02, 0.42), (0.25, -1.02, 0.42)])  # fmt: skip
    pieces = _human(rng, riding=True)
    pieces.append(Piece("dark", join([tube(ring, 0.025, 5) for ring in rings])))
    pieces.append(Piece("rim", join([tube(np.array(bar, float), 0.022, 5) for bar in bars])))
    return tuple(pieces)


# --- plants: bark, leaf ---------------------------------------------------------------------------------------------


def _leaf_cloud(rng: np.random.Generator, count: int, radii: np.ndarray, size: float) -> Mesh:
    """Small leaves, seen from both sides, around an ellipsoid; the normals are the ellipsoid's, for soft light."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = direction * radii * rng.uniform(0.75, 1.12, (count, 1))
    first, second = rng.standard_normal((2, count, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second -= first * np.sum(first * second, 1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    extent = size * rng.uniform(0.5, 1.4, (count, 1))
    a, b = first * extent, second * extent * 0.6
    points = np.stack([middle - a, middle + b, middle + a, middle - a, middle + a, middle - b], 1).reshape(-1, 3, 3)
    uv = np.tile(np.array([(-1, 0), (0, 0.6), (1, 0), (-1, 0), (1, 0), (0, -0.6)]).reshape(2, 3, 2) * size, (count, 1, 1))
    uv = uv + np.repeat(rng.random((count, 1, 2)) * 3, 2, axis=0)
    return Mesh(points, np.repeat(np.repeat(direction[:, None], 3, 1), 2, 0), uv, np.repeat(np.arange(count), 2))


def _lump(rng: np.random.Generator, radii: np.ndarray, middle: np.ndarray, leaves: int, size: float) -> list[Piece]:
    """A bumpy ellipsoid of foliage with leaves around it."""
    waves = np.column_stack([rng.standard_normal((4, 3)), rng.uniform(2, 8, 4), rng.uniform(0.02, 0.1, 4)])
    solid = ellipsoid(radii * 0.85, 8, 12, bumps=waves).moved(middle)
    return [Piece("leaf", solid), Piece("leaf", _leaf_cloud(rng, leaves, radii, size).moved(middle))]


@_shapes(32)
def tree(rng: np.random.Generator) -> Prop:
    """A trunk with branches and a crown of leaves, 4 to 10 m tall."""
    height, trunk, girth = rng.uniform(4, 10), rng.uniform(1.6, 3.2), rng.uniform(0.08, 0.22)
    pieces = [Piece("bark", lathe(np.array([[girth * 1.3, 0.0], [girth, -trunk * 0.4], [girth * 0.6, -trunk - 1.0]]), 9))]
    crown, spread = np.array([0, -(trunk + (height - trunk) / 2), 0]), (height - trunk) * rng.uniform(0.28, 0.5)
    for _ in range(int(rng.integers(2, 5))):
        branch = crown + rng.standard_normal(3) * spread * (0.5, 0.4, 0.5)
        pieces.append(Piece("bark", tube(np.array([(0, -trunk * 0.8, 0), branch]), girth * 0.35, 5)))
    for _ in range(int(rng.integers(3, 6))):
        middle = crown + rng.standard_normal(3) * spread * (0.5, 0.45, 0.5)
        lump = _lump(rng, spread * rng.uniform(0.5, 0.95, 3), middle, int(rng.integers(120, 300)), rng.uniform(0.09, 0.2))
        pieces += lump if rng.random() < 0.85 else lump[1:]
    return tuple(pieces)


@_shapes(24)
def bush(rng: np.random.Generator) -> Prop:
    """A bush or a piece of hedge."""
    pieces = []
    for _ in range(int(rng.integers(1, 4))):
        radii = rng.uniform((0.3, 0.35, 0.3), (1.0, 0.8, 0.9))
        middle = np.array([rng.normal(0, 0.4), -radii[1] * 0.8, rng.normal(0, 0.4)])
        pieces += _lump(rng, radii, middle, int(rng.integers(60, 160)), rng.uniform(0.05, 0.12))
    return tuple(pieces)


# --- furniture of the street: metal, lamp, frame, face, body --------------------------------------------------------


@_shapes(12)
def lamp_post(rng: np.random.Generator) -> Prop:
    """A thin tall pole with an arm."""
    height, radius, reach = rng.uniform(4.5, 8), rng.uniform(0.04, 0.09), rng.uniform(0, 1.5)
    path = np.array([(0, 0.1, 0), (0, -height, 0), (0, -height - 0.3, reach)])
    pole = join([tube(path[:2], radius, 7), tube(path[1:], radius * 0.7, 5)])
    return Piece("metal", pole), Piece("lamp", box((0.25, 0.12, 0.6)).moved(path[2]))


@_shapes(24)
def sign(rng: np.random.Generator) -> Prop:
    """One or two traffic signs on a pole: round, triangular or square."""
    height = rng.uniform(1.9, 2.8)
    pieces = [Piece("metal", tube(np.array([(0, 0.05, 0), (0, -height - 0.2, 0)]), rng.uniform(0.025, 0.045), 6))]
    for index in range(int(rng.integers(1, 3))):
        corners, radius = int(rng.choice([3, 4, 8, 16])), rng.uniform(0.25, 0.45)
        angle = np.arange(corners) * 2 * np.pi / corners + (np.pi / 4 if corners == 4 else np.pi / 2)
        for scale, offset, name in ((1.0, 0.05, "frame"), (0.78, 0.06, "face")):
            outline = np.stack([np.cos(angle), -np.sin(angle), np.full(corners, 0.0)], -1) * radius * scale
            pieces.append(Piece(name, polygon(outline).moved((0, -height + index * 0.75, -offset))))
    return tuple(pieces)


@_shapes(16)
def small(rng: np.random.Generator) -> Prop:
    """A bollard, bin, box or hydrant."""
    height, radius = rng.uniform(0.5, 1.2), rng.uniform(0.06, 0.35)
    if rng.random() < 0.5:
        return (Piece("body", lathe(np.array([[radius, 0.0], [radius, -height], [radius * 0.5, -height * 1.1]]), 12)),)
    return (Piece("body", box((2 * radius, height, 2 * radius * rng.uniform(0.7, 2))).moved((0, -height / 2, 0))),)


@_shapes(24)
def fence(rng: np.random.Generator) -> Prop:
    """A piece of fence along +z, 5 to 18 m: bars or boards to see through, or a low wall."""
    height, length, kind = rng.uniform(0.8, 1.6), rng.uniform(5, 18), rng.random()
    if kind < 0.3:
        return (Piece("stone", box((0.25, height, length)).moved((0, -height / 2, length / 2))),)
    gap, thick = (rng.uniform(0.14, 0.3), 0.03) if kind < 0.65 else (rng.uniform(0.16, 0.25), 0.1)
    places = np.arange(0, length, gap)[:90]
    middles = np.stack([np.zeros(len(places)), np.full(len(places), -height / 2 - 0.05), places], -1)
    reach = float(places[-1])
    rails = boxes((0.04, 0.07, reach), [(0.03, -y, reach / 2) for y in (0.25 * height, 0.9 * height)])
    return (Piece("metal" if kind < 0.65 else "wood", join([boxes((0.03, height, thick), middles), rails])),)
