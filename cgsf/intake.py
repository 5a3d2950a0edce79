"""From what people give to what solvers take: four images become validated frames, and oddities are said.

What cannot be solved is an :class:`~cgsf.errors.InputError`; what looks wrong but can be solved (left and right
exchanged, rows that do not match) is a warning in the log, once a pair.
"""

import logging
from collections.abc import Sequence

import cv2
import numpy as np

from cgsf.errors import InputError
from cgsf.formats.images import to_unit_range
from variational.frames import Frames

logger = logging.getLogger(__name__)

NAMES = ("left1", "right1", "left2", "right2")
#: Shorter sides than this hold no coarse-to-fine search.
SMALLEST_SIDE_PX = 32

_CHECK_WIDTH_PX = 512  # the checks below look at a reduced image
_CONSISTENT_PX = 0.5  # forward and backward matches of the reduced image agree to this
_FEWEST = 0.05  # share of consistent pixels below which nothing is said
_ROWS_PX = 1.5  # median vertical offset in pixels that rectification does not leave


def to_frames(images: Sequence[np.ndarray]) -> Frames:
    """Four images of any accepted kind as frames.

    Parameters
    ----------
    images : four ndarrays
        left1, right1, left2, right2 as :func:`cgsf.formats.images.to_unit_range` takes them. If only some of them are
        colour, all become grey.

    Raises
    ------
    InputError
        If one is no image, contains NaN, is constant, or is too small, or if the four sizes differ.
    """
    arrays = []
    for name, image in zip(NAMES, images, strict=True):
        try:
            arrays.append(to_unit_range(image))
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    sizes = {f"{name} {a.shape[1]} x {a.shape[0]}": a.shape[:2] for name, a in zip(NAMES, arrays, strict=True)}
    if len(set(sizes.values())) != 1:
        raise InputError(f"the four images must have one size (width x height): {', '.join(sizes)}")
    if min(arrays[0].shape[:2]) < SMALLEST_SIDE_PX:
        raise InputError(f"the images are too small ({next(iter(sizes))}): {SMALLEST_SIDE_PX} pixels a side are needed")
    for name, array in zip(NAMES, arrays, strict=True):
        if array.min() == array.max():
            raise InputError(f"{name} is constant ({array.min():.3g} everywhere): there is nothing to match")
    if len({array.shape[2] for array in arrays}) != 1:
        arrays = [_grey(array)[..., None] for array in arrays]
    return Frames(*arrays)


def warn_of_oddities(frames: Frames) -> list[str]:
    """Log a warning for pairs that look exchanged, unrectified or identical.

    Returns
    -------
    list of str
        The warnings, empty for ordinary pairs.
    """
    found = []
    for time, left, right in ((1, frames.left1, frames.right1), (2, frames.left2, frames.right2)):
        if np.array_equal(left, right):
            found.append(f"left{time} and right{time} are the same image: the disparity can only be zero")
            continue
        found += [f"left{time} and right{time} {text}" for text in _pair_oddities(left, right)]
    if np.array_equal(frames.left1, frames.left2):
        found.append("left1 and left2 are the same image: the flow can only be zero")
    for text in found:
        logger.warning(text)
    return found


def _pair_oddities(left: np.ndarray, right: np.ndarray) -> list[str]:
    """What dense matches in both directions say about one pair, on reduced images."""
    scale = min(1.0, _CHECK_WIDTH_PX / left.shape[1])
    a, b = (
        (cv2.resize(_grey(image), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) * 255).astype(np.uint8)
        for image in (left, right)
    )
    if min(a.shape) < SMALLEST_SIDE_PX:
        return []
    matcher = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    forward, backward = matcher.calc(a, b, None), matcher.calc(b, a, None)
    y, x = np.indices(a.shape, np.float32)
    back = cv2.remap(backward, x + forward[..., 0], y + forward[..., 1], cv2.INTER_LINEAR, borderValue=(1e9, 1e9))
    consistent = np.linalg.norm(forward + back, axis=-1) < _CONSISTENT_PX
    if consistent.mean() < _FEWEST:
        return []
    u, v = (forward[consistent] / scale).T
    texts = []
    if np.median(u) > 1 and np.mean(u > 0.5) > 0.75:
        texts.append("look exchanged (left and right swapped): points lie further right in the right image")
    if abs(np.median(v)) > _ROWS_PX or np.mean(np.abs(v) > _ROWS_PX) > 0.5:
        texts.append(f"look unrectified: matches are {np.median(np.abs(v)):.1f} px apart in rows")
    return texts


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else np.ascontiguousarray(image[..., 0])
