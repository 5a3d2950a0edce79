"""FlyingThings3D, Monkaa and Driving (Mayer et al., CVPR 2016), and the DispNet/FlowNet2 subset of FlyingThings3D.

The full releases, ``SceneFlowVideo``::

    root/frames_cleanpass/SEQUENCE/left/0006.png          (frames_finalpass alike; right/ beside left/)
    root/disparity/SEQUENCE/left/0006.pfm                 pixels, positive
    root/disparity_change/SEQUENCE/into_future/left/0006.pfm     second-frame disparity of the point minus its first
    root/optical_flow/SEQUENCE/into_future/left/OpticalFlowIntoFuture_0006_L.pfm    u, v and a zero

SEQUENCE is ``TRAIN/A/0000`` in FlyingThings3D, ``a_rain_of_stones_x2`` in Monkaa and
``15mm_focallength/scene_forwards/fast`` in Driving. A sample is a frame whose successor exists, so each sequence's last
frame is none: 3,933 of the 4,370 test images of FlyingThings3D.

The subset, ``FlyingThings3DSubset``::

    root/train/image_clean/left/0000000.png               (image_final alike; right/ beside left/)
    root/train/disparity/left/0000000.pfm                 **negative** for the left view: the sign is turned here
    root/train/disparity_change/left/into_future/0000000.pfm     negative likewise
    root/train/flow/left/into_future/0000000.flo

Frame numbers run on over the sequences, and frames without flow into the future or without a successor are no samples.

The rig: 1,050 px focal length (450 px in Driving's ``15mm_focallength``) at 960 x 540, principal point (479.5, 269.5),
baseline 1 unit.
"""

from pathlib import Path

import numpy as np

from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats.flo import read_flo
from cgsf.formats.images import read_image
from cgsf.formats.pfm import read_pfm

_PASSES = ("clean", "final")


def _images(left: Path, right: Path, first: str, second: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    left1, right1, left2, right2 = (
        read_image(side / f"{frame}.png") for frame in (first, second) for side in (left, right)
    )
    return left1, right1, left2, right2


def _successor(frame: str) -> str:
    return f"{int(frame) + 1:0{len(frame)}d}"


class SceneFlowVideo:
    """A full release: FlyingThings3D, Monkaa or Driving.

    Parameters
    ----------
    root : Path
        The folder that holds ``frames_cleanpass`` and the others.
    split : str, optional
        Only sequences below this folder, for example ``TRAIN`` or ``TEST``.
    render : {"clean", "final"}
    """

    def __init__(self, root: Path, split: str | None = None, render: str = "clean") -> None:
        if render not in _PASSES:
            raise InputError(f"unknown render {render!r}; known are {', '.join(_PASSES)}")
        self.root, self.frames = Path(root), Path(root) / f"frames_{render}pass"
        start = self.frames / split if split else self.frames
        if not start.is_dir():
            raise InputError(f"{start}: no such folder")
        self._samples: list[tuple[str, str]] = []
        for left in sorted(start.rglob("left")):
            sequence = left.parent.relative_to(self.frames).as_posix()
            numbers = {path.stem for path in left.glob("*.png") if path.stem.isdigit()}
            self._samples += [(sequence, frame) for frame in sorted(numbers) if _successor(frame) in numbers]
        if not self._samples:
            raise InputError(f"{start}: has no sequence SEQUENCE/left/NNNN.png of two frames that follow each other")
        self.names = [f"{sequence}/{frame}" for sequence, frame in self._samples]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        sequence, frame = self._samples[index]
        images = _images(self.frames / sequence / "left", self.frames / sequence / "right", frame, _successor(frame))
        disparity = self.root / "disparity" / sequence / "left"
        disparity1, disparity_left2 = (read_pfm(disparity / f"{number}.pfm") for number in (frame, _successor(frame)))
        change = read_pfm(self.root / "disparity_change" / sequence / "into_future" / "left" / f"{frame}.pfm")
        motion = self.root / "optical_flow" / sequence / "into_future" / "left" / f"OpticalFlowIntoFuture_{frame}_L.pfm"
        flow = read_pfm(motion)
        if flow.ndim != 3:
            raise InputError(f"{motion}: flow has three channels in this release, this file has one")
        focal = 450.0 if "15mm_focallength" in sequence else 1050.0
        truth = Truth(disparity1, disparity1 + change, np.ascontiguousarray(flow[..., :2]), disparity_left2)
        return Sample(self.names[index], *images, Calibration(focal, focal, 479.5, 269.5, 1.0), truth)


class FlyingThings3DSubset:
    """The DispNet/FlowNet2 subset.

    Parameters
    ----------
    root : Path
        The folder that holds ``train`` and ``val``.
    split : {"train", "val"}
    render : {"clean", "final"}
    """

    def __init__(self, root: Path, split: str = "train", render: str = "clean") -> None:
        if render not in _PASSES:
            raise InputError(f"unknown render {render!r}; known are {', '.join(_PASSES)}")
        self.folder, self.images = Path(root) / split, Path(root) / split / f"image_{render}"
        self._flow = self.folder / "flow" / "left" / "into_future"
        for folder in (self.images / "left", self._flow):
            if not folder.is_dir():
                raise InputError(f"{folder}: no such folder")
        numbers = {path.stem for path in (self.images / "left").glob("*.png") if path.stem.isdigit()}
        known = {path.stem for path in self._flow.glob("*.flo")}
        self.names = sorted(frame for frame in numbers & known if _successor(frame) in numbers)
        if not self.names:
            raise InputError(f"{self.folder}: has no frame with flow into the future and a successor")

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        frame = self.names[index]
        images = _images(self.images / "left", self.images / "right", frame, _successor(frame))
        disparity = self.folder / "disparity" / "left"
        disparity1, disparity_left2 = (-read_pfm(disparity / f"{number}.pfm") for number in (frame, _successor(frame)))
        change = -read_pfm(self.folder / "disparity_change" / "left" / "into_future" / f"{frame}.pfm")
        truth = Truth(disparity1, disparity1 + change, read_flo(self._flow / f"{frame}.flo"), disparity_left2)
        return Sample(frame, *images, Calibration(1050.0, 1050.0, 479.5, 269.5, 1.0), truth)
