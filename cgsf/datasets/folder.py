"""A folder of four images, with or without calibration and truth.

::

    root/
      left1.png right1.png left2.png right2.png     any image format, one file each
      calib.json    fx fy cx cy in pixels, baseline in metres (optional; or a KITTI calib.txt)
      gt.npz        truth (optional), on left1's grid, in pixels:
        D1 (H, W), F (H, W, 2) left1 -> left2, C (H, W) = disparity at time 2 minus D1, valid (H, W) bool;
        D_left2 (H, W) on left2's grid, occ_flow, occ_stereo (H, W) bool = not visible there, moving (H, W) bool
        (each of these four optional)
"""

from pathlib import Path

import numpy as np

from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats import npz
from cgsf.formats.images import read_image

IMAGES = ("left1", "right1", "left2", "right2")
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tif", ".tiff", ".webp")


class Folder:
    """One sample: a folder of four images.

    Parameters
    ----------
    root : Path
    name : str, optional
        The sample's name; the folder's without.
    """

    def __init__(self, root: Path, name: str | None = None) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise InputError(f"{self.root}: no such folder")
        self.names = [name or self.root.resolve().name]

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Sample:
        left1, right1, left2, right2 = (read_image(self._image(name)) for name in IMAGES)
        found = [self.root / name for name in ("calib.json", "calib.txt") if (self.root / name).is_file()]
        calibration = Calibration.read(found[0]) if found else None
        truth = read_truth(self.root / "gt.npz") if (self.root / "gt.npz").is_file() else None
        return Sample(self.names[index], left1, right1, left2, right2, calibration, truth)

    def _image(self, name: str) -> Path:
        paths = [path for path in self.root.iterdir() if path.stem == name and path.suffix.lower() in _EXTENSIONS]
        if len(paths) != 1:
            found = ", ".join(sorted(path.name for path in paths)) or "none"
            raise InputError(f"{self.root}: one image called {name}.png (or another format) is needed, found {found}")
        return paths[0]


def read_truth(path: Path) -> Truth:
    """The truth of a ``gt.npz``; see the module's docstring for its arrays."""
    arrays = npz.read_arrays(path, ["D1", "F", "C"])
    shape = arrays["D1"].shape
    sizes = {name: array.shape[:2] for name, array in arrays.items()}
    if len(set(sizes.values())) != 1 or arrays["F"].shape != (*shape, 2):
        raise InputError(f"{path}: the maps differ in size: {', '.join(f'{k} {v}' for k, v in sizes.items())}")
    unknown = ~arrays["valid"].astype(bool) if "valid" in arrays else np.zeros(shape, bool)
    disparity1, change, flow = (arrays[name].astype(np.float32) for name in ("D1", "C", "F"))
    disparity2 = disparity1 + change
    for values in (disparity1, disparity2, flow):
        values[unknown] = np.nan
    return Truth(
        disparity1,
        disparity2,
        flow,
        disparity_left2=arrays["D_left2"].astype(np.float32) if "D_left2" in arrays else None,
        visible_stereo=~arrays["occ_stereo"].astype(bool) if "occ_stereo" in arrays else None,
        visible_flow=~arrays["occ_flow"].astype(bool) if "occ_flow" in arrays else None,
        objects=arrays["moving"].astype(np.uint8) if "moving" in arrays else None,
    )
