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
    matrix = np.empty((3, 4))
    matrix.T[:3], matrix.T[3] = bgr * 2 * texture_share / 3, bgr * (1 - texture_share)
    return matrix


def finish(rng: np.random.Generator) -> dict[str, float]:
    """Highlights and mirrors: most surfaces are dull, some are painted, a few are polished."""
    kind = rng.random()
    if kind < 0.55:
        return {}
    if kind < 0.9:
        return {"specular": rng.uniform(0.05, 0.5), "shininess": float(np.exp(rng.uniform(1.5, 4.5)))}
    return {
        "specular": rng.uniform(0.3, 1.2),
        "shininess": float(np.exp(rng.uniform(3.5, 5.5))),
        "mirror": rng.uniform(0.2, 0.8),
    }


def surface(source: TextureSource, repeat_m: float, *kinds: str) -> Material:
    """Any surface: a texture (one of `kinds`, or any) that repeats after about `repeat_m` metres, recoloured."""
    rng = source.rng
    texture = source.any(*kinds)
    return Material(
        texture,
        recolored(rng),
        scale=1 / (repeat_m * np.exp(rng.normal(0, 0.4))),
        turn=float(rng.integers(4)) * np.pi / 2 + rng.normal(0, 0.1),
        offset=tuple(rng.random(2)),
        detail=source.kind("grain", "clouds", "cells", "marble"),
        detail_scale=rng.uniform(4, 8) / repeat_m,
        detail_strength=rng.uniform(0.0, 0.6),
        **finish(rng),
    )


def upright(
    source: TextureSource,
    repeat_m: float,
    *kinds: str,
    recolor: bool = True,
    detail: float = 0.4,
    detail_m: float = 0.8,
) -> Material:
    """A surface whose texture stands upright and keeps its scale: walls, pavings, roads."""
    rng = source.rng
    matrix = recolored(rng) if recolor else np.eye(3, 4) * rng.uniform(0.8, 1.1)
    return Material(
        source.kind(*kinds), matrix, 1 / (repeat_m * rng.uniform(0.8, 1.25)), 0.0, tuple(rng.random(2)),
        source.kind("grain", "clouds"), 1 / detail_m, detail,
    )  # fmt: skip


def paint(
    rng: np.random.Generator, bgr: np.ndarray | None = None, gloss: float = 0.0, mirror: float = 0.0, glow: float = 0.0
) -> Material:
    """One colour with hardly any texture."""
    bgr = color(rng) if bgr is None else np.asarray(bgr, float)
    texture = procedural("clouds", int(rng.integers(24)))
    return Material(
        texture,
        tinted(bgr, rng.uniform(0.02, 0.2)),
        rng.uniform(0.3, 1.0),
        specular=gloss,
        shininess=60.0,
        mirror=mirror,
        glow=glow,
    )


def foliage(source: TextureSource) -> Material:
    """Leaves in the colours of the seasons."""
    rng = source.rng
    tint = np.array([rng.uniform(0.4, 0.9), 1.0, rng.uniform(0.5, 1.1)]) * rng.uniform(0.5, 1.2)
    if rng.random() < 0.15:
        tint = np.array([0.5, rng.uniform(0.6, 0.9), 1.3])
    return Material(source.kind("foliage"), np.eye(3, 4) * tint[:, None], rng.uniform(0.7, 1.6), 0.0, tuple(rng.random(2)))


class Wardrobe:
    """The materials of a street's props: some are shared by all copies, lacquers and coats are made for each."""

    def __init__(self, source: TextureSource) -> None:
        rng = self.rng = source.rng
        self.source = source
        bark = tinted(np.array([0.2, 0.28, 0.36]) * rng.uniform(0.5, 1.4), 0.6)
        self.shared = {
            "dark": paint(rng, np.full(3, rng.uniform(0.02, 0.1))),
            "glass": paint(rng, np.full(3, rng.uniform(0.03, 0.16)), 0.8, rng.uniform(0.4, 1.0)),
            "rim": paint(rng, np.full(3, rng.uniform(0.3, 0.8)), 0.5, 0.3),
            "white": paint(rng, np.array([0.9, 0.95, 1.0]), 0.5, 0.2, rng.uniform(0, 0.6)),
            "red": paint(rng, np.array([0.05, 0.05, 0.75]), 0.5, 0.2, rng.uniform(0, 0.6)),
            "plate": Material(source.kind("text"), tinted(np.full(3, 0.85), 0.9), 2.0, 0.0, tuple(rng.random(2))),
            "bark": Material(source.kind("wood", "marble", "grain"), bark, 1.5, np.pi / 2),
            "metal": paint(rng, np.full(3, rng.uniform(0.05, 0.65)), 0.3),
            "lamp": paint(rng, np.full(3, 0.8), glow=float(rng.choice([0, 1.0]))),
            "wood": Material(source.kind("wood"), np.eye(3, 4), 0.8),
            "stone": upright(source, rng.uniform(1, 2.5), "masonry", "grain", "cells", "rust"),
            "leaf": foliage(source),
        }  # fmt: skip

    def lacquer(self) -> Material:
        """Car paint: white to grey, black, loud, or any colour."""
        rng = self.rng
        light, dark = np.full(3, rng.uniform(0.4, 0.95)), np.full(3, rng.uniform(0.03, 0.15))
        loud, any_color = color(rng, 0.9, rng.uniform(0.25, 0.8)), color(rng, rng.uniform(0.1, 0.6))
        bgr = (light, dark, loud, any_color)[int(rng.choice(4, p=[0.35, 0.2, 0.2, 0.25]))]
        return paint(rng, bgr, rng.uniform(0.3, 1.2), rng.uniform(0.2, 0.7))

    def vehicle(self) -> dict[str, Material]:
        """Materials of a car, a truck or a bicycle with its rider."""
        rng, source = self.rng, self.source
        load = paint(rng, None, 0.3, 0.2)
        if rng.random() < 0.5:
            picture = source.any("text", "stripes", "facade", "leaves")
            load = Material(picture, np.eye(3, 4), rng.uniform(0.15, 0.5), 0.0, tuple(rng.random(2)), specular=0.2)
        return self.shared | {"body": self.lacquer(), "load": load} | self.clothes()

    def clothes(self) -> dict[str, Material]:
        """Materials of a person."""
        rng = self.rng
        coat = self.source.any("stripes", "plain", "clouds", "checks", "leaves")
        return {
            "coat": Material(coat, np.eye(3, 4) * rng.uniform(0.4, 1.0), 1.5, 0.0, tuple(rng.random(2))),
            "trousers": paint(rng, color(rng, 0.3, rng.uniform(0.05, 0.4))),
            "skin": paint(rng, np.array([0.45, 0.55, 0.75]) * rng.uniform(0.35, 1.1)),
            "hair": paint(rng, color(rng, 0.5, rng.uniform(0.03, 0.4))),
        }

    def roadside(self) -> dict[str, Material]:
        """Materials of poles, signs, bins, plants and fences."""
        rng, source = self.rng, self.source
        body = paint(rng, None, 0.2)
        if rng.random() < 0.4:
            body = Material(source.kind("stripes", "rust", "text", "dots"), np.eye(3, 4), 1.2)
        return self.shared | {
            "body": body,
            "frame": paint(rng, color(rng, 0.95, 0.75)),
            "face": Material(source.any("text"), tinted(color(rng, float(rng.choice([0.0, 0.9])), 0.9), 0.3), 1.4),
            "leaf": self.shared["leaf"] if rng.random() < 0.7 else foliage(source),
        }
