"""A refiner that chooses: at each pixel the state stays as it is or becomes that of something nearby.

The solver's states are whole numbers of decisions: a pixel belongs to this surface or to that one. What is left to mend is
the choice, not the digits, and a network that adds small corrections finds nothing to do. This one sees what speaks for
each of a few whole states (`learned.choices`) and gives them probabilities; it learns by the probability of those that are
right, and at test time changes what it is sure of.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from learned.batch import Batch
from learned.choices import CHOICES, DESCRIPTION, Choices, describe, find_choices, with_gradients
from learned.inputs import View
from learned.refiner import Update, hidden_layers

# What counts as right: KITTI's limits.
_RIGHT_PX, _RIGHT_SHARE = 3.0, 0.05
_NEVER = -1e4  # a logarithm of a probability; minus infinity has no derivative
_FIRST_BIAS = 2.0  # for the state as it is, before training


@dataclass(frozen=True)
class SelectorConfig:
    """Sizes of a selector."""

    layers: tuple[tuple[int, int], ...] = ((32, 1), (32, 2), (32, 4), (32, 8), (32, 16), (32, 32), (32, 4), (32, 1))
    """(channels, dilation) of the hidden 3 x 3 convolutions."""
    least_jump_px: float = 1.0
    """Where no two neighbours within reach differ by more in disparity, all stays as it is: a slope leaves no choice."""
    sure: float = 0.7
    """Probability from which another choice than the state is taken, at test time."""
    steps: int = 4
    """T: how often it chooses; each time values may come from 4 px farther away."""

    def __post_init__(self) -> None:
        if not self.layers or self.steps < 0 or not 0 <= self.sure <= 1:
            raise ValueError("there must be a hidden layer, steps must not be negative, sure must lie in 0 ... 1")

    @property
    def needs_energy(self) -> bool:
        """It compares images itself, choice by choice."""
        return False

    @property
    def weighs_energies(self) -> bool:
        """See `learned.refiner.RefinerConfig`."""
        return False

    @property
    def detached(self) -> bool:
        """Choices have no derivative."""
        return True


class Selector(nn.Module):
    """Probabilities of the choices, by a few convolutions. Untrained, it changes nothing."""

    def __init__(self, config: SelectorConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SelectorConfig()
        self.hidden = hidden_layers(DESCRIPTION, config.layers)
        self.logits = nn.Conv2d(config.layers[-1][0], CHOICES, 1)
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.logits.bias[0] = _FIRST_BIAS  # type: ignore[index]

    def prepare(self, batch: Batch) -> Tensor:
        """The images as all steps see them, for `learned.hybrid.refine`."""
        return with_gradients(batch.images)

    def weigh(self, state: Tensor, batch: Batch, prepared: Tensor | None = None) -> tuple[Tensor, Choices]:
        """Logits (B, CHOICES, H, W) and the choices that they are about."""
        if batch.evidence is None or batch.evidence.shape[1] != 2:
            raise ValueError("choosing needs the start's confidence and visibility")
        with torch.no_grad():
            choices = find_choices(state)
            seen = describe(choices, self.prepare(batch) if prepared is None else prepared, batch.evidence)
        return self.logits(self.hidden(seen.contiguous(memory_format=torch.channels_last))).float(), choices

    def forward(self, view: View, batch: Batch) -> Update:
        """The change to the choice that it is sure of.

        Parameters
        ----------
        view : View
            Its state, and what was prepared, if that was.
        batch : Batch
            With images and evidence.
        """
        logits, choices = self.weigh(view.state, batch, view.prepared)
        probability, other = logits.softmax(1)[:, 1:].max(1)
        changes = (probability > self.config.sure) & (choices.step > self.config.least_jump_px)
        chosen = torch.where(changes, other + 1, 0)
        best = choices.states.gather(1, chosen[:, None, None].expand(-1, 1, view.state.shape[1], -1, -1))[:, 0]
        return Update(best - view.state, None)


def right(states: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Which states are right by KITTI's limits: in everything that is known of the pixel, and in D1 alone.

    Parameters
    ----------
    states : Tensor (B, K, 5, H, W)
    truth : Tensor (B, 5, H, W)
        NaN where unknown.

    Returns
    -------
    (Tensor, Tensor)
        (B, K, H, W) bool each.
    """
    truth = truth[:, None]
    d1, change, u, v = (truth[:, :, k] for k in (0, 2, 3, 4))
    disparity = ~_outlier((states[:, :, 0] - d1).abs(), d1.abs())
    second = ~_outlier((states[:, :, 0] + states[:, :, 2] - d1 - change).abs(), (d1 + change).abs())
    flow = ~_outlier(torch.hypot(states[:, :, 3] - u, states[:, :, 4] - v), torch.hypot(u, v))
    return disparity & second & flow, disparity


def _outlier(error: Tensor, size: Tensor) -> Tensor:
    """Not where either is unknown."""
    return (error > _RIGHT_PX) & (error > _RIGHT_SHARE * size)


def selection_loss(logits: Tensor, choices: Choices, truth: Tensor, least_jump_px: float) -> Tensor:
    """Mean of ``-log p(right)`` over the pixels where some choices are right and others are not.

    A choice is right if all of it is; where none is, if its disparity is.

    Parameters
    ----------
    logits : Tensor (B, CHOICES, H, W)
    choices : Choices
    truth : Tensor (B, 5, H, W)
        NaN where unknown.
    least_jump_px : float
        Pixels with less to choose between do not count; nor do those at infinity (rendered sky), of which real frames have
        no truth.
    """
    whole, disparity = right(choices.states, truth)
    good = torch.where(whole.any(1, keepdim=True), whole, disparity)
    counts = (truth[:, 0] > 0) & good.any(1) & ~good.all(1) & (choices.step > least_jump_px)
    probability = logits.log_softmax(1).masked_fill(~good, _NEVER).logsumexp(1)
    return -torch.where(counts, probability, 0).sum() / counts.sum().clamp(min=1)
