"""Procedural pictures: each kind is a function of a random generator and a size that returns (S, S, 3) BGR in [0, 1].

All repeat without a seam. They stand for the statistics of real surfaces (power-law noise, dead leaves, cells, masonry,
print), not for any one of them.
"""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from variational.jit import rowwise

Pattern = Callable[[np.random.Generator, int], np.ndarray]


@lru_cache(maxsize=8)
def _frequency(size: int, stretch: float) -> np.ndarray:
    fy, fx = np.fft.fftfreq(size)[:, None] * size, np.fft.rfftfreq(size)[None, :] * size
    frequency = np.hypot(fx * stretch, fy)
    frequency[0, 0] = np.inf
    return np.maximum(frequency, 1)


def noise(rng: np.random.Generator, size: int, slope: float, stretch: float = 1.0) -> np.ndarray:
    """Power-law noise (S, S), mean 0, deviation 1: amplitude ~ frequency ** -slope; `stretch` draws it along x."""
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    spectrum /= _frequency(size, stretch) ** slope
    values = np.fft.irfft2(spectrum, s=(size, size))
    values -= values.mean()
    values /= max(float(values.std()), 1e-12)
    return values


def color(rng: np.random.Generator, saturation: float | None = None, value: float | None = None) -> np.ndarray:
    """A random BGR colour; surfaces of the world are mostly of low saturation."""
    hue = float(rng.random()) * 6
    saturation = float(rng.beta(1.2, 2.2) if saturation is None else saturation)
    value = float(rng.uniform(0.15, 0.95) if value is None else value)
    ramps = [min(max(abs((hue + shift) % 6 - 3) - 1, 0.0), 1.0) for shift in (4.0, 2.0, 0.0)]  # B, G, R
    return np.array([value * (1 - saturation * (1 - ramp)) for ramp in ramps])


def ramp(rng: np.random.Generator, values: np.ndarray, stops: int = 3) -> np.ndarray:
    """Colours of scalar values (S, S): a broken line through `stops` random colours that share a hue range."""
    base = color(rng)
    spread = rng.uniform(0.1, 0.6)
    colors = np.stack([np.clip((1 - spread) * base + spread * color(rng), 0, 1) for _ in range(stops)])
    place = np.clip(0.5 + values / 4, 0, 1)
    at = np.linspace(0, 1, stops)
    return np.stack([np.interp(place, at, colors[:, c]) for c in range(3)], -1)


def clouds(rng: np.random.Generator, size: int) -> np.ndarray:
    return ramp(rng, noise(rng, size, rng.uniform(0.9, 2.0)), int(rng.integers(2, 5)))


def grain(rng: np.random.Generator, size: int) -> np.ndarray:
    """Asphalt, plaster, concrete: fine and coarse grain of low contrast on one colour."""
    base = color(rng, saturation=rng.uniform(0, 0.15), value=rng.uniform(0.3, 0.7))
    fine, coarse = noise(rng, size, rng.uniform(0, 0.5)), noise(rng, size, 1.5)
    speckle = (noise(rng, size, 0.3) > 2.0) * rng.uniform(-0.3, 0.4)
    return np.clip(base + (rng.uniform(0.04, 0.1) * fine + rng.uniform(0.02, 0.08) * coarse + speckle)[..., None], 0, 1)


def plain(rng: np.random.Generator, size: int) -> np.ndarray:
    """Hardly any texture: paint, sheet metal, cloth."""
    return np.clip(color(rng) + 0.012 * noise(rng, size, 1.3)[..., None], 0, 1)


@rowwise
def _nearest_two(points: np.ndarray, size: int, distance: np.ndarray, index: np.ndarray) -> None:
    """Nearest two `points` (K, K, 2) on the unit torus from each pixel: distances (S, S, 2) in 1 / K, index of the first.

    Point (i, j) lies in cell (i, j) of a K x K grid, so that both are within two cells of the pixel's own.
    """
    side = points.shape[0]
    reach = min(5, side)
    wrapped = np.arange(3 * side) % side
    for row in range(size):
        for column in range(size):
            y, x = row / size, column / size
            top, left = int(y * side) + side - reach // 2, int(x * side) + side - reach // 2
            first, second, best = np.inf, np.inf, 0
            for a in range(top, top + reach):
                i = wrapped[a]
                for b in range(left, left + reach):
                    j = wrapped[b]
                    dy, dx = abs(points[i, j, 0] - y), abs(points[i, j, 1] - x)
                    dy, dx = min(dy, 1.0 - dy), min(dx, 1.0 - dx)
                    d = dy * dy + dx * dx
                    if d < first:
                        first, second, best = d, first, i * side + j
                    elif d < second:
                        second = d
            distance[row, column, 0], distance[row, column, 1] = np.sqrt(first) * side, np.sqrt(second) * side
            index[row, column] = best


