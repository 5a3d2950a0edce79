"""Whole states that a pixel may take over from its surroundings, and what speaks for each of them.

Beside a jump of disparity the right value is often that of a pixel close by: of the nearest or the farthest thing there. To
tell which, each is followed into the other three images: how alike is what is seen there, would something else hide it, on
which side are the pixels of the same colour?
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.alternatives import kernels_may
from learned.bfloat16 import autocast_dtype, to_array
from learned.choice_kernels import describe_rows, extremes_along, extremes_down, votes_of_rows
from learned.threads import over_tasks

#: The state itself, the farthest and the nearest thing close by.
CHOICES = 3

_CLOSE_PX = 4
_VOTERS_REACH_PX = 9
_VOTERS_MOST_PX = 9.3
_VOTERS_COLOUR = 0.1  # mean difference of the channels from which a pixel has no vote
_VOTERS_DISTANCE_PX = 6.0  # where a vote weighs 1 / e
_STEPS_PX = range(-_VOTERS_REACH_PX, _VOTERS_REACH_PX + 1, 3)
_VOTERS = [(dy, dx) for dy in _STEPS_PX for dx in _STEPS_PX if math.hypot(dy, dx) <= _VOTERS_MOST_PX]
_VOTERS_WEIGHTS = [math.exp(-math.hypot(dy, dx) / _VOTERS_DISTANCE_PX) for dy, dx in _VOTERS]
_GRADIENT, _COLOUR = 4.0, 4.0  # factors that bring differences into a range of about one
_LEAST_JUMP_PX = 0.5


class Choices(NamedTuple):
    """What each pixel may choose between."""

    states: Tensor
    """(B, CHOICES, 5, H, W), pixels, the state itself first; D2, which lives on left2's grid, is the state's in all."""
    sources: Tensor
    """(B, CHOICES - 1, H, W) int64: the pixels that the others come from, as indices into the flat image."""
    step: Tensor
    """(B, H, W): largest difference of disparity between two neighbours close by; small on a slope, however far it reaches."""

    @property
    def jump(self) -> Tensor:
        """(B, H, W): between the nearest and the farthest disparity close by."""
        return self.states[:, 2, 0] - self.states[:, 1, 0]


def find_choices(state: Tensor) -> Choices:
    """The choices of a state (B, 5, H, W). Without a graph to build, on a CPU, kernels look for them."""
    sources = _sources_by_kernels(state) if kernels_may(state) else _sources(state)
    states = [state]
    for source in sources.split(1, 1):
        there = _take(state, source)
        states.append(torch.cat([there[:, :1], state[:, 1:2], there[:, 2:]], 1))
    return Choices(torch.stack(states, 1), sources, _largest_step(state[:, 0]))


def _largest_step(disparity: Tensor) -> Tensor:
    """(B, H, W): between neighbours along rows or columns, both within reach."""
    side = 2 * _CLOSE_PX + 1
    across, down = disparity.diff(dim=-1).abs(), disparity.diff(dim=-2).abs()
    across = _largest_around(_largest_around(across, side - 1, -1), side, -2)
    down = _largest_around(_largest_around(down, side - 1, -2), side, -1)
    return torch.maximum(across, down)


def _largest_around(values: Tensor, count: int, axis: Literal[-2, -1]) -> Tensor:
    """The largest of `count` values along an axis, none of them below 0, up to `_CLOSE_PX` before and behind.

    Of twice as many with each pass: pooling takes forty times as long.
    """
    values = F.pad(values, (_CLOSE_PX,) * 2 if axis == -1 else (0, 0, _CLOSE_PX, _CLOSE_PX))
    covered = 1
    while covered < count:
        shift = min(covered, count - covered)
        left = values.shape[axis] - shift
        values = torch.maximum(values.narrow(axis, 0, left), values.narrow(axis, shift, left))
        covered += shift
    return values


def _sources(state: Tensor) -> Tensor:
    """(B, 2, H, W) int64: where the farthest and the nearest thing close by are, as indices into the flat image."""
    return torch.cat([_largest_close_by(sign * state[:, :1]) for sign in (-1, 1)], 1)


def _sources_by_kernels(state: Tensor) -> Tensor:
    """As `_sources`."""
    disparity = state[:, 0].contiguous().numpy()
    best, at = np.empty((2, *disparity.shape), np.float32), np.empty((2, *disparity.shape), np.int64)
    sources = torch.empty((len(disparity), 2, *disparity.shape[1:]), dtype=torch.int64)
    rows = disparity.shape[0] * disparity.shape[1]
    over_tasks(extremes_along, rows, disparity, _CLOSE_PX, best, at)
    over_tasks(extremes_down, rows, best, at, _CLOSE_PX, sources.numpy())
    return sources


def _largest_close_by(values: Tensor) -> Tensor:
    """(B, 1, H, W) int64: the pixel of the largest value within reach, along rows first, then along columns."""
    side = 2 * _CLOSE_PX + 1
    along, source = F.max_pool2d(values, (1, side), 1, (0, _CLOSE_PX), return_indices=True)
    _, row = F.max_pool2d(along, (side, 1), 1, (_CLOSE_PX, 0), return_indices=True)
    return _take(source, row)


class _Surroundings:
    """Maps (B, n, H, W) as seen from a few pixels away; the border's values repeat outside."""

    def __init__(self, maps: Tensor, reach: int) -> None:
        self.padded, self.reach = F.pad(maps, (reach,) * 4, mode="replicate"), reach

    def __call__(self, dy: int, dx: int) -> Tensor:
        """``maps(p + (dy, dx))``."""
        height, width = (side - 2 * self.reach for side in self.padded.shape[-2:])
        top, left = self.reach + dy, self.reach + dx
        return self.padded[..., top : top + height, left : left + width]


