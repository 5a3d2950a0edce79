"""Losses of states: masks, channels, the sum over steps."""

import math

import pytest
import torch

from learned.oracle import Oracle
from learned.state_losses import energy_loss, sequence_loss, state_loss

NAN = float("nan")


def state(*values: float) -> torch.Tensor:
    """One pixel: D1, D2, C, u, v."""
    return torch.tensor(values, dtype=torch.float32).view(1, 5, 1, 1)


def test_channels():
    truth = state(0, 0, 0, 0, 0)
    assert state_loss(state(1, 10, 2, 3, 4), truth) == 1 + 2 + 3 + 4
    assert state_loss(state(1, 10, 2, 3, 4), truth, left2_weight=0.5) == 15


def test_unknown_truth_counts_for_nothing_and_passes_no_nan():
    estimate = torch.cat([state(1, 1, 1, 1, 1), state(5, 5, 5, 5, 5)], 3).requires_grad_()
    truth = torch.cat([state(0, NAN, 0, NAN, NAN), state(NAN, NAN, NAN, NAN, NAN)], 3)
    loss = state_loss(estimate, truth, left2_weight=1)
    loss.backward()
    assert loss == 2
    assert torch.equal(estimate.grad[0, :, 0], torch.tensor([[1.0, 0], [0, 0], [1, 0], [0, 0], [0, 0]]))
    assert state_loss(estimate, torch.full_like(truth, NAN)) == 0


def test_robust_loss():
    assert state_loss(state(6, 0, 0, 0, 0), state(0, 0, 0, 0, 0), robust_px=2) == pytest.approx(2 * math.log(4))


def test_sum_over_steps():
    truth = state(0, 0, 0, 0, 0)
    assert sequence_loss([state(t, 0, 0, 0, 0) for t in (3, 2, 1)], truth) == 6


def test_energy_is_a_mean_over_pixels():
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(4, 2, 3, 9, 11, generator=generator)
    oracle = Oracle(*images)
    states = [torch.rand(2, 5, 9, 11, generator=generator).requires_grad_() for _ in range(2)]
    loss = energy_loss(states, oracle)
    by_hand = sum(oracle.features(one)[0].mean() for one in states)
    assert loss.detach().item() == pytest.approx(by_hand.item(), rel=1e-5)
    loss.backward()
    gradient = oracle.features(states[0])[1] / (2 * 9 * 11)
    assert torch.allclose(states[0].grad, gradient, rtol=1e-5, atol=1e-9)
