"""Samples made harder: what was easy to estimate becomes difficult where the truth is known.

A method is surest where its work was easy, so what it says there teaches nothing about telling right from wrong. In a
variant of the same images with pieces pasted in front (which hide and move on their own), texture taken away, reflections
in panes, exposed for too long or too short a time and with the borders moved inwards (behind which things leave), the truth
of the easy original is still the truth.

Related: the pasted, randomly moving pieces of Dosovitskiy et al., FlowNet, ICCV 2015 (FlyingChairs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from cgsf.datasets import Dataset, Sample, Truth
from cgsf.errors import InputError

_PIECES, _FLAT_PLACES, _PANES = (1, 4), (1, 3), (0, 2)  # numbers of, least and most
_PIECE_SIDE, _FLAT_SIDE, _PANE_SIDE = (0.08, 0.35), (0.15, 0.45), (0.05, 0.25)  # share of the image's height
_IN_FRONT_PX = (2.0, 30.0)  # disparity more than what lies behind
_BEHIND_PX, _MIRRORED = (2.0, 30.0), (0.3, 0.9)  # disparity less than the pane's; share of the light that is a reflection
_OWN_MOTION_PX = 15.0  # standard deviation
_CHANGE = 0.08  # largest change of a piece's disparity, relative
_FLAT_BLUR_PX = 8.0
_MISEXPOSED, _LIGHT = 0.5, (0.2, 2.5)  # share of the variants; least and largest factor on their light
_NOISE, _GAIN = 0.012, 0.05  # largest


class Harder:
    """A data set of `variants` harder versions of each sample of another one.

    Parameters
    ----------
    source : Dataset
    variants : int
    size : (int, int)
        Height and width of the windows that are cut, in pixels.
    """

    def __init__(self, source: Dataset, variants: int, size: tuple[int, int]) -> None:
        self.variants, self.size = variants, size
        self.names = [f"{name}-harder{k}" for name in source.names for k in range(variants)]
        self._read = lru_cache(maxsize=1)(source.__getitem__)  # making a sample's truth may take long

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        easy = self._read(index // self.variants)
        if easy.truth is None:
            raise InputError(f"{easy.name} has no truth: only what is known can be made harder")
        return replace(_harder(easy, self.size, np.random.default_rng([index])), name=self.names[index])


class _Views:
    """Four images and the truth, as arrays that pieces are pasted into."""

    def __init__(self, sample: Sample, size: tuple[int, int], rng: np.random.Generator) -> None:
        height, width = sample.left1.shape[:2]
        if height < size[0] or width < size[1]:
            raise InputError(f"{sample.name}: {width} x {height} pixels do not fill {size[1]} x {size[0]}")
        top, left = int(rng.integers(height - size[0] + 1)), int(rng.integers(width - size[1] + 1))
        rows, columns = slice(top, top + size[0]), slice(left, left + size[1])
        self.whole = sample.left1
        self.images = [image[rows, columns].copy() for image in sample.images]
        truth = sample.truth
        assert truth is not None
        maps = (truth.disparity1, truth.disparity2, truth.disparity_left2, truth.flow)
        unknown = np.full((height, width), np.nan, np.float32)
        self.d1, self.d2, self.d_left2, flow = (
            (unknown if each is None else each)[rows, columns].copy() for each in maps
        )  # fmt: skip
        self.flow = flow if flow.ndim == 3 else np.stack([flow, flow], -1)

    def typical(self, mask: np.ndarray) -> tuple[float, float, float, float] | None:
        """Nearest disparity at time 1, its change, and the flow (u, v) in a place, in pixels; None where nothing is known."""
        known = mask & np.isfinite(self.d1 + self.d2 + self.flow.sum(-1))
        if not known.any():
            return None
        change, (u, v) = np.median((self.d2 - self.d1)[known]), np.median(self.flow[known], 0)
        return float(np.percentile(self.d1[known], 95)), float(change), float(u), float(v)


def _harder(sample: Sample, size: tuple[int, int], rng: np.random.Generator) -> Sample:
    views = _Views(sample, size, rng)
    for _ in range(rng.integers(_FLAT_PLACES[0], _FLAT_PLACES[1] + 1)):
        _flatten(views, rng)
    for _ in range(rng.integers(_PANES[0], _PANES[1] + 1)):
        _reflect(views, rng)
    for _ in range(rng.integers(_PIECES[0], _PIECES[1] + 1)):
        _paste(views, rng)
    light = np.exp(rng.uniform(*np.log(_LIGHT))) if rng.random() < _MISEXPOSED else 1.0
    for i, image in enumerate(views.images):
        gain = light * (1 + _GAIN * rng.uniform(-1, 1))
        noise = rng.uniform(0, _NOISE) * rng.standard_normal(image.shape)
        views.images[i] = np.clip(gain * image + noise, 0, 1).astype(np.float32)
    truth = Truth(views.d1, views.d2, views.flow, disparity_left2=views.d_left2)
    left1, right1, left2, right2 = views.images
    return Sample(sample.name, left1, right1, left2, right2, None, truth)


def _flatten(views: _Views, rng: np.random.Generator) -> None:
    """Take the texture of an oval place away, in all images where it is seen, as far as its middle value tells."""
    mask = _oval(views.d1.shape, _FLAT_SIDE, rng)
    typical = views.typical(mask > 0)
    if typical is None:
        return
    d, change, u, v = typical
    mask = cv2.GaussianBlur(mask, (0, 0), 4) * rng.uniform(0.7, 1)
    for i, (x, y) in enumerate(_shifts(d, d + change, u, v)):
        share = _shifted(mask, x, y)[..., None]
        smooth = cv2.GaussianBlur(views.images[i], (0, 0), _FLAT_BLUR_PX).reshape(views.images[i].shape)
        views.images[i] += share * (smooth - views.images[i])


def _reflect(views: _Views, rng: np.random.Generator) -> None:
    """Let a rectangle of a surface mirror something: what is seen lies behind it and moves on its own, and is not there."""
    shape = views.d1.shape
    pane = np.zeros(shape, np.float32)
    height, width = (max(4, round(shape[0] * rng.uniform(*_PANE_SIDE))) for _ in range(2))
    top, left = int(rng.integers(max(1, shape[0] - height))), int(rng.integers(max(1, shape[1] - width)))
    pane[top : top + height, left : left + width] = rng.uniform(*_MIRRORED)
    typical = views.typical(pane > 0)
    if typical is None:
        return
    d, change, u, v = typical
    behind = max(0.0, d - rng.uniform(*_BEHIND_PX))
    own = u + _OWN_MOTION_PX * rng.standard_normal(), v + _OWN_MOTION_PX * rng.standard_normal()
    mirrored = _elsewhere(views, rng)
    surface = _shifts(d, d + change, u, v)
    for i, seen in enumerate(_shifts(behind, behind + change, *own)):
        share = _shifted(pane, *surface[i])[..., None]
        views.images[i] += share * (_shifted(mirrored, *seen).reshape(mirrored.shape) - views.images[i])


def _paste(views: _Views, rng: np.random.Generator) -> None:
    """Put an oval piece of the sample's own left1 in front of everything else, at one disparity, moving on its own."""
    shape = views.d1.shape
    mask = _oval(shape, _PIECE_SIDE, rng)
    typical = views.typical(mask > 0)
    if typical is None:
        return
    d, _, u, v = typical
    d += rng.uniform(*_IN_FRONT_PX)
    d2 = d * (1 + _CHANGE * rng.uniform(-1, 1))
    u, v = u + _OWN_MOTION_PX * rng.standard_normal(), v + _OWN_MOTION_PX * rng.standard_normal()
    texture = np.clip(_elsewhere(views, rng), 0, 1)
    alphas = []
    for i, (x, y) in enumerate(_shifts(d, d2, u, v)):
        alphas.append(_shifted(mask, x, y))
        views.images[i] += alphas[i][..., None] * (_shifted(texture, x, y).reshape(texture.shape) - views.images[i])
    here, there = alphas[0] > 0.5, alphas[2] > 0.5
    views.d1[here], views.d2[here], views.flow[here] = d, d2, (u, v)
    views.d_left2[there] = d2


