"""Middlebury's .flo: magic 202021.25 (reads PIEH), int32 width and height, then u, v float32 interleaved, row by row.

Little-endian. A component of 1e9 or more means *unknown* (Baker et al., A Database and Evaluation Methodology for
Optical Flow, 2011); OpenCV's reader has no such code and trusts the header's size, so the twelve bytes are read here.
"""

from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import check_size, read_bytes, write_bytes

_MAGIC = np.array(202021.25, "<f4").tobytes()
_UNKNOWN = 1e9


def read_flo(path: str | Path) -> np.ndarray:
    """Flow (u, v) in pixels, (H, W, 2) float32, NaN where unknown."""
    content = read_bytes(path)
    if len(content) < 12 or content[:4] != _MAGIC:
        raise InputError(f"{path}: is no .flo file")
    width, height = (int(n) for n in np.frombuffer(content, "<i4", 2, 4))
    check_size(path, width, height)
    if len(content) != 12 + 8 * width * height:
        raise InputError(f"{path}: truncated or damaged, {width} x {height} flow needs {12 + 8 * width * height} bytes")
    flow = np.frombuffer(content, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)
    flow[~(np.abs(flow) < _UNKNOWN).all(-1)] = np.nan
    return flow


def write_flo(path: str | Path, flow: np.ndarray) -> None:
    """Write flow (u, v) in pixels, (H, W, 2); NaN becomes *unknown*."""
    height, width = flow.shape[:2]
    known = np.isfinite(flow).all(-1, keepdims=True)
    header = _MAGIC + np.array([width, height], "<i4").tobytes()
    write_bytes(path, header + np.where(known, flow, 2 * _UNKNOWN).astype("<f4").tobytes())
