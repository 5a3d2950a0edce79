"""Things that stand and move in streets, each put together from meshes; they stand on y = 0 and face +z, metres.

Every function adds its parts to a scene under one `Placement`, so that a car is one object with many materials.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cgsf.synthetic.materials import paint, tinted
from cgsf.synthetic.meshes import Mesh, box, cylinder, ellipsoid, hull, join, lathe, polygon, tube
from cgsf.synthetic.patterns import color
from cgsf.synthetic.scene import Material, Motion, Scene
from cgsf.synthetic.textures import TextureSource

_ACROSS = Rotation.from_rotvec((0, 0, np.pi / 2))  # the y axis laid along x


@dataclass(frozen=True)
class Placement:
    """Where a prop stands and how it moves.

    Parameters
    ----------
    place : ndarray (3,)
        Foot in world coordinates at time 0, metres.
    yaw : float
        Turn about the vertical, radians.
    speed : float
        Metres per frame along the prop's own +z.
    yaw_rate : float
        Radians per frame.
    object_id : int
        0 for what stands still.
    """

    place: np.ndarray
    yaw: float = 0.0
    speed: float = 0.0
    yaw_rate: float = 0.0
    object_id: int = 0

    @property
    def turn(self) -> Rotation:
        return Rotation.from_rotvec((0, self.yaw, 0))

    def motion(self) -> Motion | None:
        """The motion of a rigid prop; None when it stands still."""
        if self.object_id == 0:
            return None
        return Motion(np.asarray(self.place, float), self.turn.apply((0, 0, self.speed)), np.array([0, self.yaw_rate, 0]))

    def put(self, scene: Scene, mesh: Mesh, material: Material, joint: Motion | None = None) -> None:
        """Add a part; `joint`, in the prop's own coordinates, turns the part about its own pivot on top of a straight motion."""
        motion = self.motion()
        if motion is not None and joint is not None and self.yaw_rate == 0:
            motion = Motion(self.place + self.turn.apply(joint.pivot), motion.velocity, self.turn.apply(joint.spin))
        scene.add(mesh.moved(self.place, self.turn), material, motion, self.object_id)


def _spin(pivot: tuple[float, float, float], rate: float) -> Motion:
    return Motion(np.array(pivot), np.zeros(3), np.array([rate, 0.0, 0.0]))


# --- vehicles --------------------------------------------------------------------------------------------------------


