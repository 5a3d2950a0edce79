"""Augmentation of stereo pairs of pairs: what keeps rows aligned and the truth exact.

Crops with a random zoom, vertical mirroring, and changes of light and colour, a part of them different for each of the
four images (two cameras, two moments). Left and right are never mirrored: disparities would change their sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from learned.batch import Batch

# per channel of the state, the axis that it is measured along
_ALONG_X = (True, True, True, True, False)


@dataclass(frozen=True)
class AugmentConfig:
    """Strengths; the amount is drawn anew for every sample."""

    height: int = 256
    """Crop in pixels."""
    width: int = 448
    """Crop in pixels."""
    zoom: float = 0.3
    """Largest enlargement of the crop as a natural logarithm; 0 leaves pixels as they are."""
    stretch: float = 0.1
    """Largest difference of the zoom between x and y (logarithm)."""
    flip: bool = True
    """Mirror at a horizontal line, every second time."""
    colour: float = 0.2
    """Brightness, contrast, gamma and colour gains change by factors exp(-colour) ... exp(colour)."""
    unequal: float = 0.3
    """Share of the colour change that is drawn for each of the four images apart."""
    noise: float = 0.02
    """Largest standard deviation of added noise, in the images' unit."""
    erase: float = 0.3
    """How often a rectangle of right1, left2 or right2 is replaced by the image's mean colour: hidden pixels."""


def augment(batch: Batch, config: AugmentConfig, generator: Generator) -> Batch:
    """Crop and change every sample of a batch; the truth, the start and the backward flow follow.

    The images may be bytes; they become floating point.
    """
    return Batch.cat([_augment_one(batch[i], config, generator) for i in range(len(batch))])


def crop(batch: Batch, top: int, left: int, height: int, width: int) -> Batch:
    """The same window of every map."""
    window = batch.map(lambda maps: maps[..., top : top + height, left : left + width])
    return _recoordinated(window, (1, -left), (1, -top))


def _recoordinated(batch: Batch, x: tuple[float, float], y: tuple[float, float]) -> Batch:
    """The camera's motion after pixels (x, y) have gone to (x[0] x + x[1], y[0] y + y[1]); disparities scale along x."""
    if batch.homography is None:
        return batch
    change = torch.eye(4, dtype=batch.homography.dtype)
    change[0, 0], change[0, 3], change[1, 1], change[1, 3], change[2, 2] = x[0], x[1], y[0], y[1], x[0]
    return replace(batch, homography=change @ batch.homography @ change.inverse())


def _augment_one(sample: Batch, config: AugmentConfig, generator: Generator) -> Batch:
    sample = _zoomed_crop(sample, config, generator)
    images = _recolour(sample.images[0], config, generator)
    if _uniform(generator) < config.erase:
        _erase(images[1 + int(3 * _uniform(generator))], generator)
    sample = replace(sample, images=images[None].clamp(0, 1))
    return _mirrored(sample) if config.flip and _uniform(generator) < 0.5 else sample


def _zoomed_crop(sample: Batch, config: AugmentConfig, generator: Generator) -> Batch:
    height, width = sample.images.shape[-2:]
    if height < config.height or width < config.width:
        raise ValueError(f"samples of {width} x {height} pixels are smaller than the crop of {config.width} x {config.height}")
    zoom, stretch = config.zoom * _uniform(generator), config.stretch * (_uniform(generator) - 0.5)
    # enlarging takes a smaller window; it never leaves the image
    window_h = min(height, round(config.height * math.exp(-zoom - stretch)))
    window_w = min(width, round(config.width * math.exp(-zoom + stretch)))
    top = int((height - window_h + 1) * _uniform(generator))
    left = int((width - window_w + 1) * _uniform(generator))
    sample = crop(sample, top, left, window_h, window_w)
    if sample.images.dtype == torch.uint8:  # converted here, when it is small
        sample = replace(sample, images=sample.images.float() / 255)
    return resized(sample, (config.height, config.width))


def resized(batch: Batch, size: tuple[int, int]) -> Batch:
    """All maps at another size, values in pixels of the new grid; truth by its nearest pixel, so that edges stay
    edges."""
    height, width = batch.images.shape[-2:]
    if (height, width) == size:
        return batch
    sx, sy = size[1] / width, size[0] / height
    factors = batch.images.new_tensor([sx if along_x else sy for along_x in _ALONG_X])[:, None, None]

    def smooth(maps: Tensor) -> Tensor:
        return F.interpolate(maps, size, mode="bilinear", align_corners=False, antialias=sx < 1 or sy < 1)

    def nearest(maps: Tensor | None, scale: Tensor | None) -> Tensor | None:
        if maps is None:
            return None
        maps = F.interpolate(maps, size, mode="nearest-exact")
        return maps if scale is None else maps * scale

    images = smooth(batch.images.flatten(0, 1)).unflatten(0, batch.images.shape[:2])
    return replace(
        _recoordinated(batch, (sx, (sx - 1) / 2), (sy, (sy - 1) / 2)),
        images=images,
        truth=nearest(batch.truth, factors),
        start=nearest(batch.start, factors),
        backward_flow=nearest(batch.backward_flow, factors[3:]),
        evidence=nearest(batch.evidence, None),
    )


def _mirrored(batch: Batch) -> Batch:
    """Upside down: rows in reverse order, vertical motion with the other sign."""

    def flip(maps: Tensor | None, vertical: int | None) -> Tensor | None:
        if maps is None:
            return None
        maps = maps.flip(-2)
        if vertical is not None:
            maps[:, vertical] *= -1
        return maps

    images = batch.images.flip(-2)
    return replace(
        _recoordinated(batch, (1, 0), (-1, images.shape[-2] - 1)),
        images=images,
        truth=flip(batch.truth, 4),
        start=flip(batch.start, 4),
        backward_flow=flip(batch.backward_flow, 1),
        evidence=flip(batch.evidence, None),
    )


def _recolour(images: Tensor, config: AugmentConfig, generator: Generator) -> Tensor:
    """(4, 3, H, W) with one change for all four and a smaller one for each."""

    def factor(*shape: int) -> Tensor:
        common = 2 * torch.rand((1, *shape[1:]), generator=generator) - 1
        own = 2 * torch.rand(shape, generator=generator) - 1
        return torch.exp(config.colour * (common + config.unequal * own))

    images = images.clamp(min=1e-4) ** factor(4, 1, 1, 1)
    mean = images.mean((-2, -1), keepdim=True)
    images = (images - mean) * factor(4, 1, 1, 1) + mean * factor(4, 3, 1, 1)
    deviation = config.noise * _uniform(generator)
    return images + deviation * torch.randn(images.shape, generator=generator)


def _erase(image: Tensor, generator: Generator) -> None:
    height, width = image.shape[-2:]
    h, w = (int(side * (0.1 + 0.25 * _uniform(generator))) for side in (height, width))
    top, left = int((height - h) * _uniform(generator)), int((width - w) * _uniform(generator))
    image[:, top : top + h, left : left + w] = image.mean((-2, -1), keepdim=True)


def _uniform(generator: Generator) -> float:
    return float(torch.rand((), generator=generator))
