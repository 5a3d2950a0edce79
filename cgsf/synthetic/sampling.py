"""Textures at many points at once: which of the smaller copies suits a pixel's footprint, and its bilinear value.

All textures of a scene lie one after the other in an atlas of texels ``b + 256 g + 65536 r``. The loops are split so
that each is either free of branches, and then runs in vectors, or does little more than copy.
"""

from collections.abc import Sequence

import numpy as np

from cgsf.synthetic.textures import Texture
from variational.jit import rowwise

#: Copies of the largest texture that is allowed, 4096 pixels wide.
_COPIES = 13
#: Samples that one lookup takes at the most.
MOST_SAMPLES = 3

#: Where a texture's copies begin in the atlas, the number of its last copy, its width, whether it repeats mirrored.
TEXTURE = np.dtype(
    [("start", np.int32, (_COPIES,)), ("last", np.int32), ("size", np.int32), ("mirrored", np.bool_)], align=True
)


def pack(textures: Sequence[Texture]) -> tuple[np.ndarray, np.ndarray]:
    """The records (T,) of TEXTURE and the atlas (K,) int32 of some textures."""
    records, start = np.zeros(len(textures), TEXTURE), 0
    for record, texture in zip(records, textures, strict=True):
        last = texture.size.bit_length() - 1
        areas = [texture.size**2 >> 2 * copy for copy in range(last)]
        record["start"][: last + 1] = start + np.cumsum([0, *areas])
        record["last"], record["size"], record["mirrored"] = last, texture.size, texture.mirrored
        start += len(texture.levels)
    return records, np.concatenate([texture.levels for texture in textures]).view(np.int32)


@rowwise
def _choose(
    count: int, textures: np.ndarray, texture: np.ndarray, texels: np.ndarray, taps: np.ndarray, several: bool,
    copy: np.ndarray, mix: np.ndarray, samples: np.ndarray,
) -> None:  # fmt: skip
    """The copy that has one to two texels under the pixel, or the next; `mix` > 0 is the share of the next."""
    for i in range(count):
        x, last = np.float64(texels[i]), textures[texture[i]].last
        level = min(max((x.view(np.int64) >> 52) - 1023, 0), last)  # the logarithm's whole part: a double's exponent
        beyond = x * np.int64((1023 - level) << 52).view(np.float64) - 1.0
        mixed = several & (taps[i] == 1)
        stays = (level == last) | (beyond < (0.2 if mixed else 0.5))
        moves = (not stays) & ((beyond > 0.8) | (not mixed))
        copy[i] = level + moves
        mix[i] = 0.0 if (stays | moves) else beyond
        samples[i] = taps[i] if (stays | moves) else 2


@rowwise
def _first(
    count: int, textures: np.ndarray, texture: np.ndarray, u: np.ndarray, v: np.ndarray, step_u: np.ndarray,
    step_v: np.ndarray, taps: np.ndarray, copy: np.ndarray, mix: np.ndarray, at_u: np.ndarray, at_v: np.ndarray,
    start: np.ndarray, size: np.ndarray, mirror: np.ndarray, weight: np.ndarray,
) -> None:  # fmt: skip
    """The first sample of every lookup."""
    for i in range(count):
        t, n = texture[i], taps[i]
        along = 0.5 / n - 0.5
        at_u[i], at_v[i] = u[i] + along * step_u[i], v[i] + along * step_v[i]
        start[i] = textures[t].start[copy[i]]
        size[i] = textures[t].size >> copy[i]
        mirror[i] = textures[t].mirrored
        weight[i] = (1.0 - mix[i]) / (255.0 * 4096.0 * n)


@rowwise
def _list(count: int, samples: np.ndarray, sample: int, owner: np.ndarray) -> int:
    """The lookups that take more samples than `sample`; returns how many. One too many is written: cheaper than a branch."""
    place = 0
    for i in range(count):
        owner[place] = i
        place += samples[i] > sample
    return place


@rowwise
def _other(
    count: int, owner: np.ndarray, third: bool, textures: np.ndarray, texture: np.ndarray, u: np.ndarray, v: np.ndarray,
    step_u: np.ndarray, step_v: np.ndarray, taps: np.ndarray, copy: np.ndarray, mix: np.ndarray, at_u: np.ndarray,
    at_v: np.ndarray, start: np.ndarray, size: np.ndarray, mirror: np.ndarray, weight: np.ndarray,
) -> None:  # fmt: skip
    """The second or third sample of some lookups."""
    for k in range(count):
        i = owner[k]
        share = mix[i]
        mixed = share > 0.0
        width = 0.0 if mixed else 1.0 / taps[i]
        along = 0.0 if mixed else 1.5 * width - 0.5
        along += width if third else 0.0
        t, own = texture[i], copy[i] + mixed
        at_u[k], at_v[k] = u[i] + along * step_u[i], v[i] + along * step_v[i]
        start[k] = textures[t].start[own]
        size[k] = textures[t].size >> own
        mirror[k] = textures[t].mirrored
        weight[k] = (share if mixed else width) / (255.0 * 4096.0)


