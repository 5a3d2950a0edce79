"""From a volume of costs to disparity: enlargement, softmin, expectation.

Volumes are (B, D, H, W) and of float32 or better; disparities come out innermost in memory, as local aggregation wants
them: what belongs to one pixel lies together.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def enlarged(volume: Tensor, size: tuple[int, int, int]) -> Tensor:
    """(B, d, h, w) to (B, *size), trilinear, with pixels as areas (``align_corners=False``).

    Torch's own interpolation of volumes takes four times as long on a CPU: here disparities are a matrix product.
    """
    planes = F.interpolate(volume.contiguous(memory_format=torch.channels_last), size[1:], mode="bilinear", align_corners=False)
    identity = torch.eye(volume.shape[1], dtype=volume.dtype, device=volume.device)
    along_disparity = F.interpolate(identity[None], size[0], mode="linear", align_corners=False)[0]
    with torch.autocast(volume.device.type, enabled=False):
        return (planes.movedim(1, -1) @ along_disparity).movedim(-1, 1)


def softmin(cost: Tensor) -> Tensor:
    """Over disparities."""
    return F.softmin(cost.movedim(1, -1), -1).movedim(-1, 1)


def expectation(probability: Tensor) -> Tensor:
    """sum_d d p(d), (B, D, H, W) to (B, H, W)."""
    disparities = torch.arange(probability.shape[1], dtype=probability.dtype, device=probability.device)
    with torch.autocast(probability.device.type, enabled=False):  # 100 px in bfloat16 are known to a quarter of a pixel
        return probability.movedim(1, -1) @ disparities
