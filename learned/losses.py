"""Supervised losses of the two feedforward networks. Truth is NaN where it is unknown."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.pwcnet import MOTION_UNIT_PX

# Of the published training, for levels 6 ... 2; a network with fewer levels takes the finest ones.
_LEVEL_WEIGHTS = (0.32, 0.08, 0.02, 0.01, 0.005)
# Of GA-Net's heads, the last one is the answer.
_HEAD_WEIGHTS = (0.2, 0.6, 1.0)


def robust(error: Tensor, scale: float) -> Tensor:
    """``r log(1 + e / r)`` of an error e >= 0, r the scale: errors far above it pull less, so that hopeless pixels do not
    drown those that can be mended. The error itself if the scale is 0."""
    return scale * torch.log1p(error / scale) if scale > 0 else error


def multiscale_motion_loss(estimates: list[Tensor], truth: Tensor, robust_px: float = 0.0) -> Tensor:
    """PWC-Net's: at every level the L2 norm of the error vector, summed over pixels, mean over the batch.

    Parameters
    ----------
    estimates : list of Tensor (B, outputs, h, w)
        ``PWCNet.estimate``: coarse to fine, pixels / 20.
    truth : Tensor (B, outputs, H, W)
        In pixels; every level is compared with the mean of the known truth in each of its cells. A component that is
        unknown (a flow without disparity change) drops out of the norm alone.
    robust_px : float
        Scale in pixels of the `robust` norm; 0 is the published training.
    """
    known = torch.isfinite(truth)
    filled = torch.where(known, truth, 0) / MOTION_UNIT_PX
    loss = estimates[0].new_zeros(())
    for weight, estimate in zip(_LEVEL_WEIGHTS[-len(estimates) :], estimates, strict=True):
        size = (estimate.shape[-2], estimate.shape[-1])
        share = F.adaptive_avg_pool2d(known.to(estimate.dtype), size)
        target = F.adaptive_avg_pool2d(filled, size) / share.clamp(min=1e-6)
        squared = torch.where(share > 0, estimate - target, 0).square().sum(1)
        norm = robust((squared + 1e-12).sqrt(), robust_px / MOTION_UNIT_PX)
        loss = loss + weight * norm.sum() / len(truth)
    return loss


def disparity_loss(estimates: list[Tensor], truth: Tensor, max_disparity: int, robust_px: float = 0.0) -> Tensor:
    """GA-Net's: smooth L1 where the truth is known and below ``max_disparity``, a weighted sum over the heads.

    ``estimates`` are ``GANet.estimate``'s (B, H, W) in pixels, the last one the answer; ``truth`` (B, H, W). With
    ``robust_px`` the smooth L1 norm is made `robust` at that scale.
    """
    known = (truth >= 0) & (truth < max_disparity)
    if not known.any():
        return torch.stack([estimate.sum() * 0 for estimate in estimates]).sum()
    heads = [weight * robust(F.smooth_l1_loss(estimate[known], truth[known], reduction="none"), robust_px).mean()
             for weight, estimate in zip(_HEAD_WEIGHTS[-len(estimates) :], estimates, strict=True)]
    return torch.stack(heads).sum()