def _take(maps: Tensor, sources: Tensor) -> Tensor:
    """(B, n, H, W) maps at the pixels (B, 1, H, W)."""
    picked = sources.flatten(2).expand(-1, maps.shape[1], -1)
    return maps.flatten(2).gather(2, picked).view(maps.shape)


def with_gradients(images: Tensor) -> Tensor:
    """(B, 4, 5, H, W): colours of the images (B, 4, 3, H, W) and derivatives of their mean along x and y, all of about one."""
    each = images.flatten(0, 1)
    steps = [_GRADIENT * step for step in _gradients(each)]
    return torch.cat([each, *steps], 1).unflatten(0, images.shape[:2])


def describe(choices: Choices, seen: Tensor, evidence: Tensor) -> Tensor:
    """What speaks for each choice (B, DESCRIPTION, H, W), float32, in a range of about one.

    Without a graph to build, on a CPU, kernels do it in one pass; where autocast says so, in bfloat16.

    Parameters
    ----------
    choices : Choices
    seen : Tensor (B, 4, 5, H, W)
        :func:`with_gradients`.
    evidence : Tensor (B, 2, H, W)
        Confidence and visibility of the start.
    """
    if kernels_may(choices.states) and kernels_may(seen):
        return _describe_by_kernels(choices, seen, evidence)
    own, left1 = seen[:, 0], seen[:, 0, :3]
    state = choices.states[:, 0]
    height, width = state.shape[-2:]
    y = torch.arange(height, device=state.device, dtype=state.dtype)[:, None]
    x = torch.arange(width, device=state.device, dtype=state.dtype)
    front = _front(state[:, 0])
    parts = []
    for choice in choices.states.unbind(1):
        d1, _, change, u, v = choice.unbind(1)
        for there, at_x, at_y in ((1, x - d1, y), (2, x + u, y + v), (3, x + u - d1 - change, y + v)):
            difference = (_sample(seen[:, there], at_x, at_y) - own).abs()
            parts += [_COLOUR * difference[:, :3].mean(1, keepdim=True).clamp(max=0.5),
                      difference[:, 3:].sum(1, keepdim=True).clamp(max=1)]  # fmt: skip
        hides = _sample(front[:, None], x - d1, y) - d1[:, None]
        parts += [torch.asinh(hides / 2) / 2, (x - d1 < 0).to(state.dtype)[:, None]]
    farthest, nearest = (choices.states[:, k, :1] for k in (1, 2))
    jump = choices.jump[:, None]
    between = torch.where(jump > _LEAST_JUMP_PX, (state[:, :1] - farthest) / jump.clamp(min=_LEAST_JUMP_PX), 0.5)
    parts += [torch.log1p(jump) / 2, between]
    parts.append(evidence)
    for source in choices.sources.split(1, 1):
        away_y, away_x = source // width - y, source % width - x
        colour = (_take(left1, source) - left1).abs().mean(1, keepdim=True)
        parts += [away_y / (2 * _CLOSE_PX), away_x / (2 * _CLOSE_PX), _take(evidence[:, :1], source), _COLOUR * colour]
    parts.append(own[:, 3:])
    parts.append(2 * _votes(left1, state[:, :1], evidence[:, :1], (farthest + nearest) / 2) - 1)
    return torch.cat(parts, 1)


