"""Rendered samples on disk, in the folders and formats of KITTI Scene Flow 2015.

``cgsf evaluate kitti2015 DIR`` and every other reader of KITTI reads them. ``training/synthetic/000000.json`` names the
scene of each frame; it is written last, so an interrupted run goes on where it stopped.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from cgsf import sample_cache
from cgsf.calibration import Calibration
from cgsf.datasets.sample import Sample
from cgsf.errors import InputError
from cgsf.formats import kitti_png
from cgsf.formats.files import write_bytes
from cgsf.formats.images import to_bytes, write_png
from cgsf.synthetic.families import FAMILIES
from cgsf.synthetic.render import make_sample

Progress = Callable[[int], None]

#: Flow beyond this many pixels does not fit KITTI's format and is written as unknown.
_LARGEST_FLOW = 511.0


def write_kitti(
    folder: str | Path, family: str, count: int, seed: int = 0, height: int = 376, width: int = 1242, workers: int = 1,
    progress: Progress | None = None, **options: Any,
) -> int:  # fmt: skip
    """Render frames into ``folder/training``, leaving out those that are there; returns how many were rendered.

    Parameters
    ----------
    folder : str or Path
    family : str
    count, seed : int
        Number of frames; seed of frame 0, the others follow.
    height, width : int
        Image size in pixels.
    workers : int
        Processes; the files do not depend on it.
    progress : callable, optional
        Called with the number of frames that are complete.
    **options
        Fields of `RenderConfig`.

    Raises
    ------
    InputError
        If the folder holds frames of other scenes or cannot be written, or an argument is out of range.
    """
    if count < 1 or workers < 1:
        raise InputError(f"count and workers must be at least 1, got {count} and {workers}")
    training = Path(folder) / "training"
    plain = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
    left = []
    for frame in range(count):
        note = training / "synthetic" / f"{frame:06d}.json"
        if not note.exists():
            left.append(frame)
        elif json.loads(note.read_text()) != _about(frame, family, seed, (height, width), plain):
            raise InputError(f"{note}: this folder holds other scenes; choose another folder or the same settings")
    work = partial(_write_frame, training=training, family=family, seed=seed, size=(height, width), options=plain)
    with ExitStack() as stack:
        done: Iterable[int] = map(work, left)
        if workers > 1 and len(left) > 1:
            done = stack.enter_context(get_context("spawn").Pool(min(workers, len(left)))).imap_unordered(work, left)
        for number, _ in enumerate(done, count - len(left) + 1):
            if progress:
                progress(number)
    return len(left)


def _about(frame: int, family: str, seed: int, size: tuple[int, int], options: dict[str, Any]) -> dict[str, Any]:
    return {"family": family, "seed": seed + frame, "height": size[0], "width": size[1], "options": options}


def _write_frame(frame: int, training: Path, family: str, seed: int, size: tuple[int, int], options: dict[str, Any]) -> int:
    sample = make_sample(family, seed + frame, *size, **options)
    write_frame(training, f"{frame:06d}", sample)
    about = _about(frame, family, seed, size, options)
    write_bytes(training / "synthetic" / f"{frame:06d}.json", json.dumps(about).encode())
    return frame


def write_frame(training: Path, frame: str, sample: Sample) -> None:
    """Write one sample with full truth under the id `frame`; see `cgsf.datasets.kitti2015` for the tree."""
    truth = sample.truth
    if truth is None or truth.disparity1 is None or truth.disparity2 is None or truth.flow is None:
        raise InputError(f"{sample.name}: has no complete truth to write")
    for name, image in zip(("image_2/{}_10", "image_3/{}_10", "image_2/{}_11", "image_3/{}_11"), sample.images, strict=True):
        write_png(training / f"{name.format(frame)}.png", to_bytes(image))
    with np.errstate(invalid="ignore"):
        fits = np.abs(truth.flow).max(-1) <= _LARGEST_FLOW
    everywhere = np.ones(fits.shape, bool)
    for kind, visible in (
        ("occ", (everywhere,) * 3),
        ("noc", (truth.visible_stereo, truth.visible_change, truth.visible_flow)),
    ):
        stereo, change, motion = (everywhere if mask is None else mask for mask in visible)
        kitti_png.write_disparity(training / f"disp_{kind}_0/{frame}_10.png", np.where(stereo, truth.disparity1, np.nan))
        kitti_png.write_disparity(training / f"disp_{kind}_1/{frame}_10.png", np.where(change, truth.disparity2, np.nan))
        kitti_png.write_flow(training / f"flow_{kind}/{frame}_10.png", np.where((motion & fits)[..., None], truth.flow, np.nan))
    if truth.objects is not None:
        write_png(training / f"obj_map/{frame}_10.png", np.minimum(truth.objects, 255).astype(np.uint8))
    if sample.calibration is not None:
        write_bytes(training / f"calib_cam_to_cam/{frame}.txt", _calibration_text(sample.calibration).encode())


def _calibration_text(camera: Calibration) -> str:
    """The two lines of ``calib_cam_to_cam`` that matter: the projections of the rectified colour cameras."""
    rows = []
    for name, shift in (("P_rect_02", 0.0), ("P_rect_03", -camera.fx * camera.baseline_m)):
        matrix = (camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0)
        rows.append(f"{name}: " + " ".join(f"{value:.12e}" for value in matrix))
    return "\n".join(rows) + "\n"


def write_cache(
    folder: str | Path, families: Sequence[str], count: int, seed: int, height: int, width: int,
    progress: Progress | None = None, workers: int = 1, **options: Any,
) -> None:  # fmt: skip
    """Render samples into a training cache, see `cgsf.sample_cache`.

    The families take turns, then the seed grows by one; the other arguments and errors are those of `write_kitti`.
    """
    unknown = [family for family in families if family not in FAMILIES]
    if unknown:
        raise InputError(f"unknown family {unknown[0]!r}; known are {', '.join(sorted(FAMILIES))}")
    scenes = [(families[index % len(families)], seed + index // len(families)) for index in range(count)]
    names = [f"{family}-{number:06d}" for family, number in scenes]
    make = partial(_turn, families=tuple(families), seed=seed, size=(height, width), options=options)
    sample_cache.write_cache(folder, names, make, (height, width), progress, workers)


def _turn(index: int, families: tuple[str, ...], seed: int, size: tuple[int, int], options: dict[str, Any]) -> Sample:
    return make_sample(families[index % len(families)], seed + index // len(families), *size, **options)
