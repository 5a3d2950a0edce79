"""The family `street`: a car drives through a street, as in KITTI.

The road runs along +z at y = 0; the camera is `camera height` above it and looks along the road, more or less. Beside
it come pavements or verges, parked cars, furniture, trees, and house fronts; vehicles and people move on their own.
"""

from collections.abc import Iterator

import numpy as np

from cgsf.synthetic import props
from cgsf.synthetic.materials import Wardrobe, paint, tinted, upright
from cgsf.synthetic.meshes import box, boxes, hull, join, polygon
from cgsf.synthetic.patterns import color
from cgsf.synthetic.props import Placement
from cgsf.synthetic.scene import CameraPath, Light, Material, Scene, Sky
from cgsf.synthetic.textures import TextureSource
from variational.camera import StereoCamera

_FAR_M = 180.0


def street(rng: np.random.Generator, source: TextureSource, height: int, width: int) -> Scene:
    """A scene of the family `street`; see the module."""
    focal = 0.58 * width * rng.uniform(0.94, 1.06)
    camera = StereoCamera(focal, focal, 0.491 * width - 0.5, 0.461 * height - 0.5, rng.uniform(0.50, 0.58))
    half_road = rng.uniform(2.8, 6.5)
    lane = rng.uniform(0.2, 0.75) * half_road
    eye = np.array([lane if rng.random() < 0.85 else -lane, -rng.uniform(1.45, 1.85), 0.0])
    turning = rng.random() < 0.3
    speed = float(
        rng.choice([0.0, rng.uniform(0.05, 0.4), rng.uniform(0.3, 1.1), rng.uniform(0.9, 1.7)], p=[0.08, 0.25, 0.5, 0.17])
    )
    yaw_rate = rng.normal(0, 0.025) if turning else rng.normal(0, 0.004)
    heading = rng.normal(0, 0.25) if turning else rng.normal(0, 0.05)
    path = CameraPath(
        eye, np.array([rng.normal(0, 0.012), heading, rng.normal(0, 0.01)]),
        np.array([0.0, rng.normal(0, 0.006), speed]),
        np.array([rng.normal(0, 0.0025), yaw_rate, rng.normal(0, 0.0015)]),
    )  # fmt: skip
    scene = Scene(camera, path, *_daylight(rng, source))

    pavement = rng.uniform(1.2, 4.0)
    urban = rng.random() < 0.72
    _ground(scene, rng, source, half_road, pavement, urban)
    fronts = half_road + pavement + (rng.uniform(0, 3) if urban else rng.uniform(3, 10))
    wardrobe = Wardrobe(source)
    for side in (-1, 1):
        if urban or rng.random() < 0.25:
            _houses(scene, rng, source, side, fronts)
        else:
            _green(scene, rng, source, side, fronts, wardrobe)
        _roadside(scene, rng, side, half_road, pavement, wardrobe, urban)
    _horizon(scene, rng, source)
    ids = iter(range(1, 1000))
    _traffic(scene, rng, wardrobe, eye[0], ids)
    _people(scene, rng, wardrobe, half_road, pavement, ids)
    return scene


def _daylight(rng: np.random.Generator, source: TextureSource) -> tuple[Light, Sky]:
    overcast = rng.random() < 0.35
    azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.2)
    direction = np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    target = np.array([0.0, 0.0, 20.0])
    warm = rng.uniform(1.0, 1.2)
    sun = np.array([1 / warm, 1.0, warm]) * (rng.uniform(0.05, 0.4) if overcast else rng.uniform(1.2, 2.6))
    blue = np.array([rng.uniform(1.0, 1.35), 1.0, rng.uniform(0.75, 1.0)])
    ambient = rng.uniform(0.7, 1.1) if overcast else rng.uniform(0.18, 0.5)
    if overcast:
        horizon, zenith = np.full(3, rng.uniform(0.8, 1.5)), np.full(3, rng.uniform(0.6, 1.2))
    else:
        horizon, zenith = blue * rng.uniform(0.8, 1.6), blue**2 * rng.uniform(0.3, 1.0)
    light = Light(
        target + 300 * direction, target, 34.0, sun, np.inf, blue * ambient, np.full(3, ambient * rng.uniform(0.3, 0.6))
    )
    clouds = source.kind("clouds") if rng.random() < 0.8 else source.kind("marble")
    haze = float(np.exp(rng.uniform(np.log(3e-4), np.log(6e-3))))
    return light, Sky(horizon, zenith, clouds, rng.uniform(0.0, 0.8), haze)


def _flat(x0: float, x1: float, z0: float, z1: float, y: float = 0.0) -> np.ndarray:
    return np.array([(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)])


