"""Learned propagation: a pixel takes over values of neighbours that are more trustworthy than its own.

A sum of small corrections cannot mend an error of thirty pixels behind an occlusion; the neighbours' values can. Related:
Park et al., Non-Local Spatial Propagation Network, ECCV 2020 (there with learned offsets, on depth).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Channels of the state on left1's grid that are trusted, or not, together: D1; C, u and v. D2 lives on left2's grid.
_GROUPS = ((0,), (2, 3, 4))
_CHANNELS = (0, 2, 3, 4)
# Affinity of neighbours falls by this factor's exponential with their difference in intensity, before training.
_EDGE_SHARPNESS = 10.0
# What counts as good: KITTI's limit.
_GOOD_PX = 3.0


class Propagation(nn.Module):
    """The change towards a weighted mean of neighbours, on blocks of divisor x divisor pixels.

    ``change = gate(p) (sum_k w_k(p) X(p + o_k) - X(p))``, ``w = softmax_k(a_k(p) - s |I(p) - I(p + o_k)| + r(p + o_k))``: a
    preference for directions a, the image's edges, and the neighbours' reliability r, which is trained to tell good values
    from wrong ones. Gates start at zero: nothing changes.

    Parameters
    ----------
    features : int
        Channels of the features.
    divisor : int
        Side of a block in pixels; a block is represented by its last pixel, for a mean would be neither foreground nor
        background.
    distances : tuple of int
        Of the neighbours, in blocks, each in eight directions.
    """

    def __init__(self, features: int, divisor: int, distances: tuple[int, ...]) -> None:
        super().__init__()
        self.divisor = divisor
        directions = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
        self.offsets = [(dy * distance, dx * distance) for distance in distances for dy, dx in directions]
        self.reach = max(distances)
        self.reliability = nn.Conv2d(features, len(_GROUPS), 3, padding=1)
        self.preference = nn.Conv2d(features, len(self.offsets), 3, padding=1)
        self.gates = nn.Conv2d(features, len(_CHANNELS) * divisor**2, 3, padding=1)
        self.edge_sharpness = nn.Parameter(torch.tensor(_EDGE_SHARPNESS))
        for layer in (self.reliability, self.preference, self.gates):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, features: Tensor, state: Tensor, left1: Tensor) -> tuple[Tensor, Tensor]:
        """The change (B, 5, H, W) in pixels and the reliability's logits (B, 2, h, w) of disparity and motion.

        Parameters
        ----------
        features : Tensor (B, features, h, w)
            h = ceil(H / divisor).
        state : Tensor (B, 5, H, W)
            Pixels.
        left1 : Tensor (B, 3, H, W)
        """
        height, width = state.shape[-2:]
        reliability = self.reliability(features).float()
        values, image = self.pick(state), self.pick(left1)
        shared = self.preference(features).float() - self.edge_sharpness * torch.cat(
            [(image - other).abs().mean(1, keepdim=True) for other in self._neighbours(image)], 1
        )
        mixtures = []
        for group, channels in enumerate(_GROUPS):
            trust = torch.cat(list(self._neighbours(reliability[:, group : group + 1])), 1)
            weights = (shared + trust).softmax(1).split(1, 1)
            total = torch.zeros_like(values[:, channels])
            for weight, other in zip(weights, self._neighbours(values[:, channels]), strict=True):
                total = total + weight * other
            mixtures.append(total)
        mixture = F.interpolate(torch.cat(mixtures, 1), scale_factor=self.divisor, mode="nearest")[..., :height, :width]
        gates = F.pixel_shuffle(self.gates(features).float(), self.divisor)[..., :height, :width].tanh()
        moved = gates * (mixture - state[:, _CHANNELS])
        return torch.cat([moved[:, :1], torch.zeros_like(moved[:, :1]), moved[:, 1:]], 1), reliability

    def pick(self, maps: Tensor) -> Tensor:
        """The pixel that represents each block."""
        last = self.divisor - 1
        bottom, right = (-side % self.divisor for side in maps.shape[-2:])
        padded = F.pad(maps, (0, right, 0, bottom), mode="replicate") if bottom or right else maps
        return padded[..., last :: self.divisor, last :: self.divisor]

    def _neighbours(self, maps: Tensor) -> list[Tensor]:
        """The maps as each neighbour sees them, ``maps(p + o_k)``; the border's values repeat outside."""
        height, width = maps.shape[-2:]
        reach = self.reach
        padded = F.pad(maps, (reach,) * 4, mode="replicate")
        return [padded[..., reach + dy : reach + dy + height, reach + dx : reach + dx + width] for dy, dx in self.offsets]


def reliability_loss(logits: Tensor, state: Tensor, truth: Tensor) -> Tensor:
    """Binary cross-entropy of the reliability against "within 3 px of the truth", where that is known.

    Parameters
    ----------
    logits : Tensor (B, 2, h, w)
        Of disparity and motion.
    state, truth : Tensor (B, 5, h, w)
        At the blocks' pixels, in pixels; truth is NaN where unknown.
    """
    error = (state - truth).abs()
    good = torch.stack([error[:, 0] < _GOOD_PX, (error[:, 2:] < _GOOD_PX).all(1)], 1)
    known = torch.isfinite(torch.stack([error[:, 0], error[:, 2:].sum(1)], 1))
    entropy = F.binary_cross_entropy_with_logits(logits, good.to(logits.dtype), reduction="none")
    return torch.where(known, entropy, 0).sum() / known.sum().clamp(min=1)
