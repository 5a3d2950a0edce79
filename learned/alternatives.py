"""Values that a pixel may take over in place of its own: those of its neighbours, of the camera's motion and of the second
pair.

A sum of small corrections cannot mend an error of thirty pixels behind an occlusion, and a network whose corrections
are that large spoils images unlike those it was trained on. Values that something else vouches for carry their scale
with them; what is left to learn is which of them to trust.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.bfloat16 import to_array
from learned.gate_kernels import gated_change as gate_kernel
from learned.mixture_kernels import border as border_kernel
from learned.mixture_kernels import contrasts as contrasts_kernel
from learned.mixture_kernels import mixture as mixture_kernel
from learned.threads import over_tasks
from learned.view_kernels import LEAST_SCALE
from learned.view_kernels import pick as pick_kernel

# Channels of the state on left1's grid that are trusted, or not, together: D1; C, u and v. D2 lives on left2's grid.
_GROUPS = ((0,), (2, 3, 4))
# What counts as good: KITTI's limit.
_GOOD_PX = 3.0
_CORRECTION_MOST_PX = 4.0  # a step; larger changes need somebody who vouches for them
_DIRECTIONS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


class Grid(NamedTuple):
    """Every divisor-th pixel of an image, the last of each block: a mean would be neither foreground nor background."""

    divisor: int

    def pick(self, maps: Tensor) -> Tensor:
        """(B, n, H, W) -> (B, n, h, w), h = ceil(H / divisor); the border's values repeat outside."""
        if kernels_may(maps):
            out = torch.empty((*maps.shape[:2], *(-(-side // self.divisor) for side in maps.shape[2:])))
            arrays = maps.detach().contiguous().flatten(0, 1).numpy(), self.divisor, out.flatten(0, 1).numpy()
            over_tasks(pick_kernel, out[..., 0].numel(), *arrays)
            return out
        last = self.divisor - 1
        return self.pad(maps)[..., last :: self.divisor, last :: self.divisor]

    def pad(self, maps: Tensor) -> Tensor:
        """The maps with whole blocks."""
        bottom, right = (-side % self.divisor for side in maps.shape[-2:])
        return F.pad(maps, (0, right, 0, bottom), mode="replicate") if bottom or right else maps

    def spread(self, maps: Tensor, size: tuple[int, int]) -> Tensor:
        """(B, n, h, w) -> (B, n, H, W), the same value all over a block."""
        if self.divisor == 1:
            return maps
        return F.interpolate(maps, scale_factor=self.divisor, mode="nearest")[..., : size[0], : size[1]]

    def coordinates(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Columns (w,) and rows (h, 1) of the picked pixels of (..., h, w)."""
        last = self.divisor - 1
        height, width = like.shape[-2:]
        columns, rows = (torch.arange(side, device=like.device, dtype=like.dtype) for side in (width, height))
        return columns * self.divisor + last, rows[:, None] * self.divisor + last


def camera_motion(state: Tensor, coordinates: tuple[Tensor, Tensor], homography: Tensor) -> Tensor:
    """C, u and v (B, 3, h, w), in pixels, of points that stand still while the camera moves.

    Points that would come to lie behind the camera, or nearly, keep the motion that they have: a gate that is hardly
    open would still let in a part of a motion without bounds.

    Parameters
    ----------
    state : Tensor (B, 5, h, w)
        Pixels; its D1 says where the points are.
    coordinates : (Tensor, Tensor)
        The pixels' columns and rows, in any shapes that broadcast to (h, w).
    homography : Tensor (B, 4, 4)
        The camera's motion on (x, y, disparity, 1), float64.
    """
    x, y = coordinates
    disparity, h = state[:, 0], homography.to(state.dtype)[..., None, None]
    moved = [h[:, i, 2] * disparity + (h[:, i, 0] * x + h[:, i, 1] * y + h[:, i, 3]) for i in range(4)]
    scale = 1 / moved[3].clamp(min=LEAST_SCALE)
    motion = torch.stack([moved[2] * scale - disparity, moved[0] * scale - x, moved[1] * scale - y], 1)
    return torch.where(moved[3][:, None] > LEAST_SCALE, motion, state[:, 2:])


def second_pair(state: Tensor, coordinates: tuple[Tensor, Tensor], d2: Tensor, backward_flow: Tensor) -> tuple[Tensor, Tensor]:
    """What left2's grid says where the flow leads to.

    Parameters
    ----------
    state : Tensor (B, 5, h, w)
        At the pixels of these coordinates.
    d2, backward_flow : Tensor (B, 1, H, W) and (B, 2, H, W)
        Whole maps; beyond their border its values repeat.

    Returns
    -------
    residual : Tensor (B, 1, h, w)
        ``D2(p + F) - D1 - C``, pixels.
    round_trip : Tensor (B, 1, h, w)
        ``|F + B(p + F)|``, pixels.
    """
    x, y = coordinates
    height, width = d2.shape[-2:]
    positions = torch.stack([
        (x + state[:, 3]) * (2 / max(width - 1, 1)) - 1, (y + state[:, 4]) * (2 / max(height - 1, 1)) - 1
    ], -1)  # fmt: skip
    source = torch.cat([d2, backward_flow.to(d2.dtype)], 1)
    there = F.grid_sample(source, positions, mode="bilinear", padding_mode="border", align_corners=True)
    residual = there[:, :1] - state[:, :1] - state[:, 2:3]
    return residual, torch.hypot(state[:, 3:4] + there[:, 1:2], state[:, 4:] + there[:, 2:])


class Neighbours:
    """The pixels in eight directions at some distances.

    Parameters
    ----------
    distances : tuple of int
        In pixels of the maps that it is used on.
    """

    def __init__(self, distances: tuple[int, ...]) -> None:
        self.offsets = [(dy * distance, dx * distance) for distance in distances for dy, dx in _DIRECTIONS]
        self.reach = max(distances)

    def __call__(self, maps: Tensor) -> list[Tensor]:
        """``maps(p + o_k)`` for each offset o_k; the border's values repeat outside."""
        height, width = maps.shape[-2:]
        reach, padded = self.reach, self._pad(maps)
        return [padded[..., reach + dy : reach + dy + height, reach + dx : reach + dx + width] for dy, dx in self.offsets]

    def _pad(self, maps: Tensor) -> Tensor:
        return F.pad(maps, (self.reach,) * 4, mode="replicate")

    def contrasts(self, image: Tensor) -> Tensor:
        """(B, k, h, w): mean absolute difference of an image (B, c, h, w) to each neighbour's."""
        if kernels_may(image):
            out = torch.empty((image.shape[0], len(self.offsets), *image.shape[2:]))
            arrays = self._pad(image.detach()).numpy(), np.array(self.offsets), self.reach, out.numpy()
            over_tasks(contrasts_kernel, image.shape[0] * image.shape[2], *arrays)
            return out
        return torch.cat([(image - other).abs().mean(1, keepdim=True) for other in self(image)], 1)

    def mixture(
        self, state: Tensor, preference: Tensor, contrasts: Tensor, sharpness: Tensor, reliability: Tensor
    ) -> Tensor:  # fmt: skip
        """Weighted means of the neighbours' D1, C, u and v.

        ``sum_k w_k(p) X(p + o_k)``, ``w = softmax_k(a_k(p) - s c_k(p) + r(p + o_k))``. Related: Park et al., Non-Local
        Spatial Propagation Network, ECCV 2020 (there with learned offsets, on depth). Without a graph to build, on a CPU,
        a kernel does it in one pass.

        Parameters
        ----------
        state : Tensor (B, 5, h, w)
        preference : Tensor (B, k, h, w)
            a.
        contrasts : Tensor (B, k, h, w)
            c, of an image.
        sharpness : Tensor ()
            s.
        reliability : Tensor (B, 2, h, w)
            r, of disparity and of motion.

        Returns
        -------
        Tensor (B, 4, h, w)
        """
        if kernels_may(state):
            out = torch.empty((state.shape[0], 4, *state.shape[2:]))
            count, _, height, width = state.shape
            bordered = np.empty((count, 6, height + 2 * self.reach, width + 2 * self.reach), np.float32)
            arrays = state.detach().contiguous().numpy(), to_array(reliability.detach())
            over_tasks(border_kernel, count * bordered.shape[2], *arrays, self.reach, bordered)
            maps, weight = (to_array(preference.detach()), contrasts.numpy()), np.float32(sharpness.item())
            over_tasks(mixture_kernel, count * height, bordered, *maps, weight, np.array(self.offsets), self.reach, out.numpy())
            return out
        preference = preference.float() - sharpness * contrasts
        reliability = reliability.float()
        means = []
        for group, channels in enumerate(_GROUPS):
            trust = torch.cat(self(reliability[:, group : group + 1]), 1)
            weights = (preference + trust).softmax(1)
            values = state[:, channels]
            total = torch.zeros_like(values)
            for k, other in enumerate(self(values)):
                total = torch.addcmul(total, weights[:, k : k + 1], other)
            means.append(total)
        return torch.cat(means, 1)


def kernels_may(maps: Tensor) -> bool:
    """Whether kernels, which build no graph, may take over."""
    return maps.device.type == "cpu" and maps.dtype == torch.float32 and not torch.is_grad_enabled()


class Alternatives(NamedTuple):
    """What a pixel may take over, at the picked pixels."""

    mixture: Tensor
    """(B, 4, h, w): the neighbours' D1, C, u, v."""
    camera: Tensor
    """(B, 3, h, w): C, u, v of a point that stands still."""
    residual: Tensor
    """(B, 1, h, w): the second pair's, to be added to D1 or to C."""


def gated_change(state: Tensor, alternatives: Alternatives, correction: Tensor, gates: Tensor, grid: Grid) -> Tensor:
    """A correction, and what gates let in of the alternatives: the change (B, 5, H, W), in pixels.

    Without a graph to build, on a CPU, a kernel does it in one pass.

    Parameters
    ----------
    state : Tensor (B, 5, H, W)
    alternatives : Alternatives
    correction : Tensor (B, 5, h, w)
        Added in any case, but bounded.
    gates : Tensor (B, 5 divisor**2, h, w)
        For each pixel of a block, in the order of a pixel shuffle: D1 from the neighbours, D1 from the second pair, motion
        from the neighbours, then from the camera, C from the second pair. Their hyperbolic tangents count.
    grid : Grid
    """
    if kernels_may(state):
        change = torch.empty(state.shape)
        arrays = [each.detach().numpy() for each in (state.contiguous(), *(maps.contiguous() for maps in alternatives))]
        arrays += [to_array(correction.detach()), to_array(gates.detach())]
        rows = state.shape[0] * correction.shape[2]
        over_tasks(gate_kernel, rows, *arrays, np.float32(_CORRECTION_MOST_PX), grid.divisor, change.numpy())
        return change
    size = state.shape[-2], state.shape[-1]
    correction = _CORRECTION_MOST_PX * (correction.float() / _CORRECTION_MOST_PX).tanh()
    mixture, camera, residual, correction = (grid.spread(maps, size) for maps in (*alternatives, correction))
    near, far, motion_near, motion_camera, change_far = (
        F.pixel_shuffle(gates.float().tanh(), grid.divisor)[..., : size[0], : size[1]].split(1, 1)
    )  # fmt: skip
    d1, motion = state[:, :1], state[:, 2:]
    mended = near * (mixture[:, :1] - d1) + far * residual
    moved = motion_near * (mixture[:, 1:] - motion)
    moved = moved + motion_camera * (camera - motion - moved)
    moved = torch.cat([moved[:, :1] + change_far * residual, moved[:, 1:]], 1)
    return torch.cat([mended, torch.zeros_like(d1), moved], 1) + correction


def reliability_loss(logits: Tensor, state: Tensor, truth: Tensor) -> Tensor:
    """Binary cross-entropy of the reliability against "within 3 px of the truth", where that is known.

    Parameters
    ----------
    logits : Tensor (B, 2, h, w)
        Of disparity and motion.
    state, truth : Tensor (B, 5, h, w)
        At the same pixels; truth is NaN where unknown.
    """
    error = (state - truth).abs()
    good = torch.stack([error[:, 0] < _GOOD_PX, (error[:, 2:] < _GOOD_PX).all(1)], 1)
    known = torch.isfinite(torch.stack([error[:, 0], error[:, 2:].sum(1)], 1))
    entropy = F.binary_cross_entropy_with_logits(logits, good.to(logits.dtype), reduction="none")
    return torch.where(known, entropy, 0).sum() / known.sum().clamp(min=1)
