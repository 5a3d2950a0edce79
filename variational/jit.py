"""How kernels are compiled, and how they run on several threads: the only place with numba's flags.

Three kinds of kernel, from the inside out:

* ``@scalar``   a few operations on numbers, inlined by LLVM into whoever calls it;
* ``@rowwise``  a loop over one image row, or a band of rows; its array arguments **must not overlap**, which is
  promised to LLVM, and without which it would vectorise neither a loop with many streams nor one that gathers;
* ``@inlined``  the same, merged into its caller: for a loop so short that handing over its arrays would cost as much.

Outermost kernels are ``@rowwise``, begin with the arguments ``first, last``, and are called by :func:`over_rows`: plain
threads take one band of rows after the other, for kernels release the interpreter's lock. Numba's own parallel loops do
the same, but each takes about a second to compile, whatever it does. ``numba.set_num_threads`` bounds both.

Results have the same bits for any number of threads, by construction: every output pixel is written by one band, with
the same instructions wherever the band begins, and sums are one float64 partial a row, added in order
(:func:`total`). A parallel scalar reduction would give another sum for every number of threads.

Fast-math is on without ``nnan`` and ``ninf``, so that a NaN in the input is seen in the output. Compiled code is cached
on disk beside the sources; numba notices a change of a kernel's own file only, so after changing a ``@scalar`` that is
used from another file, delete the ``__pycache__`` folders.

A fresh install waits for the compiler, so kernels are written to be cheap to compile too:

* A literal handed to a kernel, ``count = 0`` before a loop that counts, say, has a type of its own, for which the
  kernel is compiled once more: ``np.int64(0)`` has not.
* A slice assigned to a slice brings the text of the error that it could raise, and with it all of numba's strings; a
  loop does not.
* Loops stand in the kernel that is called from Python, not in one more that calls it: whatever is called is compiled
  on its own and then once more inside of its caller.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numba import config, get_num_threads, njit, set_num_threads, types
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.extending import overload
from threadpoolctl import ThreadpoolController

__all__ = ["band_edges", "inlined", "over_bands", "over_rows", "rowwise", "scalar", "side_by_side", "total"]

MIN_BAND_ROWS = 24
"""Rows below which a band is not worth its halo: the stencils recompute two rows on either side."""


class _NoAlias(CompilerBase):
    """Numba's ordinary pipeline, with the promise that array arguments do not overlap."""

    def define_pipelines(self) -> list:
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


_FLAGS: dict[str, Any] = {
    "cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp", "afn"},
}

scalar = njit(**_FLAGS)
rowwise = njit(**_FLAGS, pipeline_class=_NoAlias)
inlined = njit(**_FLAGS, pipeline_class=_NoAlias, forceinline=True)


def real(number: Any, like: Any) -> Any:
    """`number` in the float type of `like`; a bare literal is float64 and would drag float32 arithmetic up with it."""
    return like.dtype.type(number)


@overload(real)
def _real(number, like):  # type: ignore[no-untyped-def]  # numba matches bare names
    if like == types.float32:
        return lambda number, like: np.float32(number)
    return lambda number, like: np.float64(number)


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """The helpers beside the calling thread. None ever waits for another: bands are not cut into bands."""
    return ThreadPoolExecutor(max(1, config.NUMBA_NUM_THREADS - 1), thread_name_prefix="kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


def band_edges(height: int) -> list[int]:
    """Rows at which bands begin and end: one band a thread, and none that is thin.

    Results never depend on the bands, so they may follow the number of threads.
    """
    bands = max(1, min(get_num_threads(), height // MIN_BAND_ROWS))
    return [height * band // bands for band in range(bands + 1)]


def over_rows(kernel: Callable[..., None], height: int, *arguments: Any) -> None:
    """``kernel(first, last, *arguments)`` on bands of the rows ``0 ... height - 1``; `last` is excluded."""
    over_bands(kernel, band_edges(height), *arguments)


def over_bands(kernel: Callable[..., None], edges: Sequence[int], *arguments: Any) -> None:
    """``kernel(first, last, *arguments)`` for every two successive `edges`, on as many threads as numba may use.

    Parameters
    ----------
    kernel : callable
        A ``@rowwise`` kernel, or a function that spends its time in numpy or OpenCV; no two bands write to the same place.
    edges : sequence of int
        Ascending, at least two.
    *arguments
        The same for all bands.
    """
    bands = iter(list(pairwise(edges)))

    def work() -> None:
        for first, last in bands:  # one iterator for all threads: each takes the next band
            kernel(first, last, *arguments)

    helpers = [_pool().submit(work) for _ in range(min(get_num_threads(), len(edges) - 1) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():  # one that has not begun would find nothing left
            helper.result()


@lru_cache(maxsize=1)
def _products_of_matrices() -> ThreadpoolController:
    """The library that numpy multiplies matrices with, and its threads; looking for it takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")


def side_by_side(*tasks: Callable[[], Any]) -> list[Any]:
    """Results of functions that do not depend on one another, run at the same time on as many threads as numba may use.

    For whole stages, whose serial parts then fill one another's waits. They share the threads out among them, products of
    matrices too: the threads of one idle on for a while after it, and would take time from the other stages. That bound holds
    for the whole process until the last stage ends.
    """
    threads = get_num_threads()
    if threads == 1:
        return [task() for task in tasks]
    share = max(1, threads // len(tasks))
    pool = ThreadPoolExecutor(threads, "stages", initializer=set_num_threads, initargs=(share,))
    with _products_of_matrices().limit(limits=share), pool as stages:
        return list(stages.map(lambda task: task(), tasks))


def total(values: np.ndarray) -> float:
    """Sum of a ``(H, W)`` map in float64, with the same bits for any number of threads."""
    return float(values.sum(axis=1, dtype=np.float64).cumsum()[-1])