def car(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A passenger car, van or sports car: body, glass house, wheels, lamps, plates."""
    kind = rng.random()
    length, width, height = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.9), rng.uniform(1.38, 1.6)
    hood, trunk = rng.uniform(0.9, 1.35), rng.uniform(0.25, 0.9)
    if kind < 0.2:  # van
        length, height, hood, trunk = rng.uniform(4.5, 5.5), rng.uniform(1.8, 2.3), rng.uniform(0.4, 0.9), rng.uniform(0.0, 0.15)
    elif kind < 0.45:  # estate or hatchback
        trunk = rng.uniform(0.0, 0.25)
    waist, clear, x, z = height * rng.uniform(0.55, 0.64), rng.uniform(0.16, 0.26), width / 2, length / 2
    lacquer = rng.choice(4, p=[0.35, 0.2, 0.2, 0.25])
    bgr = [
        np.full(3, rng.uniform(0.45, 0.95)), np.full(3, rng.uniform(0.03, 0.15)), color(rng, 0.9, rng.uniform(0.25, 0.8)),
        color(rng, rng.uniform(0.1, 0.6)),
    ][lacquer]  # fmt: skip
    body = paint(rng, bgr, rng.uniform(0.3, 1.2), rng.uniform(0.2, 0.7))
    glass, dark = paint(rng, np.full(3, rng.uniform(0.03, 0.16)), 0.8, rng.uniform(0.4, 1.0)), paint(rng, np.full(3, rng.uniform(0.02, 0.1)))

    def slab(levels: list[tuple[float, float, float, float]]) -> Mesh:
        """Hull of rectangles (y, half width, z from, z to)."""
        return hull(np.array([(side * w, -y, end) for y, w, rear, front in levels for side in (-1, 1) for end in (rear, front)]))

    dip = rng.uniform(0.02, 0.12)
    lower = slab([(clear, x * 0.93, -z + 0.12, z - 0.15), (clear + 0.25, x, -z, z), (waist - 0.1, x, -z + 0.02, z - 0.05)])
    upper = slab([(waist - 0.12, x * 0.99, -z + 0.02, z - 0.05), (waist, x * 0.94, -z + 0.08, z - hood), (waist - dip, x * 0.9, -z + 0.1, z - 0.25)])
    at.put(scene, join([lower, upper]), body)
    rake_front, rake_rear = rng.uniform(0.45, 0.85), rng.uniform(0.1, 0.7) if kind > 0.2 else 0.1
    front, rear = z - hood, -z + trunk + 0.05
    roof_z = (rear + rake_rear, front - rake_front)
    at.put(scene, slab([(waist - 0.03, x * 0.93, rear, front), (height - 0.05, x * 0.74, *roof_z)]), glass)
    at.put(scene, slab([(height - 0.1, x * 0.765, roof_z[0] - 0.07, roof_z[1] + 0.08), (height, x * 0.7, roof_z[0] + 0.1, roof_z[1] - 0.1)]), body)
    pillars, low, high = [], waist - 0.05, height - 0.06
    for side in (-1, 1):
        for z_low, z_high in ((front, roof_z[1]), (rear, roof_z[0]), ((front + rear) / 2, sum(roof_z) / 2)):
            path = np.array([(side * x * 0.94, -low, z_low), (side * x * 0.755, -high, z_high)])
            pillars.append(tube(path, 0.045, 5))
    at.put(scene, join(pillars), body)
    radius, tread = rng.uniform(0.29, 0.36), 0.2
    rim = paint(rng, np.full(3, rng.uniform(0.3, 0.8)), 0.5, 0.3)
    rate = at.speed / radius
    for side in (-1, 1):
        for axle in (-0.5 * length + 0.75, 0.5 * length - 0.8):
            hub = (side * (x - tread / 2 + 0.02), -radius, axle)
            joint = _spin(hub, rate)
            at.put(scene, cylinder(radius, tread, 16).moved(hub, _ACROSS), dark, joint)
            disc = (side * (x + 0.03), -radius, axle)
            spokes = [box((0.015, radius * 1.25, 0.07)).moved(disc, Rotation.from_rotvec((angle, 0, 0))) for angle in np.arange(3) * np.pi / 3]
            at.put(scene, join(spokes), rim, joint)
    for end, bgr_lamp in ((z - 0.02, (0.9, 0.95, 1.0)), (-z, (0.05, 0.05, 0.75))):
        lamps = [box((0.34, 0.13, 0.1)).moved((side * (x - 0.28), -waist * 0.82, end - 0.03 * np.sign(end))) for side in (-1, 1)]
        at.put(scene, join(lamps), paint(rng, np.array(bgr_lamp), 0.5, 0.2, rng.uniform(0, 0.6)))
        plate = Material(source.kind("text"), tinted(np.full(3, 0.85), 0.9), 2.0, 0.0, tuple(rng.random(2)))
        at.put(scene, box((0.52, 0.12, 0.04)).moved((0, -0.5, end + 0.02 * np.sign(end))), plate)
        at.put(scene, box((width * 0.9, 0.14, 0.08)).moved((0, -clear - 0.08, end)), dark)
    mirrors = [box((0.18, 0.13, 0.1)).moved((side * (x + 0.06), -waist - 0.05, front - 0.25)) for side in (-1, 1)]
    at.put(scene, join(mirrors), body if rng.random() < 0.7 else dark)


def truck(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A lorry, bus or container: a large box with little or loud texture on wheels."""
    length, width, height = rng.uniform(5.5, 12), rng.uniform(2.1, 2.5), rng.uniform(2.4, 3.6)
    loud = rng.random() < 0.5
    side = paint(rng, None, 0.3, 0.2)
    if loud:
        side = Material(source.any("text", "stripes", "facade", "leaves"), np.eye(3, 4), rng.uniform(0.15, 0.5), 0.0, tuple(rng.random(2)), specular=0.2)
    at.put(scene, box((width, height - 0.9, length - 1.8)).moved((0, -(height + 0.9) / 2, -0.9)), side)
    cab = paint(rng, None, 0.6, 0.4)
    low, high = rng.uniform(0.4, 0.6), min(height, rng.uniform(2.2, 3.0))
    nose = np.array([(s * width * 0.48, -y, z) for s in (-1, 1) for y, z in ((low, 0), (low, 1.75), (1.3, 1.8), (high, 1.5), (high, 0))])
    at.put(scene, hull(nose).moved((0, 0, length / 2 - 1.85)), cab)
    glass = paint(rng, np.full(3, 0.06), 0.8, 0.8)
    at.put(scene, box((width * 0.9, 0.35 * high, 0.05)).moved((0, -0.72 * high, length / 2 - 0.14), Rotation.from_rotvec((-0.2, 0, 0))), glass)
    dark = paint(rng, np.full(3, 0.05))
    at.put(scene, box((width * 0.8, 0.3, length - 0.6)).moved((0, -0.75, -0.1)), dark)
    radius = rng.uniform(0.42, 0.52)
    for axle in (length / 2 - 1.2, -length / 2 + 1.2, -length / 2 + 2.4)[: 2 if length < 8 else 3]:
        for x in (-1, 1):
            hub = (x * (width / 2 - 0.17), -radius, axle)
            at.put(scene, cylinder(radius, 0.3, 16).moved(hub, _ACROSS), dark, _spin(hub, at.speed / radius))
            rim = paint(rng, np.full(3, 0.6))
            at.put(scene, box((0.02, radius * 0.9, radius * 0.5)).moved((x * (width / 2 - 0.01), -radius, axle)), rim, _spin(hub, at.speed / radius))
    lamps = [box((0.25, 0.2, 0.06)).moved((s * (width / 2 - 0.25), -0.85, -length / 2 + 0.0)) for s in (-1, 1)]
    at.put(scene, join(lamps), paint(rng, np.array((0.05, 0.05, 0.7)), glow=0.3))


def person(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement, riding: bool = False) -> None:
    """A walker, or the rider of a bicycle; the legs of a walker swing."""
    tall = rng.uniform(1.55, 1.9)
    coat = Material(source.any("stripes", "plain", "clouds", "checks", "leaves"), np.eye(3, 4) * rng.uniform(0.4, 1.0), 1.5, 0.0, tuple(rng.random(2)))
    trousers, skin = paint(rng, color(rng, 0.3, rng.uniform(0.05, 0.4))), paint(rng, np.array([0.45, 0.55, 0.75]) * rng.uniform(0.35, 1.1))
    lift = 0.25 if riding else 0.0
    hip, chest = 0.5 * tall + lift, 0.7 * tall + lift
    at.put(scene, ellipsoid((0.21, 0.17 * tall, 0.13), 8, 12, 0.8).moved((0, -chest, 0)), coat)
    at.put(scene, ellipsoid((0.085, 0.12, 0.1), 8, 10).moved((0, -0.93 * tall - lift, 0)), skin)
    at.put(scene, ellipsoid((0.095, 0.07, 0.11), 6, 10).moved((0, -0.97 * tall - lift, -0.01)), paint(rng, color(rng, 0.5, rng.uniform(0.03, 0.4))))
    swing, rate = rng.uniform(-0.45, 0.45), rng.uniform(-0.2, 0.2) if at.object_id and not riding else 0.0
    for side in (-1, 1):
        angle = side * swing
        foot = (side * 0.1, -hip + 0.48 * tall * np.cos(angle), 0.48 * tall * np.sin(angle))
        leg = tube(np.array([(side * 0.09, -hip, 0), foot]), 0.075, 7)
        at.put(scene, leg, trousers, _spin((side * 0.09, -hip, 0), side * rate))
        shoe = box((0.09, 0.08, 0.25)).moved((foot[0], foot[1] + 0.02, foot[2] + 0.06))
        at.put(scene, shoe, trousers, _spin((side * 0.09, -hip, 0), side * rate))
        reach = 0.45 if riding else -0.3 * tall * np.sin(angle)
        arm = np.array([(side * 0.23, -0.81 * tall - lift, 0), (side * 0.26, -(0.55 if not riding else 0.62) * tall - lift, reach)])
        at.put(scene, tube(arm, 0.05, 6), coat)


def cyclist(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A person on two thin wheels."""
    person(scene, rng, source, at, riding=True)
    metal = paint(rng, None, 0.6)
    angle = np.linspace(0, 2 * np.pi, 21)
    angle[-1] = 0.0
    for axle in (-0.5, 0.55):
        ring = np.stack([np.zeros(21), 0.33 * np.sin(angle) - 0.34, 0.33 * np.cos(angle) + axle], -1)
        at.put(scene, tube(ring, 0.025, 5), paint(rng, np.full(3, 0.05)))
    for bar in ([(0, -0.34, -0.5), (0, -0.85, -0.15)], [(0, -0.34, 0.55), (0, -1.0, 0.4)], [(0, -0.8, -0.15), (0, -0.8, 0.42)],
                [(0, -0.35, 0.0), (0, -0.8, 0.42)], [(-0.25, -1.02, 0.42), (0.25, -1.02, 0.42)]):  # fmt: skip
        at.put(scene, tube(np.array(bar, float), 0.022, 5), metal)


# --- plants ----------------------------------------------------------------------------------------------------------


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


def foliage_material(rng: np.random.Generator, source: TextureSource) -> Material:
    """Leaves in the colours of the seasons, now and then a picture."""
    season = rng.random()
    tint = np.array([rng.uniform(0.4, 0.9), 1.0, rng.uniform(0.5, 1.1)]) * rng.uniform(0.5, 1.2)
    if season < 0.15:
        tint = np.array([0.5, rng.uniform(0.6, 0.9), 1.3])
    return Material(source.kind("foliage"), np.eye(3, 4) * tint[:, None], rng.uniform(0.7, 1.6), 0.0, tuple(rng.random(2)))


def tree(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement, leaf: Material | None = None) -> None:
    """A trunk and a crown of blobs with leaves around them, or a bare or conical tree."""
    height, trunk_height = rng.uniform(4, 10), rng.uniform(1.6, 3.2)
    girth = rng.uniform(0.08, 0.22)
    bark = Material(source.kind("wood", "marble", "grain"), tinted(np.array([0.2, 0.28, 0.36]) * rng.uniform(0.5, 1.4), 0.6), 1.5, np.pi / 2)
    at.put(scene, lathe(np.array([[girth * 1.3, 0.0], [girth, -trunk_height * 0.4], [girth * 0.6, -trunk_height - 1.0]]), 9), bark)
    leaf = leaf or foliage_material(rng, source)
    crown = np.array([0, -(trunk_height + (height - trunk_height) / 2), 0])
    spread = (height - trunk_height) * rng.uniform(0.28, 0.5)
    for _ in range(int(rng.integers(2, 5))):
        branch = crown + rng.standard_normal(3) * spread * (0.5, 0.4, 0.5)
        at.put(scene, tube(np.array([(0, -trunk_height * 0.8, 0), branch]), girth * 0.35, 5), bark)
    for _ in range(int(rng.integers(3, 6))):
        middle = crown + rng.standard_normal(3) * spread * (0.5, 0.45, 0.5)
        radii = spread * rng.uniform(0.5, 0.95, 3)
        if rng.random() < 0.85:
            waves = np.column_stack([rng.standard_normal((4, 3)), rng.uniform(2, 7, 4), rng.uniform(0.02, 0.1, 4)])
            at.put(scene, ellipsoid(radii * 0.85, 8, 12, bumps=waves).moved(middle), leaf)
        at.put(scene, _leaf_cloud(rng, int(rng.integers(120, 320)), radii, rng.uniform(0.09, 0.2)).moved(middle), leaf)


def bush(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement, leaf: Material | None = None) -> None:
    """A bush or a piece of hedge."""
    leaf = leaf or foliage_material(rng, source)
    for _ in range(int(rng.integers(1, 4))):
        radii = rng.uniform((0.3, 0.35, 0.3), (1.0, 0.8, 0.9))
        middle = np.array([rng.normal(0, 0.4), -radii[1] * 0.8, rng.normal(0, 0.4)])
        waves = np.column_stack([rng.standard_normal((4, 3)), rng.uniform(3, 9, 4), rng.uniform(0.02, 0.1, 4)])
        at.put(scene, ellipsoid(radii * 0.9, 8, 12, bumps=waves).moved(middle), leaf)
        at.put(scene, _leaf_cloud(rng, int(rng.integers(60, 200)), radii, rng.uniform(0.05, 0.12)).moved(middle), leaf)


# --- furniture of the street -------------------------------------------------------------------------------------------


def lamp_post(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A thin tall pole with an arm."""
    height, radius = rng.uniform(4.5, 8), rng.uniform(0.04, 0.09)
    metal = paint(rng, np.full(3, rng.uniform(0.05, 0.6)), 0.3)
    reach = rng.uniform(0, 1.5)
    path = np.array([(0, 0.1, 0), (0, -height, 0), (0, -height - 0.3, reach)])
    at.put(scene, tube(path[:2], radius, 7), metal)
    at.put(scene, tube(path[1:], radius * 0.7, 5), metal)
    at.put(scene, box((0.25, 0.12, 0.6)).moved(path[2]), paint(rng, np.full(3, 0.8), glow=rng.choice([0, 1.0])))


def sign(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A traffic sign on a pole: round, triangular or square, one or two."""
    height = rng.uniform(1.9, 2.8)
    at.put(scene, tube(np.array([(0, 0.05, 0), (0, -height, 0)]), rng.uniform(0.025, 0.045), 6), paint(rng, np.full(3, rng.uniform(0.3, 0.7)), 0.3))
    for index in range(int(rng.integers(1, 3))):
        corners, radius = int(rng.choice([3, 4, 8, 16])), rng.uniform(0.25, 0.5)
        angle = np.arange(corners) * 2 * np.pi / corners + (np.pi / 4 if corners == 4 else np.pi / 2)
        y = -height + index * 0.75
        for scale, bgr, offset in ((1.0, color(rng, 0.95, 0.75), 0.05), (0.78, color(rng, rng.choice([0.0, 0.9]), 0.9), 0.06)):
            outline = np.stack([np.cos(angle), -np.sin(angle), np.full(corners, 0.0)], -1) * radius * scale
            material = Material(source.any("text"), tinted(bgr, 0.3), 1.4) if scale < 1 else paint(rng, bgr)
            at.put(scene, polygon(outline).moved((0, y, -offset)), material)


def small(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement) -> None:
    """A bollard, bin, box or hydrant."""
    height, radius = rng.uniform(0.5, 1.2), rng.uniform(0.06, 0.35)
    material = paint(rng, None, 0.2) if rng.random() < 0.6 else Material(source.kind("stripes", "rust", "text", "dots"), np.eye(3, 4), 1.2)
    if rng.random() < 0.5:
        at.put(scene, lathe(np.array([[radius, 0.0], [radius, -height], [radius * 0.5, -height * 1.1]]), 12), material)
    else:
        at.put(scene, box((2 * radius, height, 2 * radius * rng.uniform(0.7, 2))).moved((0, -height / 2, 0)), material)


def fence(scene: Scene, rng: np.random.Generator, source: TextureSource, at: Placement, length: float) -> None:
    """A fence along z: pickets, bars or boards to see through, or a low wall."""
    height = rng.uniform(0.8, 1.6)
    kind = rng.random()
    if kind < 0.3:
        stone = Material(source.kind("masonry", "grain", "cells", "rust"), np.eye(3, 4), rng.uniform(0.4, 1.0), detail=source.kind("grain"), detail_scale=1.5, detail_strength=0.4)
        at.put(scene, box((0.25, height, length)).moved((0, -height / 2, length / 2)), stone)
        return
    material = paint(rng, np.full(3, rng.uniform(0.05, 0.9)), 0.2) if kind < 0.65 else Material(source.kind("wood"), np.eye(3, 4), 0.8)
    gap, thick = (rng.uniform(0.14, 0.3), 0.03) if kind < 0.65 else (rng.uniform(0.16, 0.25), 0.1)
    places = np.arange(0, length, gap)[:90]
    bars = [box((0.03, height, thick)).moved((0, -height / 2 - 0.05, z)) for z in places]
    reach = float(places[-1])
    bars += [box((0.04, 0.07, reach)).moved((0.03, -y, reach / 2)) for y in (0.25 * height, 0.9 * height)]
    at.put(scene, join(bars), material)
