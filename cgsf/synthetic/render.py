"""Samples of stereo video: scene -> views -> pictures and truth."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.synthetic.caster import Caster
from cgsf.synthetic.edges import picture_rays
from cgsf.synthetic.families import FAMILIES
from cgsf.synthetic.sampling import pack
from cgsf.synthetic.scene import Scene, Soup
from cgsf.synthetic.sensor import Sensor
from cgsf.synthetic.shading import ILLUMINATION, Surfaces, shade
from cgsf.synthetic.textures import TextureSource
from cgsf.synthetic.truth import View, follow, seen
from cgsf.threads import keep_freed_memory

_QUARTERS = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])


@dataclass(frozen=True)
class RenderConfig:
    """What may be asked of the renderer beside family, seed and size.

    Parameters
    ----------
    photos : str or Path, optional
        A folder of .jpg and .png pictures that become textures beside the procedural ones.
    photo_share : float
        How often a picture is taken where any texture will do, in [0, 1].
    gloss : float
        Factor on highlights and mirrors; 0 makes every surface look the same from everywhere.
    shadows : bool
        Cast shadows.
    antialias : bool
        Four rays a pixel at edges in place of one.
    sensor : bool
        Random camera: gains, vignetting, blur, noise, eight bits. Off: one ideal camera twice.
    shutter : float
        Motion blur: share of the frame interval that the shutter is open, in [0, 1). Truth stays that of the middle.
    shutter_steps : int
        Moments that are averaged when `shutter` > 0; time grows with it.
    """

    photos: str | Path | None = None
    photo_share: float = 0.5
    gloss: float = 1.0
    shadows: bool = True
    antialias: bool = True
    sensor: bool = True
    shutter: float = 0.0
    shutter_steps: int = 5

    def __post_init__(self) -> None:
        for name in ("photo_share", "gloss", "shutter", "shutter_steps"):
            if not isinstance(getattr(self, name), int | float):
                raise InputError(f"{name} must be a number, got {getattr(self, name)!r}")
        if not 0 <= self.shutter < 1:
            raise InputError(f"shutter must be in [0, 1), got {self.shutter}")
        if not 0 <= self.photo_share <= 1:
            raise InputError(f"photo_share must be in [0, 1], got {self.photo_share}")
        if self.shutter_steps < 2:
            raise InputError(f"shutter_steps must be at least 2, got {self.shutter_steps}")


class Renderer:
    """Pictures and views of one scene at any time.

    Parameters
    ----------
    scene : Scene
    height, width : int
        Image size in pixels.
    config : RenderConfig
    """

    def __init__(self, scene: Scene, height: int, width: int, config: RenderConfig) -> None:
        self.scene, self.height, self.width, self.config = scene, height, width, config
        camera = scene.camera
        self.intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], float)
        self.soup = Soup.of(scene)
        records, self.atlas = pack(self.soup.textures)
        clouds = records[:1].copy()  # the first texture is the sky's, which repeats mirrored whatever it is elsewhere
        clouds["mirrored"] = True
        self.textures = np.concatenate([records, clouds])
        self.offsets = _QUARTERS if config.antialias else _QUARTERS[:0]
        self.points, self.normals = np.empty_like(self.soup.points), np.empty_like(self.soup.normals)
        self.moving = self.soup.moving
        still = np.delete(np.arange(len(self.points)), self.moving)
        self.soup.at(0.0, still, self.points, self.normals)
        self.illumination, self.still = self._illumination(still)

    def stereo(self, time: float) -> tuple[View, View, np.ndarray, np.ndarray]:
        """Left and right view at `time` with their radiance, (H, W, 3) float32 each."""
        soup, points = self.soup, self.points
        soup.at(time, self.moving, points, self.normals)
        depth_map = self._shadows()
        surfaces = Surfaces(self.normals, soup.uv, soup.material, soup.materials, self.textures, self.atlas)
        pose = self.scene.path.pose(time)
        views, radiances = [], []
        for shift in (0.0, self.scene.camera.baseline_m):
            pose = pose.copy()
            pose[0, 3] -= shift
            caster = Caster(points, pose, soup.culled, self.intrinsics, self.height, self.width)
            inverse_depth, hit = caster.centres()
            rays = picture_rays(caster, inverse_depth, hit, soup.surface, self.offsets)
            radiance = np.zeros((self.height, self.width, 3), np.float32)
            shade(*surfaces, self.illumination, depth_map, caster.plane, caster.sight(), *rays, radiance)
            radiances.append(radiance)
            views.append(View(caster, inverse_depth, hit))
        return views[0], views[1], radiances[0], radiances[1]

    def exposed(self, time: float) -> tuple[View, View, np.ndarray, np.ndarray]:
        """As `stereo`, with the radiance averaged over the time that the shutter is open."""
        left, right, left_radiance, right_radiance = self.stereo(time)
        if self.config.shutter > 0:
            steps = self.config.shutter_steps
            left_radiance, right_radiance = left_radiance / steps, right_radiance / steps
            for offset in np.linspace(-0.5, 0.5, steps):
                if abs(offset) > 1e-9 or steps % 2 == 0:
                    _, _, more_left, more_right = self.stereo(time + self.config.shutter * offset)
                    left_radiance += more_left / steps
                    right_radiance += more_right / steps
            if steps % 2 == 0:  # the middle was an extra moment
                left_radiance *= steps / (steps + 1)
                right_radiance *= steps / (steps + 1)
        return left, right, left_radiance, right_radiance

    def _illumination(self, still: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The record of light and sky, and the inverse depth (S, S) in 1/m along the light's rays to what stands `still`."""
        light, sky = self.scene.light, self.scene.sky
        size = max(16, round(1.4 * float(np.sqrt(self.height * self.width))))
        forward = light.target - light.position
        distance = float(np.linalg.norm(forward))
        forward = forward / distance
        side = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
        side /= np.linalg.norm(side)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([side, np.cross(forward, side), forward])
        pose[:3, 3] = -pose[:3, :3] @ light.position
        record = np.zeros(1, ILLUMINATION)
        for name in ("position", "color", "above", "below", "falloff_m"):
            record[name] = getattr(light, name)
        for name in ("horizon", "zenith", "cloud_strength", "haze_per_m"):
            record[name] = getattr(sky, name)
        record["shadow_pose"], record["shadow_focal"] = pose, 0.5 * size * distance / light.radius
        record["shadow_bias_m"] = 2.0 * light.radius / size + 0.01
        record["gloss"] = self.config.gloss
        return record, self._towards_light(record, size, still) if self.config.shadows else np.zeros((size, size))

    def _towards_light(self, illumination: np.ndarray, size: int, which: np.ndarray) -> np.ndarray:
        """Inverse depth (S, S) in 1/m along the light's rays to the first of some triangles."""
        focal, middle = float(illumination["shadow_focal"][0]), 0.5 * (size - 1)
        intrinsics = np.array([focal, focal, middle, middle])
        pose, culled = illumination["shadow_pose"][0], self.soup.culled[which]
        return Caster(self.points[which], pose, culled, intrinsics, size, size).centres()[0]

    def _shadows(self) -> np.ndarray:
        """The shadow map (S, S) float32: depth in metres along the light's rays at present."""
        inverse_depth = self.still
        if self.config.shadows:
            inverse_depth = np.maximum(self.still, self._towards_light(self.illumination, len(self.still), self.moving))
        with np.errstate(divide="ignore"):
            return (1 / inverse_depth).astype(np.float32)


