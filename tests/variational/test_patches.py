"""Patches seen again: kernels against plain twins, rotation, votes, repeated patterns."""

import cv2
import numpy as np
import pytest

from tests.variational.test_objects import texture
from variational.patches import Described, Patches, PatchesConfig, describe, displacements_of


def plain_words(small: np.ndarray, radius: int) -> np.ndarray:
    """(h, w, n), of unit norm, of an image (h, w, channels), one pixel after the other."""
    height, width, channels = small.shape
    padded = np.pad(small.astype(np.float64), ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    words = np.empty((height, width, channels * (2 * radius + 1) ** 2))
    for y in range(height):
        for x in range(width):
            patch = padded[y : y + 2 * radius + 1, x : x + 2 * radius + 1].transpose(2, 0, 1)
            patch = patch - patch.mean(axis=(1, 2), keepdims=True)
            words[y, x] = patch.ravel() / np.sqrt((patch**2).sum() + 0.02**2 * patch.size)
    return words


def plain_displacements(
    image1: Described, image2: Described, places: np.ndarray, groups: np.ndarray, reach: int, config: PatchesConfig
) -> np.ndarray:
    """Whole pixels, without a parabola; NaN where unclear."""
    side, (height, width, _) = 2 * reach + 1, image2.words.shape
    scores = np.zeros((len(places), side, side))
    for n, (x, y) in enumerate(places):
        for i, to_y in enumerate(range(y - reach, y + reach + 1)):
            for j, to_x in enumerate(range(x - reach, x + reach + 1)):
                if 0 <= to_x < width and 0 <= to_y < height:
                    score = max(image1.words[y, x] @ image2.words[to_y, to_x] / 4000**2, 0) ** 1.5
                    apart = np.linalg.norm(image1.colours[y, x] - image2.colours[to_y, to_x]) / config.colour
                    scores[n, i, j] = (config.plain + (1 - config.plain) * score) / (1 + apart**2)
    pooled = np.stack([cv2.dilate(each, np.ones((3, 3))) for each in scores])
    found = np.empty((len(places), 2))
    for n in range(len(places)):
        near = np.exp(-((places - places[n]) ** 2).sum(axis=1) / (2 * config.neighbours**2))
        near[n] = 0
        near[groups != groups[n]] = 0
        total = scores[n] + config.votes * np.tensordot(near, pooled, 1) / max(near.sum(), 1)
        i, j = np.unravel_index(total.argmax(), total.shape)
        found[n] = j - reach, i - reach
        rest = total.copy()
        rest[max(i - 3, 0) : i + 4, max(j - 3, 0) : j + 4] = 0
        if rest.max() > config.ratio * total.max():
            found[n] = np.nan
    return found


def test_words_equal_the_plain_ones() -> None:
    image = np.random.default_rng(0).random((26, 34, 3), dtype=np.float32)
    image[:12, :16] = 0.5  # even: nothing but noise there
    small = cv2.GaussianBlur(cv2.resize(image, (17, 13), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    described = describe(image, (13, 17), 2)
    np.testing.assert_allclose(described.words, 4000 * plain_words(small, 2), atol=0.51)
    np.testing.assert_array_equal(described.words, np.rint(described.words))
    np.testing.assert_array_equal(described.colours, small)


@pytest.mark.parametrize(("votes", "channels"), [(0.0, 1), (2.0, 3)])
def test_displacements_equal_the_plain_ones(votes: float, channels: int) -> None:
    random, config = np.random.default_rng(1), PatchesConfig(votes=votes, neighbours=4.0, colour=0.3)
    image = random.random((19, 27, channels), dtype=np.float32)
    images = [describe(each, image.shape[:2], 1) for each in (image, np.roll(image, (2, -3), (0, 1)))]
    places = np.argwhere(random.random(image.shape[:2]) < 0.08)[:, ::-1]
    groups = random.integers(0, 2, len(places))
    found = displacements_of(*images, places, groups, 5, config)
    expected = plain_displacements(*images, places, groups, 5, config)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert np.isfinite(found).any()
    assert (np.abs(found - expected)[np.isfinite(expected)] <= 0.5).all()


@pytest.mark.parametrize("channels", [1, 3])
def test_a_turned_surface_is_followed(channels: int) -> None:
    """By 12 degrees about a centre, and far: whole templates no longer fit."""
    image1 = np.dstack([texture(seed, (200, 320), blur=4) for seed in range(channels)])
    turn = cv2.getRotationMatrix2D((150, 90), 12, 1.0) + np.array([[0, 0, 31], [0, 0, -22]])
    image2 = cv2.warpAffine(image1, turn, (320, 200)).reshape(image1.shape)
    surface = np.zeros((200, 320), bool)
    surface[60:140, 90:210] = True
    unseen = np.zeros_like(surface)
    ends, nothing = Patches(image1, image2, PatchesConfig(pixels=4000)).follow([surface, unseen], 40)
    assert len(nothing) == 0
    expected = np.column_stack([ends[:, :2], np.ones(len(ends))]) @ turn.T
    distance = np.linalg.norm(ends[:, 2:] - expected, axis=1)
    assert 25 < len(ends) <= 40
    assert (distance < 3).mean() > 0.9
    assert np.median(distance) < 1.2


def test_neighbours_decide_what_a_patch_cannot() -> None:
    """One patch has a better double; those around it know better."""
    image1 = np.zeros((40, 60, 1), np.float32) + 0.5
    image1[10:30, 15:35, 0] = np.random.default_rng(3).random((20, 20))
    image2 = np.roll(image1, (3, 8), (0, 1))
    image2[23 - 3 : 23 + 4, 33 - 3 : 33 + 4] = 0.7 * image2[23 - 3 : 23 + 4, 33 - 3 : 33 + 4] + 0.15  # the true one loses
    image2[2:9, 12:19] = image1[17:24, 22:29]  # contrast here, as in left1
    image2[20:27, 30:37] += 0.2 * np.random.default_rng(4).random((7, 7, 1), dtype=np.float32)
    images = [describe(each, (40, 60), 3) for each in (image1, image2)]
    places = np.array([[25, 20], [22, 18], [28, 22], [22, 22], [28, 18]])
    one = np.zeros(len(places), int)
    alone = displacements_of(*images, places, one, 16, PatchesConfig(votes=0, ratio=1, colour=9))
    together = displacements_of(*images, places, one, 16, PatchesConfig(ratio=1, colour=9))
    assert np.abs(alone[0] - (8, 3)).max() > 5
    np.testing.assert_allclose(together, np.tile([8, 3], (5, 1)), atol=0.6)


def test_a_surface_without_texture_is_known_by_its_colour() -> None:
    """A plain disc goes far before noise; grey alone, it would be a hole in the noise like any other."""
    random = np.random.default_rng(7)
    images, centres = [], ((20, 30), (33, 44))
    y, x = np.indices((60, 80))
    for row, column in centres:
        image = random.random((60, 80, 3), dtype=np.float32) * 0.1 + np.float32(0.5)
        image[np.hypot(y - row, x - column) < 5] = (0.9, 0.4, 0.1)
        images.append(image)
    surface = np.hypot(y - centres[0][0], x - centres[0][1]) < 5
    (ends,) = Patches(*images, PatchesConfig(pixels=60 * 80, reach=0.3)).follow([surface], 60)
    assert len(ends) > 20
    np.testing.assert_allclose(np.median(ends[:, 2:] - ends[:, :2], axis=0), (14, 13), atol=1)


def test_a_repeated_pattern_is_unclear() -> None:
    fence = np.tile(texture(5, (120, 24), blur=2), (1, 10))[..., None]
    moved = np.roll(fence, 8, 1)
    surface = np.zeros(fence.shape[:2], bool)
    surface[40:80, 80:160] = True
    patches, places = Patches(fence, moved, PatchesConfig(pixels=1800)), np.array([[28, 15], [30, 12]])
    one = np.zeros(2, int)
    assert np.isfinite(displacements_of(*patches.images, places, one, 9, PatchesConfig(ratio=1))).all()
    assert np.isnan(displacements_of(*patches.images, places, one, 9, PatchesConfig())).all()
    assert len(patches.follow([surface], 40)[0]) == 0


@pytest.mark.parametrize("case", ["no surface", "flat", "tiny"])
def test_nothing_to_follow(case: str) -> None:
    shape = (16, 17) if case == "tiny" else (60, 80)
    image = np.full((*shape, 3), 0.5, np.float32) if case != "tiny" else texture(0, shape)[..., None]
    surface = np.zeros(shape, bool)
    surface[4:12, 4:12] = case != "no surface"
    (ends,) = Patches(image, image, PatchesConfig(pixels=surface.size // 16)).follow([surface], 20)
    assert len(ends) == 0 or case == "tiny"
    np.testing.assert_allclose(ends[:, 2:], ends[:, :2], atol=2)


def test_memory_is_bounded_for_panoramas() -> None:
    """Scores take the square of the reach: at its share of such a width they would take 9 GB."""
    image = np.zeros((16, 40_000, 1), np.float32)
    assert Patches(image, image, PatchesConfig()).reach == 64
    assert Patches(image[:, :40], image[:, :40], PatchesConfig()).reach == 6


def test_settings_that_cannot_be() -> None:
    for wrong in ({"radius": 0}, {"pixels": 0}, {"votes": 4.0}, {"colour": 0.0}, {"plain": 1.5}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            PatchesConfig(**wrong)


def test_sums_are_exact() -> None:
    """The largest product of two patches, and the largest sum of votes: whole numbers that float32 still holds."""
    words = describe(texture(6, (40, 60))[..., None], (40, 60), 3).words
    power = (words.astype(np.float64) ** 2).sum(axis=2)
    assert 3900**2 < power.max() < 2**24
    assert 4000 * (1 + 3) * 1000 < 2**24
