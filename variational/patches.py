"""Where patches of one image are seen again in another, however far they went, with neighbours that vote.

For what dense flow lost: it follows small steps only. Patches of both images, made smaller, are compared by normalised
correlation at every displacement within reach. A patch alone is often ambiguous, but its neighbours on the same surface
move nearly as it does: their scores at nearly the same displacement are added to its own, which tolerates the rotation
and the stretch that a whole template does not. A place is believed if the same search leads back from it. After
Weinzaepfel et al. 2013, DeepFlow, doi:10.1109/ICCV.2013.175: one level of its matching, on scattered places.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.jit import over_bands, over_rows, rowwise, scalar

# All that is summed is a whole number and small enough for float32 to hold the sum exactly: products of matrices then have the
# same bits in whatever order, and on however many threads, they are summed.
_NORM = 4000  # of a patch: its products stay below 2**24
_SCORE = 1000  # of a patch with itself
_SHARE = 4000  # weight of a patch's own score; with the votes' weights below 2**24 / _SCORE

_NOISE = 0.02  # a patch that differs less from its mean (a pixel, in [0, 1]) is an even surface, and correlates with nothing
_MOST_REACH = 64  # bounds the memory for images that are much wider than high
_BESIDE = 3  # displacements so near belong to one maximum
_STACK = 8  # places that a thread takes at once


@dataclass(frozen=True)
class PatchesConfig:
    """Patches, and how far they are looked for.

    Parameters
    ----------
    pixels : int
        Images are made smaller to about so many pixels, which bounds the time.
    radius : int
        Patches have 2 radius + 1 pixels of the smaller image on a side.
    reach : float
        Largest displacement along x and y, as a share of the image's width; at most 64 pixels of the smaller image.
    votes : float
        Weight of the neighbours' mean score beside a patch's own; 0 lets none vote.
    neighbours : float
        Standard deviation of the neighbours' distances, in pixels of the smaller image: farther ones count less.
    return_px : float
        A place is believed if the way back leads this near along x and y, in pixels of the smaller image.
    ratio : float
        A displacement is believed if all but those beside it score less than this share of its score: in a repeated pattern
        others score as well, and the way back leads home from each of them. 1 believes all.
    colour : float
        Difference of colour (its length, channels in [0, 1]) at which a score has fallen to half.
    plain : float
        Share of a score that is for the colour alone: a surface without texture is known by its colour and its extent.
    """

    pixels: int = 16_000
    radius: int = 3
    reach: float = 0.15
    votes: float = 2.0
    neighbours: float = 5.0
    return_px: float = 1.5
    ratio: float = 0.9
    colour: float = 0.1
    plain: float = 0.2

    def __post_init__(self) -> None:
        if self.pixels < 1 or self.radius < 1 or not 0 <= self.votes <= 3:
            raise ValueError("PatchesConfig needs pixels >= 1, radius >= 1 and votes between 0 and 3")
        if self.colour <= 0 or not 0 <= self.plain <= 1:
            raise ValueError("PatchesConfig needs colour > 0 and plain between 0 and 1")


@rowwise
def _describe(first: int, last: int, padded: np.ndarray, radius: int, words: np.ndarray) -> None:
    """words (h, w, n): the patch around each pixel less its mean in each channel; of norm _NORM, or less where it is even.

    padded: (h + 2 radius, w + 2 radius, channels).
    """
    channels, side = padded.shape[2], 2 * radius + 1
    area = np.float32(side * side)
    for y in range(first, last):
        for x in range(words.shape[1]):
            power, place = np.float32(0), 0
            for c in range(channels):
                mean = np.float32(0)
                for i in range(side):
                    for j in range(side):
                        mean += padded[y + i, x + j, c]
                mean /= area
                for i in range(side):
                    for j in range(side):
                        value = padded[y + i, x + j, c] - mean
                        words[y, x, place] = value
                        power += value * value
                        place += 1
            scale = np.float32(_NORM) / np.sqrt(power + np.float32(_NOISE * _NOISE) * area * np.float32(channels))
            for k in range(place):
                words[y, x, k] = np.rint(scale * words[y, x, k])


@dataclass(frozen=True, eq=False)
class Described:
    """An image made smaller, and the patches around its pixels.

    Parameters
    ----------
    colours : np.ndarray
        (h, w, channels) float32.
    words : np.ndarray
        (h, w, n) float32, see `describe`.
    """

    colours: np.ndarray
    words: np.ndarray


def describe(image: np.ndarray, shape: tuple[int, int], radius: int) -> Described:
    """An image (H, W, channels) made smaller to `shape` (h, w), and the patches of 2 radius + 1 pixels around its pixels."""
    small = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 0.7).reshape(*shape, -1).astype(np.float32)  # OpenCV drops a single channel
    padded = np.pad(small, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    words = np.empty((*shape, (2 * radius + 1) ** 2 * small.shape[2]), np.float32)
    over_rows(_describe, shape[0], padded, radius, words)
    return Described(small, words)


@rowwise
def _score(
    first: int, last: int, products: np.ndarray, colours1: np.ndarray, colours2: np.ndarray, places: np.ndarray, reach: int,
    half: np.float32, plain: np.float32, scores: np.ndarray, pooled: np.ndarray,
) -> None:  # fmt: skip
    """scores (N, S + 2, S + 2) of the places (N, 2: x, y) at each displacement, S = 2 reach + 1, inside a border of zeros.

    A score is the correlation to the power of 1.5, 0 if negative: what agrees well counts for more; and a share of `plain`
    for the colour alone. Colours that differ by `half` take half of it. Outside of the image it is 0. products (N, h, w): of
    the places' patches with all of the other image; pooled (N, S, S): maximum of scores over 3 x 3.
    """
    _, height, width = products.shape
    side, zero, unit = 2 * reach + 1, np.float32(0), np.float32(1 / _NORM**2)
    one, sharpness = np.float32(1), np.float32(1) / half**2
    for n in range(first, last):
        x, y = places[n, 0], places[n, 1]
        for i in range(side + 2):
            for j in range(side + 2):
                scores[n, i, j] = zero
        begin, end = max(x - reach, 0), min(x + reach + 1, width)
        # unsigned: numba gathers from an index that it cannot prove positive
        at, start, size = np.uint64(begin - (x - reach) + 1), np.uint64(begin), np.uint64(max(end - begin, 0))
        for to_y in range(max(y - reach, 0), min(y + reach + 1, height)):
            i = to_y - (y - reach) + 1
            for j in range(size):
                correlation = max(unit * products[n, to_y, start + j], zero)
                apart = zero
                for c in range(colours1.shape[2]):
                    apart += (colours1[y, x, c] - colours2[to_y, start + j, c]) ** 2
                score = (plain + (one - plain) * correlation * np.sqrt(correlation)) / (one + sharpness * apart)
                scores[n, i, at + j] = np.rint(np.float32(_SCORE) * score)
        for i in range(side):
            for j in range(side):
                above = max(scores[n, i, j], scores[n, i, j + 1], scores[n, i, j + 2])
                middle = max(scores[n, i + 1, j], scores[n, i + 1, j + 1], scores[n, i + 1, j + 2])
                below = max(scores[n, i + 2, j], scores[n, i + 2, j + 1], scores[n, i + 2, j + 2])
                pooled[n, i, j] = max(above, middle, below)


@rowwise
def _elect(first: int, last: int, scores: np.ndarray, votes: np.ndarray, ratio: np.float32, best: np.ndarray) -> None:
    """best (N, 2): the displacement (x, y) of each place that has most of its own score and of the votes (N, S, S).

    NaN where another displacement, not beside it, has more than `ratio` of that.
    """
    side = votes.shape[1]
    for n in range(first, last):
        for i in range(side):
            for j in range(side):
                scores[n, i + 1, j + 1] = np.float32(_SHARE) * scores[n, i + 1, j + 1] + votes[n, i, j]
        top, at_i, at_j = np.float32(-1), 0, 0
        for i in range(1, side + 1):
            for j in range(1, side + 1):
                if scores[n, i, j] > top:
                    top, at_i, at_j = scores[n, i, j], i, j
        second = np.float32(0)
        for i in range(1, side + 1):
            beside = abs(i - at_i) <= _BESIDE
            for j in range(1, side + 1):
                second = max(second, np.float32(0) if beside and abs(j - at_j) <= _BESIDE else scores[n, i, j])
        unclear, middle = second > ratio * top, side // 2 + 1
        x = at_j - middle + _vertex(scores[n, at_i, at_j - 1], top, scores[n, at_i, at_j + 1])
        y = at_i - middle + _vertex(scores[n, at_i - 1, at_j], top, scores[n, at_i + 1, at_j])
        best[n, 0], best[n, 1] = np.nan if unclear else x, np.nan if unclear else y


@scalar
def _vertex(below: np.float32, top: np.float32, above: np.float32) -> np.float32:
    """Where the parabola through three neighbouring values, the middle one the largest, has its top; from the middle one."""
    curvature = np.float32(2) * top - below - above
    return np.float32(0.5) * (above - below) / curvature if curvature > np.float32(0) else np.float32(0)


def displacements_of(
    image1: Described, image2: Described, places: np.ndarray, groups: np.ndarray, reach: int, config: PatchesConfig
) -> np.ndarray:
    """(N, 2) float32 displacements (x, y) of the places (N, 2) int, pixels of the smaller image; NaN where unclear.

    groups (N,): places of one number vote for one another.
    """
    count, side = len(places), 2 * reach + 1
    scores, pooled, votes = (np.empty((count, each, each), np.float32) for each in (side + 2, side, side))
    edges = [*range(0, count, _STACK), count]
    # all at once: the threads of a product of matrices idle on for a while after it, and take time from other stages
    products = image1.words[places[:, 1], places[:, 0]] @ image2.words.reshape(-1, image2.words.shape[2]).T
    products = products.reshape(count, *image2.words.shape[:2])
    half, plain = np.float32(config.colour), np.float32(config.plain)
    over_bands(_score, edges, products, image1.colours, image2.colours, places, reach, half, plain, scores, pooled)
    for group in np.unique(groups):
        mine = groups == group
        together = _shares(places[mine], config) @ pooled[mine].reshape(-1, side * side)
        votes[mine] = together.reshape(-1, side, side)
    best = np.empty((count, 2), np.float32)
    over_bands(_elect, edges, scores, votes, np.float32(config.ratio), best)
    return best


def _shares(places: np.ndarray, config: PatchesConfig) -> np.ndarray:
    """(N, N) float32: what the scores of the places (N, 2) weigh for one another, whole numbers of at most _SHARE votes a row."""
    squared = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    weights = np.exp(-squared / (2 * config.neighbours**2)) * ~np.eye(len(places), dtype=bool)
    return np.floor(_SHARE * config.votes * weights / np.maximum(weights.sum(axis=1, keepdims=True), 1)).astype(np.float32)


class Patches:
    """The patches of two images, ready to be looked for.

    Parameters
    ----------
    image1, image2 : np.ndarray
        (H, W, channels) float32 in [0, 1].
    config : PatchesConfig
    """

    def __init__(self, image1: np.ndarray, image2: np.ndarray, config: PatchesConfig) -> None:
        self.config = config
        self.shape = height, width = image1.shape[:2]
        factor = max(1.0, np.sqrt(height * width / config.pixels))
        self.small = max(1, round(height / factor)), max(1, round(width / factor))
        self.reach = min(max(1, int(config.reach * self.small[1])), _MOST_REACH)
        self.scale = np.array([width / self.small[1], height / self.small[0]])
        self.images = [describe(image, self.small, config.radius) for image in (image1, image2)]

    def follow(self, surfaces: list[np.ndarray], most: int) -> list[np.ndarray]:
        """Look for at most so many patches of each surface (H, W) bool, spread evenly over it.

        Returns
        -------
        list of np.ndarray
            For each surface: (N, 4) float64, x, y in image1 and in image2 of those that are seen again, in pixels.
        """
        found = [self._places(surface, most) for surface in surfaces]
        groups = np.repeat(np.arange(len(found)), [len(places) for places in found])
        places = np.concatenate([*found, np.empty((0, 2), np.intp)])
        image1, image2 = self.images
        there = places + displacements_of(image1, image2, places, groups, self.reach, self.config)
        clear = np.isfinite(there).all(axis=1)
        places, there, groups = places[clear], there[clear], groups[clear]
        nearest = np.clip(np.rint(there).astype(np.intp), 0, np.array(self.small[::-1]) - 1)
        back = nearest + displacements_of(image2, image1, nearest, groups, self.reach, self.config)
        home = (np.abs(back - places) <= self.config.return_px).all(axis=1)
        ends = np.hstack([(ends + 0.5) * self.scale - 0.5 for ends in (places, there)])
        return [ends[home & (groups == group)] for group in range(len(found))]

    def _places(self, surface: np.ndarray, most: int) -> np.ndarray:
        """(N, 2) x, y in the smaller image."""
        small = cv2.resize(surface.astype(np.uint8), self.small[::-1], interpolation=cv2.INTER_NEAREST)
        places = np.argwhere(small)[:, ::-1]
        return places[np.linspace(0, len(places) - 1, min(most, len(places))).astype(np.intp)]
