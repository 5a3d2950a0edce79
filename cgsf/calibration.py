"""Calibration: from files to a camera, and from pixels to metres.

Accepted sources

* KITTI raw / 2015 ``calib_cam_to_cam/000003.txt``: the rectified colour cameras ``P_rect_02`` and ``P_rect_03``;
* KITTI 2012 ``calib/000027.txt``: the grey cameras ``P0`` and ``P1`` (or, with ``color=True``, ``P2`` and ``P3``);
* JSON with ``fx fy cx cy`` in pixels and ``baseline`` (or ``baseline_m``) in metres;
* plain numbers: ``Calibration(fx, fy, cx, cy, baseline_m)``.

Points are in metres in the left camera of time 1 (or 2): x right, y down, z forward.
"""

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from variational.camera import StereoCamera

_LARGEST_FILE = 1 << 20  # a calibration is a page of text; anything larger is another file


@dataclass(frozen=True)
class Calibration(StereoCamera):
    """A rectified stereo camera that comes from a file and knows metres; the fields are those of `StereoCamera`."""

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "baseline_m"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
                raise InputError(f"calibration: {name} must be a number, got {value!r}")
        try:
            super().__post_init__()
        except ValueError as error:
            raise InputError(str(error).replace("StereoCamera.", "calibration: ")) from None

    @classmethod
    def from_camera(cls, camera: StereoCamera) -> "Calibration":
        """The same camera, with metres."""
        return cls(camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m)

    def camera(self) -> StereoCamera:
        """The plain camera that the classical side works with."""
        return StereoCamera(self.fx, self.fy, self.cx, self.cy, self.baseline_m)

    @classmethod
    def read(cls, path: str | Path, *, color: bool = False) -> "Calibration":
        """Calibration from a JSON or KITTI file; the kind is told by the content.

        Parameters
        ----------
        path : str or Path
        color : bool
            For KITTI files with ``P0 ... P3``: take the colour cameras in place of the grey ones.

        Raises
        ------
        InputError
            If the file is missing, is none of the kinds, or its numbers make no camera.
        """
        path = Path(path)
        try:
            if path.stat().st_size > _LARGEST_FILE:
                raise InputError(f"{path}: too large for a calibration file")
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise InputError(f"{path}: no such calibration file") from None
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read as a calibration file ({type(error).__name__})") from None
        try:
            return cls._from_json(text) if text.lstrip().startswith("{") else cls._from_kitti(text, color)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def _from_json(cls, text: str) -> "Calibration":
        try:
            values = json.loads(text)
        except (json.JSONDecodeError, RecursionError):
            raise InputError("broken JSON") from None
        if "baseline" in values and "baseline_m" not in values:
            values["baseline_m"] = values["baseline"]
        missing = [name for name in ("fx", "fy", "cx", "cy", "baseline_m") if name not in values]
        if missing:
            names = ", ".join(missing)
            raise InputError(f"calibration lacks {names}; needed are fx fy cx cy (pixels) and baseline (metres)")
        return cls(*(values[name] for name in ("fx", "fy", "cx", "cy", "baseline_m")))

    @classmethod
    def _from_kitti(cls, text: str, color: bool) -> "Calibration":
        rows = dict(re.findall(r"^(P\d|P_rect_\d\d)[: ]\s*(.+)$", text, re.MULTILINE))
        pairs = [("P_rect_02", "P_rect_03"), ("P2", "P3") if color else ("P0", "P1"), ("P2", "P3")]
        found = next((pair for pair in pairs if pair[0] in rows and pair[1] in rows), None)
        if found is None:
            raise InputError("no calibration found; give KITTI projection matrices or JSON with fx fy cx cy baseline")
        try:
            left, right = (np.array(rows[name].split(), np.float64).reshape(3, 4) for name in found)
        except ValueError:
            raise InputError(f"{found[0]} and {found[1]} must be twelve numbers each") from None
        with np.errstate(divide="ignore", invalid="ignore"):
            baseline_m = (left[0, 3] - right[0, 3]) / left[0, 0]
        return cls(*(float(value) for value in (left[0, 0], left[1, 1], left[0, 2], left[1, 2], baseline_m)))

    def to_dict(self) -> dict[str, float]:
        """Plain numbers by name, as the JSON files have them (``baseline_m`` in metres)."""
        return {name: float(value) for name, value in asdict(self).items()}

    def depth(self, disparity: np.ndarray) -> np.ndarray:
        """Depth Z in metres of disparities in pixels, same shape, float32; NaN where a disparity is not above zero."""
        disparity = np.asarray(disparity, np.float32)
        depth = np.full(disparity.shape, np.nan, np.float32)
        return np.divide(self.fx * self.baseline_m, disparity, out=depth, where=disparity > 0)

    def points(self, disparity: np.ndarray, flow: np.ndarray | None = None) -> np.ndarray:
        """3D points in metres, (H, W, 3) float32 (X right, Y down, Z forward); NaN where a disparity is not above zero.

        Parameters
        ----------
        disparity : ndarray (H, W)
            Disparity in pixels of the point that pixel (x, y) stands for.
        flow : ndarray (H, W, 2), optional
            Where the point is seen in pixels relative to (x, y); zero if left out.
        """
        depth = self.depth(disparity)
        pixels = np.moveaxis(np.indices(depth.shape, np.float32)[::-1], 0, -1)  # (H, W, 2): x, y
        if flow is not None:
            pixels = pixels + flow
        sideways = (pixels - (self.cx, self.cy)) * depth[..., None] / (self.fx, self.fy)
        return np.concatenate([sideways, depth[..., None]], -1).astype(np.float32)

    def motion(self, disparity1: np.ndarray, disparity_change: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """3D scene flow in metres per frame, (H, W, 3) float32: the point at time 2 minus the point at time 1.

        Both points are in the coordinates of their own frame's left camera, so a standing world seen by a moving
        camera moves. NaN where either disparity is not above zero.
        """
        return self.points(disparity1 + disparity_change, flow) - self.points(disparity1)
