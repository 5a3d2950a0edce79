"""The feedforward module: from four images to a first state, by any disparity network and any motion network."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import partial
from itertools import pairwise
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from learned.threads import side_by_side

Precision = Literal["auto", "float32", "bfloat16"]


class DisparityNetwork(Protocol):
    """Whatever maps (left, right), (B, 3, H, W) in [0, 1] BGR, to the left image's disparity (B, H, W) in pixels.

    One with a true attribute ``light`` may run side by side with itself: two passes take little memory.
    """

    def __call__(self, left: Tensor, right: Tensor) -> Tensor: ...


class MotionNetwork(Protocol):
    """Whatever maps (first, second) to (B, 3, H, W): u, v and the disparity change, in pixels, at first's pixels."""

    def __call__(self, first: Tensor, second: Tensor) -> Tensor: ...


@runtime_checkable
class SharedMotionNetwork(Protocol):
    """A motion network that may have a cheaper way to both directions; the same results up to rounding."""

    def both_ways(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]: ...


class FeedforwardModule(nn.Module):
    """Two disparity passes and two motion passes, joined to a state.

    Parameters
    ----------
    disparity, motion : DisparityNetwork, MotionNetwork
        ``GANet`` and ``PWCNet``, or any others that follow the protocol; modules are trained and moved along.
    precision : "auto", "float32" or "bfloat16"
        Of convolutions; coordinates, correlations, aggregation and the results stay in float32. auto is bfloat16 where a
        CPU has instructions for it, and float32 elsewhere.
    """

    def __init__(self, disparity: DisparityNetwork, motion: MotionNetwork, precision: Precision = "float32") -> None:
        super().__init__()
        self.disparity, self.motion, self.precision = disparity, motion, precision

    def forward(self, left1: Tensor, right1: Tensor, left2: Tensor, right2: Tensor) -> tuple[Tensor, Tensor]:
        """State and backward flow, in pixels.

        Parameters
        ----------
        left1, right1, left2, right2 : Tensor (B, 3, H, W)
            In [0, 1], BGR.

        Returns
        -------
        state : Tensor (B, 5, H, W)
            D1, D2 (on left2's grid), C, u, v.
        backward_flow : Tensor (B, 2, H, W)
            left2 -> left1.
        """
        disparities, (motion, backward_flow) = self.disparities(left1, right1, left2, right2), self.motions(left1, left2)
        return join_state(disparities, motion), backward_flow

    def disparities(self, left1: Tensor, right1: Tensor, left2: Tensor, right2: Tensor) -> Tensor:
        """D1 and D2 alone, (B, 2, H, W)."""
        size = left1.shape[0], *left1.shape[2:]
        first, second = partial(self.disparity, left1, right1), partial(self.disparity, left2, right2)
        with mixed_precision(self.precision, left1.device):
            if left1.device.type == "cpu" and not torch.is_grad_enabled() and getattr(self.disparity, "light", False):
                d1, d2 = side_by_side(first, second)
            else:
                d1, d2 = first(), second()
        if d1.shape != size or d2.shape != size:
            raise ValueError(f"the network must return disparity {size}, not {tuple(d1.shape)}")
        return torch.stack([d1, d2], 1)

    def motions(self, left1: Tensor, left2: Tensor) -> tuple[Tensor, Tensor]:
        """Motion (B, 3, H, W: u, v and the disparity change) and backward flow (B, 2, H, W) alone."""
        size = left1.shape[0], 3, *left1.shape[2:]
        with mixed_precision(self.precision, left1.device):
            forward, backward = self._both_ways(left1, left2)
        if forward.shape != size:
            raise ValueError(f"the network must return motion {size}, not {tuple(forward.shape)}")
        return forward, backward[:, :2]

    def _both_ways(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Motion there and back; a network that can share work between the two is asked for both at once."""
        if isinstance(self.motion, SharedMotionNetwork):
            return self.motion.both_ways(first, second)
        return self.motion(first, second), self.motion(second, first)


def mixed_precision(precision: Precision, device: torch.device) -> AbstractContextManager[None]:
    """A context in which convolutions have this precision; auto is bfloat16 where a CPU has instructions for it."""
    auto = precision == "auto" and device.type == "cpu" and _fast_bfloat16()
    return torch.autocast(device.type, torch.bfloat16, enabled=auto or precision == "bfloat16")


def _fast_bfloat16() -> bool:
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # older torch cannot tell
    return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def join_state(disparities: Tensor, motion: Tensor) -> Tensor:
    """The state (B, 5, H, W) of D1 and D2 (B, 2, H, W) and u, v, C (B, 3, H, W)."""
    return torch.cat([disparities, motion[:, 2:], motion[:, :2]], 1)


def fold_normalisation(net: nn.Module) -> nn.Module:
    """Fold batch normalisation into the convolution before it, in place: the same results in evaluation, in less time.

    The network must be in evaluation mode and cannot be trained afterwards.
    """
    if net.training:
        raise ValueError("only a network in evaluation mode can be folded")
    for module in net.modules():
        layers = list(module.named_children()) if isinstance(module, nn.Sequential) else []
        for (name, layer), (next_name, following) in pairwise(layers):
            if isinstance(following, nn.BatchNorm2d | nn.BatchNorm3d):
                transposed = isinstance(layer, nn.ConvTranspose2d | nn.ConvTranspose3d)
                setattr(module, name, fuse_conv_bn_eval(layer, following, transposed))  # type: ignore[type-var]
                setattr(module, next_name, nn.Identity())
    return net


def select_device(name: str) -> torch.device:
    """The device of that name; a ValueError with one clear line if this machine or this torch does not have it."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).add_(1)
    except (RuntimeError, AssertionError, NotImplementedError, ValueError):
        accelerator = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
        have = "cpu" + (f", {accelerator.type}" if accelerator else "")
        raise ValueError(f"device {name!r} is not available here; available: {have}") from None
    return device