def truth_of(renderer: Renderer, left1: View, right1: View, left2: View, right2: View) -> Truth:
    """Exact truth of two stereo pairs; see `Truth`. Flow is NaN for points that lie behind the second camera."""
    scale = renderer.scene.camera.fx * renderer.scene.camera.baseline_m
    in_left2, inverse_depth2 = follow(left1, left2)
    in_right2, inverse_depth_right2 = follow(left1, right2)
    visible_flow = seen(left2, in_left2, inverse_depth2)
    height, width = left1.hit.shape
    flow = np.empty((height, width, 2), np.float32)
    np.subtract(in_left2[..., 0], np.arange(width), out=flow[..., 0], casting="same_kind")
    np.subtract(in_left2[..., 1], np.arange(height)[:, None], out=flow[..., 1], casting="same_kind")
    objects = renderer.soup.objects[left1.hit]
    objects[left1.hit < 0] = 0
    return Truth(
        disparity1=(scale * left1.inverse_depth).astype(np.float32),
        disparity2=(scale * inverse_depth2).astype(np.float32),
        flow=flow,
        disparity_left2=(scale * left2.inverse_depth).astype(np.float32),
        visible_stereo=seen(right1, *follow(left1, right1)),
        visible_flow=visible_flow,
        visible_change=visible_flow & seen(right2, in_right2, inverse_depth_right2),
        objects=objects,
    )


