"""The analytic gradient behind tensors: equal to the twin, batched, without copies, as features and under autograd."""

import numpy as np
import pytest
import torch

from cgsf.gradcheck import random_scene
from learned.consistency import consistency_map
from learned.oracle import Oracle
from variational.energy import EnergyConfig


def batch(count=2, size=(18, 25), dtype=torch.float64):
    """State, images and backward flow of several random scenes."""
    parts = []
    for seed in range(count):
        scene = random_scene(size, seed)
        frames = scene.frames
        arrays = (frames.left1, frames.right1, frames.left2, frames.right2, scene.backward_flow)
        planes = [torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1))) for array in arrays]
        parts.append([torch.from_numpy(scene.state), *planes])
    return [torch.stack(part).to(dtype) for part in zip(*parts, strict=True)]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 1e-3)])
def test_features_equal_the_twins(dtype, tolerance):
    state, *rest = batch(dtype=dtype)
    loss, gradient = Oracle(*rest).features(state)
    assert loss.dtype == gradient.dtype == dtype
    leaf = state.clone().requires_grad_()
    twin = consistency_map(leaf, *rest)
    (expected,) = torch.autograd.grad(twin.sum(), leaf)
    scale = expected.abs().amax((2, 3), keepdim=True)
    deviation = ((gradient - expected).abs() / scale).flatten()
    assert deviation.quantile(0.999) < tolerance
    torch.testing.assert_close(loss, twin.detach(), rtol=0, atol=tolerance)


def test_features_have_no_graph_and_leave_the_state_alone():
    state, *rest = batch()
    kept = state.clone()
    loss, gradient = Oracle(*rest).features(state.requires_grad_())
    assert not loss.requires_grad
    assert not gradient.requires_grad
    assert torch.equal(state, kept)


def test_energy_under_autograd():
    """The chain rule through the bridge: a network's parameter before it, weights of the samples after it."""
    state, *rest = batch()
    oracle = Oracle(*rest)
    scale = torch.tensor(1.1, dtype=state.dtype, requires_grad=True)
    weights = torch.tensor([0.5, -2.0], dtype=state.dtype)
    (weights * oracle.energy(scale * state)).sum().backward()
    other = scale.detach().clone().requires_grad_()
    (weights * consistency_map(other * state, *rest).sum((1, 2))).sum().backward()
    torch.testing.assert_close(scale.grad, other.grad, rtol=1e-9, atol=0)


def test_energy_is_differentiable_once():
    state, *rest = batch(1)
    state.requires_grad_()
    (gradient,) = torch.autograd.grad(Oracle(*rest).energy(state).sum() * state.sum(), state, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_float32_memory_is_shared(monkeypatch):
    state, *rest = batch(dtype=torch.float32)
    oracle, seen = Oracle(*rest), []
    energy = oracle._energies[0]
    original = energy.value_and_gradient
    monkeypatch.setattr(energy, "value_and_gradient", lambda x, out: seen.append((x, out)) or original(x, out=out))
    loss, gradient = oracle.features(state)
    (x, out), = seen
    assert x.ctypes.data == state.data_ptr()
    assert [array.ctypes.data for array in out] == [loss.data_ptr(), gradient.data_ptr()]


def test_half_precision_is_computed_in_single():
    state, *rest = batch(dtype=torch.float32)
    oracle = Oracle(*rest)
    rounded = state.to(torch.bfloat16)
    loss, gradient = oracle.features(rounded)
    assert gradient.dtype == torch.float32
    assert torch.equal(loss, oracle.features(rounded.float())[0])


def test_another_device_goes_to_the_twin():
    """The meta device has no memory: only shapes pass, and only through torch."""
    state, *rest = (tensor.to("meta") for tensor in batch())
    oracle = Oracle(*rest, config=EnergyConfig(flow_weight=0, coupling_weight=0))
    loss, gradient = oracle.features(state)
    assert loss.shape == (2, 18, 25)
    assert gradient.shape == state.shape
    assert gradient.device.type == oracle.energy(state).device.type == "meta"


def test_grey_images_repeated_without_a_copy_are_computed_once():
    state, left1, right1, left2, right2, backward = batch(dtype=torch.float32)
    grey = [image[:, :1] for image in (left1, right1, left2, right2)]
    repeated = Oracle(*(image.expand(-1, 3, -1, -1) for image in grey), backward)
    assert {energy.frames.left1.shape[2] for energy in repeated._energies} == {1}
    copied = Oracle(*(image.repeat(1, 3, 1, 1) for image in grey), backward)
    for one, other in zip(repeated.features(state), copied.features(state), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
