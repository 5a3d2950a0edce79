"""How many threads this process may use."""

from __future__ import annotations

import cv2
import numba


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