@rowwise
def _bilinear(
    count: int, atlas: np.ndarray, start: np.ndarray, size: np.ndarray, mirror: np.ndarray, u: np.ndarray, v: np.ndarray,
    blue: np.ndarray, green: np.ndarray, red: np.ndarray,
) -> None:  # fmt: skip
    """Bilinear values in 1 / (255 * 4096) at (u, v) in repeats; pixel centres lie at halves."""
    for i in range(count):
        side, whole = size[i], np.float64(size[i])
        x, y = u[i] * whole - 0.5, v[i] * whole - 0.5
        fx, fy = np.floor(x), np.floor(y)
        x0, y0 = np.int32(fx), np.int32(fy)
        last = np.int32(2 * side - 1 if mirror[i] else side - 1)
        back = np.int32(last if mirror[i] else 4 * side)  # beyond any column: nothing is turned back
        x1, y1 = np.int32((x0 + 1) & last), np.int32((y0 + 1) & last)
        x0, y0 = np.int32(x0 & last), np.int32(y0 & last)
        x0, x1 = np.int32(min(x0, back - x0)), np.int32(min(x1, back - x1))
        y0, y1 = np.int32(min(y0, back - y0)), np.int32(min(y1, back - y1))
        ax, ay = 4096.0 * (x - fx), y - fy
        w11 = np.floor(ax * ay)  # whole numbers of 1/4096
        w01, w10 = np.floor(ax) - w11, np.floor(4096.0 * ay) - w11
        w00 = max(4096.0 - w01 - w10 - w11, 0.0)
        upper, lower = np.int32(start[i] + y0 * side), np.int32(start[i] + y1 * side)
        a, b = atlas[np.int32(upper + x0)], atlas[np.int32(upper + x1)]
        c, d = atlas[np.int32(lower + x0)], atlas[np.int32(lower + x1)]
        blue[i] = w00 * np.int32(a & 255) + w01 * np.int32(b & 255) + w10 * np.int32(c & 255) + w11 * np.int32(d & 255)
        a, b, c, d = np.int32(a >> 8), np.int32(b >> 8), np.int32(c >> 8), np.int32(d >> 8)
        green[i] = w00 * np.int32(a & 255) + w01 * np.int32(b & 255) + w10 * np.int32(c & 255) + w11 * np.int32(d & 255)
        a, b, c, d = np.int32(a >> 8), np.int32(b >> 8), np.int32(c >> 8), np.int32(d >> 8)
        red[i] = w00 * a + w01 * b + w10 * c + w11 * d


@rowwise
def _weigh(count: int, weight: np.ndarray, blue: np.ndarray, green: np.ndarray, red: np.ndarray, color: np.ndarray) -> None:
    for i in range(count):
        color[0, i] = weight[i] * blue[i]
    for i in range(count):
        color[1, i] = weight[i] * green[i]
    for i in range(count):
        color[2, i] = weight[i] * red[i]


@rowwise
def _add(
    count: int, owner: np.ndarray, weight: np.ndarray, blue: np.ndarray, green: np.ndarray, red: np.ndarray, color: np.ndarray
) -> None:  # fmt: skip
    for i in range(count):
        color[0, owner[i]] += weight[i] * blue[i]
        color[1, owner[i]] += weight[i] * green[i]
        color[2, owner[i]] += weight[i] * red[i]


@rowwise
def look_up(
    count: int, textures: np.ndarray, atlas: np.ndarray, texture: np.ndarray, u: np.ndarray, v: np.ndarray,
    step_u: np.ndarray, step_v: np.ndarray, taps: np.ndarray, texels: np.ndarray, several: bool, color: np.ndarray,
    space: np.ndarray, whole: np.ndarray,
) -> None:  # fmt: skip
    """Texture values.

    Parameters
    ----------
    count : int
        Number of lookups; all arrays of lookups are at least as long.
    textures, atlas : ndarray
        From `pack`.
    texture : ndarray (n,) int32
        Index of the texture.
    u, v : ndarray (n,) float64
        Place in repeats.
    step_u, step_v : ndarray (n,) float64
        Extent of the pixel along its longer side, over which the taps are spread.
    taps : ndarray (n,) int32
        Samples along that side, 1 to `MOST_SAMPLES`.
    texels : ndarray (n,) float64
        Texels of the largest copy under a tap: they choose the copy.
    several : bool
        Take all taps, and where there is one, mix two copies linearly in the texels: close to a logarithm's mix and
        much cheaper. Otherwise `taps` is 1 and the value is that of the nearer copy.
    color : ndarray (3, n) float64, written
        BGR in [0, 1].
    space, whole : ndarray (7, n + 1) float64, (6, n + 1) int32
        Scratch.
    """
    copy, start, size, mirror, owner, samples = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    mix, at_u, at_v, weight, blue, green, red = space[0], space[1], space[2], space[3], space[4], space[5], space[6]
    _choose(count, textures, texture, texels, taps, several, copy, mix, samples)
    _first(count, textures, texture, u, v, step_u, step_v, taps, copy, mix, at_u, at_v, start, size, mirror, weight)
    _bilinear(count, atlas, start, size, mirror, at_u, at_v, blue, green, red)
    _weigh(count, weight, blue, green, red, color)
    if several:
        for sample in range(1, MOST_SAMPLES):
            others = _list(count, samples, sample, owner)
            _other(
                others, owner, sample == 2, textures, texture, u, v, step_u, step_v, taps, copy, mix, at_u, at_v, start, size,
                mirror, weight,
            )  # fmt: skip
            _bilinear(others, atlas, start, size, mirror, at_u, at_v, blue, green, red)
            _add(others, owner, weight, blue, green, red, color)
