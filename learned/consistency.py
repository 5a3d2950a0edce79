"""The consistency energy written plainly in torch: the executable definition, differentiable by autograd.

Any device, any floating type, batched, and twice differentiable. Readable before fast: the handwritten gradient of the
classical side is checked against this file (:mod:`learned.oracle` brings that one to torch, many times faster).
Images are ``(B, c, H, W)`` in [0, 1], states ``(B, 5, H, W)`` in pixels, channels D1 D2 C u v.

Formulas: Godard et al. 2017 (photometric error, smoothness), Sundaram et al. 2010 (visibility).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def penalty(residual: Tensor, eps: float) -> Tensor:
    """``|r|``, or ``sqrt(r^2 + eps^2)`` (Charbonnier) where eps is positive; the derivative of ``|r|`` at 0 is 0."""
    return (residual * residual + eps * eps).sqrt() if eps > 0 else residual.abs()


def sample(image: Tensor, dx: Tensor, dy: Tensor | None = None) -> Tensor:
    """Bilinear sampling at displaced pixels.

    Positions are clamped to the image; a clamped coordinate has zero derivative. The displacement is clamped and split,
    not the sum, which would cost float32 its digits.

    Parameters
    ----------
    image : Tensor
        ``(B, c, H, W)``.
    dx, dy : Tensor
        ``(B, H, W)`` in pixels: pixel (x, y) gets the image's value at (x + dx, y + dy); dy None is zero.

    Returns
    -------
    Tensor
        ``(B, c, H, W)``.
    """
    batch, channels, height, width = image.shape
    xs = torch.arange(width, device=image.device, dtype=dx.dtype).expand(height, width)
    ys = torch.arange(height, device=image.device, dtype=dx.dtype)[:, None].expand(height, width)

    def at(y: Tensor, x: Tensor) -> Tensor:
        index = (y * width + x).reshape(batch, 1, -1).expand(-1, channels, -1)
        return image.reshape(batch, channels, -1).gather(2, index).reshape(image.shape)

    x0, x1, fx = _cell(dx, xs, width)
    if dy is None:
        row = ys.long().expand_as(x0)
        return at(row, x0) * (1 - fx) + at(row, x1) * fx
    y0, y1, fy = _cell(dy, ys, height)
    top = at(y0, x0) * (1 - fx) + at(y0, x1) * fx
    return top * (1 - fy) + (at(y1, x0) * (1 - fx) + at(y1, x1) * fx) * fy


def _cell(displacement: Tensor, coordinate: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Lower and upper pixel of the cell, and the ``(B, 1, H, W)`` fraction between, which carries the derivative."""
    clamped = displacement.clamp(-coordinate, size - 1 - coordinate)
    shift = clamped.detach().floor().minimum(size - 2 - coordinate).maximum(-coordinate)
    lower = (coordinate + shift).long()
    return lower, (lower + 1).clamp(max=size - 1), (clamped - shift)[:, None]


def inside_image(dx: Tensor, dy: Tensor | None = None) -> Tensor:
    """``(B, H, W)`` bool: whether the displaced pixel lies in the image, borders included."""
    height, width = dx.shape[-2:]
    x = torch.arange(width, device=dx.device, dtype=dx.dtype)
    inside = (dx >= -x) & (dx <= width - 1 - x)
    if dy is not None:
        y = torch.arange(height, device=dx.device, dtype=dx.dtype)[:, None]
        inside = inside & (dy >= -y) & (dy <= height - 1 - y)
    return inside


def box_mean(image: Tensor) -> Tensor:
    """Mean over 3 x 3 pixels, reflected at the border; an axis of one pixel reflects to itself."""
    for axis in (-2, -1):
        size = image.shape[axis]
        last = size - 1
        padded = torch.cat([image.narrow(axis, min(1, last), 1), image, image.narrow(axis, max(last - 1, 0), 1)], axis)
        image = padded.narrow(axis, 0, size) + padded.narrow(axis, 1, size) + padded.narrow(axis, 2, size)
    return image / 9


