"""Data sets: frame ids to samples.

A data set is a class with ``__init__(root, **options)``, ``__len__``, ``__getitem__(index) -> Sample`` and ``names``
(the samples' names, known without reading an image). The registry names classes without importing them.
"""

import importlib
from pathlib import Path
from typing import Any, Protocol

from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError

__all__ = ["DATASETS", "Dataset", "Sample", "Truth", "open_dataset"]

#: name on the command line -> "module:Class"
DATASETS: dict[str, str] = {
    "kitti2015": "cgsf.datasets.kitti2015:Kitti2015",
    "kitti2012": "cgsf.datasets.kitti2012:Kitti2012",
    "frames": "cgsf.datasets.frames:FrameFolders",
    "rendered": "cgsf.datasets.frames:FrameFolders",
    "folder": "cgsf.datasets.folder:Folder",
    "synthetic-things": "cgsf.datasets.synthetic:Things",
    "synthetic-street": "cgsf.datasets.synthetic:Street",
    "synthetic-v1": "cgsf.datasets.synthetic:SyntheticV1",
    "flyingthings3d": "cgsf.datasets.flyingthings3d:SceneFlowVideo",
    "flyingthings3d-subset": "cgsf.datasets.flyingthings3d:FlyingThings3DSubset",
    "monkaa": "cgsf.datasets.flyingthings3d:SceneFlowVideo",
    "driving": "cgsf.datasets.flyingthings3d:SceneFlowVideo",
    "kitti-raw": "cgsf.datasets.kitti_raw:KittiRaw",
    "sintel": "cgsf.datasets.sintel:Sintel",
    "middlebury2014": "cgsf.datasets.middlebury:Middlebury2014",
}


class Dataset(Protocol):
    """What every data set offers."""

    names: list[str]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...


def open_dataset(name: str, root: str | Path, **options: Any) -> Dataset:
    """The data set called `name` (a key of `DATASETS`) in the folder `root`.

    Raises
    ------
    InputError
        For an unknown name, and whatever the data set itself finds missing.
    """
    if name not in DATASETS:
        raise InputError(f"unknown data set {name!r}; known are {', '.join(sorted(DATASETS))}")
    module, cls = DATASETS[name].split(":")
    return getattr(importlib.import_module(module), cls)(Path(root), **options)
