"""From radiance to the picture that a camera delivers: exposure, vignetting, blur, tone curve, noise, eight bits."""

from dataclasses import dataclass

import cv2
import numpy as np


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
        height, width = radiance.shape[:2]
        gain = np.ones(3) if self.gain is None else self.gain[camera]
        factor = scale * gain * (1.0 if self.flicker is None else self.flicker[frame])
        image = radiance * factor.astype(np.float32)
        if self.vignetting > 0:
            y = np.linspace(-1, 1, height, dtype=np.float32)[:, None, None] ** 2
            x = np.linspace(-1, 1, width, dtype=np.float32)[None, :, None] ** 2
            image *= 1 - np.float32(self.vignetting) * (0.5 * (x + y))
        if self.grey:
            image = np.repeat(image @ np.array([[0.114], [0.587], [0.299]], np.float32), 3, axis=-1)
        np.clip(image, 0, 1, out=image)
        image = cv2.pow(image, self.gamma)
        if self.blur_px > 0.2:
            image = cv2.GaussianBlur(image, (5, 5), self.blur_px)
        if self.read_noise > 0 or self.shot_noise > 0:
            noise = rng.standard_normal(image.shape[:2] if self.grey else image.shape, dtype=np.float32)
            if self.grey:
                noise = noise[..., None]
            image += noise * (np.float32(self.read_noise) + np.float32(self.shot_noise) * image)
        np.clip(image, 0, 1, out=image)
        if self.eight_bits:
            image = np.round(image * np.float32(255)) / np.float32(255)
        return image