def photometric_error(a: Tensor, b: Tensor, ssim_share: float = 0.85, eps: float = 0.0) -> Tensor:
    """``alpha clip((1 - SSIM) / 2, 0, 1) + (1 - alpha) |a - b|``, mean over channels: ``(B, H, W)``."""
    mean_a, mean_b = box_mean(a), box_mean(b)
    variance_a, variance_b = box_mean(a * a) - mean_a**2, box_mean(b * b) - mean_b**2
    covariance = box_mean(a * b) - mean_a * mean_b
    ssim = ((2 * mean_a * mean_b + SSIM_C1) * (2 * covariance + SSIM_C2)
            / ((mean_a**2 + mean_b**2 + SSIM_C1) * (variance_a + variance_b + SSIM_C2)))
    dissimilarity = ((1 - ssim) / 2).clamp(0, 1)
    return (ssim_share * dissimilarity + (1 - ssim_share) * penalty(b - a, eps)).mean(1)


def visible_mask(flow: Tensor, backward_flow: Tensor, relative: float = 0.01, absolute: float = 0.05) -> Tensor:
    """``(B, H, W)`` bool: the way there leads back; flows ``(B, 2, H, W)`` in pixels. No gradient."""
    with torch.no_grad():
        back = sample(backward_flow, flow[:, 0], flow[:, 1])
        squares = (flow**2).sum(1) + (back**2).sum(1)
        return ((flow + back) ** 2).sum(1) < relative * squares + absolute


def smoothness_map(field: Tensor, image: Tensor, edge_sharpness: float = 1.0, eps: float = 0.0) -> Tensor:
    """First differences of ``(B, n, H, W)`` maps, weighted by the edges of the image, summed over n: ``(B, H, W)``."""
    total = torch.zeros_like(field[:, 0])
    for axis, pad in ((-1, (0, 1)), (-2, (0, 0, 0, 1))):
        edge = torch.exp(-edge_sharpness * image.diff(dim=axis).abs().mean(1, keepdim=True))
        total = total + functional.pad((penalty(field.diff(dim=axis), eps) * edge).sum(1), pad)
    return total


def consistency_map(state: Tensor, left1: Tensor, right1: Tensor, left2: Tensor, right2: Tensor,
                    backward_flow: Tensor | None = None, visible: Tensor | None = None, *, stereo_weight: float = 1.0,
                    flow_weight: float = 1.0, coupling_weight: float = 1.0, smoothness_weight: float = 0.1,
                    ssim_share: float = 0.85, edge_sharpness: float = 1.0, visible_relative: float = 0.01,
                    visible_absolute: float = 0.05, drop_outside: bool = False, charbonnier_intensity: float = 0.0,
                    charbonnier_px: float = 0.0) -> Tensor:
    """The energy's per-pixel map; the energy is its sum.

    Parameters
    ----------
    state : Tensor
        ``(B, 5, H, W)`` in pixels.
    left1, right1, left2, right2 : Tensor
        ``(B, c, H, W)`` in [0, 1].
    backward_flow : Tensor or None
        ``(B, 2, H, W)`` left2 -> left1 on left2's grid, held fixed; None calls every pixel visible.
    visible : Tensor or None
        ``(B, H, W)`` bool to use in place of the forward-backward check.
    stereo_weight, ... :
        Weights and options, those of the classical side's ``EnergyConfig``.

    Returns
    -------
    Tensor
        ``(B, H, W)``.
    """
    d1, d2, change, u, v = state.unbind(1)
    if visible is None:
        visible = (torch.ones_like(d1, dtype=torch.bool) if backward_flow is None
                   else visible_mask(state[:, 3:], backward_flow, visible_relative, visible_absolute))

    def photometric(target: Tensor, source: Tensor, dx: Tensor, dy: Tensor | None = None) -> Tensor:
        error = photometric_error(target, sample(source, dx, dy), ssim_share, charbonnier_intensity)
        return error * inside_image(dx, dy) if drop_outside else error

    loss = torch.zeros_like(d1)
    if stereo_weight > 0:
        loss = loss + stereo_weight * (photometric(left1, right1, -d1) + photometric(left2, right2, -d2))
    if flow_weight > 0:
        loss = loss + flow_weight * (visible * photometric(left1, left2, u, v))
    if coupling_weight > 0:
        arrived = sample(d2[:, None], u, v)[:, 0]
        loss = loss + coupling_weight * (visible * penalty(d1 + change - arrived, charbonnier_px))
    if smoothness_weight > 0:
        first = smoothness_map(state[:, [0, 2, 3, 4]], left1, edge_sharpness, charbonnier_px)
        second = smoothness_map(state[:, 1:2], left2, edge_sharpness, charbonnier_px)
        loss = loss + smoothness_weight * (first + second)
    return loss
