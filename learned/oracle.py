"""The analytic gradient for torch: the classical side's kernels behind tensors. The only file here that imports it.

Two ways to use it, both batched:

* :meth:`Oracle.features`: loss map and gradient as plain tensors without a graph, the refiner's input;
* :meth:`Oracle.energy`: a scalar a sample that autograd can differentiate, whose backward pass is the analytic
  gradient, so that self-supervised training on the CPU never builds the twin's graph.

On the CPU the kernels read and write the tensors' own memory. Tensors on any other device go to the twin
(:mod:`learned.consistency`), which gives the same numbers more slowly. How numba's and torch's threads share the cores
stands in docs/decisions.md.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from learned.consistency import consistency_map
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames


class Oracle:
    """The energy of a batch of frames as a function of the batch's states.

    Parameters
    ----------
    left1, right1, left2, right2 : Tensor
        ``(B, c, H, W)`` in [0, 1], c = 1 or 3 (BGR).
    backward_flow : Tensor or None
        ``(B, 2, H, W)`` left2 -> left1 on left2's grid, in pixels, held fixed; None calls every pixel visible.
    config : EnergyConfig
        Weights and options.
    """

    def __init__(self, left1: Tensor, right1: Tensor, left2: Tensor, right2: Tensor,
                 backward_flow: Tensor | None = None, config: EnergyConfig | None = None) -> None:
        self.config = config or EnergyConfig()
        self._images = tuple(image.detach() for image in (left1, right1, left2, right2))
        self._backward = None if backward_flow is None else backward_flow.detach()
        self._energies: list[Energy] = []
        if left1.device.type == "cpu":
            images = [_channels_last(image) for image in self._images]
            backward = None if self._backward is None else _channels_last(self._backward)
            self._energies = [Energy(Frames(*(image[i] for image in images)), self.config,
                                     None if backward is None else backward[i]) for i in range(left1.shape[0])]

    def features(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Loss map ``(B, H, W)`` and gradient of its sum ``(B, 5, H, W)``, detached from every graph.

        `state` is ``(B, 5, H, W)`` in pixels; float32 and float64 are computed as such, any other type in float32.
        """
        state = state.detach()
        if state.device.type != "cpu":
            return self._twin_features(state)
        kept = state.dtype if state.dtype in (torch.float32, torch.float64) else torch.float32
        contiguous = state.to(kept).contiguous()
        loss, gradient = torch.empty_like(contiguous[:, 0]).contiguous(), torch.empty_like(contiguous)
        arrays = contiguous.numpy(), loss.numpy(), gradient.numpy()
        for i, energy in enumerate(self._energies):
            energy.value_and_gradient(arrays[0][i], out=(arrays[1][i], arrays[2][i]))
        return loss, gradient

    def energy(self, state: Tensor) -> Tensor:
        """The energy of each sample, ``(B,)``: the sum of its loss map. Differentiable once by the state."""
        if state.device.type != "cpu":
            return self._twin_map(state).sum((1, 2))
        return _AnalyticEnergy.apply(state, self)

    def _twin_map(self, state: Tensor) -> Tensor:
        left1, right1, left2, right2 = self._images
        return consistency_map(state, left1, right1, left2, right2, self._backward, **asdict(self.config))

    def _twin_features(self, state: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            state = state.requires_grad_()
            loss = self._twin_map(state)
            (gradient,) = torch.autograd.grad(loss.sum(), state)
        return loss.detach(), gradient


class _AnalyticEnergy(torch.autograd.Function):
    """Forward: the handwritten energy, with its gradient along the way. Backward: that gradient."""

    @staticmethod
    def forward(ctx: Any, state: Tensor, oracle: Oracle) -> Tensor:
        loss, gradient = oracle.features(state)
        ctx.save_for_backward(gradient.to(state.dtype))
        return loss.sum((1, 2), dtype=torch.float64).to(state.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return upstream[:, None, None, None] * gradient, None


def _channels_last(images: Tensor) -> np.ndarray:
    """``(B, c, H, W)`` tensor to ``(B, H, W, c)`` array, contiguous, float32 or float64; channels that share their memory,
    as those of a grey image made to look like colour, become one: the energy takes their mean."""
    images = images[:, :1] if images.stride(1) == 0 else images
    kept = images if images.dtype in (torch.float32, torch.float64) else images.float()
    return np.ascontiguousarray(kept.permute(0, 2, 3, 1).numpy())
