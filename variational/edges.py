"""Jumps of disparity, put where the colours change.

Matching compares windows, and a window across a jump sees both sides: its pixel may take the disparity of either. So may
a pixel that was filled. Its own colour often tells where it belongs: the pixels around vote for their side, and weigh the
more, the more alike and the nearer they are (a local mode: van de Weijer and van den Boomgaard, CVPR 2001). A pixel changes
sides if most are for it, and by far most of those that lie clear of every jump, whose own side is certain.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from variational.jit import over_rows, rowwise


@dataclass(frozen=True)
class EdgesConfig:
    """Sides of jumps.

    Parameters
    ----------
    reach_px : int
        Pixels no farther than this from a jump may change sides; 0 leaves all as they are.
    jump_px : float
        Least difference of disparity within that reach.
    clear_px : int
        Voters this far from any jump between neighbours are certain of their side.
    window_px : int
        How far away the voters may be.
    colour : float
        Mean difference of the channels in [0, 1] from which a pixel has no vote.
    distance_px : float
        Distance at which a vote weighs 1 / e.
    majority : float
        Share of the certain votes that it takes, in [0.5, 1].
    """

    reach_px: int = 2
    jump_px: float = 2.0
    clear_px: int = 3
    window_px: int = 9
    colour: float = 0.1
    distance_px: float = 6.0
    majority: float = 0.73

    def __post_init__(self) -> None:
        if not (0 <= self.reach_px <= 64 and 1 <= self.clear_px <= 64 and 0 <= self.window_px <= 64):
            raise ValueError("EdgesConfig.reach_px and window_px must lie in 0 ... 64, clear_px in 1 ... 64")
        if not (self.colour > 0 and self.distance_px > 0):
            raise ValueError("EdgesConfig.colour and distance_px must be positive")
        if not 0.5 <= self.majority <= 1:
            raise ValueError(f"EdgesConfig.majority must lie in 0.5 ... 1, got {self.majority}")


@rowwise
def _votes(
    y: int, x: int, channels: np.ndarray, voters: np.ndarray, nearness: np.ndarray, per_colour: np.float32, votes: np.ndarray
) -> None:  # fmt: skip
    """votes (r, r): weights of the voters around pixel (y, x), 0 where there is none."""
    count, rows, columns = voters.shape
    size = votes.shape[0]
    top, begin = y // 2 - size // 2, x // 2 - size // 2
    left, right = max(-begin, 0), min(columns - begin, size)
    one, zero = np.float32(1), np.float32(0)
    for j in range(size):
        for i in range(size):
            votes[j, i] = zero
        if top + j < 0 or top + j >= rows:
            continue
        for c in range(count):
            for i in range(left, right):
                votes[j, i] += abs(voters[c, top + j, begin + i] - channels[c, y, x])
        for i in range(left, right):
            alike = max(one - votes[j, i] * per_colour, zero)
            votes[j, i] = alike * alike * nearness[y % 2, x % 2, j, i]


@rowwise
def _elect(
    first: int, last: int, channels: np.ndarray, disparity: np.ndarray, middle: np.ndarray, voters: np.ndarray,
    voted: np.ndarray, clear: np.ndarray, nearness: np.ndarray, per_colour: np.float32, majority: np.float32, source: np.ndarray,
) -> None:  # fmt: skip
    """source (H, W): the pixel that each takes its values from, as an index into the flat image.

    channels (c, H, W): of all pixels; middle (H, W): between the two sides, NaN far from any jump; voters (c, h, w),
    voted, clear (h, w): colours, disparities and certainty of every second pixel; nearness (2, 2, r, r): their weights
    as seen from even and odd rows and columns.
    """
    _, rows, columns = voters.shape
    width, size = channels.shape[2], nearness.shape[2]
    zero, half = np.float32(0), np.float32(0.5)
    votes = np.empty((size, size), np.float32)
    for y in range(first, last):
        top = y // 2 - size // 2
        for x in range(width):
            source[y, x] = y * width + x
            between, begin = middle[y, x], x // 2 - size // 2
            if np.isnan(between):
                continue
            _votes(y, x, channels, voters, nearness, per_colour, votes)
            left, right = max(-begin, 0), min(columns - begin, size)
            near = total = certain_near = certain = zero
            for j in range(max(-top, 0), min(rows - top, size)):
                for i in range(left, right):
                    vote = votes[j, i]
                    sure = vote * clear[top + j, begin + i]
                    nearer = voted[top + j, begin + i] > between
                    near += vote if nearer else zero
                    certain_near += sure if nearer else zero
                    total += vote
                    certain += sure
            from_near = disparity[y, x] > between
            if from_near:
                near, certain_near = total - near, certain - certain_near
            if near <= half * total or certain_near <= majority * certain:
                continue
            best = zero
            for j in range(max(-top, 0), min(rows - top, size)):
                for i in range(left, right):
                    sure = votes[j, i] * clear[top + j, begin + i]
                    if sure > best and (voted[top + j, begin + i] > between) != from_near:
                        best = sure
                        source[y, x] = 2 * (top + j) * width + 2 * (begin + i)


def other_sides(disparity: np.ndarray, image: np.ndarray, config: EdgesConfig) -> np.ndarray:
    """Where each pixel takes its values from: itself, or a pixel on the other side of a jump, if its colour belongs there.

    Parameters
    ----------
    disparity : np.ndarray
        (H, W) float32, pixels, finite.
    image : np.ndarray
        (H, W, c) float32 in [0, 1], the view that the disparity belongs to.
    config : EdgesConfig

    Returns
    -------
    np.ndarray
        (H, W) int64, indices into the flat image: of the pixel itself, or of its weightiest certain voter.
    """
    height, width = disparity.shape
    if not config.reach_px:
        return np.arange(height * width).reshape(height, width)

    def square(reach: int) -> np.ndarray:
        return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)

    jumps = cv2.morphologyEx(disparity, cv2.MORPH_GRADIENT, square(1)) > config.jump_px
    beside, unclear = (cv2.dilate(jumps.astype(np.uint8), square(reach - 1)) for reach in (config.reach_px, config.clear_px))
    around = square(config.reach_px)
    middle = np.where(beside > 0, (cv2.erode(disparity, around) + cv2.dilate(disparity, around)) / 2, np.float32(np.nan))
    # every second pixel votes: offsets of the voters from an even and from an odd pixel
    offsets = 2 * np.arange(-(config.window_px // 2), config.window_px // 2 + 1) - np.array([[0], [1]])
    nearness = np.exp(-np.hypot(offsets[:, None, :, None], offsets[None, :, None]) / config.distance_px).astype(np.float32)
    channels, source = np.ascontiguousarray(np.moveaxis(image, -1, 0), np.float32), np.empty(disparity.shape, np.int64)
    clear = (unclear == 0).astype(np.float32)
    voters, voted, clear = (np.ascontiguousarray(plane[..., ::2, ::2]) for plane in (channels, disparity, clear))
    per_colour = np.float32(1 / (config.colour * len(channels)))
    over_rows(
        _elect, height, channels, disparity, middle, voters, voted, clear, nearness, per_colour, np.float32(config.majority),
        source,
    )  # fmt: skip
    return source