def _ground(
    scene: Scene, rng: np.random.Generator, source: TextureSource, half_road: float, pavement: float, urban: bool
) -> None:
    """Road with its marks, repairs and covers, kerbs, pavements or verges, and what lies behind."""
    asphalt = Material(
        source.kind("grain"),
        tinted(np.full(3, rng.uniform(0.25, 0.65)) * rng.uniform(0.95, 1.05, 3), rng.uniform(0.3, 0.9)),
        scale=1 / rng.uniform(3, 9),
        turn=rng.uniform(0, 6),
        detail=source.kind("grain"),
        detail_scale=rng.uniform(0.8, 2.0),
        detail_strength=rng.uniform(0.2, 0.7),
        specular=float(rng.choice([0.0, 0.15])),
        shininess=10.0,
    )
    if urban and rng.random() < 0.12:
        asphalt = upright(source, rng.uniform(1.0, 2.5), "cells", "masonry")
    near = -12.0
    scene.add(polygon(_flat(-half_road, half_road, near, _FAR_M)), asphalt)
    walk = (
        upright(source, rng.uniform(0.8, 2.5), "masonry", "cells", "grain")
        if urban
        else upright(source, rng.uniform(1.5, 3.0), "foliage", recolor=False)
    )
    behind = upright(source, rng.uniform(1.5, 4.0), *(("grain", "masonry", "foliage") if urban else ("foliage",)), recolor=urban)
    stone, step = paint(rng, np.full(3, rng.uniform(0.35, 0.75))), rng.uniform(0.06, 0.16) if urban else 0.02
    for side in (-1, 1):
        inner, outer = side * (half_road + 0.15), side * (half_road + pavement)
        scene.add(polygon(_flat(inner, outer, near, _FAR_M, -step)), walk)
        scene.add(box((0.15, 2 * step, _FAR_M - near)).moved((side * (half_road + 0.075), 0, (_FAR_M + near) / 2)), stone)
        scene.add(polygon(_flat(outer, side * 90, near, _FAR_M, -step)), behind)
    white = paint(rng, np.full(3, rng.uniform(0.6, 0.95)))
    if rng.random() < 0.7:
        dash, gap = (rng.uniform(1.5, 6), rng.uniform(2, 8)) if rng.random() < 0.75 else (_FAR_M, 1.0)
        dashes = [polygon(_flat(-0.07, 0.07, z, min(z + dash, _FAR_M), -0.004)) for z in np.arange(near, 90, dash + gap)[:24]]
        scene.add(join(dashes), white)
    if rng.random() < 0.4:
        for side in (-1, 1):
            x = side * (half_road - 0.3)
            scene.add(polygon(_flat(x - 0.06, x + 0.06, near, _FAR_M, -0.004)), white)
    if rng.random() < 0.3:
        z = rng.uniform(6, 30)
        bars = [polygon(_flat(x, x + 0.5, z, z + 3, -0.004)) for x in np.arange(-half_road + 0.4, half_road - 0.5, 1.0)]
        scene.add(join(bars), white)
    for _ in range(int(rng.integers(0, 8))):  # repairs and covers
        x, z, w, depth = (
            rng.uniform(-half_road, half_road - 1),
            rng.uniform(3, 30),
            rng.uniform(0.4, 2.5),
            rng.uniform(0.5, 6),
        )
        shade = tinted(np.full(3, rng.uniform(0.15, 0.6)), 0.6)
        patch = Material(
            source.kind("grain", "cells", "checks", "rust"),
            shade,
            rng.uniform(0.3, 1.5),
            detail=asphalt.detail,
            detail_scale=1.5,
            detail_strength=0.4,
        )
        scene.add(polygon(_flat(x, min(x + w, half_road), z, z + depth, -0.003)), patch)


