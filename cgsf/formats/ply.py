"""Point clouds with 3D motion as binary little-endian PLY, which MeshLab, CloudCompare and Open3D open.

Written properties: ``x y z`` in metres (x right, y down, z forward), ``motion_x motion_y motion_z`` in metres per
frame, ``red green blue``. Read: any file whose vertices are scalars.
"""

import re
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import read_bytes, write_bytes

_TYPES = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
          "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4",
          "uint32": "<u4", "float32": "<f4", "float64": "<f8"}  # fmt: skip
_WRITTEN = {"x": "float", "y": "float", "z": "float", "motion_x": "float", "motion_y": "float", "motion_z": "float",
            "red": "uchar", "green": "uchar", "blue": "uchar"}  # fmt: skip


def write_ply(path: str | Path, points: np.ndarray, motion: np.ndarray, bgr: np.ndarray) -> int:
    """Write the points whose position and motion are finite; returns how many these are.

    Parameters
    ----------
    path : str or Path
    points, motion : ndarray (..., 3)
        Metres, and metres per frame.
    bgr : ndarray (..., 3) uint8
        Colours.
    """
    points, motion, bgr = (array.reshape(-1, 3) for array in (points, motion, bgr))
    keep = np.isfinite(points).all(1) & np.isfinite(motion).all(1)
    vertices = np.empty(int(keep.sum()), [(name, _TYPES[kind]) for name, kind in _WRITTEN.items()])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[keep, axis]
        vertices[f"motion_{name}"] = motion[keep, axis]
    for channel, name in enumerate(("blue", "green", "red")):
        vertices[name] = bgr[keep, channel]
    properties = [f"property {kind} {name}" for name, kind in _WRITTEN.items()]
    header = ["ply", "format binary_little_endian 1.0", "comment metres, x right, y down, z forward; motion per frame",
              f"element vertex {len(vertices)}", *properties, "end_header", ""]  # fmt: skip
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes())
    return len(vertices)


def read_ply(path: str | Path) -> np.ndarray:
    """The vertices of a binary little-endian file as a structured array, one field a property.

    Raises
    ------
    InputError
        If the file is none of these, or shorter than its header claims.
    """
    content = read_bytes(path)
    header, found, _ = content[:65536].partition(b"end_header\n")
    if not content.startswith(b"ply") or not found or b"format binary_little_endian 1.0" not in header:
        raise InputError(f"{path}: is no binary little-endian PLY file")
    elements = re.split(rb"^element ", header, flags=re.MULTILINE)[1:]
    count = re.match(rb"vertex (\d{1,9})\s", elements[0]) if elements else None
    properties = re.findall(rb"^property (\S+) (\S+)\s*$", elements[0], re.MULTILINE) if elements else []
    try:
        vertex = np.dtype([(name.decode("ascii"), _TYPES[kind.decode("ascii")]) for kind, name in properties])
    except (KeyError, ValueError):
        vertex = np.dtype([])
    if count is None or vertex.itemsize == 0 or b"property list" in elements[0]:
        raise InputError(f"{path}: the first element must be vertices with scalar properties")
    start = len(header) + len(found)
    if int(count[1]) * vertex.itemsize > len(content) - start:
        raise InputError(f"{path}: truncated, {int(count[1])} points do not fit in {len(content)} bytes")
    return np.frombuffer(content, vertex, int(count[1]), start).copy()
