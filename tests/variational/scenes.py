"""A scene of two textured layers with whole-pixel motion, so that its truth needs no interpolation."""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.frames import Frames


@dataclass(frozen=True)
class Layers:
    frames: Frames
    state: np.ndarray
    """(5, H, W) truth; D2 on left2's grid."""


def _texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    fine = cv2.GaussianBlur(rng.random((height, width)), (0, 0), 1.0)
    coarse = cv2.GaussianBlur(rng.random((height, width)), (0, 0), 4.0)
    mixed = (fine - fine.mean()) / fine.std() + (coarse - coarse.mean()) / coarse.std()
    return np.clip(0.5 + 0.12 * mixed, 0, 1).astype(np.float32)


def two_layers(height: int = 72, width: int = 108, seed: int = 0, apart: float = 0.0) -> Layers:
    """Background: disparity 5, flow (2, 1), no change. A box before it: disparity 13, flow (-4, 3), change +2.

    apart: how much brighter the box is; 1 leaves no texture.
    """
    rng = np.random.default_rng(seed)
    margin = 24
    textures = [
        ((1 - apart) * _texture(rng, height + 2 * margin, width + 2 * margin) + apart * k).astype(np.float32) for k in range(2)
    ]
    box = np.zeros((height + 2 * margin, width + 2 * margin), bool)
    box[margin + height // 3 : margin + 3 * height // 4, margin + width // 3 : margin + 2 * width // 3] = True
    layers = ((5, 2, 1, 0), (13, -4, 3, 2))

    def view(right: bool, second: bool) -> tuple[np.ndarray, np.ndarray]:
        shifts = []
        for disparity, u, v, change in layers:
            x = (u if second else 0) - ((disparity + (change if second else 0)) if right else 0)
            shifts.append((v if second else 0, x))
        moved = [np.roll(texture, shift, (0, 1)) for texture, shift in zip(textures, shifts, strict=True)]
        front = np.roll(box, shifts[1], (0, 1))
        inner = (slice(margin, margin + height), slice(margin, margin + width))
        return np.where(front, moved[1], moved[0])[inner], front[inner]

    images, masks = zip(*(view(right, second) for second in (False, True) for right in (False, True)), strict=True)
    frames = Frames(*(np.ascontiguousarray(image[..., None]) for image in images))
    front1, front2 = masks[0], masks[2]
    state = np.stack([
        np.where(front1, 13, 5), np.where(front2, 15, 5), np.where(front1, 2, 0), np.where(front1, -4, 2), np.where(front1, 3, 1),
    ]).astype(np.float32)  # fmt: skip
    return Layers(frames, state)
