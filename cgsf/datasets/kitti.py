"""What the two KITTI scene flow benchmarks share: frame ids, folders, maps with holes."""

import re
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats import kitti_png
from cgsf.formats.images import read_image

Images = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def split_folder(root: Path, split: str) -> Path:
    """``root/split``, or `root` itself if that is the split's folder already."""
    if split not in ("training", "testing"):
        raise InputError(f"unknown split {split!r}; KITTI has training and testing")
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    if (root / split).is_dir():
        return root / split
    if root.name == split:
        return root
    raise InputError(f"{root}: has no folder {split}")


def frame_ids(folder: Path) -> list[str]:
    """The ids ``000003`` of all ``000003_10.png`` in `folder`."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    ids = sorted(match[1] for path in folder.iterdir() if (match := re.fullmatch(r"(\d{6})_10\.png", path.name)))
    if not ids:
        raise InputError(f"{folder}: has no image called NNNNNN_10.png")
    return ids


def read_images(folder: Path, left: str, right: str, frame: str) -> Images:
    """The four images left1, right1, left2, right2 of a frame id."""
    left1, left2 = (read_image(folder / left / f"{frame}_{time}.png") for time in ("10", "11"))
    right1, right2 = (read_image(folder / right / f"{frame}_{time}.png") for time in ("10", "11"))
    return left1, right1, left2, right2


def visible(folder: Path, frame: str, occluded_too: np.ndarray) -> np.ndarray | None:
    """True where a ``noc`` map knows the truth; None where the whole folder is absent."""
    if not folder.is_dir():
        return None
    path = folder / f"{frame}_10.png"
    values = kitti_png.read_flow(path)[..., 0] if occluded_too.ndim == 3 else kitti_png.read_disparity(path)
    return np.isfinite(values)
