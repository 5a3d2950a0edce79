"""The refinement network G: from a state, its energy and the energy's gradient to a better state.

``X_{t+1} = X_t + G(X_t, L(X_t), dL/dX(X_t))`` (Chen et al., section "Refinement"), the same weights in every step; the
loop over steps stands in `learned.hybrid`. The published network is three 3 x 3 convolutions with 512 hidden channels;
the compact one works on blocks of pixels, sees further by dilation, and may take over the values of neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.propagation import Propagation

Input = Literal["state", "loss", "gradient", "deviation", "image", "evidence"]

# What brings each input to a range of about one. Pixels of motion, the energy's map (its photometric terms end at 3),
# the gradient (the coupling's is 1 a pixel) and the state's deviation from its surroundings, in pixels.
_STATE_SCALE, _LOSS_SCALE, _GRADIENT_SCALE, _DEVIATION_SCALE = 0.05, 0.5, 1.0, 0.25
_LOSS_MOST, _GRADIENT_MOST, _DEVIATION_MOST = 20.0, 5.0, 40.0
_SURROUNDINGS_PX = 16  # side of the box that the deviation is measured against


@dataclass(frozen=True)
class RefinerConfig:
    """Sizes of a refiner; the defaults are the published network."""

    inputs: tuple[Input, ...] = ("state", "loss", "gradient")
    """What it sees: the state X (5 channels), the energy's map L (1), its gradient (5); beyond the paper the state
    minus its mean over 16 x 16 pixels (5), left1 and left2 (6), and the start's evidence."""
    evidence: int = 0
    """Channels of the evidence, if it is an input."""
    layers: tuple[tuple[int, int], ...] = ((512, 1), (512, 1))
    """(channels, dilation) of the hidden convolutions."""
    divisor: int = 1
    """Work on blocks of divisor x divisor pixels, all of whose values are inputs and outputs: 1 / divisor**2 of the
    time, nothing is averaged."""
    propagation: tuple[int, ...] = ()
    """Distances, in blocks, of neighbours whose values a pixel may take over (`learned.propagation`); empty as
    published."""
    detached: bool = False
    """Each step learns from its own loss alone, none through the steps before: a half of the training time."""
    steps: int = 5
    """T: refinement steps in training and, unless told otherwise, at test time."""

    def __post_init__(self) -> None:
        unknown = set(self.inputs) - set(get_args(Input))
        if unknown or not self.inputs or len(set(self.inputs)) != len(self.inputs):
            raise ValueError(f"inputs must be different ones of {', '.join(get_args(Input))}; got {self.inputs}")
        if (self.evidence > 0) != ("evidence" in self.inputs):
            raise ValueError("evidence must count the channels of the input 'evidence', 0 without it")
        if self.divisor < 1 or self.steps < 0 or not self.layers or any(distance < 1 for distance in self.propagation):
            raise ValueError("divisor and distances must be at least 1, steps not negative, and there must be a hidden layer")

    @property
    def channels(self) -> int:
        """Input channels for each pixel."""
        count = {"state": 5, "loss": 1, "gradient": 5, "deviation": 5, "image": 6, "evidence": self.evidence}
        return sum(count[name] for name in self.inputs)

    @property
    def needs_images(self) -> bool:
        """Whether left1 and left2 must be given."""
        return "image" in self.inputs or bool(self.propagation)

    @property
    def needs_energy(self) -> bool:
        """Whether the energy must be evaluated at all."""
        return "loss" in self.inputs or "gradient" in self.inputs


#: For a CPU: half the resolution in blocks, a field of view of about 100 pixels, neighbours at two distances.
COMPACT = RefinerConfig(
    inputs=("state", "loss", "gradient", "deviation", "image"),
    layers=((32, 1), (32, 2), (32, 4), (32, 8), (32, 1)),
    divisor=2,
    propagation=(2, 8),
    detached=True,
)


