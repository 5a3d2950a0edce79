"""KITTI raw recordings (Geiger et al., IJRR 2013) as unlabelled stereo video for self-supervised training.

::

    root/2011_09_26/calib_cam_to_cam.txt
    root/2011_09_26/2011_09_26_drive_0005_sync/image_02/data/0000000010.png     left, rectified colour
    root/2011_09_26/2011_09_26_drive_0005_sync/image_03/data/0000000010.png     right
    root/train_mapping.txt                              from KITTI 2015's development kit, devkit/mapping/

A line of the mapping names date, drive and frame of one of the 200 training images of KITTI Scene Flow 2015 (an
empty line: unknown). Every drive named there is left out as a whole, so that what is trained on is never scored.
"""

from pathlib import Path

from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample
from cgsf.errors import InputError
from cgsf.formats.images import read_image


def read_mapping(path: Path) -> set[str]:
    """The drives named in a mapping file.

    Raises
    ------
    InputError
        If the file is missing, names no drive, or has a line that is neither empty nor ``date drive frame``.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file; copy train_mapping.txt from KITTI 2015's development kit or give mapping=FILE"
        ) from None
    drives = set()
    for number, line in enumerate(lines, 1):
        parts = line.split()
        if not parts:
            continue
        if len(parts) != 3 or not parts[1].startswith(parts[0]) or not parts[2].isdigit():
            raise InputError(f"{path}: line {number} is not 'date drive frame'")
        drives.add(parts[1])
    if not drives:
        raise InputError(f"{path}: names no drive")
    return drives


class KittiRaw:
    """Pairs of frames that follow each other, without truth.

    Parameters
    ----------
    root : Path
    mapping : str or Path, optional
        The mapping file; ``root/train_mapping.txt`` if left out.
    step : int or str
        Take every so-manieth pair of a drive.
    """

    def __init__(self, root: Path, mapping: str | Path | None = None, step: int | str = 1) -> None:
        self.root = Path(root)
        if not str(step).isdigit() or int(step) < 1:
            raise InputError(f"step must be a whole number above 0, got {step!r}")
        if not self.root.is_dir():
            raise InputError(f"{self.root}: no such folder")
        excluded = read_mapping(Path(mapping) if mapping is not None else self.root / "train_mapping.txt")
        self._samples: list[tuple[str, str, str]] = []
        for drive in sorted(self.root.glob("*/*_drive_*_sync")):
            if drive.name in excluded:
                continue
            numbers = {path.stem for path in (drive / "image_02" / "data").glob("*.png") if path.stem.isdigit()}
            pairs = [(frame, f"{int(frame) + 1:010d}") for frame in sorted(numbers)]
            found = [(drive.relative_to(self.root).as_posix(), *pair) for pair in pairs if pair[1] in numbers]
            self._samples += found[:: int(step)]
        if not self._samples:
            raise InputError(f"{self.root}: has no drive DATE/DATE_drive_NNNN_sync that may be trained on")
        self.names = [f"{drive}/{frame}" for drive, frame, _ in self._samples]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        drive, first, second = self._samples[index]
        folder = self.root / drive
        left1, right1, left2, right2 = (
            read_image(folder / camera / "data" / f"{frame}.png")
            for frame in (first, second)
            for camera in ("image_02", "image_03")
        )
        calibration = Calibration.read(folder.parent / "calib_cam_to_cam.txt")
        return Sample(self.names[index], left1, right1, left2, right2, calibration)
