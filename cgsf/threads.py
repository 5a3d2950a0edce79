"""How many threads this process may use, and how its memory is kept for them."""

from __future__ import annotations

import ctypes
import os
from functools import cache

import cv2
import numba

# Of glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def bound_threads(count: int, networks: bool = True) -> None:
    """Let numba, OpenCV and torch use at most `count` threads each.

    Every library keeps a pool as large as the machine; two processes with whole pools each slow one another down
    several times over.

    Parameters
    ----------
    count : int
    networks : bool
        False leaves torch out, and unloaded.

    Notes
    -----
    numba's bound holds for the calling thread. Its pool, when it starts, sets the number of OpenMP's threads for torch
    too, whatever ``OMP_NUM_THREADS`` says and whichever is loaded first: so it is started here, and torch bounded last.
    """
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    cv2.setNumThreads(count)
    if networks:
        import torch

        torch.set_num_threads(count)


@cache
def keep_freed_memory() -> None:
    """Let the C library keep what is freed, up to 1 GiB, for the next layer of a network or the next rendered scene.

    Otherwise it gives large arrays back at once, and the system hands out the same pages anew, zeroed one by one: a
    twentieth of the hybrid's time, a tenth of a scene's. A C library that is not glibc is left as it is.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)  # the most that it takes
        mallopt(_M_TRIM_THRESHOLD, 1 << 30)