def _describe_by_kernels(choices: Choices, seen: Tensor, evidence: Tensor) -> Tensor:
    """As `describe`, with channels innermost in memory."""
    states = choices.states.contiguous()
    count, _, _, height, width = states.shape
    middle = (states[:, 1, 0] + states[:, 2, 0]) / 2
    votes = _votes_by_kernels(seen[:, 0, :3], states[:, 0, :1], evidence[:, :1], middle)
    halved = autocast_dtype("cpu", torch.float32) == torch.bfloat16  # kernels know no other type of half the size
    out = torch.empty((count, height, width, DESCRIPTION), dtype=torch.bfloat16 if halved else torch.float32)
    maps = states, choices.sources.contiguous(), seen.flatten(3), _front(states[:, 0, 0]), evidence.contiguous(), votes
    scales = (np.float32(each) for each in (_LEAST_JUMP_PX, _COLOUR, 1 / (2 * _CLOSE_PX)))
    over_tasks(describe_rows, count * height, *(each.numpy() for each in maps), *scales, to_array(out))
    return out.permute(0, 3, 1, 2)


#: Channels of a description.
DESCRIPTION = 8 * CHOICES + 2 + 2 + 4 * (CHOICES - 1) + 2 + 2


def _gradients(image: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 1, H, W) derivatives of the mean of the channels along x and y."""
    grey = _Surroundings(image.mean(1, keepdim=True), 1)
    return (grey(0, 1) - grey(0, -1)) / 2, (grey(1, 0) - grey(-1, 0)) / 2


def _sample(maps: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(B, n, H, W) maps at places that broadcast to (B, H, W), bilinearly; the border's values repeat outside."""
    height, width = maps.shape[-2:]
    x, y = torch.broadcast_tensors(x * (2 / max(width - 1, 1)) - 1, y * (2 / max(height - 1, 1)) - 1)
    places = torch.stack([x, y], -1)
    return F.grid_sample(maps, places, mode="bilinear", padding_mode="border", align_corners=True)


def _front(disparity: Tensor) -> Tensor:
    """(B, H, W): the largest disparity that lands on each pixel of right1; 0 where none does."""
    width = disparity.shape[-1]
    columns = torch.arange(width, device=disparity.device)
    lands = (columns - disparity).round().long().clamp(-1, width - 1) + 1  # what leaves the image goes into column 0
    room = disparity.new_zeros((*disparity.shape[:-1], width + 1))
    return room.scatter_reduce(-1, lands, disparity, "amax")[..., 1:]


def _votes(image: Tensor, disparity: Tensor, confidence: Tensor, middle: Tensor) -> Tensor:
    """(B, 2, H, W): share of the pixels around, by colour and distance, that lie in front of the middle of a jump; and of
    the confident ones. See `variational.edges`."""
    around = _Surroundings(torch.cat([image, disparity, confidence**2], 1), _VOTERS_REACH_PX)
    totals, fronts = torch.full_like(image[:, :2], 1e-6), torch.zeros_like(image[:, :2])
    for (dy, dx), weight in zip(_VOTERS, _VOTERS_WEIGHTS, strict=True):
        voter = around(dy, dx)
        unlike = (voter[:, :3] - image).abs().mean(1, keepdim=True)
        vote = (1 - unlike / _VOTERS_COLOUR).clamp(min=0) ** 2 * weight
        votes = torch.cat([vote, vote * voter[:, 4:]], 1)
        totals += votes
        fronts += votes * (voter[:, 3:4] > middle)
    return fronts / totals


def _votes_by_kernels(image: Tensor, disparity: Tensor, confidence: Tensor, middle: Tensor) -> Tensor:
    """As `_votes`, but for the middle, (B, H, W)."""
    around = _Surroundings(torch.cat([image, disparity, confidence**2], 1), _VOTERS_REACH_PX)
    out = torch.empty((len(image), 2, *image.shape[2:]))
    voters = np.array(_VOTERS), np.array(_VOTERS_WEIGHTS, np.float32), _VOTERS_REACH_PX, np.float32(1 / _VOTERS_COLOUR)
    rows = image.shape[0] * image.shape[2]
    over_tasks(votes_of_rows, rows, around.padded.numpy(), middle.contiguous().numpy(), *voters, out.numpy())
    return out