def _elsewhere(views: _Views, rng: np.random.Generator) -> np.ndarray:
    """Another window of the sample's own left1, mirrored, darker or brighter."""
    parts = zip(views.whole.shape, views.d1.shape, strict=False)
    top, left = (int(rng.integers(full - part + 1)) for full, part in parts)
    window = views.whole[top : top + views.d1.shape[0], left : left + views.d1.shape[1]]
    return window[:, ::-1] * rng.uniform(0.7, 1.3)


def _shifts(d1: float, d2: float, u: float, v: float) -> Sequence[tuple[float, float]]:
    """Where left1's point goes in left1, right1, left2 and right2: (x, y) in pixels."""
    return (0.0, 0.0), (-d1, 0.0), (u, v), (u - d2, v)


def _shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    matrix = np.array([[1, 0, x], [0, 1, y]])
    return cv2.warpAffine(image, matrix, image.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _oval(shape: tuple[int, ...], side: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """A random ellipse, (H, W) float32, 1 inside."""
    height, width = shape[:2]
    mask = np.zeros((height, width), np.float32)
    centre = int(rng.integers(width)), int(rng.integers(height))
    axes = tuple(max(2, round(0.5 * height * rng.uniform(*side))) for _ in range(2))
    cv2.ellipse(mask, centre, axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
    return mask
