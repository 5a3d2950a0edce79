"""Middlebury stereo 2014 (Scharstein et al., GCPR 2014): still scenes with dense disparity.

::

    root/Adirondack-perfect/im0.png  im1.png      left, right (scene folders also without -perfect or with -imperfect)
    root/Adirondack-perfect/disp0.pfm             pixels, positive; infinite where unknown
    root/Adirondack-perfect/calib.txt             cam0=[f 0 cx; 0 f cy; 0 0 1], doffs (px), baseline (mm), ...

There is one moment only, the second pair of a sample is the first again, with zero flow. The principal points of the
two cameras differ by ``doffs``; depth is then ``f baseline / (disparity + doffs)``, which is no `Calibration`: a scene
has one only where ``doffs`` is 0.
"""

import re
from pathlib import Path

import numpy as np

from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats.files import read_bytes
from cgsf.formats.images import read_image
from cgsf.formats.pfm import read_pfm


def read_middlebury_calibration(path: Path) -> Calibration | None:
    """The camera in pixels and metres, or None where the principal points differ."""
    values = dict(re.findall(r"^(\w+)=(.*)$", read_bytes(path).decode("utf-8", "replace"), re.MULTILINE))
    try:
        camera = [float(value) for value in re.split(r"[\s;]+", values["cam0"].strip().strip("[]"))]
        doffs, baseline_mm = float(values["doffs"]), float(values["baseline"])
        fx, cx, fy, cy = camera[0], camera[2], camera[4], camera[5]
    except (KeyError, ValueError, IndexError):
        raise InputError(f"{path}: lacks a readable cam0, doffs or baseline") from None
    return Calibration(fx, fy, cx, cy, baseline_mm / 1000) if doffs == 0 else None


class Middlebury2014:
    """Middlebury stereo 2014.

    Parameters
    ----------
    root : Path
        The folder of the scene folders.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise InputError(f"{self.root}: no such folder")
        self.names = sorted(path.name for path in self.root.iterdir() if (path / "im0.png").is_file())
        if not self.names:
            raise InputError(f"{self.root}: has no scene folder with im0.png")

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        folder = self.root / self.names[index]
        left, right = read_image(folder / "im0.png"), read_image(folder / "im1.png")
        disparity = read_pfm(folder / "disp0.pfm")
        disparity = np.where(np.isfinite(disparity), disparity, np.float32(np.nan))
        truth = Truth(disparity, disparity, np.zeros((*disparity.shape, 2), np.float32), disparity)
        return Sample(
            self.names[index], left, right, left, right, read_middlebury_calibration(folder / "calib.txt"), truth
        )
