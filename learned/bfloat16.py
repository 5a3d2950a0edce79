"""bfloat16 in CPU kernels: numba has no such type, so a kernel gets the bits as uint16 and computes in float32.

A kernel that reads with `widen` and writes with `narrow` is compiled for float32 and for bfloat16 arrays alike. With half of
the bytes to move, and no copies in another type around the kernel, it also takes half of the time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import types
from numba.extending import overload
from torch import Tensor


def to_array(tensor: Tensor) -> np.ndarray:
    """The memory of a detached tensor: float32 as it is, bfloat16 as uint16."""
    return tensor.view(torch.int16).numpy().view(np.uint16) if tensor.dtype == torch.bfloat16 else tensor.numpy()


def autocast_dtype(device: str, otherwise: torch.dtype) -> torch.dtype:
    """The type that layers compute in on a kind of device: autocast's, or what they are given without it."""
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else otherwise


def widen(value: Any) -> Any:
    """In kernels: a value out of an array, as float32."""
    raise NotImplementedError("for kernels alone")


def narrow(value: Any, array: Any) -> Any:
    """In kernels: a float32 as what `array` holds, to the nearest bfloat16 and to even ones between two, as torch rounds."""
    raise NotImplementedError("for kernels alone")


@overload(widen)
def _widen(value):  # type: ignore[no-untyped-def]  # numba matches bare names
    if value == types.uint16:
        return lambda value: np.uint32(np.uint32(value) << np.uint32(16)).view(np.float32)
    return lambda value: value


@overload(narrow)
def _narrow(value, array):  # type: ignore[no-untyped-def]
    if array.dtype == types.uint16:
        return _nearest
    return lambda value, array: value


def _nearest(value, array):  # type: ignore[no-untyped-def]
    bits = np.float32(value).view(np.uint32)
    return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))
