"""Constancy of local structure between the images, linearised: the data term of the second-order minimiser.

Every image becomes three features that forget brightness and contrast: the image less its local mean and over its local
deviation, and the two derivatives of that. Between a pixel of a left image and its place in another image,

    E = sum over pairs of  w * phi( sum over features of  theta r^2 ),    r = f_other(p + displacement) - f_left(p),
    theta = 1 / (|grad f_other|^2 + zeta^2),    phi(s) = sqrt(s + eps^2)

theta (Zimmer et al. 2011) makes the residual a distance in pixels. The pairs are left1-right1 (moves D1), left1-left2
(u, v), left1-right2 (D1 + C, u, v) and left2-right2 (D2, on left2's grid); with them comes the coupling
``phi((D1 + C - D2(p + F))^2)``. Pairs that are hidden or lead out of the image are left out.

At a state, each pixel gets the Gauss-Newton system of its four unknowns z = (D1, C, u, v), phi's weight held fixed:
``A (z_new - z) = -b``, b being the exact gradient of E by z at the state (D2 held fixed), and A >= 0. D2 has a system of
one unknown.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.frames import Frames
from variational.jit import over_rows, rowwise, scalar

FEATURES = 3
"""Channels of :func:`features`."""
SYSTEM = 18
"""Numbers a pixel: 10 of A (upper triangle, by rows), 4 of b, then A and b of D2, E of both."""


@dataclass(frozen=True)
class ConstancyConfig:
    """Weights of the data term.

    Parameters
    ----------
    stereo_weight, flow_weight, cross_weight, coupling_weight : float
        Weights of left-right, left1-left2, left1-right2 and of D1 + C = D2(p + F).
    zeta : float
        Gradient of the normalised image, per pixel, below which an area counts as without structure.
    eps_px : float
        Residual, in pixels, below which the penalty is quadratic.
    window : int
        Side of the window of the local mean and deviation, pixels, odd.
    noise : float
        Added to the local deviation, intensity: contrasts below it are not amplified.
    """

    stereo_weight: float = 1.0
    flow_weight: float = 1.0
    cross_weight: float = 0.5
    coupling_weight: float = 0.5
    zeta: float = 0.3
    eps_px: float = 0.1
    window: int = 9
    noise: float = 0.02


def features(image: np.ndarray, config: ConstancyConfig) -> np.ndarray:
    """(H, W, 3) float32 features of a (H, W) grey image in [0, 1]; pixel-major, as the kernel gathers them."""
    box = (config.window, config.window)
    mean = cv2.blur(image, box)
    deviation = np.sqrt(np.maximum(cv2.blur(image * image, box) - mean * mean, 0))
    normal = (image - mean) / (deviation + np.float32(config.noise))
    along_x = cv2.Sobel(normal, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    along_y = cv2.Sobel(normal, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.dstack([normal, along_x, along_y])


@scalar
def _compare(
    here: np.ndarray, other: np.ndarray, x: int, y: int, to_x: float, to_y: float, weight: float, zeta2: float, eps2: float
) -> tuple[np.float32, ...]:
    """One pair at one pixel: (gxx, gxy, gyy, bx, by, E) by the position; zeros where it leads outside."""
    height, width, _ = other.shape
    zero, one = np.float32(0), np.float32(1)
    if not (0 <= to_x <= width - 1 and 0 <= to_y <= height - 1):
        return zero, zero, zero, zero, zero, zero
    i, j = min(int(to_x), max(width - 2, 0)), min(int(to_y), max(height - 2, 0))
    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
    fx, fy = to_x - np.float32(i), to_y - np.float32(j)
    gxx = gxy = gyy = bx = by = energy = zero
    for k in range(FEATURES):  # a constant, so that the loop is unrolled
        v00, v01, v10, v11 = other[j, i, k], other[j, i1, k], other[j1, i, k], other[j1, i1, k]
        top, bottom = v00 + fx * (v01 - v00), v10 + fx * (v11 - v10)
        dx, dy = (one - fy) * (v01 - v00) + fy * (v11 - v10), bottom - top
        residual = top + fy * (bottom - top) - here[y, x, k]
        # theta moves with the position too; like phi's weight it is held fixed
        theta = one / (dx * dx + dy * dy + zeta2)
        energy += theta * residual * residual
        gxx += theta * dx * dx
        gxy += theta * dx * dy
        gyy += theta * dy * dy
        bx += theta * dx * residual
        by += theta * dy * residual
    root = np.sqrt(energy + eps2)
    scale = weight / root
    return scale * gxx, scale * gxy, scale * gyy, scale * bx, scale * by, weight * root


@rowwise
def _systems(
    first: int, last: int, state: np.ndarray, left1: np.ndarray, right1: np.ndarray, left2: np.ndarray, right2: np.ndarray,
    seen_right1: np.ndarray, seen_left2: np.ndarray, seen_right2: np.ndarray, weights: np.ndarray, zeta2: float, eps2: float,
    systems: np.ndarray,
) -> None:  # fmt: skip
    _, height, width = state.shape
    for y in range(first, last):
        for x in range(width):
            s = systems[y, x]
            s[:] = 0
            d1, d2, change = state[0, y, x], state[1, y, x], state[2, y, x]
            px, py = np.float32(x), np.float32(y)  # an integer plus a float32 would be float64
            to_x, to_y = px + state[3, y, x], py + state[4, y, x]
            if seen_right1[y, x]:
                gxx, _, _, bx, _, e = _compare(left1, right1, x, y, px - d1, py, weights[0], zeta2, eps2)
                s[0] += gxx
                s[10] -= bx
                s[16] += e
            if seen_left2[y, x]:
                gxx, gxy, gyy, bx, by, e = _compare(left1, left2, x, y, to_x, to_y, weights[1], zeta2, eps2)
                s[7] += gxx
                s[8] += gxy
                s[9] += gyy
                s[12] += bx
                s[13] += by
                s[16] += e
                to_right = to_x - d1 - change
                gxx, gxy, gyy, bx, by, e = _compare(left1, right2, x, y, to_right, to_y, weights[2], zeta2, eps2)
                # the position's x moves by -1, -1, +1, 0 with D1, C, u, v; its y with v alone
                s[0] += gxx
                s[1] += gxx
                s[2] -= gxx
                s[3] -= gxy
                s[4] += gxx
                s[5] -= gxx
                s[6] -= gxy
                s[7] += gxx
                s[8] += gxy
                s[9] += gyy
                s[10] -= bx
                s[11] -= bx
                s[12] += bx
                s[13] += by
                s[16] += e
                if 0 <= to_x <= width - 1 and 0 <= to_y <= height - 1:
                    i, j = min(int(to_x), max(width - 2, 0)), min(int(to_y), max(height - 2, 0))
                    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
                    fx, fy = to_x - np.float32(i), to_y - np.float32(j)
                    v00, v01, v10, v11 = state[1, j, i], state[1, j, i1], state[1, j1, i], state[1, j1, i1]
                    top, bottom = v00 + fx * (v01 - v00), v10 + fx * (v11 - v10)
                    dx, dy = (np.float32(1) - fy) * (v01 - v00) + fy * (v11 - v10), bottom - top
                    residual = d1 + change - top - fy * (bottom - top)
                    root = np.sqrt(residual * residual + eps2)
                    scale = weights[3] / root
                    s[0] += scale
                    s[1] += scale
                    s[2] -= scale * dx
                    s[3] -= scale * dy
                    s[4] += scale
                    s[5] -= scale * dx
                    s[6] -= scale * dy
                    s[7] += scale * dx * dx
                    s[8] += scale * dx * dy
                    s[9] += scale * dy * dy
                    s[10] += scale * residual
                    s[11] += scale * residual
                    s[12] -= scale * dx * residual
                    s[13] -= scale * dy * residual
                    s[16] += weights[3] * root
            if seen_right2[y, x]:
                gxx, _, _, bx, _, e = _compare(left2, right2, x, y, px - d2, py, weights[0], zeta2, eps2)
                s[14] += gxx
                s[15] -= bx
                s[17] += e


class Constancy:
    """The data term of one set of frames at one resolution.

    Parameters
    ----------
    frames : Frames
    config : ConstancyConfig
    """

    def __init__(self, frames: Frames, config: ConstancyConfig) -> None:
        self.shape, self.config = frames.shape, config
        self._features = [features(grey, config) for grey in frames.grey]

    def systems(self, state: np.ndarray, seen: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
        """Gauss-Newton systems of all pixels.

        Parameters
        ----------
        state : np.ndarray
            (5, H, W) float32.
        seen : tuple of three np.ndarray
            (H, W) bool: left1's pixels seen in right1 and in left2, left2's seen in right2.

        Returns
        -------
        np.ndarray
            (H, W, SYSTEM) float32; see the module's text.
        """
        c = self.config
        weights = np.array([c.stereo_weight, c.flow_weight, c.cross_weight, c.coupling_weight], np.float32)
        systems = np.empty((*self.shape, SYSTEM), np.float32)
        zeta2, eps2 = np.float32(c.zeta**2), np.float32(c.eps_px**2)
        over_rows(_systems, self.shape[0], state, *self._features, *seen, weights, zeta2, eps2, systems)
        return systems