def _houses(scene: Scene, rng: np.random.Generator, source: TextureSource, side: int, front: float) -> None:
    """A row of houses with bays, balconies, cornices, roofs, signs, and gaps between them."""
    z = rng.uniform(-14, -4)
    terrace = rng.random() < 0.5
    while z < 110:
        length, floors, storey = rng.uniform(7, 22), int(rng.integers(1, 6)), rng.uniform(2.7, 3.6)
        tall, depth, back = (
            floors * storey + rng.uniform(0.2, 1.5),
            rng.uniform(6, 12),
            rng.uniform(0, 2.5) * (not terrace),
        )
        x = side * (front + back)
        facade = Material(
            source.any("facade") if rng.random() < 0.5 else source.kind("facade"),
            np.eye(3, 4) * rng.uniform(0.6, 1.15, (3, 1)) ** 0.5,
            scale=1 / (storey * rng.integers(1, 4)),
            offset=(rng.random(), 0.0),
            detail=source.kind("grain", "masonry", "clouds"),
            detail_scale=1 / rng.uniform(0.5, 2),
            detail_strength=rng.uniform(0, 0.5),
        )
        wall = upright(source, rng.uniform(2, 5), "masonry", "grain", "rust", "plain")
        scene.add(
            box((depth, tall, length)).moved((x + side * depth / 2, -tall / 2, z + length / 2)),
            facade if rng.random() < 0.8 else wall,
        )
        trim = paint(rng, color(rng, 0.2))
        if rng.random() < 0.6:
            _windows(scene, rng, side, x, (z, length, floors, storey), trim)
        if rng.random() < 0.6:
            for floor in range(1, floors + 1):
                scene.add(box((0.3, 0.18, length)).moved((x, -floor * storey, z + length / 2)), trim)
        if rng.random() < 0.5:
            ridge = rng.uniform(1.5, 4)
            corners = [
                (x - side * 0.4, -tall, z),
                (x - side * 0.4, -tall, z + length),
                (x + side * depth, -tall, z),
                (x + side * depth, -tall, z + length),
            ]
            corners += [
                (x + side * depth / 2, -tall - ridge, z + 0.3),
                (x + side * depth / 2, -tall - ridge, z + length - 0.3),
            ]
            scene.add(hull(np.array(corners)), upright(source, 2.0, "masonry", "stripes", "cells"))
        if rng.random() < 0.35:  # shop sign or awning
            w = rng.uniform(1.5, 5)
            board = Material(
                source.any("text", "stripes"),
                np.eye(3, 4),
                1 / rng.uniform(1, 3),
                0.0,
                tuple(rng.random(2)),
                glow=rng.choice([0, 0.3]),
            )
            scene.add(
                box((rng.uniform(0.1, 1.2), rng.uniform(0.4, 1.0), w)).moved(
                    (x - side * 0.3, -rng.uniform(2.4, 3.2), z + length * rng.uniform(0.3, 0.7))
                ),
                board,
            )
        z += length + (0.0 if terrace and rng.random() < 0.8 else rng.uniform(1, 9))


def _windows(
    scene: Scene, rng: np.random.Generator, side: int, x: float, house: tuple[float, float, int, float], trim: Material
) -> None:
    """Windows and balconies on a wall; `house` is its z, length, floors and height of a floor."""
    z, length, floors, storey = house
    bay = rng.uniform(1.2, 3.5)
    glass = paint(rng, np.full(3, rng.uniform(0.03, 0.2)), 0.5, rng.uniform(0.3, 1.0))
    wide, tall = bay * rng.uniform(0.4, 0.7), storey * rng.uniform(0.4, 0.6)
    columns, rows = np.arange(z + bay / 2, z + length - bay / 2, bay)[:8], -(np.arange(min(floors, 4)) + 0.55) * storey
    middles = np.array([(x, y, column) for y in rows for column in columns])
    if len(middles) == 0:
        return
    scene.add(boxes((0.16, tall + 0.2, wide + 0.2), middles), trim)
    scene.add(boxes((0.2, tall, wide), middles), glass)
    if rng.random() < 0.3 and len(rows) > 1:
        upper = middles[len(columns) :]
        scene.add(boxes((1.0, 0.15, wide + 0.6), upper + (-side * 0.5, tall / 2 + 0.2, 0)), trim)
        scene.add(boxes((0.06, 0.9, wide + 0.6), upper + (-side * 0.95, tall / 2 - 0.25, 0)), trim)


def _green(scene: Scene, rng: np.random.Generator, source: TextureSource, side: int, front: float, wardrobe: Wardrobe) -> None:
    """Trees, hedges and banks in place of houses."""
    for z in np.arange(rng.uniform(2, 8), 80, rng.uniform(6, 14))[:9]:
        foot = (side * (front + rng.uniform(0, 8)), 0.0, z + rng.normal(0, 1.5))
        Placement(foot, rng.uniform(0, 6)).put(scene, props.tree(rng), wardrobe.roadside())
    bank = rng.uniform(0, 4)
    if bank > 1:
        near, far = side * (front + 6), side * (front + 18)
        corners = np.array([(near, 0.2, -10), (near, 0.2, 150), (far, -bank, 150), (far, -bank, -10)])
        scene.add(polygon(corners), upright(source, 3.0, "foliage", recolor=False))


