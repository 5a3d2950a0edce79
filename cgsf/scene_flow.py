"""The result: named maps on left1's grid, masks, and what calibration makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.calibration import Calibration
from cgsf.errors import InputError
from cgsf.formats import kitti_png, npz, ply

_MAPS = {"disparity1": 2, "disparity2": 2, "disparity_change": 2, "flow": 3}
_OPTIONAL_MAPS = {"confidence": np.float32, "moving": bool, "loss": np.float32}


@dataclass(frozen=True, eq=False)
class SceneFlow:
    """Dense scene flow of two stereo pairs, in pixels; NaN where a method gives nothing.

    Parameters
    ----------
    disparity1 : ndarray (H, W) float32
        Disparity of left1: ``left1(x, y)`` matches ``right1(x - disparity1, y)``.
    disparity2 : ndarray (H, W) float32
        Disparity of left2, on **left2's own grid**.
    disparity_change : ndarray (H, W) float32
        Disparity at time 2 of the point that left1 sees, minus `disparity1`; left1's grid.
    flow : ndarray (H, W, 2) float32
        ``left1(x, y)`` matches ``left2(x + u, y + v)``.
    visible : ndarray (H, W) bool
        True where left1's point is seen in left2.
    confidence : ndarray (H, W) float32, optional
        From 0, a guess, to 1, sure.
    moving : ndarray (H, W) bool, optional
        True where the point does not move with the camera's own motion.
    camera_motion : ndarray (4, 4) float64, optional
        Takes points of the standing world from left1's coordinates to left2's: metres with a calibration.
    loss : ndarray (H, W) float32, optional
        The consistency energy of each pixel.
    backward_flow : ndarray (H, W, 2) float32, optional
        Flow left2 -> left1 on left2's grid, which the visible mask comes from; it is not saved.
    calibration : Calibration, optional
        Needed by `depth`, `points` and `motion`.
    method : str
        The name of the pipeline that made it.
    seconds : dict
        Time of each stage; ``total`` is the solving alone.
    record : dict
        What else the method has to say (why it stopped, energies); goes into ``run.json``.
    initial : SceneFlow, optional
        The state that the method started from; it is not saved.
    """

    disparity1: np.ndarray
    disparity2: np.ndarray
    disparity_change: np.ndarray
    flow: np.ndarray
    visible: np.ndarray
    confidence: np.ndarray | None = None
    moving: np.ndarray | None = None
    camera_motion: np.ndarray | None = None
    loss: np.ndarray | None = None
    backward_flow: np.ndarray | None = None
    calibration: Calibration | None = None
    method: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    initial: SceneFlow | None = None

    def __post_init__(self) -> None:
        shape = self.disparity1.shape
        for name, axes in _MAPS.items():
            array = getattr(self, name)
            if array.dtype != np.float32 or array.shape != (shape if axes == 2 else (*shape, 2)) or len(shape) != 2:
                raise InputError(f"{name} must be a float32 map of disparity1's size, got {array.dtype} {array.shape}")
        for name, dtype in {"visible": bool, **_OPTIONAL_MAPS}.items():
            array = getattr(self, name)
            if array is not None and (array.dtype != dtype or array.shape != shape):
                kind = np.dtype(dtype)
                raise InputError(f"{name} must be a {kind} map of disparity1's size, got {array.dtype} {array.shape}")

    @classmethod
    def from_state(cls, state: np.ndarray, visible: np.ndarray, **others: Any) -> SceneFlow:
        """From a state (5, H, W) in the order D1, D2, C, u, v; `others` are fields of the result."""
        d1, d2, change, u, v = np.asarray(state, np.float32)
        return cls(d1.copy(), d2.copy(), change.copy(), np.stack([u, v], -1), np.asarray(visible, bool), **others)

    def state(self) -> np.ndarray:
        """The maps as a state (5, H, W) float32."""
        maps = (self.disparity1, self.disparity2, self.disparity_change, self.flow[..., 0], self.flow[..., 1])
        return np.stack(maps).astype(np.float32, copy=False)

    @property
    def shape(self) -> tuple[int, int]:
        """``(H, W)`` in pixels."""
        height, width = self.disparity1.shape
        return height, width

    @property
    def disparity2_on_left1(self) -> np.ndarray:
        """Disparity at time 2 of the point that left1 sees, (H, W): what KITTI calls disp_1."""
        return self.disparity1 + self.disparity_change

    @property
    def depth(self) -> np.ndarray:
        """Depth at time 1 in metres, (H, W) float32; NaN where the disparity is not above zero."""
        return self._calibrated().depth(self.disparity1)

    @property
    def points(self) -> np.ndarray:
        """3D points at time 1 in metres, (H, W, 3) float32: X right, Y down, Z forward."""
        return self._calibrated().points(self.disparity1)

    @property
    def motion(self) -> np.ndarray:
        """3D motion in metres per frame, (H, W, 3) float32, as the camera sees it (its own motion is included)."""
        return self._calibrated().motion(self.disparity1, self.disparity_change, self.flow)

    def _calibrated(self) -> Calibration:
        if self.calibration is None:
            raise InputError("metres need a calibration: give a file, or fx fy cx cy and the baseline")
        return self.calibration

    def save(self, folder: str | Path, bgr: np.ndarray | None = None) -> list[str]:
        """Write ``scene_flow.npz``, ``disp_0.png``, ``disp_1.png``, ``flow.png``; with a calibration ``points.ply``.

        Parameters
        ----------
        folder : str or Path
            Made if it does not exist. Each file is replaced atomically.
        bgr : ndarray (H, W, 3) uint8, optional
            Colours of the points; grey without.

        Returns
        -------
        list of str
            The names of the files.
        """
        folder = Path(folder)
        self.save_maps(folder / "scene_flow.npz")
        kitti_png.write_disparity(folder / "disp_0.png", self.disparity1)
        kitti_png.write_disparity(folder / "disp_1.png", self.disparity2_on_left1)
        kitti_png.write_flow(folder / "flow.png", self.flow)
        names = ["scene_flow.npz", "disp_0.png", "disp_1.png", "flow.png"]
        if self.calibration is not None:
            colours = np.full((*self.shape, 3), 128, np.uint8) if bgr is None else bgr
            ply.write_ply(folder / "points.ply", self.points, self.motion, colours)
            names.append("points.ply")
        return names

    def save_maps(self, path: str | Path) -> None:
        """Write all maps as one ``.npz`` file, which `load` reads."""
        arrays = {name: getattr(self, name) for name in (*_MAPS, "visible", *_OPTIONAL_MAPS, "camera_motion")}
        if self.calibration is not None:
            arrays["calibration"] = np.array(list(self.calibration.to_dict().values()))
        npz.write_arrays(path, {name: array for name, array in arrays.items() if array is not None})

    @classmethod
    def load(cls, folder: str | Path) -> SceneFlow:
        """Read the ``scene_flow.npz`` that `save` wrote, or another program's with the same names.

        Parameters
        ----------
        folder : str or Path
            The folder, or the file itself. ``disparity1``, ``disparity_change`` and ``flow`` are required; without
            ``disparity2`` that map is NaN, without ``visible`` everything counts as visible.

        Raises
        ------
        InputError
            If the file is missing, damaged, or lacks a map.
        """
        path = Path(folder)
        path = path / "scene_flow.npz" if path.is_dir() else path
        arrays = npz.read_arrays(path, ["disparity1", "disparity_change", "flow"])
        shape = arrays["disparity1"].shape
        try:
            fields: dict[str, Any] = {
                name: arrays.get(name, np.full(shape, np.nan)).astype(np.float32) for name in _MAPS
            }
            fields["visible"] = arrays.get("visible", np.ones(shape)).astype(bool)
            fields |= {name: arrays[name].astype(dtype) for name, dtype in _OPTIONAL_MAPS.items() if name in arrays}
            calibration = Calibration(*map(float, arrays["calibration"])) if "calibration" in arrays else None
            return cls(**fields, camera_motion=arrays.get("camera_motion"), calibration=calibration)
        except (InputError, TypeError, ValueError) as error:
            raise InputError(f"{path}: {error}") from None
