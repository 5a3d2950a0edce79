"""Named arrays in NumPy's .npz, never with pickle, sizes checked before anything is allocated."""

import io
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.files import LARGEST_FILE, read_bytes, write_bytes


def read_arrays(path: str | Path, required: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of the file by name.

    Parameters
    ----------
    path : str or Path
    required : iterable of str
        Names that must be there.

    Raises
    ------
    InputError
        If the file is missing, truncated, no .npz, needs pickle, claims sizes that its content does not have, expands
        to more than a gigabyte, or lacks a required name.
    """
    content = read_bytes(path)
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > LARGEST_FILE:
                raise InputError(f"{path}: expands to more than {LARGEST_FILE >> 20} MB, refused")
            for member in members:
                arrays[member.filename.removesuffix(".npy")] = _read_array(archive.read(member))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError, NotImplementedError, RuntimeError, KeyError):
        raise InputError(f"{path}: is no .npz file of plain arrays, or is truncated") from None
    missing = [name for name in required if name not in arrays]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}")
    return arrays


def _read_array(content: bytes) -> np.ndarray:
    """The array of one .npy; `ValueError` unless the header's size is that of the content."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, fortran, dtype = read_header(file)
    size = dtype.itemsize
    for length in shape:
        size *= int(length)
    if dtype.hasobject or size != len(content) - file.tell():
        raise ValueError("the header does not fit the content")
    array = np.frombuffer(content, dtype, offset=file.tell())
    return array.reshape(shape, order="F" if fortran else "C").copy()


def write_arrays(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays, compressed."""
    if any(array.dtype.hasobject for array in arrays.values()):
        raise ValueError("arrays of objects would need pickle")
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    write_bytes(path, file.getvalue())
