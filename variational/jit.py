"""How kernels are compiled: the only place with numba's flags.

Four kinds of kernel, from the inside out:

* ``@scalar``   a few operations on numbers, inlined by LLVM into whoever calls it;
* ``@rowwise``  a loop over one image row, or a band of rows; its array arguments **must not overlap**, which is
  promised to LLVM, and without which it would vectorise neither a loop with many streams nor one that gathers;
* ``@inlined``  the same, merged into its caller: for a loop so short that handing over its arrays would cost as much;
* ``@parallel`` the outermost loop, ``prange`` over bands of rows.

Results have the same bits for any number of threads, by construction: every output pixel is written by one band, with
the same instructions wherever the band begins, and sums are one float64 partial a row, added in order
(:func:`total`). A parallel scalar reduction would give another sum for every number of threads.

Fast-math is on without ``nnan`` and ``ninf``, so that a NaN in the input is seen in the output. Compiled code is cached
on disk beside the sources; numba notices a change of a kernel's own file only, so after changing a ``@scalar`` that is
used from another file, delete the ``__pycache__`` folders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import get_num_threads, njit, prange, types
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.extending import overload

__all__ = ["band_edges", "inlined", "parallel", "prange", "rowwise", "scalar", "total"]

MIN_BAND_ROWS = 24
"""Rows below which a band is not worth its halo: the stencils recompute two rows on either side."""


class _NoAlias(CompilerBase):
    """Numba's ordinary pipeline, with the promise that array arguments do not overlap."""

    def define_pipelines(self) -> list:
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


_FLAGS: dict[str, Any] = {
    "cache": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp", "afn"},
}

scalar = njit(**_FLAGS)
rowwise = njit(**_FLAGS, pipeline_class=_NoAlias)
inlined = njit(**_FLAGS, pipeline_class=_NoAlias, forceinline=True)
parallel = njit(**_FLAGS, parallel=True)


def real(number: Any, like: Any) -> Any:
    """`number` in the float type of `like`; a bare literal is float64 and would drag float32 arithmetic up with it."""
    return like.dtype.type(number)


@overload(real)
def _real(number, like):  # type: ignore[no-untyped-def]  # numba matches bare names
    if like == types.float32:
        return lambda number, like: np.float32(number)
    return lambda number, like: np.float64(number)


def band_edges(height: int) -> np.ndarray:
    """Rows at which the bands of a parallel loop begin and end: ``(bands + 1,)`` int64, one or two bands a thread.

    Results never depend on the bands, so they may follow the number of threads.
    """
    bands = max(1, min(get_num_threads(), height // MIN_BAND_ROWS))
    return np.linspace(0, height, bands + 1).astype(np.int64)


@parallel
def _row_sums(values: np.ndarray, sums: np.ndarray) -> None:
    for y in prange(values.shape[0]):
        partial = 0.0
        for x in range(values.shape[1]):
            partial += np.float64(values[y, x])
        sums[y] = partial


def total(values: np.ndarray) -> float:
    """Sum of a ``(H, W)`` map in float64, with the same bits for any number of threads."""
    sums = np.empty(values.shape[0])
    _row_sums(values, sums)
    return float(sums.cumsum()[-1])
