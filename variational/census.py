"""Census words of an image, and what it costs to match two of them.

A word holds one bit for each pixel of a window: is it darker than the centre? Two words differ in few bits where they
show the same thing, whatever the exposure; two random ones in about half. Each pixel has two words, one of a 9 x 7
window, and one of the same window spread over twice the area of the smoothed image, which sees through noise on dark
roads. Source: Zabih and Woodfill 1994, doi:10.1007/BFb0028345.
"""

import cv2
import numpy as np
from numba import types
from numba.extending import intrinsic

from variational.jit import inlined, over_rows, rowwise

CENSUS_ROWS, CENSUS_COLUMNS = 3, 4
"""Half window of the census: 7 rows x 9 columns, 62 comparisons in one 64-bit word."""
BITS = 124
"""Largest matching cost: all bits of both words differ. Two random windows differ in about half of them."""
OUTSIDE_COST = 36
"""Cost of a match outside of the right image: more than a good match (about 20), less than a random one (60), so that
surfaces continue across the left border instead of jumping to a wrong match inside."""

_SMOOTHING_PX = 1.0
_SMOOTHED_NOISE = 1 / (2 * np.sqrt(np.pi) * _SMOOTHING_PX)
"""What smoothing leaves of white noise's deviation."""


@intrinsic
def popcount(typing_context, word):  # type: ignore[no-untyped-def]
    """Number of set bits of a 64-bit word."""
    return types.int64(types.uint64), lambda c, builder, s, v: builder.ctpop(v[0])


@rowwise
def _compare_row(centre: np.ndarray, other: np.ndarray, half_words: np.ndarray) -> None:
    """Append one bit to each half word: is the neighbour in `other` darker than the centre?"""
    for x in range(half_words.size):
        half_words[x] = (half_words[x] << np.uint32(1)) | np.uint32(other[x] < centre[x])


@rowwise
def _join_halves(high: np.ndarray, low: np.ndarray, low_bits: int, words: np.ndarray) -> None:
    for x in range(words.size):
        words[x] = (np.uint64(high[x]) << np.uint64(low_bits)) | np.uint64(low[x])


@rowwise
def _census(first: int, last: int, centres: np.ndarray, padded: np.ndarray, spacing: int, words: np.ndarray) -> None:
    """One neighbour after the other over a whole row: halves of words are as wide as the image's numbers, so that a
    comparison and a shift are one vector instruction each."""
    width = words.shape[1]
    columns = 2 * CENSUS_COLUMNS + 1
    neighbours = columns * (2 * CENSUS_ROWS + 1)
    halves = np.empty((2, width), np.uint32)
    for y in range(first, last):
        centre = centres[y]
        halves[:] = 0
        for n in range(neighbours):
            begin = n % columns * spacing
            _compare_row(centre, padded[y + n // columns * spacing, begin : begin + width], halves[n // 32])
        _join_halves(halves[0], halves[1], neighbours - 32, words[y])


def census(grey: np.ndarray, overlook: float = 0.0) -> np.ndarray:
    """Census words of a grey image: fine, and twice as wide on the smoothed image.

    Parameters
    ----------
    grey : np.ndarray
        (H, W) float32. Positions outside take the nearest pixel.
    overlook : float
        A neighbour that is darker by no more than this is not told from the centre.

    Returns
    -------
    np.ndarray
        (2, H, W) uint64; one bit a neighbour, set where it is darker than the centre.
    """
    words = np.empty((2, *grey.shape), np.uint64)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    for k, (image, least) in enumerate(((grey, overlook), (smooth, overlook * _SMOOTHED_NOISE))):
        rows, columns = (k + 1) * CENSUS_ROWS, (k + 1) * CENSUS_COLUMNS
        padded = cv2.copyMakeBorder(image, rows, rows, columns, columns, cv2.BORDER_REPLICATE)
        over_rows(_census, len(grey), image - np.float32(least), padded, k + 1, words[k])
    return words


@inlined
def write_matching_costs(left: np.ndarray, right_mirrored: np.ndarray, y: int, x: int, step: int, costs: np.ndarray) -> None:
    """Costs of the disparities 0, step, 2 step, ... of pixel (x, y), in differing bits; OUTSIDE_COST outside.

    left, right_mirrored (2, H, W): words, the right image's from its right end, so that disparities follow in the order of
    memory. costs (H, W, D).
    """
    disparities = costs.shape[2]
    reach = min(x // step + 1, disparities)
    fine, wide = left[0, y, x], left[1, y, x]
    begin = left.shape[2] - 1 - x
    for d in range(reach):
        at = np.uintp(begin + step * d)  # an index that may be negative, as numba sees it, is gathered word by word
        costs[y, x, d] = popcount(fine ^ right_mirrored[0, y, at]) + popcount(wide ^ right_mirrored[1, y, at])
    for d in range(reach, disparities):
        costs[y, x, d] = OUTSIDE_COST


@rowwise
def _matching_costs(first: int, last: int, left: np.ndarray, right_mirrored: np.ndarray, costs: np.ndarray) -> None:
    width = costs.shape[1]
    for y in range(first, last):
        for x in range(width):
            write_matching_costs(left, right_mirrored, y, x, np.intp(1), costs)


def stereo_costs(words_left: np.ndarray, words_right: np.ndarray, disparities: int) -> np.ndarray:
    """Matching costs (H, W, disparities) uint8 of the left image's pixels, in differing census bits."""
    costs = np.empty((*words_left.shape[1:], disparities), np.uint8)
    over_rows(_matching_costs, len(costs), words_left, np.ascontiguousarray(words_right[..., ::-1]), costs)
    return costs
