"""Random materials: a texture, its colours, and how the surface answers to light."""

import numpy as np

from cgsf.synthetic.patterns import color
from cgsf.synthetic.scene import Material
from cgsf.synthetic.textures import TextureSource, procedural


def recolored(rng: np.random.Generator) -> np.ndarray:
    """A random affine colour change (3, 4): channels exchanged, greyed, tinted, flattened or left alone."""
    matrix = np.eye(3)
    if rng.random() < 0.4:
        matrix = matrix[rng.permutation(3)]
    saturation = rng.uniform(0.2, 1.3)
    matrix = saturation * matrix + (1 - saturation) / 3
    matrix = matrix * (1 + 0.2 * rng.standard_normal((3, 1)))
    contrast, level = rng.uniform(0.35, 1.2), rng.uniform(0.3, 0.65)
    return np.concatenate([contrast * matrix, np.full((3, 1), level * (1 - contrast))], 1)


def tinted(bgr: np.ndarray, texture_share: float = 0.3) -> np.ndarray:
    """The colour change (3, 4) that turns any texture into `bgr` (3,) with a grey trace of the texture."""
    bgr = np.asarray(bgr, float)
    return np.concatenate([np.repeat(bgr[:, None] * 2 * texture_share / 3, 3, 1), bgr[:, None] * (1 - texture_share)], 1)


def finish(rng: np.random.Generator) -> dict[str, float]:
    """Highlights and mirrors: most surfaces are dull, some are painted, a few are polished."""
    kind = rng.random()
    if kind < 0.55:
        return {}
    if kind < 0.9:
        return {"specular": rng.uniform(0.05, 0.5), "shininess": float(np.exp(rng.uniform(1.5, 4.5)))}
    return {"specular": rng.uniform(0.3, 1.2), "shininess": float(np.exp(rng.uniform(3.5, 5.5))), "mirror": rng.uniform(0.2, 0.8)}


def surface(source: TextureSource, repeat_m: float, *kinds: str) -> Material:
    """Any surface: a texture (one of `kinds`, or any) that repeats after about `repeat_m` metres, recoloured."""
    rng = source.rng
    texture = source.any(*kinds)
    return Material(
        texture, recolored(rng), 1 / (repeat_m * np.exp(rng.normal(0, 0.4))), float(rng.integers(4)) * np.pi / 2 + rng.normal(0, 0.1),
        tuple(rng.random(2)), source.kind("grain", "clouds", "cells", "marble"), rng.uniform(4, 8) / repeat_m,
        rng.uniform(0.0, 0.6), **finish(rng),
    )  # fmt: skip


def upright(source: TextureSource, repeat_m: float, *kinds: str, recolor: bool = True, detail: float = 0.4, detail_m: float = 0.8) -> Material:
    """A surface whose texture stands upright and keeps its scale: walls, pavings, roads."""
    rng = source.rng
    matrix = recolored(rng) if recolor else np.eye(3, 4) * rng.uniform(0.8, 1.1)
    return Material(
        source.kind(*kinds), matrix, 1 / (repeat_m * rng.uniform(0.8, 1.25)), 0.0, tuple(rng.random(2)),
        source.kind("grain", "clouds"), 1 / detail_m, detail,
    )  # fmt: skip


def paint(rng: np.random.Generator, bgr: np.ndarray | None = None, gloss: float = 0.0, mirror: float = 0.0, glow: float = 0.0) -> Material:
    """One colour with hardly any texture."""
    bgr = color(rng) if bgr is None else np.asarray(bgr, float)
    texture = procedural("clouds", int(rng.integers(24)))
    return Material(texture, tinted(bgr, rng.uniform(0.02, 0.2)), rng.uniform(0.3, 1.0), specular=gloss, shininess=60.0, mirror=mirror, glow=glow)
