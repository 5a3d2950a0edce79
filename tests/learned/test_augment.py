"""Augmentation keeps rows aligned and the truth exact."""

import dataclasses

import pytest
import torch

from learned.augment import AugmentConfig, augment, resized
from learned.batch import Batch
from learned.hybrid import still

PLAIN = AugmentConfig(40, 56, zoom=0, stretch=0, flip=False, colour=0, noise=0, erase=0)


@pytest.fixture
def batch() -> Batch:
    """left1's first channel is x, the second y; the state's channels are smooth functions of them."""
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    image = torch.stack([x / 80, y / 60, torch.full_like(x, 0.5)])
    truth = torch.stack([x / 8, y / 6, x - 40, y / 3, x / 5])[None]
    return Batch(image.expand(1, 4, 3, 60, 80).clone(), truth, truth + 1, truth[:, 3:], truth[:, :1], names=("a",))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_every_map_is_cut_alike(batch: Batch):
    one = augment(batch, PLAIN, generator(1))
    assert one.images.shape == (1, 4, 3, 40, 56)
    x = one.images[0, 0, 0] * 80
    assert torch.allclose(one.truth[0, 0], x / 8, atol=1e-4)
    assert torch.equal(one.start, one.truth + 1)
    assert torch.equal(one.backward_flow, one.truth[:, 3:])
    assert one.names == ("a",)


def test_the_same_seed_gives_the_same_sample(batch: Batch):
    config = AugmentConfig(40, 56)
    first, again, other = (augment(batch, config, generator(seed)).images for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_zoom_scales_by_the_channels_axis(batch: Batch):
    """Twice as wide and three times as high: D1, D2, C and u double, v triples."""
    large = resized(batch, (180, 160))
    middle, scaled = batch.truth[0, :, 30, 40], large.truth[0, :, 91, 81]
    assert torch.allclose(scaled, middle * torch.tensor([2.0, 2, 2, 2, 3]))
    assert torch.allclose(large.backward_flow[0, :, 91, 81], batch.backward_flow[0, :, 30, 40] * torch.tensor([2.0, 3]))
    assert torch.equal(large.evidence[0, 0, 91, 81], batch.evidence[0, 0, 30, 40])


def test_mirroring_turns_vertical_motion(batch: Batch):
    config = dataclasses.replace(PLAIN, height=60, width=80, flip=True)
    flips = [augment(batch, config, generator(seed)) for seed in range(8)]
    mirrored = [one for one in flips if one.images[0, 0, 1, 0, 0] > 0.5]
    assert 0 < len(mirrored) < 8
    sign = torch.tensor([1.0, 1, 1, 1, -1])[:, None, None]
    assert torch.equal(mirrored[0].truth[0], batch.truth[0].flip(-2) * sign)
    assert torch.equal(mirrored[0].backward_flow[0, 1], -batch.backward_flow[0, 1].flip(-2))


def test_colour_changes_all_images_alike_but_for_a_part(batch: Batch):
    config = dataclasses.replace(PLAIN, colour=0.3, unequal=0.0)
    images = augment(batch, config, generator()).images[0]
    assert not torch.allclose(images[0], augment(batch, PLAIN, generator()).images[0, 0], atol=0.01)
    assert torch.allclose(images[0], images[3])
    images = augment(batch, dataclasses.replace(config, unequal=1.0), generator()).images[0]
    assert not torch.allclose(images[0], images[3], atol=0.01)


def test_left1_is_never_erased(batch: Batch):
    config = dataclasses.replace(PLAIN, erase=1.0)
    for seed in range(6):
        images = augment(batch, config, generator(seed)).images[0]
        changed = [not torch.equal(images[0], image) for image in images[1:]]
        assert sum(changed) == 1


def test_bytes_become_unit_range(batch: Batch):
    bytes_ = dataclasses.replace(batch, images=(batch.images * 255).round().to(torch.uint8))
    assert torch.allclose(augment(bytes_, PLAIN, generator()).images, augment(batch, PLAIN, generator()).images, atol=0.003)


def test_a_sample_that_is_too_small_is_refused(batch: Batch):
    with pytest.raises(ValueError, match="smaller than the crop"):
        augment(batch, AugmentConfig(100, 50), generator())


def test_the_cameras_motion_follows_every_change_of_coordinates():
    """What the homography predicts is changed as a truth of the same motion is, by crop, zoom and mirror."""
    homography = torch.eye(4, dtype=torch.float64)[None] + 2e-3 * torch.randn(1, 4, 4, generator=generator(4)).double()
    homography[0, :, 3] += torch.tensor([2.0, -1.5, 0.7, 0.0])
    disparity = 5 + 10 * torch.rand(1, 64, 96, generator=generator(5))
    truth = still(torch.stack([disparity] * 5, 1), homography)
    sample = Batch(torch.rand(1, 4, 3, 64, 96, generator=generator(6)), truth, homography=homography)
    for seed in range(6):
        config = AugmentConfig(48, 64, zoom=0.5 if seed > 2 else 0, stretch=0.2 if seed > 2 else 0, colour=0, noise=0, erase=0)
        changed = augment(sample, config, generator(seed))
        predicted = still(changed.truth, changed.homography)
        # a resized truth is its nearest pixel's: off by what the motion changes within half a pixel, but not on average
        difference = predicted - changed.truth
        assert difference.abs().max() < (0.3 if seed > 2 else 1e-3)
        assert difference.mean((0, 2, 3)).abs().max() < 2e-3
    both = Batch.cat([sample, changed := augment(sample, AugmentConfig(64, 96, zoom=0, stretch=0), generator(9))])
    assert torch.equal(both[1].homography, changed.homography)
