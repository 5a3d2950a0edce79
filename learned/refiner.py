"""The refinement network G: from a state, its energy and the energy's gradient to a better state.

``X_{t+1} = X_t + G(X_t, L(X_t), dL/dX(X_t))`` (Chen et al., section "Refinement"), the same weights in every step; the
loop over steps stands in `learned.hybrid`. The published network is three 3 x 3 convolutions with 512 hidden channels;
the compact one works on every second pixel, sees further by dilation, and may take over values that something else
vouches for (`learned.alternatives`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.alternatives import Alternatives, Grid, Neighbours, gated_change
from learned.batch import Batch
from learned.inputs import Input, View, look

# Affinity of neighbours falls by this factor's exponential with their difference in intensity, before training.
_EDGE_SHARPNESS = 10.0
# Gates: D1 from its neighbours and from the second pair, motion from its neighbours and the camera's, C from the second
# pair.
_GATES = 5


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
    """Look at one pixel of each block of divisor x divisor, and at the mean of energy and gradient there: 1 / divisor**2
    of the time."""
    neighbours: tuple[int, ...] = ()
    """Distances, in blocks, of neighbours whose values a pixel may take over, as those of the camera's motion and of the
    second pair; empty as published: corrections alone."""
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
        if self.divisor < 1 or self.steps < 0 or not self.layers or any(distance < 1 for distance in self.neighbours):
            raise ValueError("divisor and distances must be at least 1, steps not negative, and there must be a hidden layer")

    @property
    def layout(self) -> dict[str, int]:
        """Input channels by name, in order; with neighbours, all that tells whom to trust is among them."""
        counts = {"state": 5, "loss": 1, "gradient": 5, "deviation": 5, "image": 6, "evidence": self.evidence}
        layout: dict[str, int] = {name: counts[name] for name in self.inputs}
        if self.neighbours:
            layout |= {"camera": 3, "residual": 1, "round trip": 1}
            layout |= {"camera loss": 1} if self.weighs_energies else {}
            layout["within"] = 2 * (self.divisor**2 - 1)
        return layout

    @property
    def channels(self) -> int:
        """Input channels."""
        return sum(self.layout.values())

    @property
    def needs_energy(self) -> bool:
        """Whether the energy must be evaluated at all."""
        return "loss" in self.inputs or "gradient" in self.inputs

    @property
    def weighs_energies(self) -> bool:
        """Whether it compares the energy of the state with that of a camera that moves past a standing world."""
        return bool(self.neighbours) and "loss" in self.inputs


#: For a CPU: every second pixel, a field of view of about 100 pixels, neighbours at two distances. What it sees has no
#: scale and no colour of its own, so that it carries over to other cameras.
COMPACT = RefinerConfig(
    inputs=("loss", "gradient", "deviation"),
    layers=((32, 1), (32, 2), (32, 4), (32, 8), (32, 1)),
    divisor=2,
    neighbours=(2, 8),
    detached=True,
)


class Update(NamedTuple):
    """What G says about a state."""

    change: Tensor
    """(B, 5, H, W), to be added, in pixels."""
    reliability: Tensor | None
    """(B, 2, h, w): logits of the state's disparity and motion being right, at each block; with neighbours only."""


def hidden_layers(channels: int, layers: tuple[tuple[int, int], ...]) -> nn.Sequential:
    """3 x 3 convolutions of (channels, dilation), each with a rectifier."""
    modules: list[nn.Module] = []
    for width, dilation in layers:
        convolution = nn.Conv2d(channels, width, 3, padding=dilation, dilation=dilation)
        nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
        modules += [convolution, nn.ReLU(inplace=True)]
        channels = width
    return nn.Sequential(*modules)


class Refiner(nn.Module):
    """G. Its last layers start at zero: untrained, it changes nothing."""

    def __init__(self, config: RefinerConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RefinerConfig()
        self.grid = Grid(config.divisor)
        channels = config.layers[-1][0]
        self.hidden = hidden_layers(config.channels, config.layers)
        self.correction = nn.Conv2d(channels, 5, 3, padding=1)
        heads: list[nn.Conv2d] = [self.correction]
        if config.neighbours:
            self.neighbours = Neighbours(config.neighbours)
            self.reliability = nn.Conv2d(channels, 2, 1)
            self.preference = nn.Conv2d(channels, len(self.neighbours.offsets), 1)
            self.gates = nn.Conv2d(channels, _GATES * config.divisor**2, 1)
            self.edge_sharpness = nn.Parameter(torch.tensor(_EDGE_SHARPNESS))
            heads += [self.reliability, self.preference, self.gates]
        for layer in heads:
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def prepare(self, batch: Batch) -> Tensor | None:
        """(B, k, h, w): contrasts of left1 between neighbours, for `View`; the same in every step."""
        return self.neighbours.contrasts(self.grid.pick(batch.images[:, 0])) if self.config.neighbours else None

    def forward(self, view: View, batch: Batch) -> Update:
        """The update of a state.

        Parameters
        ----------
        view : View
            Energy and gradient if they are inputs; with neighbours what was prepared, and the camera's energy if energy is an
            input.
        batch : Batch
            Its images if they are an input, its evidence if that is one; with neighbours its backward flow and the camera's
            motion (without it, the state's own).
        """
        state, seen = view.state, look(self.config, self.grid, view, batch)
        x = self.hidden(seen.inputs)
        correction = self.correction(x)
        if not self.config.neighbours:
            return Update(self.grid.spread(correction.float(), (state.shape[-2], state.shape[-1])), None)
        reliability, preference, gates = self._heads(x)
        assert view.prepared is not None
        mixture = self.neighbours.mixture(seen.picked, preference, view.prepared, self.edge_sharpness, reliability)
        change = gated_change(state, Alternatives(mixture, seen.camera, seen.residual), correction, gates, self.grid)
        return Update(change, reliability.float())

    def _heads(self, x: Tensor) -> tuple[Tensor, ...]:
        """Reliability, preference and gates, by one convolution."""
        heads = self.reliability, self.preference, self.gates
        weight, bias = (torch.cat([head.get_parameter(name) for head in heads]) for name in ("weight", "bias"))
        return F.conv2d(x, weight, bias).split([head.out_channels for head in heads], 1)
