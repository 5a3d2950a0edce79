"""Losses of states, for the refiner and for training everything jointly; those of the single networks:
`learned.losses`.

Unknown truth is NaN and counts for nothing. Chen et al., section "Training".
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from learned.losses import robust
from learned.oracle import Oracle


def masked_mean(values: Tensor, known: Tensor) -> Tensor:
    """Mean of `values` where `known`; zero where nothing is known."""
    return torch.where(known, values, 0).sum() / known.sum().clamp(min=1)


def state_loss(state: Tensor, truth: Tensor, left2_weight: float = 0.0, robust_px: float = 0.0) -> Tensor:
    """``|F - F*| + |D1 - D1*| + |C - C*|``, each the mean over the pixels whose truth is known, in pixels.

    Parameters
    ----------
    state, truth : Tensor (B, 5, H, W)
        Pixels; truth is NaN where unknown.
    left2_weight : float
        Weight of ``|D2 - D2*|``; the paper leaves it out.
    robust_px : float
        0: the absolute error. Otherwise the `robust` one at that scale.
    """
    weights = (1.0, left2_weight, 1.0, 1.0, 1.0)
    total = state.new_zeros(())
    for channel, weight in enumerate(weights):
        if weight > 0:
            known = torch.isfinite(truth[:, channel])
            error = (state[:, channel] - torch.where(known, truth[:, channel], 0)).abs()
            total = total + weight * masked_mean(robust(error, robust_px), known)
    return total


def sequence_loss(states: Sequence[Tensor], truth: Tensor, left2_weight: float = 0.0, robust_px: float = 0.0) -> Tensor:
    """The sum over t = 0 ... T of the loss of X_t."""
    return torch.stack([state_loss(state, truth, left2_weight, robust_px) for state in states]).sum()


def energy_loss(states: Sequence[Tensor], oracle: Oracle) -> Tensor:
    """Self-supervision: the sum over t of the consistency energy of X_t, mean over pixels and batch."""
    pixels = states[0].shape[-2] * states[0].shape[-1]
    return torch.stack([oracle.energy(state).mean() / pixels for state in states]).sum()
