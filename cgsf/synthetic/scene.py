"""A scene: meshes with materials and rigid motions, lights, a sky and a camera that moves.

World coordinates are those of the left camera's frame at time 0 up to the camera's own pose: metres, x right, y down,
z forward. Time is counted in frames. Everything moves rigidly: a world point x of a part at time 0 is at
``pivot + velocity t + R(spin t) (x - pivot)`` at time t.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from cgsf.synthetic.meshes import Mesh
from cgsf.synthetic.textures import Texture
from variational.camera import StereoCamera
from variational.jit import rowwise

MATERIAL = np.dtype(
    [
        ("texture", np.int32),  # index into the scene's textures
        ("detail", np.int32),  # index of the fine texture that is multiplied in
        ("color", np.float32, (3, 4)),  # BGR of the surface = color @ (texture's BGR, 1)
        ("uv", np.float32, (2, 3)),  # texture repeats = uv @ (surface metres, 1)
        ("detail_scale", np.float32),  # repeats of the fine texture per metre
        ("detail_strength", np.float32),
        ("specular", np.float32),  # strength of the highlight
        ("shininess", np.float32),  # its exponent
        ("mirror", np.float32),  # share of the reflected surroundings at grazing angles
        ("glow", np.float32),  # light of its own
    ],
    align=True,
)


@dataclass(frozen=True)
class Material:
    """How a surface looks.

    Parameters
    ----------
    texture : Texture
    color : ndarray (3, 4)
        Affine colour change: BGR of the surface = ``color @ (b, g, r, 1)``, texture values in [0, 1].
    scale : float
        Texture repeats per metre.
    turn : float
        Angle of the texture on the surface, radians.
    offset : tuple of two floats
        Shift of the texture in repeats.
    detail : Texture or None
        Fine texture multiplied in, so that a surface near the eye is not a blur.
    detail_scale, detail_strength : float
        Repeats per metre; relative amplitude.
    specular, shininess : float
        Strength and exponent of the highlight, which moves with the eye.
    mirror : float
        Share of the reflected surroundings at grazing angles.
    glow : float
        Share of light of its own: lamps, signs.
    """

    texture: Texture
    color: np.ndarray = field(default_factory=lambda: np.eye(3, 4))
    scale: float = 1.0
    turn: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    detail: Texture | None = None
    detail_scale: float = 4.0
    detail_strength: float = 0.0
    specular: float = 0.0
    shininess: float = 20.0
    mirror: float = 0.0
    glow: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Rigid motion at a constant rate: `velocity` (3,) m/frame, `spin` (3,) rad/frame about `pivot` (3,) m."""

    pivot: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    @staticmethod
    def poses(motions: Sequence["Motion"], time: float) -> np.ndarray:
        """(K, 4, 4) matrices from world points at time 0 to the same points at `time`."""
        matrices = np.tile(np.eye(4), (len(motions), 1, 1))
        if len(motions):
            spins = np.array([motion.spin for motion in motions], float)
            matrices[:, :3, :3] = Rotation.from_rotvec(spins * time).as_matrix()
        for matrix, motion in zip(matrices, motions, strict=True):
            matrix[:3, 3] = motion.pivot + np.asarray(motion.velocity, float) * time - matrix[:3, :3] @ motion.pivot
        return matrices


@dataclass(frozen=True)
class CameraPath:
    """The left camera over time: it drives along its own z axis and turns.

    Parameters
    ----------
    position : ndarray (3,) m, at time 0
    rotation : ndarray (3,)
        Rotation vector from camera to world axes at time 0, radians.
    velocity : ndarray (3,) m/frame
        In the camera's own axes.
    spin : ndarray (3,) rad/frame
        In the camera's own axes.
    """

    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    def pose(self, time: float) -> np.ndarray:
        """(4, 4) matrix from world to camera coordinates at `time`; the velocity turns with the camera."""
        start = Rotation.from_rotvec(self.rotation)
        steps = max(1, round(8 * abs(time)))
        middle = (np.arange(steps) + 0.5) * time / steps
        heading = start * Rotation.from_rotvec(np.outer(middle, self.spin))
        position = self.position + heading.apply(self.velocity).sum(0) * time / steps
        turn = (start * Rotation.from_rotvec(np.asarray(self.spin) * time)).as_matrix().T
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, -turn @ position
        return matrix


@dataclass(frozen=True)
class Light:
    """The light that casts shadows, at `position` (3,) m looking at `target` (3,) m, and the light from all around.

    Parameters
    ----------
    position, target : ndarray (3,) m
    radius : float
        Radius in metres about `target` inside which shadows are cast.
    color : ndarray (3,)
        BGR radiance of the light.
    falloff_m : float
        Distance in metres at which the light has fallen to half; infinity for the sun.
    above, below : ndarray (3,)
        BGR light that comes from all around, on surfaces that face up and down.
    """

    position: np.ndarray
    target: np.ndarray
    radius: float
    color: np.ndarray
    falloff_m: float
    above: np.ndarray
    below: np.ndarray


@dataclass(frozen=True)
class Sky:
    """What rays meet that meet nothing, and what mirrors show.

    Parameters
    ----------
    horizon, zenith : ndarray (3,)
        BGR radiance.
    clouds : Texture
    cloud_strength : float
    haze_per_m : float
        Share of the horizon's colour mixed in per metre of distance.
    """

    horizon: np.ndarray
    zenith: np.ndarray
    clouds: Texture
    cloud_strength: float
    haze_per_m: float = 0.0


_HERE = np.eye(4)


@dataclass(frozen=True)
class Part:
    """One mesh with its material, its place in the world at time 0 (4, 4) and its motion.

    `object_id` 0 stands still; the parts of one object share an id.
    """

    mesh: Mesh
    material: Material
    place: np.ndarray
    motion: Motion | None = None
    object_id: int = 0