class Update(NamedTuple):
    """What G says about a state."""

    change: Tensor
    """(B, 5, H, W), to be added, in pixels."""
    reliability: Tensor | None
    """(B, 2, h, w): logits of the state's disparity and motion being right, at each block; with propagation only."""


class Refiner(nn.Module):
    """G. Its last layer starts at zero: untrained, it changes nothing."""

    def __init__(self, config: RefinerConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RefinerConfig()
        block = config.divisor**2
        channels, layers = config.channels * block, []
        for width, dilation in config.layers:
            layers += [nn.Conv2d(channels, width, 3, padding=dilation, dilation=dilation), nn.ReLU(inplace=True)]
            channels = width
        self.hidden = nn.Sequential(*layers)
        self.correction = nn.Conv2d(channels, 5 * block, 3, padding=1)
        for module in self.hidden:
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)  # type: ignore[arg-type]
        self.propagation = Propagation(channels, config.divisor, config.propagation) if config.propagation else None

    def forward(
        self,
        state: Tensor,
        loss: Tensor | None = None,
        gradient: Tensor | None = None,
        images: Tensor | None = None,
        evidence: Tensor | None = None,
    ) -> Update:
        """The update of a state.

        Parameters
        ----------
        state : Tensor (B, 5, H, W)
            X in pixels.
        loss, gradient : Tensor (B, H, W) and (B, 5, H, W)
            The energy's map and the gradient of its sum, if they are inputs.
        images : Tensor (B, 6, H, W)
            left1 and left2 in [0, 1], if they are an input or there is propagation.
        evidence : Tensor (B, evidence, H, W)
            In [0, 1], if it is an input.
        """
        height, width = state.shape[-2:]
        divisor = self.config.divisor
        features = self._features(state, loss, gradient, images, evidence)
        bottom, right = -height % divisor, -width % divisor
        if bottom or right:
            features = F.pad(features, (0, right, 0, bottom), mode="replicate")
        x = self.hidden(F.pixel_unshuffle(features, divisor))
        change = F.pixel_shuffle(self.correction(x).float(), divisor)[..., :height, :width]
        if self.propagation is None:
            return Update(change, None)
        if images is None:
            raise ValueError("this refiner propagates along the images' edges: it needs the images")
        moved, reliability = self.propagation(x, state, images[:, :3])
        return Update(change + moved, reliability)

    def _features(
        self,
        state: Tensor,
        loss: Tensor | None,
        gradient: Tensor | None,
        images: Tensor | None,
        evidence: Tensor | None,
    ) -> Tensor:
        """All inputs, scaled, (B, channels, H, W)."""
        given = {
            "state": state,
            "deviation": state,
            "loss": loss,
            "gradient": gradient,
            "image": images,
            "evidence": evidence,
        }
        parts = []
        for name in self.config.inputs:
            maps = given[name]
            if maps is None:
                raise ValueError(f"this refiner needs the input {name!r}")
            parts.append(_SCALED[name](maps))
        return torch.cat(parts, 1)


def _deviation(state: Tensor) -> Tensor:
    # of boxes, interpolated: a sliding mean costs as much as the convolutions
    boxes = F.avg_pool2d(state, _SURROUNDINGS_PX, ceil_mode=True, count_include_pad=False)
    mean = F.interpolate(boxes, state.shape[-2:], mode="bilinear", align_corners=False)
    return _DEVIATION_SCALE * (state - mean).clamp(-_DEVIATION_MOST, _DEVIATION_MOST)


_SCALED = {
    "state": lambda state: _STATE_SCALE * state,
    "deviation": _deviation,
    "loss": lambda loss: _LOSS_SCALE * loss[:, None].clamp(max=_LOSS_MOST),
    "gradient": lambda gradient: _GRADIENT_SCALE * gradient.clamp(-_GRADIENT_MOST, _GRADIENT_MOST),
    "image": lambda images: images - 0.5,
    "evidence": lambda evidence: evidence,
}
