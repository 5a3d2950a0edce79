"""A folder of frame folders, each as :mod:`cgsf.datasets.folder` describes it.

::

    root/
      teddy/        left1.png right1.png left2.png right2.png gt.npz
      street_00/    ... and calib.json
      street_01/

Samples are named by group and folder, ``street/street_00``: the group is the folder's name without a trailing number,
and groups are scored apart.
"""

import re
from pathlib import Path

from cgsf.datasets.folder import Folder
from cgsf.datasets.sample import Sample
from cgsf.errors import InputError


class FrameFolders:
    """Every sub-folder that holds a left1 image.

    Parameters
    ----------
    root : Path
    """

    def __init__(self, root: Path) -> None:
        root = Path(root)
        if not root.is_dir():
            raise InputError(f"{root}: no such folder")
        self.folders = sorted(path for path in root.iterdir() if path.is_dir() and any(path.glob("left1.*")))
        if not self.folders:
            raise InputError(f"{root}: has no frame folder (one with left1.png, right1.png, left2.png, right2.png)")
        self.names = [f"{re.sub(r'_?[0-9]+$', '', path.name) or 'frames'}/{path.name}" for path in self.folders]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        return Folder(self.folders[index], self.names[index])[0]