def make_scene(family: str, seed: int, height: int, width: int, config: RenderConfig | None = None) -> Scene:
    """The scene of a seed; its geometry depends on the size only by the camera's focal length and aspect.

    Raises
    ------
    InputError
        For an unknown family, a negative seed or an image smaller than 16 x 16.
    """
    config = config or RenderConfig()
    if family not in FAMILIES:
        raise InputError(f"unknown family {family!r}; known are {', '.join(sorted(FAMILIES))}")
    if seed < 0:
        raise InputError(f"seed must not be negative, got {seed}")
    if height < 16 or width < 16:
        raise InputError(f"images must be at least 16 x 16 pixels, got {height} x {width}")
    rng = np.random.default_rng([sorted(FAMILIES).index(family), seed])
    source = TextureSource(np.random.default_rng([sorted(FAMILIES).index(family), seed, 1]), config.photos, config.photo_share)
    return FAMILIES[family](rng, source, height, width)


def make_video(family: str, seed: int, height: int, width: int, frames: int, **options: Any) -> list[Sample]:
    """Stereo video with exact truth: ``frames - 1`` samples, each of two frames that follow each other.

    Parameters
    ----------
    family : str
        ``things`` or ``street``.
    seed : int
        Names the scene; the same seed, size and options give the same bytes everywhere.
    height, width : int
        Image size in pixels.
    frames : int
        Length of the video, at least 2.
    **options
        Fields of `RenderConfig`.

    Returns
    -------
    list of Sample
        The second pair of one sample is the first of the next.

    Raises
    ------
    InputError
        For arguments out of range and unknown options.
    """
    unknown = set(options) - {field.name for field in fields(RenderConfig)}
    if unknown:
        raise InputError(f"unknown option {sorted(unknown)[0]!r}; known are {', '.join(f.name for f in fields(RenderConfig))}")
    if frames < 2:
        raise InputError(f"a video has at least 2 frames, got {frames}")
    config = RenderConfig(**options)
    keep_freed_memory()
    scene = make_scene(family, seed, height, width, config)
    rng = np.random.default_rng([sorted(FAMILIES).index(family), seed, 2])
    sensor = Sensor.random(rng, frames) if config.sensor else Sensor()
    renderer = Renderer(scene, height, width, config)
    calibration = Calibration.from_camera(scene.camera)
    samples: list[Sample] = []
    scale = 0.0
    before: tuple[View, View, tuple[np.ndarray, np.ndarray]] | None = None
    for frame in range(frames):
        left, right, left_radiance, right_radiance = renderer.exposed(float(frame))
        scale = scale or sensor.scale(left_radiance)
        images = [
            sensor.develop(radiance, scale, side, frame, rng) for side, radiance in enumerate((left_radiance, right_radiance))
        ]
        if before is not None:
            truth = truth_of(renderer, before[0], before[1], left, right)
            name = f"{family}-{seed:06d}" + (f"/{frame - 1:03d}" if frames > 2 else "")
            samples.append(Sample(name, *before[2], images[0], images[1], calibration, truth))
        before = (left, right, (images[0], images[1]))
    return samples


def make_sample(family: str, seed: int, height: int, width: int, **options: Any) -> Sample:
    """One sample, two stereo pairs with exact truth: `make_video` of two frames."""
    return make_video(family, seed, height, width, 2, **options)[0]
