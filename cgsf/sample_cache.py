"""Samples on disk, ready for training: rendered or decoded once, then read by memory map as often as one likes.

A cache is a folder with ``images.npy`` (N, 4, H, W, 3) uint8 in the order left1, right1, left2, right2 (BGR),
``truth.npy`` (N, 5, H, W) float32 in the state's order D1, D2, C, u, v (NaN where unknown; D2 on left2's grid) and
``cache.json`` with the names of the samples that are complete: a killed writer goes on where it stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np

from cgsf.datasets.sample import Sample, Truth
from cgsf.errors import InputError
from cgsf.formats.files import write_bytes
from cgsf.threads import bound_threads

_DTYPES = {"images": np.uint8, "truth": np.float32}
_INDEX = "cache.json"


class SampleCache:
    """Read access to a cache; grows while another process still writes it.

    Parameters
    ----------
    folder : str or Path

    Raises
    ------
    InputError
        If the folder is no cache, or its files do not fit each other.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.names = _read_index(self.folder)
        try:
            self.images = np.load(self.folder / "images.npy", mmap_mode="r", allow_pickle=False)
            self.truth = np.load(self.folder / "truth.npy", mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"{self.folder}: the cache cannot be read ({error}); make it anew") from None
        count, _, height, width, _ = self.images.shape
        if self.truth.shape != (count, 5, height, width) or len(self.names) > count:
            raise InputError(f"{self.folder}: images and truth of the cache do not fit each other; make it anew")

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Images (4, H, W, 3) uint8 and truth (5, H, W) float32 of one sample, read-only views."""
        return self.images[index], self.truth[index]


def write_cache(
    folder: str | Path, names: Sequence[str], make: Callable[[int], Sample], size: tuple[int, int],
    progress: Callable[[int], None] | None = None, workers: int = 1,
) -> SampleCache:  # fmt: skip
    """Fill a cache with ``make(0) ... make(len(names) - 1)``; goes on where an earlier call was stopped.

    Parameters
    ----------
    names : sequence of str
        Of all samples.
    make : callable
        Gives the sample of an index; larger ones are cut to `size` around their centre. With several workers it is
        pickled.
    size : (int, int)
        Height and width in pixels.
    progress : callable, optional
        Called with the number of samples that are complete.
    workers : int
        Processes that make samples; the files do not depend on it.

    Raises
    ------
    InputError
        If the folder holds another cache, a sample is too small, or the disk is full.
    """
    folder, names = Path(folder), list(names)
    done = _read_index(folder) if (folder / _INDEX).exists() else []
    if done != names[: len(done)]:
        raise InputError(f"{folder} holds a cache of other samples; choose another folder")
    shapes = {"images": (len(names), 4, *size, 3), "truth": (len(names), 5, *size)}
    arrays = {name: open_array(folder / f"{name}.npy", shape, _DTYPES[name]) for name, shape in shapes.items()}
    if progress:
        progress(len(done))
    with ExitStack() as stack:
        left = range(len(done), len(names))
        made: Iterable[Sample] = map(make, left)
        if workers > 1 and len(left) > 1:
            made = stack.enter_context(get_context("spawn").Pool(workers, bound_threads, (1, False))).imap(make, left)
        for index, sample in zip(left, made, strict=True):
            arrays["images"][index] = [_to_bytes(_centre(image, size)) for image in sample.images]
            truth = truth_state(sample.truth, sample.left1.shape[:2])
            arrays["truth"][index] = _centre(truth.transpose(1, 2, 0), size).transpose(2, 0, 1)
            for array in arrays.values():
                array.flush()
            _write_index(folder, names[: index + 1])
            if progress:
                progress(index + 1)
    return SampleCache(folder)


def open_array(path: Path, shape: tuple[int, ...], dtype: type) -> np.memmap:
    """A ``.npy`` file on disk as a writable array: the one that is there, or a new one whose space is set aside, so that
    a full disk shows now and not as a crash while it is filled.

    Raises
    ------
    InputError
        If the file is another array, or there is no space for it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        temporary = path.with_name(f".{path.name}.part")
        array = np.lib.format.open_memmap(temporary, mode="w+", dtype=dtype, shape=shape)
        try:
            if hasattr(os, "posix_fallocate"):
                with temporary.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, array.offset + array.nbytes)
            temporary.replace(path)
        except OSError as error:
            raise InputError(f"{path}: no space for {array.nbytes / 1e9:.1f} GB ({error.strerror})") from None
        finally:
            temporary.unlink(missing_ok=True)
        return array
    try:
        array = np.lib.format.open_memmap(path, mode="r+")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be continued ({error}); choose another folder") from None
    if array.shape != shape or array.dtype != dtype:
        raise InputError(f"{path.parent} holds a cache of another size; choose another folder")
    return array


def truth_state(truth: Truth | None, shape: tuple[int, int]) -> np.ndarray:
    """Truth as a state (5, H, W) float32 in pixels, NaN where it is unknown."""
    state = np.full((5, *shape), np.nan, np.float32)
    if truth is None:
        return state
    if truth.disparity1 is not None:
        state[0] = truth.disparity1
        if truth.disparity2 is not None:
            state[2] = truth.disparity2 - truth.disparity1
    if truth.disparity_left2 is not None:
        state[1] = truth.disparity_left2
    if truth.flow is not None:
        state[3:] = truth.flow.transpose(2, 0, 1)
    state[~np.isfinite(state)] = np.nan
    return state


def _centre(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    height, width = array.shape[:2]
    if height < size[0] or width < size[1]:
        raise InputError(f"a sample of {width} x {height} pixels does not fill a cache of {size[1]} x {size[0]}")
    top, left = (height - size[0]) // 2, (width - size[1]) // 2
    return array[top : top + size[0], left : left + size[1]]


def _to_bytes(image: np.ndarray) -> np.ndarray:
    scaled = np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
    return scaled if scaled.shape[2] == 3 else cv2.cvtColor(scaled, cv2.COLOR_GRAY2BGR)


def _read_index(folder: Path) -> list[str]:
    try:
        names = json.loads((folder / _INDEX).read_text())["names"]
    except FileNotFoundError:
        raise InputError(f"{folder} is no cache of samples: {_INDEX} is missing") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{folder / _INDEX} is damaged; make the cache anew") from None
    return list(names)


def _write_index(folder: Path, names: Sequence[str]) -> None:
    write_bytes(folder / _INDEX, json.dumps({"names": list(names)}).encode())
