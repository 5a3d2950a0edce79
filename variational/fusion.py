"""Fusion: a discrete choice per pixel between candidate motions.

Candidates are whole motion fields, measured flow or rigid proposals. A candidate's cost at a pixel is how badly the
census words of left1 agree with those of left2 and right2 where it leads, averaged over a small window; one that leads
out of the image costs a constant. Neighbours pay for a difference of motion, less across jumps of disparity and edges
of the image. The labelling minimises this along a tree at every pixel (rows first, then the column through it: the
"simple tree" of Bleyer and Gelautz 2008), which dynamic programming does exactly in four sweeps.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.census import BITS, popcount
from variational.jit import parallel, prange, rowwise

STRIP = 64
"""Columns that a chain works on at a time: their candidates and costs of two rows stay in the nearest cache."""
FORBIDDEN = 100.0
"""Cost of a candidate that does not exist at a pixel: finite, so that sums stay finite."""


@dataclass(frozen=True)
class FusionConfig:
    """Choice between motions.

    Parameters
    ----------
    truncation : float
        Share of differing census bits from which a comparison says no more than "different".
    outside_cost : float
        Cost in [0, 1] of leading out of the image.
    window : int
        Side of the window that costs are averaged over, pixels, odd.
    motion_scale_px : float
        Difference of motion between neighbours at which they pay the full price.
    jump_cost : float
        That price, where neither disparity nor image has an edge.
    disparity_edge_px, intensity_edge : float
        Jumps at which the price has fallen to a third.
    measured_prior, object_prior : float
        Added to the cost of measured flow and of a moving object's motion: what is rigid and still needs no excuse.
    """

    truncation: float = 0.4
    outside_cost: float = 0.4
    window: int = 7
    motion_scale_px: float = 10.0
    jump_cost: float = 3.0
    disparity_edge_px: float = 1.5
    intensity_edge: float = 0.08
    measured_prior: float = 0.2
    object_prior: float = 0.1


@parallel
def _costs(
    candidates: np.ndarray, disparity: np.ndarray, words_left1: np.ndarray, words_left2: np.ndarray,
    words_right2: np.ndarray, largest: float, outside: float, costs: np.ndarray,
) -> None:  # fmt: skip
    count, _, height, width = candidates.shape
    for y in prange(height):
        for k in range(count):
            for x in range(width):
                u, v = candidates[k, 1, y, x], candidates[k, 2, y, x]
                if not np.isfinite(u):
                    costs[k, y, x] = FORBIDDEN
                    continue
                to_x, to_y = int(np.rint(x + u)), int(np.rint(y + v))
                if to_x < 0 or to_x >= width or to_y < 0 or to_y >= height:
                    costs[k, y, x] = outside
                    continue
                bits = popcount(words_left1[0, y, x] ^ words_left2[0, to_y, to_x])
                bits += popcount(words_left1[1, y, x] ^ words_left2[1, to_y, to_x])
                cost = min(bits / largest, 1.0)
                in_right = int(np.rint(x + u - disparity[y, x] - candidates[k, 0, y, x]))
                if 0 <= in_right < width:
                    bits = popcount(words_left1[0, y, x] ^ words_right2[0, to_y, in_right])
                    bits += popcount(words_left1[1, y, x] ^ words_right2[1, to_y, in_right])
                    cost = 0.5 * (cost + min(bits / largest, 1.0))
                costs[k, y, x] = cost


@rowwise
def _pass_message(
    motion: np.ndarray, motion_from: np.ndarray, price: np.ndarray, inverse_scale: float, before: np.ndarray,
    least: np.ndarray, message: np.ndarray,
) -> None:  # fmt: skip
    """message (K, X): least cost of the chains up to the row before, given each label here, less the least of all.

    motion, motion_from (K, 3, X); before (K, X): costs of the chains that end in the row before.
    """
    count, _, width = motion.shape
    least[:] = before[0]
    for k in range(1, count):
        for x in range(width):
            least[x] = min(least[x], before[k, x])
    for k in range(count):
        for x in range(width):
            message[k, x] = least[x] + price[x]
        for m in range(count):
            for x in range(width):
                difference = (
                    abs(motion[k, 0, x] - motion_from[m, 0, x])
                    + abs(motion[k, 1, x] - motion_from[m, 1, x])
                    + abs(motion[k, 2, x] - motion_from[m, 2, x])
                )
                cost = before[m, x] + price[x] * difference * inverse_scale
                message[k, x] = cost if cost < message[k, x] else message[k, x]  # NaN: no such candidate, full price
        for x in range(width):
            message[k, x] -= least[x]


@parallel
def _chains(
    candidates: np.ndarray, costs: np.ndarray, price: np.ndarray, inverse_scale: float, out: np.ndarray
) -> None:
    """out (K, H, W): for every label of every pixel, the least cost of its whole column that has this label there.

    price (H, W): full price between a pixel and the one above it. Exact: dynamic programming down and up, for a strip
    of columns at a time.
    """
    count, height, width = costs.shape
    for strip in prange((width + STRIP - 1) // STRIP):
        here = slice(strip * STRIP, min((strip + 1) * STRIP, width))
        size = min((strip + 1) * STRIP, width) - strip * STRIP
        before, message = np.empty((count, size), costs.dtype), np.empty((count, size), costs.dtype)
        least = np.empty(size, costs.dtype)
        for upwards in range(2):
            for i in range(height):
                y = height - 1 - i if upwards else i
                from_y = y + 1 if upwards else y - 1
                if i == 0:
                    message[:] = 0
                else:
                    _pass_message(
                        candidates[:, :, y, here], candidates[:, :, from_y, here], price[max(y, from_y), here],
                        inverse_scale, before, least, message,
                    )  # fmt: skip
                for k in range(count):
                    for x in range(size):
                        at = here.start + x
                        before[k, x] = message[k, x] + costs[k, y, at]
                        out[k, y, at] = costs[k, y, at] + out[k, y, at] + message[k, x] if upwards else message[k, x]


def _transposed(planes: np.ndarray) -> np.ndarray:
    """(..., W, H) copy of (..., H, W) planes."""
    turned = [cv2.transpose(plane) for plane in planes.reshape(-1, *planes.shape[-2:])]
    return np.stack(turned).reshape(*planes.shape[:-2], *turned[0].shape)


def _price(disparity: np.ndarray, grey: np.ndarray, axis: int, config: FusionConfig) -> np.ndarray:
    """(H, W) float32 price of a jump between each pixel and the one before it along `axis`."""
    step = np.exp(-np.abs(np.diff(disparity, axis=axis)) / config.disparity_edge_px)
    contrast = np.exp(-np.abs(np.diff(grey, axis=axis)) / config.intensity_edge)
    price = np.zeros(grey.shape, np.float32)
    price[(slice(None),) * axis + (slice(1, None),)] = config.jump_cost * (0.05 + step * (0.3 + 0.7 * contrast))
    return price


def motion_costs(
    candidates: np.ndarray, disparity: np.ndarray, words: tuple[np.ndarray, np.ndarray, np.ndarray],
    config: FusionConfig,
) -> np.ndarray:  # fmt: skip
    """Cost in [0, 1] of each candidate at each pixel.

    Parameters
    ----------
    candidates : np.ndarray
        (K, 3, H, W) float32: disparity change, u, v; NaN where a candidate does not exist.
    disparity : np.ndarray
        (H, W) at time 1.
    words : tuple of three np.ndarray
        (2, H, W) uint64 census words of left1, left2 and right2.

    Returns
    -------
    np.ndarray
        (K, H, W) float32; FORBIDDEN where a candidate does not exist.
    """
    costs = np.empty((len(candidates), *disparity.shape), np.float32)
    _costs(candidates, disparity, *words, np.float32(config.truncation * BITS), np.float32(config.outside_cost), costs)
    exists = np.isfinite(candidates[:, 1])
    for k in range(len(costs)):
        costs[k] = np.where(exists[k], cv2.blur(np.minimum(costs[k], 1), (config.window, config.window)), FORBIDDEN)
    return costs


def choose(
    candidates: np.ndarray, costs: np.ndarray, disparity: np.ndarray, grey: np.ndarray, config: FusionConfig
) -> np.ndarray:
    """Label of the best candidate at each pixel.

    Parameters
    ----------
    candidates, costs : np.ndarray
        (K, 3, H, W) and (K, H, W), see `motion_costs`, priors added.
    disparity, grey : np.ndarray
        (H, W), whose edges make jumps cheap.

    Returns
    -------
    np.ndarray
        (H, W) int, in 0 ... K - 1.
    """
    inverse_scale = np.float32(1 / config.motion_scale_px)
    turned = _transposed(costs)
    rows, trees = np.empty_like(turned), np.empty_like(costs)
    _chains(_transposed(candidates), turned, cv2.transpose(_price(disparity, grey, 1, config)), inverse_scale, rows)
    _chains(candidates, _transposed(rows), _price(disparity, grey, 0, config), inverse_scale, trees)
    return trees.argmin(axis=0)
