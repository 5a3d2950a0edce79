"""How many threads this process may use."""

from __future__ import annotations

import sys

import cv2
import numba


def bound_threads(count: int) -> None:
    """Let numba, OpenCV, and torch if it is loaded, use at most `count` threads each.

    Every library keeps a pool as large as the machine; two processes with whole pools each slow one another down
    several times over. numba's bound holds for the calling thread.
    """
    # first of all: it starts numba's pool, which makes torch's as large
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    cv2.setNumThreads(count)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(count)
