"""The torch twin: against the plain twin in numpy, batched, twice differentiable, with the classical side's options."""

import inspect
from dataclasses import asdict

import numpy as np
import pytest
import torch

from cgsf.gradcheck import random_scene
from learned.consistency import consistency_map, sample, visible_mask
from tests import naive
from tests.tolerances import EXACT
from variational.energy import EnergyConfig

OPTIONS = EnergyConfig(drop_outside=True, charbonnier_intensity=0.01, charbonnier_px=0.05, edge_sharpness=7,
                       ssim_share=0.6)


def tensors(scene):
    """State, four images and backward flow of a scene, each with a batch axis."""
    frames = scene.frames
    images = (frames.left1, frames.right1, frames.left2, frames.right2, scene.backward_flow)
    planes = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None] for image in images]
    return torch.from_numpy(scene.state)[None], *planes


def test_arguments_are_the_classical_configuration():
    signature = inspect.signature(consistency_map).parameters
    keywords = {name: p.default for name, p in signature.items() if p.kind is p.KEYWORD_ONLY}
    assert keywords == asdict(EnergyConfig())


@pytest.mark.parametrize("config", [EnergyConfig(), OPTIONS], ids=["paper", "options"])
def test_map_equals_naive(config):
    scene = random_scene((11, 17), seed=2)
    twin = consistency_map(*tensors(scene), **asdict(config))[0].numpy()
    plain = naive.energy_map(scene.frames, scene.state, scene.backward_flow, config)
    assert np.abs(twin - plain).max() < EXACT * np.abs(plain).max()


def test_batch_is_samples_side_by_side():
    scenes = [tensors(random_scene((9, 14), seed)) for seed in range(3)]
    batch = consistency_map(*(torch.cat(parts) for parts in zip(*scenes, strict=True)))
    for i, scene in enumerate(scenes):
        torch.testing.assert_close(batch[i], consistency_map(*scene)[0], rtol=1e-13, atol=0)


def test_visible_mask_equals_naive_and_has_no_gradient():
    scene = random_scene((23, 26))
    state, *_, back = tensors(scene)
    mask = visible_mask(state[:, 3:].requires_grad_(), back)
    assert not mask.requires_grad
    expected = naive.visible_mask(scene.state[3:].transpose(1, 2, 0), scene.backward_flow, 0.01, 0.05)
    assert np.array_equal(mask[0].numpy(), expected)
    assert 0.02 < mask.double().mean() < 0.98


def test_first_and_second_derivatives():
    """gradcheck and gradgradcheck on the smooth penalty, away from the sampler's kinks."""
    state, *rest = tensors(random_scene((3, 4), seed=1))
    options = asdict(EnergyConfig(charbonnier_intensity=0.05, charbonnier_px=0.3))
    visible = torch.ones(1, 3, 4, dtype=torch.bool)

    def energy(x):
        return consistency_map(x, *rest, visible, **options).sum()

    state = (state.floor() + state.frac().clamp(0.1, 0.9)).requires_grad_()
    assert torch.autograd.gradcheck(energy, (state,))
    assert torch.autograd.gradgradcheck(energy, (state,))


def test_sample_keeps_whole_displacements_exact():
    image = torch.rand(1, 2, 6, 9, generator=torch.Generator().manual_seed(0))
    dx, dy = torch.full((1, 6, 9), 2.0), torch.full((1, 6, 9), -1.0)
    assert torch.equal(sample(image, dx, dy)[..., 1:, :-2], image[..., :-1, 2:])
    assert torch.equal(sample(image, dx)[..., :-2], image[..., 2:])
