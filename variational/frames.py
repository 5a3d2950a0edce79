"""The four images of one problem: two rectified stereo pairs, validated once so that nothing below has to."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np


@dataclass(frozen=True, eq=False)
class Frames:
    """Two rectified stereo pairs of equal size.

    Parameters
    ----------
    left1, right1, left2, right2 : np.ndarray
        ``(H, W, c)``, c = 1 or 3 (BGR), C-contiguous, float32 in [0, 1]. All four may be float64 instead, for checks
        that need the digits.

    Raises
    ------
    ValueError
        In one line that names the image, where one is not such an array, or where the four differ in size or type.
    """

    left1: np.ndarray
    right1: np.ndarray
    left2: np.ndarray
    right2: np.ndarray

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_image(field.name, getattr(self, field.name))
        for name in ("right1", "left2", "right2"):
            image = getattr(self, name)
            if image.shape != self.left1.shape:
                raise ValueError(f"the four images must have one size: left1 {self.left1.shape}, {name} {image.shape}")
            if image.dtype != self.left1.dtype:
                raise ValueError(f"the four images must have one type: left1 {self.left1.dtype}, {name} {image.dtype}")

    @property
    def shape(self) -> tuple[int, int]:
        """``(H, W)`` in pixels."""
        return self.left1.shape[:2]

    @property
    def dtype(self) -> np.dtype:
        """float32 or float64."""
        return self.left1.dtype

    @cached_property
    def grey(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """left1, right1, left2, right2 as (H, W) float32 grey images, made once."""
        left1, right1, left2, right2 = (_to_grey(getattr(self, field.name)) for field in fields(self))
        return left1, right1, left2, right2

    def reversed(self) -> Frames:
        """The same four images with time 1 and time 2 exchanged (for the backward flow)."""
        return Frames(self.left2, self.right2, self.left1, self.right1)

    def astype(self, dtype: np.dtype | type) -> Frames:
        """The four images in `dtype`; without a copy where they have it already."""
        return self if self.dtype == dtype else Frames(*(getattr(self, f.name).astype(dtype) for f in fields(self)))


def _to_grey(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image, np.float32)
    return np.ascontiguousarray(image[..., 0]) if image.shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _check_image(name: str, image: np.ndarray) -> None:
    if not isinstance(image, np.ndarray) or image.dtype not in (np.float32, np.float64):
        kind = getattr(image, "dtype", type(image).__name__)
        raise ValueError(f"{name} must be a float32 array in [0, 1], not {kind}; divide integers by their maximum")
    if image.ndim != 3 or image.shape[2] not in (1, 3):
        raise ValueError(f"{name} must have shape (H, W, 1) or (H, W, 3), not {image.shape}")
    if image.size == 0:
        raise ValueError(f"{name} is empty: {image.shape}")
    if not image.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous: pass it through numpy.ascontiguousarray")
    low, high = image.min(), image.max()
    if not (low >= 0 and high <= 1):  # also catches NaN, which compares false
        raise ValueError(f"{name} must be finite and in [0, 1], found values from {low:g} to {high:g}")
