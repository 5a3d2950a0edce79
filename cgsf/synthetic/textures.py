"""Textures with their smaller copies: procedural kinds from a seed, photographs from the user's folder.

A texture is square, a power of two wide, and repeats without a seam (photographs are mirrored at their border). The
procedural ones come from a bank: (kind, variant) names one texture for good, made when it is first asked for.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np

from cgsf.errors import InputError
from cgsf.synthetic import patterns

#: Variants of each procedural kind; materials change their colours, scale and angle, so that few go far.
VARIANTS = 24
#: Pixels of a procedural texture.
SIZE = 256
#: Pixels of a photograph after it has been read.
PHOTO_SIZE = 512
#: Variants of each kind, and photographs, that one scene chooses from.
VARIANTS_PER_SCENE, PHOTOS_PER_SCENE = 3, 6
_SEED = 20_190_512


@dataclass(frozen=True, eq=False)
class Texture:
    """A texture and its copies at 1/2, 1/4, ... down to one pixel.

    Parameters
    ----------
    levels : ndarray (K,) uint32
        All copies one after the other, row by row, the largest first; a texel is ``b + 256 g + 65536 r``.
    size : int
        Pixels of the largest copy, a power of two.
    mirrored : bool
        Repeat by mirroring, for pictures whose borders do not fit.
    """

    levels: np.ndarray
    size: int
    mirrored: bool = False

    @classmethod
    def of(cls, image: np.ndarray, mirrored: bool = False) -> "Texture":
        """The texture of a square uint8 BGR image whose width is a power of two."""
        size = image.shape[0]
        copies = [np.ascontiguousarray(image)]
        while copies[-1].shape[0] > 1:
            half = copies[-1].shape[0] // 2
            copies.append(cv2.resize(copies[-1], (half, half), interpolation=cv2.INTER_AREA).reshape(half, half, 3))
        texels = np.concatenate([copy.reshape(-1, 3) for copy in copies]).astype(np.uint32)
        return cls(texels[:, 0] | texels[:, 1] << 8 | texels[:, 2] << 16, size, mirrored)


@cache
def procedural(kind: str, variant: int) -> Texture:
    """Texture `variant` (0 ... VARIANTS - 1) of `kind`, a key of `patterns.KINDS`."""
    rng = np.random.default_rng([_SEED, sorted(patterns.KINDS).index(kind), variant])
    image = patterns.KINDS[kind](rng, SIZE)
    return Texture.of((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))


def photo_paths(folder: str | Path) -> tuple[Path, ...]:
    """The pictures of a folder, sorted by name.

    Raises
    ------
    InputError
        If the folder does not exist or holds no picture.
    """
    folder = Path(folder)
    paths = tuple(sorted(p for p in folder.glob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png")))
    if not paths:
        raise InputError(f"{folder}: no .jpg or .png pictures for textures in this folder")
    return paths


@lru_cache(maxsize=128)
def photo(path: Path) -> Texture:
    """The middle square of a picture as a mirrored texture."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: cannot be read as a picture")
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = image[top : top + side, left : left + side]
    if side != PHOTO_SIZE:
        way = cv2.INTER_AREA if side > PHOTO_SIZE else cv2.INTER_LINEAR
        square = cv2.resize(square, (PHOTO_SIZE, PHOTO_SIZE), interpolation=way)
    return Texture.of(square, mirrored=True)


class TextureSource:
    """Random textures for one scene, which has only a few of each kind, as real places do.

    Parameters
    ----------
    rng : numpy.random.Generator
    photos : str, Path or None
        A folder of pictures that are used beside the procedural textures.
    photo_share : float
        How often a picture is taken where any texture will do.
    """

    def __init__(self, rng: np.random.Generator, photos: str | Path | None = None, photo_share: float = 0.5) -> None:
        self.rng = rng
        paths = photo_paths(photos) if photos is not None else ()
        self.photos = [paths[i] for i in rng.integers(len(paths), size=PHOTOS_PER_SCENE)] if paths else []
        self.photo_share = photo_share if paths else 0.0
        self.variants = {kind: rng.integers(VARIANTS, size=VARIANTS_PER_SCENE) for kind in sorted(patterns.KINDS)}

    def kind(self, *names: str) -> Texture:
        """A random variant of one of the named kinds."""
        name = names[int(self.rng.integers(len(names)))]
        return procedural(name, int(self.variants[name][self.rng.integers(VARIANTS_PER_SCENE)]))

    def any(self, *names: str) -> Texture:
        """A picture now and then, otherwise one of the named kinds (all kinds if none is named)."""
        if self.rng.random() < self.photo_share:
            return photo(self.photos[int(self.rng.integers(len(self.photos)))])
        return self.kind(*(names or patterns.ANYWHERE))