def _roadside(
    scene: Scene,
    rng: np.random.Generator,
    side: int,
    half_road: float,
    pavement: float,
    wardrobe: Wardrobe,
    urban: bool,
) -> None:
    """Parked cars, trees, poles, signs, fences, bins along one side."""
    if rng.random() < (0.65 if urban else 0.2):
        z, x = rng.uniform(3, 9), side * (half_road - rng.uniform(0.7, 1.0))
        while z < 70:
            if rng.random() < 0.75:
                yaw = (0.0 if side > 0 else np.pi) + rng.normal(0, 0.03)
                prop = props.car(rng) if rng.random() < 0.93 else props.truck(rng)
                Placement((x, 0.0, z), yaw).put(scene, prop, wardrobe.vehicle())
            z += rng.uniform(5.0, 8.0) if z < 40 else rng.uniform(8, 14)
    middle = side * (half_road + rng.uniform(0.4, 0.8))
    if rng.random() < 0.45:
        for z in np.arange(rng.uniform(4, 12), 60, rng.uniform(8, 16))[:6]:
            Placement((middle, 0.0, z), rng.uniform(0, 6)).put(scene, props.tree(rng), wardrobe.roadside())
    for shape, chance, spacing in (
        (props.lamp_post, 0.7, 22.0),
        (props.sign, 0.7, 14.0),
        (props.small, 0.6, 8.0),
        (props.bush, 0.4, 7.0),
    ):
        if rng.random() < chance:
            for z in np.arange(rng.uniform(2, spacing), 55, spacing * rng.uniform(0.6, 1.4))[:7]:
                x = middle + side * rng.uniform(0, max(pavement - 0.8, 0.1)) * (shape is not props.lamp_post)
                yaw = side * np.pi / -2 if shape is props.lamp_post else rng.normal(0, 0.2)
                Placement((x, -0.05, z), yaw).put(scene, shape(rng), wardrobe.roadside())
    if rng.random() < 0.4:
        foot = (side * (half_road + pavement), -0.05, rng.uniform(2, 15))
        Placement(foot).put(scene, props.fence(rng), wardrobe.roadside())


def _horizon(scene: Scene, rng: np.random.Generator, source: TextureSource) -> None:
    """What closes the view: hills, a wood or blocks far away."""
    for _ in range(int(rng.integers(2, 9))):
        z, x, w, tall = rng.uniform(0.7, 1.0) * _FAR_M, rng.uniform(-90, 90), rng.uniform(10, 50), rng.uniform(3, 16)
        material = upright(source, rng.uniform(6, 14), "facade", "foliage", "clouds", "masonry")
        if rng.random() < 0.5:
            scene.add(box((w, tall, 8)).moved((x, -tall / 2, z)), material)
        else:
            scene.add(
                hull(
                    np.array(
                        [
                            (x - w, 1, z),
                            (x + w, 1, z),
                            (x, 1, z + 20),
                            (x - 0.4 * w, -tall, z + 8),
                            (x + 0.3 * w, -tall * 0.8, z + 8),
                        ]
                    )
                ),
                material,
            )


def _traffic(scene: Scene, rng: np.random.Generator, wardrobe: Wardrobe, lane: float, ids: Iterator[int]) -> None:
    """Vehicles ahead, oncoming and crossing, each with its own speed."""

    def add(x: float, z: float, yaw: float, speed: float) -> None:
        shape = (props.car, props.truck, props.cyclist)[int(rng.choice(3, p=[0.8, 0.11, 0.09]))]
        rate = rng.normal(0, 0.02) if rng.random() < 0.25 else 0.0
        Placement((x, 0.0, z), yaw, speed, rate, next(ids)).put(scene, shape(rng), wardrobe.vehicle())

    z = rng.uniform(7, 25)
    while z < 60 and rng.random() < 0.75:  # ahead
        add(lane + rng.normal(0, 0.2), z, rng.normal(0, 0.03), rng.uniform(0.1, 1.5))
        z += rng.uniform(9, 30)
    z = rng.uniform(8, 40)
    while z < 80 and rng.random() < 0.7:  # oncoming
        add(-lane + rng.normal(0, 0.2), z, np.pi + rng.normal(0, 0.03), rng.uniform(0.2, 1.5))
        z += rng.uniform(8, 30)
    if rng.random() < 0.35:  # crossing
        way = int(rng.choice([-1, 1]))
        add(-way * rng.uniform(-3, 6), rng.uniform(9, 30), way * (np.pi / 2 + rng.normal(0, 0.2)), rng.uniform(0.2, 1.0))


def _people(
    scene: Scene, rng: np.random.Generator, wardrobe: Wardrobe, half_road: float, pavement: float, ids: Iterator[int]
) -> None:
    """Walkers on the pavements and across the road."""
    for _ in range(int(rng.integers(0, 7))):
        crossing = rng.random() < 0.25
        beside = int(rng.choice([-1, 1])) * (half_road + rng.uniform(0.4, pavement))
        x = rng.uniform(-half_road, half_road) if crossing else beside
        yaw = int(rng.choice([-1, 1])) * np.pi / 2 if crossing else float(rng.choice([0, np.pi])) + rng.normal(0, 0.2)
        speed = rng.uniform(0.05, 0.2) if rng.random() < 0.8 else 0.0
        foot = (x, 0.0 if crossing else -0.08, rng.uniform(5, 35))
        Placement(foot, yaw, speed, 0.0, next(ids) if speed else 0).put(scene, props.person(rng), wardrobe.clothes())
