"""Image pyramids: the same four images at ever coarser sizes, anti-aliased, for any size and any factor."""

from __future__ import annotations

import cv2
import numpy as np

from variational.frames import Frames


def pyramid_shapes(shape: tuple[int, int], factor: float = 0.5, smallest: int = 16) -> list[tuple[int, int]]:
    """Sizes of a pyramid's levels, finest first.

    Parameters
    ----------
    shape : tuple of int
        ``(H, W)`` of the finest level, always the first entry.
    factor : float
        Ratio of a level's sides to those of the next finer one, in (0, 1); nearer to 1 gives more levels.
    smallest : int
        No further level has a side shorter than this, in pixels.
    """
    if not 0 < factor < 1:
        raise ValueError(f"the pyramid's factor must lie between 0 and 1, got {factor}")
    shapes = [(int(shape[0]), int(shape[1]))]
    while True:
        scale = factor ** len(shapes)
        height, width = round(shape[0] * scale), round(shape[1] * scale)
        if min(height, width) < max(smallest, 1) or (height, width) == shapes[-1]:
            return shapes
        shapes.append((height, width))


def resize_image(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """An ``(H, W, c)`` image at another size, ``(*shape, c)`` of the same type, C-contiguous.

    Shrinking sides are anti-aliased by the mean over the covered area, growing ones bilinear; outer edges coincide.
    """
    if image.shape[:2] == tuple(shape):
        return image
    shrinks = shape[0] <= image.shape[0] and shape[1] <= image.shape[1]
    resized = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.clip(resized.reshape(*shape, image.shape[2]), 0, 1)  # sums of areas may round to a hair above 1


def image_pyramid(image: np.ndarray, shapes: list[tuple[int, int]]) -> list[np.ndarray]:
    """The image at each size, each level made from the next finer one; `shapes` from fine to coarse."""
    levels: list[np.ndarray] = []
    for shape in shapes:
        levels.append(resize_image(levels[-1] if levels else image, shape))
    return levels


def frames_pyramid(frames: Frames, shapes: list[tuple[int, int]]) -> list[Frames]:
    """The four images at each size; `shapes` from fine to coarse."""
    images = (frames.left1, frames.right1, frames.left2, frames.right2)
    return [Frames(*level) for level in zip(*(image_pyramid(image, shapes) for image in images), strict=True)]
