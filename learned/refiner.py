"""The refinement network G: from a state, its energy and the energy's gradient to a better state.

``X_{t+1} = X_t + G(X_t, L(X_t), dL/dX(X_t))`` (Chen et al., section "Refinement"), the same weights in every step; the
loop over steps stands in `learned.hybrid`. The published network is three 3 x 3 convolutions with 512 hidden channels;
the compact one works on every second pixel, sees further by dilation, and may take over values that something else
vouches for (`learned.alternatives`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.alternatives import Grid, Neighbours, adopted_change, camera_motion, gated_change, second_pair
from learned.batch import Batch

Input = Literal["state", "loss", "gradient", "deviation", "image", "evidence"]

# What brings each input to a range of about one. Pixels of motion, the energy's map (its photometric terms end at 3),
# the gradient (the coupling's is 1 a pixel).
_STATE_SCALE, _LOSS_SCALE, _GRADIENT_SCALE = 0.05, 0.5, 1.0
_LOSS_MOST, _GRADIENT_MOST = 20.0, 5.0
_SURROUNDINGS_PX = 16  # side of the box that the deviation is measured against
# Affinity of neighbours falls by this factor's exponential with their difference in intensity, before training.
_EDGE_SHARPNESS = 10.0
# Gates: D1 from its neighbours and from the second pair, motion from its neighbours and the camera's, C from the second
# pair; then both disparities and motion from the rival.
_GATES, _RIVAL_GATES = 5, 2
_CORRECTION_MOST_PX = 4.0  # a step; larger changes need somebody who vouches for them


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
    rival: bool = False
    """Whether a pixel may take over a rival's values too: another method's state (`Batch.rival`)."""
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
        if self.rival and not (self.neighbours and "loss" in self.inputs):
            raise ValueError("a refiner with a rival must have neighbours, and the energy's map among its inputs, to compare")
        if self.divisor < 1 or self.steps < 0 or not self.layers or any(distance < 1 for distance in self.neighbours):
            raise ValueError("divisor and distances must be at least 1, steps not negative, and there must be a hidden layer")

    @property
    def channels(self) -> int:
        """Input channels."""
        count = {"state": 5, "loss": 1, "gradient": 5, "deviation": 5, "image": 6, "evidence": self.evidence}
        beside = 2 * (self.divisor**2 - 1) + 5 + self.weighs_energies + 7 * self.rival if self.neighbours else 0
        return sum(count[name] for name in self.inputs) + beside

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


class View(NamedTuple):
    """What G looks at, beside the batch."""

    state: Tensor
    """(B, 5, H, W), pixels."""
    loss: Tensor | None = None
    """(B, H, W): the energy's map."""
    gradient: Tensor | None = None
    """(B, 5, H, W): of the energy."""
    camera_loss: Tensor | None = None
    """(B, H, W): the energy's map if everything followed the camera's motion."""
    rival_losses: Tensor | None = None
    """(B, 2, H, W): the energy's map with the rival's disparities, and with its motion."""
    contrasts: Tensor | None = None
    """(B, k, h, w): of left1, between neighbours."""


class Update(NamedTuple):
    """What G says about a state."""

    change: Tensor
    """(B, 5, H, W), to be added, in pixels."""
    reliability: Tensor | None
    """(B, 2, h, w): logits of the state's disparity and motion being right, at each block; with neighbours only."""