def _cells(rng: np.random.Generator, size: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest two of `count` random points on a torus: distances (S, S, 2) in their spacing, index, the points."""
    side = max(2, round(np.sqrt(count)))
    jitter = rng.uniform(0.0, 1.0) * (rng.random((side, side, 2)) - 0.5)
    points = (np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1) + 0.5 + jitter) / side
    distance, index = np.empty((size, size, 2)), np.empty((size, size), np.int64)
    _nearest_two(points % 1.0, size, distance, index)
    return distance, index, points.reshape(-1, 2)


def cells(rng: np.random.Generator, size: int) -> np.ndarray:
    """Cobbles, leather, mosaics, dry mud."""
    distance, index, points = _cells(rng, size, int(rng.integers(20, 400)))
    colors = np.clip(
        color(rng) + rng.uniform(0.02, 0.3) * rng.standard_normal((len(points), 1 if rng.random() < 0.6 else 3)), 0, 1
    )
    colors = np.broadcast_to(colors, (len(points), 3))
    gap = np.clip((distance[..., 1] - distance[..., 0]) / rng.uniform(0.05, 0.3), 0, 1)[..., None]
    dome = 1 - rng.uniform(0, 0.5) * distance[..., :1] ** 2
    return np.clip(gap * colors[index] * dome + (1 - gap) * color(rng) * 0.6, 0, 1)


def leaves(rng: np.random.Generator, size: int) -> np.ndarray:
    """Dead leaves: shapes of power-law size over each other, the statistics of natural images."""
    image = np.full((size, size, 3), 0.5)
    image[:] = color(rng)
    base, spread = color(rng), rng.uniform(0.1, 1.0)
    aspect, kind = rng.uniform(0.3, 1.0), int(rng.integers(3))
    for _ in range(int(rng.integers(150, 500))):
        radius = size * min(max(0.02 / (1 - 0.97 * rng.random()), 0.015), 0.3)
        mixed = (1 - spread) * base * rng.uniform(0.5, 1.4) + spread * color(rng)
        shade = [min(max(channel, 0.0), 1.0) for channel in mixed.tolist()]
        x, y, angle = rng.random() * size, rng.random() * size, rng.random() * 360
        for shift_x in (-size, 0, size):
            for shift_y in (-size, 0, size):
                centre = (int(x + shift_x), int(y + shift_y))
                if not (-radius < centre[0] < size + radius and -radius < centre[1] < size + radius):
                    continue
                axes = (max(1, int(radius)), max(1, int(radius * aspect)))
                if kind == 2:
                    corners = cv2.boxPoints((centre, (2.0 * axes[0], 2.0 * axes[1]), angle)).astype(np.int32)
                    cv2.fillConvexPoly(image, corners, shade, cv2.LINE_AA)
                else:
                    cv2.ellipse(image, centre, axes, angle, 0, 360, shade, -1)
    return np.clip(image + 0.03 * noise(rng, size, 0.8)[..., None], 0, 1)


def foliage(rng: np.random.Generator, size: int) -> np.ndarray:
    """Leaves and grass: many small strokes from dark to light in greens and browns."""
    hue = np.array([rng.uniform(0.1, 0.3), rng.uniform(0.45, 0.7), rng.uniform(0.2, 0.65)])
    image = np.full((size, size, 3), 0.5) * hue * 0.5
    spread, mean_angle = rng.uniform(10, 180), rng.random() * 180
    for step in range(900):
        mixed = hue * (0.25 + 1.1 * step / 900 * rng.uniform(0.5, 1.2)) + 0.05 * rng.standard_normal(3)
        shade = [min(max(channel, 0.0), 1.0) for channel in mixed.tolist()]
        centre = rng.random(2) * size
        axes = (int(rng.integers(4, 13)), int(rng.integers(2, 5)))
        angle = mean_angle + spread * (rng.random() - 0.5)
        for shift in ((0, 0), (-size, 0), (size, 0), (0, -size), (0, size)):
            place = (int(centre[0] + shift[0]), int(centre[1] + shift[1]))
            if -13 < place[0] < size + 13 and -13 < place[1] < size + 13:
                cv2.ellipse(image, place, axes, angle, 0, 360, shade, -1)
    return image


def stripes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Stripes and plaids of random widths, straight or waved."""
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    wave = rng.uniform(0, 12) * (rng.random() < 0.4) * noise(rng, size, 2.2)
    count = int(rng.integers(3, 24))
    edges = np.sort(rng.random(count)) if rng.random() < 0.5 else np.arange(count) / count
    colors = np.stack([color(rng) for _ in range(int(rng.integers(2, 5)))])
    across = np.searchsorted(edges, ((x + wave) / size) % 1.0) % len(colors)
    image = colors[across]
    if rng.random() < 0.4:
        image = 0.5 * image + 0.5 * colors[np.searchsorted(edges, ((y + wave) / size) % 1.0) % len(colors)]
    return np.clip(image + 0.03 * noise(rng, size, 0.7)[..., None], 0, 1)


def masonry(rng: np.random.Generator, size: int) -> np.ndarray:
    """Bricks, tiles, paving: rows of rectangles with joints, each a little different."""
    rows = int(2 * rng.integers(2, 9))
    columns = max(1, round(rows / rng.uniform(1, 3)))
    y, x = np.meshgrid(np.arange(size) / size, np.arange(size) / size, indexing="ij")
    row = np.floor(y * rows).astype(int)
    along = x * columns + (0.5 * (row % 2) if rng.random() < 0.7 else 0)
    column = np.floor(along).astype(int) % columns
    edge_x, edge_y = np.abs(along % 1 - 0.5), np.abs(y * rows % 1 - 0.5)
    joint = rng.uniform(0.02, 0.06)
    mortar = np.maximum((edge_x - 0.5) / columns * rows + joint, edge_y - 0.5 + joint) > 0
    shade = 1 + rng.uniform(0.03, 0.3) * rng.standard_normal((rows, columns))
    stone = color(rng) * shade[row, column][..., None] + rng.uniform(0.02, 0.08) * noise(rng, size, 0.8)[..., None]
    grout = color(rng, saturation=0.1) + 0.05 * noise(rng, size, 0.5)[..., None]
    return np.clip(np.where(mortar[..., None], grout, stone), 0, 1)


def checks(rng: np.random.Generator, size: int) -> np.ndarray:
    """A chess board or a grid of lines: repeated patterns that invite wrong matches."""
    count = int(2 * rng.integers(2, 12))
    y, x = np.meshgrid(np.arange(size) * count // size, np.arange(size) * count // size, indexing="ij")
    first, second = color(rng), color(rng)
    if rng.random() < 0.5:
        mask = (x + y) % 2 == 0
    else:
        cell = size / count
        mask = (np.arange(size) % cell < 0.18 * cell)[None, :] | (np.arange(size) % cell < 0.18 * cell)[:, None]
    return np.clip(np.where(mask[..., None], first, second) + 0.02 * noise(rng, size, 0.8)[..., None], 0, 1)


def wood(rng: np.random.Generator, size: int) -> np.ndarray:
    """Boards with grain."""
    fibre = noise(rng, size, 1.0, stretch=rng.uniform(8, 25))
    boards = int(rng.integers(1, 9))
    board = np.arange(size) * boards // size
    shade = 1 + 0.15 * rng.standard_normal(boards)[board][:, None]
    seam = (np.arange(size) * boards % size < boards * 2)[:, None] * rng.uniform(0, 0.6)
    base = np.array([rng.uniform(0.1, 0.4), rng.uniform(0.25, 0.5), rng.uniform(0.35, 0.7)])
    return np.clip(base * ((shade + 0.18 * fibre) * (1 - seam))[..., None], 0, 1)


def marble(rng: np.random.Generator, size: int) -> np.ndarray:
    """Veins, cracks, crumpled paper."""
    folds = np.abs(noise(rng, size, rng.uniform(1.1, 1.8)))
    return ramp(rng, 4 * np.exp(-folds * rng.uniform(2, 8)) - 2, 3)


def rust(rng: np.random.Generator, size: int) -> np.ndarray:
    """Two materials with a ragged border: peeling paint, stains, moss."""
    over = noise(rng, size, rng.uniform(1.2, 1.8)) > rng.uniform(-0.8, 0.8)
    first = color(rng) + 0.06 * noise(rng, size, 0.7)[..., None]
    second = color(rng) + 0.04 * noise(rng, size, 1.0)[..., None]
    return np.clip(np.where(over[..., None], first, second), 0, 1)


_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)
_LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVWXYZabcdefghiklmnoprstuvwyz0123456789 "))


def _word(rng: np.random.Generator, length: int) -> str:
    return "".join(rng.choice(_LETTERS, length))


def text(rng: np.random.Generator, size: int) -> np.ndarray:
    """Print: lines of letters, a page, a poster, a sign."""
    image = np.empty((size, size, 3))
    image[:] = color(rng)
    for _ in range(int(rng.integers(0, 4))):  # blocks of colour behind the print
        x, y, w, h = (rng.random(4) * size * (1, 1, 0.6, 0.5)).astype(int)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), color(rng).tolist(), -1)
    ink = (255 * color(rng, value=rng.choice([0.05, 0.95]))).tolist()
    image = (255 * image).astype(np.uint8)
    y = 0.0
    while y < size:
        scale = float(rng.choice([0.4, 0.6, 1.0, 2.0]))
        y += 26 * scale
        place = (int(rng.integers(-4, 10)), int(y))
        word = _word(rng, int(size / (16 * scale)) + 1)
        cv2.putText(image, word, place, int(rng.choice(_FONTS)), scale, ink, max(1, round(1.6 * scale)), cv2.LINE_AA)
        y += 6
    return image / 255


