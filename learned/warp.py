"""Backward warping of feature maps: look up, for every target pixel, the feature that the motion points to."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

# A sample counts as valid only if its whole bilinear support lies inside (the published PWC-Net's threshold).
FULL_SUPPORT = 0.9999


def warp(source: Tensor, flow: Tensor) -> Tensor:
    """Sample ``source`` bilinearly at ``p + flow(p)``; samples that touch the outside become zero.

    Parameters
    ----------
    source : Tensor (B, C, H, W)
        Features of the second image.
    flow : Tensor (B, 2, H, W)
        Motion (u, v) in pixels of this grid: target(x, y) matches source(x + u, y + v).

    Returns
    -------
    Tensor (B, C, H, W)
        In source's dtype. Differentiable in both arguments; the coordinates are always computed in float32 or better.

    References
    ----------
    Sun et al., PWC-Net, CVPR 2018, section 3 "Warping layer".
    """
    height, width = source.shape[-2:]
    flow = flow.float() if flow.dtype in (torch.bfloat16, torch.float16) else flow
    x = flow[:, 0] + torch.arange(width, device=flow.device, dtype=flow.dtype)
    y = flow[:, 1] + torch.arange(height, device=flow.device, dtype=flow.dtype)[:, None]
    # pixel centres sit at -1 and 1 of the outermost samples: align_corners=True
    grid = torch.stack([2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1], dim=-1)
    # grid_sample has no mixed precision, and bfloat16 coordinates would be pixels off
    sampled = F.grid_sample(source.to(grid.dtype), grid, mode="bilinear", padding_mode="zeros", align_corners=True)
    with torch.no_grad():
        valid = _inside(x, width) * _inside(y, height) >= FULL_SUPPORT
    return (sampled * valid[:, None]).to(source.dtype)


def _inside(position: Tensor, size: int) -> Tensor:
    """Share of the one-dimensional linear support that lies inside 0 ... size - 1."""
    return (1 - (-position).clamp(min=0) - (position - (size - 1)).clamp(min=0)).clamp(min=0)
