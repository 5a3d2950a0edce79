"""MPI Sintel stereo (Butler et al., ECCV 2012): rendered film, disparity of the left view, training part.

::

    root/training/clean_left/alley_1/frame_0001.png      (final_left alike; clean_right, final_right)
    root/training/disparities/alley_1/frame_0001.png     8-bit RGB: disparity = 4 R + G / 64 + B / 16384 px, positive
    root/training/occlusions/alley_1/frame_0001.png      255 where the right camera does not see the point
    root/training/outofframe/alley_1/frame_0001.png      255 where the point lies outside the right image
    root/training/flow/alley_1/frame_0001.flo            optional, from the optical-flow release: left1 -> left2

The second disparity of left1's points is not given, so `Truth.disparity2` is None; that of left2's own grid is.
"""

from pathlib import Path

import numpy as np

from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats.flo import read_flo
from cgsf.formats.images import decode, read_image


def read_sintel_disparity(path: Path) -> np.ndarray:
    """Disparity in pixels, (H, W) float32."""
    pixels = decode(path)
    if pixels.ndim != 3 or pixels.dtype != np.uint8:
        raise InputError(f"{path}: a Sintel disparity is an 8-bit colour image, this is {pixels.dtype} {pixels.shape}")
    blue, green, red = (pixels[..., channel].astype(np.float32) for channel in range(3))
    return red * 4 + green / 64 + blue / 16384


class Sintel:
    """MPI Sintel stereo.

    Parameters
    ----------
    root : Path
        The folder that holds ``training``.
    render : {"clean", "final"}
    """

    def __init__(self, root: Path, render: str = "clean") -> None:
        if render not in ("clean", "final"):
            raise InputError(f"unknown render {render!r}; known are clean, final")
        self.folder, self.render = Path(root) / "training", render
        left = self.folder / f"{render}_left"
        if not left.is_dir():
            raise InputError(f"{left}: no such folder")
        self._samples: list[tuple[str, int]] = []
        for scene in sorted(path for path in left.iterdir() if path.is_dir()):
            numbers = {int(path.stem[6:]) for path in scene.glob("frame_*.png") if path.stem[6:].isdigit()}
            self._samples += [(scene.name, number) for number in sorted(numbers) if number + 1 in numbers]
        if not self._samples:
            raise InputError(f"{left}: has no scene with frame_NNNN.png and its successor")
        self.names = [f"{scene}/{number:04d}" for scene, number in self._samples]

    def __len__(self) -> int:
        return len(self.names)

    def _read(self, folder: str, scene: str, number: int) -> Path:
        return self.folder / folder / scene / f"frame_{number:04d}.png"

    def __getitem__(self, index: int) -> Sample:
        scene, number = self._samples[index]
        left1, right1, left2, right2 = (
            read_image(self._read(f"{self.render}_{side}", scene, frame))
            for frame in (number, number + 1)
            for side in ("left", "right")
        )
        hidden = [decode(self._read(kind, scene, number)) > 0 for kind in ("occlusions", "outofframe")]
        flow = self.folder / "flow" / scene / f"frame_{number:04d}.flo"
        truth = Truth(
            disparity1=read_sintel_disparity(self._read("disparities", scene, number)),
            disparity_left2=read_sintel_disparity(self._read("disparities", scene, number + 1)),
            flow=read_flo(flow) if flow.parent.parent.is_dir() else None,
            visible_stereo=~(hidden[0] | hidden[1]),
        )
        return Sample(self.names[index], left1, right1, left2, right2, None, truth)