def dots(rng: np.random.Generator, size: int) -> np.ndarray:
    """Polka dots and holes in rows."""
    distance, index, _ = _cells(rng, size, int(rng.integers(4, 14)) ** 2)
    radius = rng.uniform(0.15, 0.45)
    colors = np.stack([color(rng) for _ in range(int(rng.integers(1, 5)))])
    inside = np.clip((radius - distance[..., 0]) * 8, 0, 1)[..., None]
    return inside * colors[index % len(colors)] + (1 - inside) * color(rng)


def carpet(rng: np.random.Generator, size: int) -> np.ndarray:
    """A mirrored ornament in few colours."""
    quarter = ramp(rng, noise(rng, size // 2, rng.uniform(0.9, 1.6)), 4)
    quarter = np.round(quarter * rng.integers(3, 7)) / 6
    half = np.concatenate([quarter, quarter[:, ::-1]], 1)
    return np.clip(np.concatenate([half, half[::-1]], 0) + 0.04 * noise(rng, size, 0.4)[..., None], 0, 1)


def facade(rng: np.random.Generator, size: int) -> np.ndarray:
    """A piece of a house front: windows in rows on a wall, with frames, sills, blinds and dirt."""
    wall = color(rng, saturation=rng.uniform(0, 0.35), value=rng.uniform(0.3, 0.95))
    image = np.empty((size, size, 3))
    image[:] = wall
    image += rng.uniform(0.01, 0.05) * noise(rng, size, rng.uniform(0.5, 1.4))[..., None]
    if rng.random() < 0.35:
        image *= 0.75 + 0.5 * masonry(rng, size).mean(-1, keepdims=True)
    columns, rows = int(rng.integers(1, 6)), int(rng.integers(1, 5))
    width, height = rng.uniform(0.3, 0.7) * size / columns, rng.uniform(0.4, 0.75) * size / rows
    frame, glass = (
        color(rng, saturation=0.1, value=rng.choice([0.2, 0.9])).tolist(),
        color(rng, value=rng.uniform(0.05, 0.3)),
    )
    panes, sill, sash = int(rng.integers(1, 4)), rng.random() < 0.6, max(1, int(0.06 * width))
    for row in range(rows):
        for column in range(columns):
            x0, y0 = int((column + 0.5) * size / columns - width / 2), int((row + 0.5) * size / rows - height / 2)
            x1, y1 = int(x0 + width), int(y0 + height)
            shade = glass * rng.uniform(0.4, 1.8)
            pane = np.linspace(1.3, 0.6, max(1, y1 - y0))[:, None, None] * shade
            image[y0:y1, x0:x1] = np.clip(pane, 0, 1)
            if rng.random() < 0.35:  # a blind or curtain
                cv2.rectangle(
                    image,
                    (x0, y0),
                    (x1, int(y0 + rng.random() * height)),
                    color(rng, 0.15, rng.uniform(0.4, 0.9)).tolist(),
                    -1,
                )
            cv2.rectangle(image, (x0, y0), (x1, y1), frame, sash)
            for pane_index in range(1, panes):
                x = int(x0 + pane_index * width / panes)
                cv2.line(image, (x, y0), (x, y1), frame, max(1, sash // 2))
            if sill:
                cv2.rectangle(image, (x0 - sash, y1), (x1 + sash, y1 + sash), (0.8 * wall).tolist(), -1)
    if rng.random() < 0.5:
        for row in range(rows):  # a cornice between the floors
            y = int(row * size / rows)
            cv2.rectangle(image, (0, y), (size, y + max(2, size // 60)), (wall * rng.uniform(0.6, 1.2)).clip(0, 1).tolist(), -1)
    return np.clip(image, 0, 1)


#: kind -> function; the names are part of the seeds' meaning
KINDS: dict[str, Pattern] = {
    "carpet": carpet, "cells": cells, "checks": checks, "clouds": clouds, "dots": dots, "facade": facade,
    "foliage": foliage, "grain": grain, "leaves": leaves, "marble": marble, "masonry": masonry, "plain": plain,
    "rust": rust, "stripes": stripes, "text": text, "wood": wood,
}  # fmt: skip
#: kinds that suit any object
ANYWHERE = tuple(sorted(set(KINDS) - {"facade", "foliage"}))