@dataclass
class Scene:
    """Parts, light, sky and camera; grows by `add`, then is only read.

    Parameters
    ----------
    camera : StereoCamera
        Pixels of the image that is asked for.
    path : CameraPath
    light : Light
    sky : Sky
    parts : list of Part
    """

    camera: StereoCamera
    path: CameraPath
    light: Light
    sky: Sky
    parts: list[Part] = field(default_factory=list)

    def add(
        self,
        mesh: Mesh,
        material: Material,
        motion: Motion | None = None,
        object_id: int = 0,
        place: np.ndarray = _HERE,
    ) -> None:
        """Put a mesh into the scene; `place` (4, 4) takes its coordinates to the world's at time 0."""
        self.parts.append(Part(mesh, material, place, motion, object_id))


@dataclass(frozen=True)
class Soup:
    """All triangles of a scene in single arrays, as the kernels read them.

    Parameters
    ----------
    points, normals : ndarray (N, 3, 3) float64
        In each part's own coordinates.
    uv : ndarray (N, 3, 2) float64
    surface : ndarray (N,) int64
        Smooth surface that the triangle belongs to, unique over the scene.
    part, material : ndarray (N,) int64
    culled : ndarray (N,) bool
    objects : ndarray (N,) int32
    materials : ndarray of MATERIAL
    textures : list of Texture
    places : ndarray (P, 4, 4)
        Of every part: from its own coordinates to the world's at time 0.
    motions : list of Motion
    motion : ndarray (P,) int64
        Number of every part's motion; -1 for what stands still.
    """

    points: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    surface: np.ndarray
    part: np.ndarray
    material: np.ndarray
    culled: np.ndarray
    objects: np.ndarray
    materials: np.ndarray
    textures: list[Texture]
    places: np.ndarray
    motions: list[Motion]
    motion: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> "Soup":
        """The scene's parts, joined."""
        parts = scene.parts
        counts = [len(part.mesh.points) for part in parts]
        of_part = np.repeat(np.arange(len(parts)), counts)
        offsets = np.cumsum([0, *(part.mesh.surfaces for part in parts[:-1])])[of_part]
        unique = {id(part.material): part.material for part in parts}
        place = {key: index for index, key in enumerate(unique)}
        motions = {id(part.motion): part.motion for part in parts if part.motion is not None}
        number = {key: index for index, key in enumerate(motions)}
        textures: dict[int, Texture] = {id(scene.sky.clouds): scene.sky.clouds}
        for material in unique.values():
            for texture in (material.texture, material.detail):
                if texture is not None:
                    textures.setdefault(id(texture), texture)
        slot = {key: index for index, key in enumerate(textures)}
        materials = list(unique.values())
        records = np.zeros(len(materials), MATERIAL)
        records["texture"] = [slot[id(material.texture)] for material in materials]
        records["detail"] = [slot[id(material.detail or material.texture)] for material in materials]
        records["color"] = np.concatenate([material.color for material in materials]).reshape(-1, 3, 4)
        turn, scale = np.array([(material.turn, material.scale) for material in materials]).T
        records["uv"][:, 0, 0] = records["uv"][:, 1, 1] = np.cos(turn) * scale
        records["uv"][:, 1, 0] = np.sin(turn) * scale
        records["uv"][:, 0, 1] = -records["uv"][:, 1, 0]
        records["uv"][:, :, 2] = [material.offset for material in materials]
        records["detail_strength"] = [material.detail_strength if material.detail is not None else 0.0 for material in materials]
        for name in ("detail_scale", "specular", "shininess", "mirror", "glow"):
            records[name] = [getattr(material, name) for material in materials]
        return cls(
            np.concatenate([part.mesh.points for part in parts]),
            np.concatenate([part.mesh.normals for part in parts]),
            np.concatenate([part.mesh.uv for part in parts]),
            np.concatenate([part.mesh.surface for part in parts]) + offsets,
            of_part,
            np.array([place[id(part.material)] for part in parts])[of_part],
            np.array([part.mesh.closed for part in parts])[of_part],
            np.array([part.object_id for part in parts], np.int32)[of_part],
            records,
            list(textures.values()),
            np.concatenate([part.place for part in parts]).reshape(-1, 4, 4),
            list(motions.values()),
            np.array([number.get(id(part.motion), -1) for part in parts]),
        )

    @property
    def moving(self) -> np.ndarray:
        """Numbers of the triangles that are not always at the same place, (M,) int64."""
        return np.flatnonzero((self.motion >= 0)[self.part])

    def at(self, time: float, which: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
        """Write the corners and normals of the triangles `which` (M,) at `time` in world coordinates, (N, 3, 3) each."""
        moves = self.motion >= 0
        places = self.places.copy()
        places[moves] = Motion.poses(self.motions, time)[self.motion[moves]] @ places[moves]
        _place(which, self.points, self.normals, self.part, places, points, normals)


@rowwise
def _place(
    which: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    part: np.ndarray,
    places: np.ndarray,
    points_out: np.ndarray,
    normals_out: np.ndarray,
) -> None:
    """Rigidly move some triangles by their parts' matrices."""
    for k in range(which.size):
        n = which[k]
        m = places[part[n]]
        for c in range(3):
            for i in range(3):
                points_out[n, c, i] = m[i, 0] * points[n, c, 0] + m[i, 1] * points[n, c, 1] + m[i, 2] * points[n, c, 2] + m[i, 3]
                normals_out[n, c, i] = m[i, 0] * normals[n, c, 0] + m[i, 1] * normals[n, c, 1] + m[i, 2] * normals[n, c, 2]
