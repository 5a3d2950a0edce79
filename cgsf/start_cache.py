"""Starts for the refiner on disk: what a method makes of every sample of a `SampleCache`, computed once.

A folder with ``start.npy`` (N, 5, H, W) float32, ``backward.npy`` (N, 2, H, W) float32 (flow left2 -> left1),
``evidence.npy`` (N, 2, H, W) float32 (confidence and visibility in [0, 1]) and ``cache.json``: what made them, and the
names of the samples that are complete.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import write_bytes
from cgsf.intake import to_frames
from cgsf.sample_cache import SampleCache, open_array
from cgsf.starts import StartConfig, describe, make_start, start_maps

_ARRAYS = {"start": 5, "backward": 2, "evidence": 2}
_INDEX = "cache.json"


class StartCache:
    """Read access; `InputError` if the folder is no cache of starts."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.about, self.names = _read_index(self.folder)
        try:
            self.maps = {name: np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in _ARRAYS}
        except (OSError, ValueError) as error:
            raise InputError(f"{self.folder}: the starts cannot be read ({error}); make them anew") from None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Start (5, H, W), backward flow (2, H, W) and evidence (2, H, W) of the cache's sample of this index."""
        return self.maps["start"][index], self.maps["backward"][index], self.maps["evidence"][index]


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
    arrays = [open_array(folder / f"{name}.npy", (count, channels, *size), np.float32) for name, channels in _ARRAYS.items()]
    if progress:
        progress(done)
    for index in range(done, count):
        start = make_start(to_frames(list(cache[index][0])), config)
        for array, maps in zip(arrays, start_maps(start), strict=True):
            array[index] = maps
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
