"""What training and refinement work on: a few stereo pairs of pairs as tensors, and what is known about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Batch:
    """B samples.

    Parameters
    ----------
    images : Tensor (B, 4, 3, H, W)
        left1, right1, left2, right2 in [0, 1], BGR.
    truth : Tensor (B, 5, H, W) or None
        The state's truth in pixels, NaN where unknown.
    start : Tensor (B, 5, H, W) or None
        State to refine.
    backward_flow : Tensor (B, 2, H, W) or None
        Flow left2 -> left1 on left2's grid that belongs to the start.
    evidence : Tensor (B, n, H, W) or None
        What else the start's maker says about each pixel, in [0, 1] (confidence, visibility).
    homography : Tensor (B, 4, 4) or None
        The camera's motion on (x, y, disparity, 1) of left1, float64.
    names : tuple of str
        The samples' names, for messages.
    """

    images: Tensor
    truth: Tensor | None = None
    start: Tensor | None = None
    backward_flow: Tensor | None = None
    evidence: Tensor | None = None
    homography: Tensor | None = None
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.images.shape[0]

    @property
    def frames(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """left1, right1, left2, right2, each (B, 3, H, W)."""
        left1, right1, left2, right2 = self.images.unbind(1)
        return left1, right1, left2, right2

    def __getitem__(self, index: int) -> Batch:
        """One sample, as a batch of one."""
        one = self.map(lambda maps: maps[index : index + 1])
        homography = None if self.homography is None else self.homography[index : index + 1]
        return replace(one, homography=homography, names=self.names[index : index + 1])

    def to(self, device: torch.device | str) -> Batch:
        """The same on another device."""
        homography = None if self.homography is None else self.homography.to(device)
        return replace(self.map(lambda maps: maps.to(device)), homography=homography)

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """The same change of every map that is there; what is no map stays."""
        changed: dict[str, Any] = {}
        for name in _MAPS:
            value = getattr(self, name)
            changed[name] = None if value is None else change(value)
        return replace(self, **changed)

    @staticmethod
    def cat(batches: list[Batch]) -> Batch:
        """Several batches as one; a map that one of them lacks is lost."""
        joined: dict[str, Any] = {}
        for name in (*_MAPS, "homography"):
            values = [getattr(batch, name) for batch in batches]
            joined[name] = None if any(value is None for value in values) else torch.cat(values)
        return Batch(**joined, names=tuple(name for batch in batches for name in batch.names))


_MAPS = tuple(field.name for field in fields(Batch) if field.name not in ("homography", "names"))