class Refiner(nn.Module):
    """G. Its last layers start at zero: untrained, it changes nothing."""

    def __init__(self, config: RefinerConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RefinerConfig()
        self.grid = Grid(config.divisor)
        channels, layers = config.channels, []
        for width, dilation in config.layers:
            layers += [nn.Conv2d(channels, width, 3, padding=dilation, dilation=dilation), nn.ReLU(inplace=True)]
            channels = width
        self.hidden = nn.Sequential(*layers)
        self.correction = nn.Conv2d(channels, 5, 3, padding=1)
        for module in self.hidden:
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        heads: list[nn.Conv2d] = [self.correction]
        if config.neighbours:
            self.neighbours = Neighbours(config.neighbours)
            self.reliability = nn.Conv2d(channels, 2, 1)
            self.preference = nn.Conv2d(channels, len(self.neighbours.offsets), 1)
            self.gates = nn.Conv2d(channels, (_GATES + _RIVAL_GATES * config.rival) * config.divisor**2, 1)
            self.edge_sharpness = nn.Parameter(torch.tensor(_EDGE_SHARPNESS))
            heads += [self.reliability, self.preference, self.gates]
        for layer in heads:
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def contrasts(self, batch: Batch) -> Tensor | None:
        """What the images say about neighbours, for `View`; the same in every step."""
        return self.neighbours.contrasts(self.grid.pick(batch.images[:, 0])) if self.config.neighbours else None

    def forward(self, view: View, batch: Batch) -> Update:
        """The update of a state.

        Parameters
        ----------
        view : View
            Energy and gradient if they are inputs; with neighbours the contrasts, and the camera's energy if energy is an input.
        batch : Batch
            Its images if they are an input, its evidence if that is one; with neighbours its backward flow and the camera's
            motion (without it, the state's own).
        """
        state = view.state
        size = state.shape[-2], state.shape[-1]
        picked = self.grid.pick(state)
        features = [self._input(name, view, picked, batch) for name in self.config.inputs]
        if not self.config.neighbours:
            correction = self.correction(self.hidden(_planar(torch.cat(features, 1)))).float()
            return Update(self.grid.spread(correction, size), None)
        camera, residual, beside = self._alternatives(view, picked, batch)
        features += [_signed_log(maps) for maps in beside]
        x = self.hidden(_planar(torch.cat(features, 1)))
        correction, reliability, gates = (head(x).float() for head in (self.correction, self.reliability, self.gates))
        preference = self.preference(x)
        correction = _CORRECTION_MOST_PX * (correction / _CORRECTION_MOST_PX).tanh()
        assert view.contrasts is not None
        mixture = self.neighbours.mixture(picked, preference, view.contrasts, self.edge_sharpness, reliability)
        values = torch.cat([mixture, camera, residual, correction], 1)
        own = _GATES * self.config.divisor**2
        gates, rival_gates = gates.tanh().tensor_split((own,), 1)
        change = gated_change(state, values, gates, self.grid)
        if self.config.rival:
            assert batch.rival is not None
            change = adopted_change(change, state, batch.rival, rival_gates, self.grid)
        return Update(change, reliability)

    def _alternatives(self, view: View, picked: Tensor, batch: Batch) -> tuple[Tensor, Tensor, list[Tensor]]:
        """The camera's motion (B, 3, h, w), the second pair's residual (B, 1, h, w), and all that tells whom to trust."""
        state, coordinates = view.state, self.grid.coordinates(picked)
        backward_flow = -state[:, 3:] if batch.backward_flow is None else batch.backward_flow
        residual, round_trip = second_pair(picked, coordinates, state[:, 1:2], backward_flow)
        camera = picked[:, 2:]
        if batch.homography is not None:
            camera = camera_motion(picked, coordinates, batch.homography)
        beside = [camera - picked[:, 2:], residual, round_trip]
        if self.config.weighs_energies:
            assert view.camera_loss is not None
            assert view.loss is not None
            beside.append(self._mean((view.camera_loss - view.loss)[:, None]))
        if self.config.rival:
            assert batch.rival is not None
            assert view.rival_losses is not None
            assert view.loss is not None
            beside += [self.grid.pick(batch.rival) - picked, self._mean(view.rival_losses - view.loss[:, None])]
        return camera, residual, beside + [self._within(state[:, channel : channel + 1]) for channel in (0, 3)]

    def _input(self, name: Input, view: View, picked: Tensor, batch: Batch) -> Tensor:
        """An input (B, n, h, w), scaled."""
        match name:
            case "state":
                return _STATE_SCALE * picked
            case "deviation":
                return _signed_log(_deviation(picked, max(_SURROUNDINGS_PX // self.config.divisor, 1)))
            case "loss" if view.loss is not None:
                return _LOSS_SCALE * self._mean(view.loss[:, None].clamp(max=_LOSS_MOST))
            case "gradient" if view.gradient is not None:
                return _GRADIENT_SCALE * self._mean(view.gradient.clamp(-_GRADIENT_MOST, _GRADIENT_MOST))
            case "image":
                return self.grid.pick(batch.images[:, (0, 2)].flatten(1, 2)) - 0.5
            case "evidence" if batch.evidence is not None:
                return self.grid.pick(batch.evidence) - 0.5
        raise ValueError(f"this refiner needs the input {name!r}")

    def _mean(self, maps: Tensor) -> Tensor:
        """Mean over each block."""
        divisor, padded = self.config.divisor, self.grid.pad(maps)
        corners = [padded[..., i::divisor, j::divisor] for i in range(divisor) for j in range(divisor)]
        return sum(corners[1:], corners[0]) / divisor**2  # a quarter of a pooling's time

    def _within(self, maps: Tensor) -> Tensor:
        """How the other pixels of a block differ from the one that stands for it."""
        block = F.pixel_unshuffle(self.grid.pad(maps), self.config.divisor)
        return block[:, :-1] - block[:, -1:]


def _deviation(state: Tensor, side: int) -> Tensor:
    # of boxes, interpolated: a sliding mean costs as much as the convolutions
    boxes = F.avg_pool2d(state, side, ceil_mode=True, count_include_pad=False)
    return state - F.interpolate(boxes, state.shape[-2:], mode="bilinear", align_corners=False)


def _signed_log(maps: Tensor) -> Tensor:
    """From a tenth of a pixel to a hundred in a range of about one: asinh(2 x) / 2, which torch has in slow loops only."""
    size = 2 * maps.abs()
    return 0.5 * torch.copysign((size + (size * size + 1).sqrt()).log(), maps)


def _planar(maps: Tensor) -> Tensor:
    """As convolutions want them: channels innermost, half of a convolution's time, and in autocast's type, all at once."""
    device = maps.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else maps.dtype
    return maps.to(dtype, memory_format=torch.channels_last)
