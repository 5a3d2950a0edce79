"""How CPU kernels are compiled: the one place with numba flags on the learned side.

(``variational.jit`` is out of reach here by design: ``learned`` imports the classical side through one file only.)
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core.compiler import CompilerBase, DefaultPassBuilder

__all__ = ["lanes", "tasks"]


class _NoAlias(CompilerBase):
    """Numba's ordinary pipeline, with the promise that array arguments do not overlap."""

    def define_pipelines(self) -> list:
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


# Reordering sums is fine; the absence of NaN and infinity is not assumed, so that bad values stay visible.
_FLAGS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}

#: An inner loop over vector lanes. Its array arguments must not overlap, else LLVM could not vectorise it.
lanes = njit(forceinline=True, pipeline_class=_NoAlias, **_FLAGS)

#: An outermost loop, over independent tasks ``first`` ... ``last`` - 1, for ``learned.threads.over_tasks``.
tasks = njit(nogil=True, **_FLAGS)
