"""From radiance to the picture that a camera delivers: exposure, vignetting, blur, tone curve, noise, eight bits."""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from variational.jit import rowwise


@dataclass(frozen=True)
class Sensor:
    """A stereo rig's two cameras; no two cameras are alike, and matching has to live with it.

    Parameters
    ----------
    exposure : float
        Mean of the square-rooted picture that the exposure aims at, in [0, 1].
    gamma : float
        Exponent of the tone curve from radiance to picture value; 0.5 is close to a usual display curve.
    grey : bool
        Deliver grey pictures in all three channels.
    gain : ndarray (2, 3)
        Factors per camera (left, right) and channel BGR.
    flicker : ndarray (frames,)
        Factor of each frame's exposure.
    vignetting : float
        Relative loss of light in the corners.
    blur_px : float
        Standard deviation of the lens's blur.
    read_noise, shot_noise : float
        Standard deviation of the noise at black, and what is added at white, in picture values.
    eight_bits : bool
        Round to 1/255.
    """

    exposure: float = 0.45
    gamma: float = 0.5
    grey: bool = False
    gain: np.ndarray | None = None
    flicker: np.ndarray | None = None
    vignetting: float = 0.0
    blur_px: float = 0.0
    read_noise: float = 0.0
    shot_noise: float = 0.0
    eight_bits: bool = False

    @classmethod
    def random(cls, rng: np.random.Generator, frames: int) -> "Sensor":
        """A plausible rig: from excellent to cheap."""
        noise = rng.uniform(0.0, 1.0) ** 2
        return cls(
            exposure=rng.uniform(0.32, 0.58),
            gamma=rng.uniform(0.4, 0.65),
            grey=bool(rng.random() < 0.12),
            gain=1 + rng.uniform(0, 0.06) * rng.standard_normal((2, 1)) + rng.uniform(0, 0.02) * rng.standard_normal((2, 3)),
            flicker=1 + 0.01 * rng.standard_normal(frames),
            vignetting=rng.uniform(0, 0.3) * float(rng.random() < 0.5),
            blur_px=rng.uniform(0.0, 0.8),
            read_noise=0.001 + 0.012 * noise,
            shot_noise=0.001 + 0.012 * noise,
            eight_bits=True,
        )

    def scale(self, radiance: np.ndarray) -> float:
        """Factor on the radiance that meets the exposure for this picture, (H, W, 3)."""
        # pictures are judged on every fourth pixel
        return float((self.exposure / max(float(np.sqrt(radiance[::4, ::4].mean(-1)).mean()), 1e-6)) ** 2)

    def develop(self, radiance: np.ndarray, scale: float, camera: int, frame: int, rng: np.random.Generator) -> np.ndarray:
        """The picture (H, W, 3) float32 in [0, 1] of `radiance` by camera 0 (left) or 1 (right)."""
        gain = np.ones(3) if self.gain is None else self.gain[camera]
        factor = scale * gain * (1.0 if self.flicker is None else self.flicker[frame])
        width = radiance.shape[1]
        across = np.repeat((2.0 * np.arange(width) / (width - 1) - 1.0) ** 2, 3)
        curve = np.linspace(0, 1, 1025) ** (2 * self.gamma)
        image = np.empty_like(radiance)
        rows, out = radiance.reshape(-1, 3 * width), image.reshape(-1, 3 * width)
        _expose(rows, np.tile(factor, width), self.vignetting, across, curve, self.grey, np.empty(3 * width), out)
        if self.blur_px > 0.2:
            image = cv2.GaussianBlur(image, (5, 5), self.blur_px)
        if self.read_noise > 0 or self.shot_noise > 0:
            _add_noise(image, _normals(), int(rng.integers(1 << 62)), self.read_noise, self.shot_noise, self.grey)
        if self.eight_bits:
            _round(image.reshape(-1), np.arange(256, dtype=np.float32) / 255)
        return image


@rowwise
def _expose(
    radiance: np.ndarray, factor: np.ndarray, vignetting: float, across: np.ndarray, curve: np.ndarray, grey: bool,
    light: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Gains, vignetting, clip and tone curve.

    `radiance`, `out` (H, 3 W); `factor`, `across` (3 W,): gain and squared place across the image of every value in a
    row; `curve` (K,) is a table over the square root of the light; `light` (3 W,) is scratch.
    """
    height, count = radiance.shape
    last = curve.size - 2
    for row in range(height):
        y = 2.0 * row / (height - 1) - 1.0
        for j in range(count):
            light[j] = radiance[row, j] * factor[j]
        if grey:
            for j in range(0, count, 3):
                value = 0.114 * light[j] + 0.587 * light[j + 1] + 0.299 * light[j + 2]
                light[j] = light[j + 1] = light[j + 2] = value
        for j in range(count):
            value = light[j] * (1.0 - vignetting * 0.5 * (across[j] + y * y))
            light[j] = math.sqrt(min(max(value, 0.0), 1.0)) * (last + 1)
        for j in range(count):
            i = np.uint32(min(int(light[j]), last))
            out[row, j] = curve[i] + (light[j] - i) * (curve[np.uint32(i + 1)] - curve[i])


@rowwise
def _round(values: np.ndarray, levels: np.ndarray) -> None:
    """Round values in [0, 1] to the nearest of 256 `levels`."""
    for i in range(values.size):
        values[i] = levels[int(np.rint(values[i] * np.float32(255.0)))]


@lru_cache(maxsize=1)
def _normals() -> np.ndarray:
    return np.random.default_rng(7).standard_normal(1 << 15).astype(np.float32)


@rowwise
def _add_noise(image: np.ndarray, normals: np.ndarray, seed: int, read: float, shot: float, grey: bool) -> None:
    """Gaussian noise drawn from a table by a linear congruential generator, and the clip to [0, 1]."""
    state = np.uint64(seed)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            for channel in range(3):
                if channel == 0 or not grey:
                    state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                value = image[row, column, channel]
                value += normals[state >> np.uint64(49)] * (read + shot * value)
                image[row, column, channel] = min(max(value, 0.0), 1.0)
