"""Starts for the refiner on disk: what a method makes of every sample of a `SampleCache`, computed once.

A folder with ``start.npy`` (N, 5, H, W) float32, ``backward.npy`` (N, 2, H, W) float32 (flow left2 -> left1),
``evidence.npy`` (N, 2, H, W) float32 (confidence and visibility in [0, 1]) and ``cache.json`` (the method, the samples
that are complete).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import write_bytes
from cgsf.pipelines import load_config, solve
from cgsf.sample_cache import SampleCache
from cgsf.scene_flow import SceneFlow

_ARRAYS = {"start": 5, "backward": 2, "evidence": 2}
_INDEX = "cache.json"


class StartCache:
    """Read access; `InputError` if the folder is no cache of starts."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.method, self.names = _read_index(self.folder)
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
    folder: str | Path, cache: SampleCache, method: str, preset: str = "default", count: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> StartCache:  # fmt: skip
    """Solve the first `count` samples of a cache with a method; goes on where an earlier call was stopped."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    count = min(len(cache), count or len(cache))
    config = load_config(method, preset)
    arrays = {}
    for name, channels in _ARRAYS.items():
        path, shape = folder / f"{name}.npy", (len(cache.images), channels, *cache.images.shape[2:4])
        mode = "r+" if path.exists() else "w+"
        arrays[name] = np.lib.format.open_memmap(path, mode=mode, dtype=np.float32, shape=shape)
    done = 0
    if (folder / _INDEX).exists():
        made_by, names = _read_index(folder)
        done = len(names)
        if made_by != method or names != cache.names[:done]:
            raise InputError(f"{folder} holds starts of {made_by} for other samples; choose another folder")
    for index in range(done, count):
        result = solve(list(cache[index][0]), method, config)
        arrays["start"][index], arrays["backward"][index], arrays["evidence"][index] = start_of(result)
        for array in arrays.values():
            array.flush()
        write_bytes(folder / _INDEX, json.dumps({"method": method, "names": cache.names[: index + 1]}).encode())
        if progress:
            progress(index + 1)
    return StartCache(folder)


def start_of(result: SceneFlow) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State (5, H, W), backward flow (2, H, W) and evidence (2, H, W) of a method's result, float32 and finite."""
    if result.backward_flow is None:
        raise InputError(f"the method {result.method!r} gives no backward flow: its states cannot be refined")
    state = np.nan_to_num(result.state(), posinf=0, neginf=0)
    backward = result.backward_flow.transpose(2, 0, 1)
    confidence = np.ones(result.shape, np.float32) if result.confidence is None else result.confidence
    return state, backward, np.stack([confidence, result.visible.astype(np.float32)])


def _read_index(folder: Path) -> tuple[str, list[str]]:
    try:
        index = json.loads((folder / _INDEX).read_text())
        return index["method"], list(index["names"])
    except FileNotFoundError:
        raise InputError(f"{folder} is no cache of starts: {_INDEX} is missing") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{folder / _INDEX} is damaged; make the starts anew") from None
