"""Slow plain twins of the kernels: one pixel at a time, straight from the formulas, sharing no code with them.

Arrays as on the classical side: images ``(H, W, c)``, states ``(5, H, W)`` in pixels.
"""

import math

import numpy as np


def reflect(i: int, size: int) -> int:
    """Index of the pixel that stands for one at most one outside."""
    if size == 1:
        return 0
    if i < 0:
        return -i
    return 2 * (size - 1) - i if i >= size else i


def sample(plane: np.ndarray, x: float, y: float) -> float:
    """Bilinear value of an (H, W) plane at a position, clamped to the border."""
    height, width = plane.shape
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    x0, y0 = math.floor(x), math.floor(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    fx, fy = x - x0, y - y0
    top = (1 - fx) * plane[y0, x0] + fx * plane[y0, x1]
    bottom = (1 - fx) * plane[y1, x0] + fx * plane[y1, x1]
    return (1 - fy) * top + fy * bottom


def warp(image: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """The image sampled at every displaced pixel."""
    warped = np.empty_like(image)
    for y, x, c in np.ndindex(image.shape):
        warped[y, x, c] = sample(image[..., c], x + dx[y, x], y + dy[y, x])
    return warped


def penalty(residual: float, eps: float) -> float:
    return math.sqrt(residual * residual + eps * eps)


def photometric_error(a: np.ndarray, b: np.ndarray, alpha: float, eps: float) -> np.ndarray:
    """(H, W) mean over channels of SSIM and absolute difference."""
    height, width, channels = a.shape
    error = np.zeros((height, width))
    for y, x, c in np.ndindex(a.shape):
        window = [(reflect(y + j, height), reflect(x + i, width), c) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        wa, wb = np.array([a[p] for p in window]), np.array([b[p] for p in window])
        covariance = ((wa - wa.mean()) * (wb - wb.mean())).mean()
        ssim = ((2 * wa.mean() * wb.mean() + 1e-4) * (2 * covariance + 9e-4)
                / ((wa.mean() ** 2 + wb.mean() ** 2 + 1e-4) * (wa.var() + wb.var() + 9e-4)))
        clipped = min(max((1 - ssim) / 2, 0), 1)
        error[y, x] += (alpha * clipped + (1 - alpha) * penalty(a[y, x, c] - b[y, x, c], eps)) / channels
    return error


def inside(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    height, width = dx.shape
    result = np.zeros(dx.shape, bool)
    for y, x in np.ndindex(dx.shape):
        result[y, x] = 0 <= x + dx[y, x] <= width - 1 and 0 <= y + dy[y, x] <= height - 1
    return result


def visible_mask(flow: np.ndarray, backward: np.ndarray, w1: float, w2: float) -> np.ndarray:
    """(H, W) bool forward-backward check of (H, W, 2) flows."""
    visible = np.zeros(flow.shape[:2], bool)
    for y, x in np.ndindex(visible.shape):
        u, v = flow[y, x]
        bu, bv = (sample(backward[..., i], x + u, y + v) for i in (0, 1))
        visible[y, x] = (u + bu) ** 2 + (v + bv) ** 2 < w1 * (u * u + v * v + bu * bu + bv * bv) + w2
    return visible


def coupling(state: np.ndarray, eps: float) -> np.ndarray:
    """(H, W) penalty of D1 + C - D2(p + F)."""
    result = np.zeros(state.shape[1:])
    for y, x in np.ndindex(result.shape):
        d1, _, change, u, v = state[:, y, x]
        result[y, x] = penalty(d1 + change - sample(state[1], x + u, y + v), eps)
    return result


def smoothness(plane: np.ndarray, image: np.ndarray, sharpness: float, eps: float) -> np.ndarray:
    """(H, W) edge-aware first differences of one channel."""
    height, width = plane.shape
    result = np.zeros(plane.shape)
    for y, x in np.ndindex(plane.shape):
        for yy, xx in ((y, x + 1), (y + 1, x)):
            if yy < height and xx < width:
                edge = math.exp(-sharpness * np.abs(image[yy, xx] - image[y, x]).mean())
                result[y, x] += edge * penalty(plane[yy, xx] - plane[y, x], eps)
    return result


def energy_map(frames, state: np.ndarray, backward: np.ndarray | None, config) -> np.ndarray:
    """(H, W) map of the whole energy."""
    still = np.zeros(state.shape[1:])
    visible = np.ones(state.shape[1:]) if backward is None else visible_mask(
        state[3:].transpose(1, 2, 0), backward, config.visible_relative, config.visible_absolute)

    def photometric(target: np.ndarray, source: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        error = photometric_error(target, warp(source, dx, dy), config.ssim_share, config.charbonnier_intensity)
        return error * inside(dx, dy) if config.drop_outside else error

    total = config.stereo_weight * (photometric(frames.left1, frames.right1, -state[0], still)
                                    + photometric(frames.left2, frames.right2, -state[1], still))
    total += config.flow_weight * visible * photometric(frames.left1, frames.left2, state[3], state[4])
    total += config.coupling_weight * visible * coupling(state, config.charbonnier_px)
    for channel in range(5):
        image = frames.left2 if channel == 1 else frames.left1
        plain = smoothness(state[channel], image, config.edge_sharpness, config.charbonnier_px)
        total += config.smoothness_weight * plain
    return total
