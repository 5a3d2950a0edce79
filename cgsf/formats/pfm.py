"""Portable float maps: ``Pf`` one channel, ``PF`` three; the scale's sign gives the byte order; bottom row first.

OpenCV's reader exchanges the first and third channel (it takes them for RGB), which these maps, flows mostly, are not.
"""

import re
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import check_size, read_bytes, write_bytes

_HEADER = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?\d{1,9}(?:\.\d{0,9})?(?:[eE][-+]?\d{1,3})?)[ \t\r]*\n")


def read_pfm(path: str | Path) -> np.ndarray:
    """The map as stored, top row first: (H, W) or (H, W, 3) float32; the scale's magnitude is not applied.

    Infinity and NaN stay as they are: what they mean is the data set's affair.
    """
    content = read_bytes(path)
    header = _HEADER.match(content)
    if header is None or float(header[4]) == 0:
        raise InputError(f"{path}: is no PFM file")
    channels = 3 if header[1] == b"PF" else 1
    width, height = int(header[2]), int(header[3])
    check_size(path, width, height)
    if len(content) - header.end() != 4 * channels * width * height:
        raise InputError(f"{path}: truncated or damaged, the size does not fit {width} x {height} x {channels} floats")
    order = "<f4" if float(header[4]) < 0 else ">f4"
    values = np.frombuffer(content, order, offset=header.end()).reshape(height, width, channels)[::-1]
    return np.ascontiguousarray(values if channels == 3 else values[..., 0], np.float32)


def write_pfm(path: str | Path, values: np.ndarray) -> None:
    """Write (H, W) or (H, W, 3) as little-endian float32."""
    if not (values.ndim == 2 or (values.ndim == 3 and values.shape[2] == 3)):
        raise ValueError(f"a PFM file holds (H, W) or (H, W, 3), not {values.shape}")
    kind, (height, width) = "Pf" if values.ndim == 2 else "PF", values.shape[:2]
    header = f"{kind}\n{width} {height}\n-1.0\n".encode()
    write_bytes(path, header + np.ascontiguousarray(values[::-1], "<f4").tobytes())
