"""Starts for the refiner on disk: what a method makes of every sample of a `SampleCache`, computed once.

A folder with ``start.npy`` (N, 5, H, W) float32, ``backward.npy`` (N, 2, H, W) float32 (flow left2 -> left1),
``evidence.npy`` (N, 2, H, W) float32 (confidence and visibility in [0, 1]), ``homography.npy`` (N, 4, 4) float64 (the
camera's motion on x, y, disparity, 1) and ``cache.json``: what made them, and the names of the samples that are complete.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.camera_motion import find_homography
from cgsf.errors import InputError
from cgsf.formats.files import write_bytes
from cgsf.intake import to_frames
from cgsf.sample_cache import SampleCache, open_array
from cgsf.starts import StartConfig, describe, make_start, start_maps

_MAPS = {"start": 5, "backward": 2, "evidence": 2}
_INDEX = "cache.json"


class StartCache:
    """Read access; `InputError` if the folder is no cache of starts."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.about, self.names = _read_index(self.folder)
        try:
            self.arrays = {
                name: np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in (*_MAPS, "homography")
            }
        except (OSError, ValueError) as error:
            raise InputError(f"{self.folder}: the starts cannot be read ({error}); make them anew") from None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        """``start`` (5, H, W), ``backward`` (2, H, W), ``evidence`` (2, H, W) and ``homography`` (4, 4) of a sample."""
        return {name: array[index] for name, array in self.arrays.items()}


def write_starts(
    folder: str | Path, cache: SampleCache, config: StartConfig, count: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> StartCache:  # fmt: skip
    """Make the starts of the first `count` samples of a cache; goes on where an earlier call was stopped.

    Parameters
    ----------
    folder : str or Path
    cache : SampleCache
        No cameras are known there: the solver works as it does without a calibration.
    config : StartConfig
    count : int, optional
        All samples unless given; later calls on the folder need the same.
    progress : callable, optional
        Called with the number of starts that are complete.

    Raises
    ------
    InputError
        If the folder holds other starts or the disk is full; and whatever the start's maker refuses.
    """
    folder, about = Path(folder), describe(config)
    count = min(len(cache), count or len(cache))
    done = 0
    if (folder / _INDEX).exists():
        made_by, names = _read_index(folder)
        done = len(names)
        if made_by != json.loads(json.dumps(about)) or names != cache.names[:done]:
            raise InputError(f"{folder} holds starts made otherwise or of other samples; choose another folder")
    size = cache.images.shape[2:4]
    arrays = [open_array(folder / f"{name}.npy", (count, channels, *size), np.float32) for name, channels in _MAPS.items()]
    arrays.append(open_array(folder / "homography.npy", (count, 4, 4), np.float64))
    if progress:
        progress(done)
    for index in range(done, count):
        start = make_start(to_frames(list(cache[index][0])), config)
        maps = start_maps(start)
        homography = find_homography(maps[0], maps[1].transpose(1, 2, 0))
        for array, values in zip(arrays, (*maps, homography), strict=True):
            array[index] = values
            array.flush()
        write_bytes(folder / _INDEX, json.dumps({"about": about, "names": cache.names[: index + 1]}).encode())
        if progress:
            progress(index + 1)
    return StartCache(folder)


def _read_index(folder: Path) -> tuple[dict[str, Any], list[str]]:
    try:
        index = json.loads((folder / _INDEX).read_text())
        return index["about"], list(index["names"])
    except FileNotFoundError:
        raise InputError(f"{folder} is no cache of starts: {_INDEX} is missing") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{folder / _INDEX} is damaged; make the starts anew") from None
