"""Bytes to and from disk: reading with a limit, writing that leaves either the old file or the whole new one."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cgsf.errors import InputError

#: No file of ours comes near: a 64-megapixel flow field has half of it.
LARGEST_FILE = 1 << 30
#: Largest number of pixels of an image or a map; 8192 x 8192.
LARGEST_IMAGE = 1 << 26


def read_bytes(path: str | Path) -> bytes:
    """The content of a file; `InputError` if it is missing, unreadable, empty, no file, or larger than a gigabyte."""
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder, a file is expected")
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: larger than {LARGEST_FILE >> 20} MB, refused")
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if not content:
        raise InputError(f"{path}: the file is empty")
    return content


def check_size(path: str | Path, width: int, height: int) -> None:
    """Refuse a size that a header claims if it is empty or larger than any image that can be worked on."""
    if width < 1 or height < 1:
        raise InputError(f"{path}: the header claims an empty {width} x {height} image")
    if width * height > LARGEST_IMAGE:
        raise InputError(f"{path}: the header claims {width} x {height} pixels, the limit is {LARGEST_IMAGE}")


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name beside its place, flush it to disk, then rename it.

    Raises
    ------
    InputError
        If the folder cannot be made or written; the temporary file is gone then.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def all_or_nothing(folder: str | Path) -> Iterator[Path]:
    """A temporary folder whose files move into `folder` when the block ends well, and vanish when it does not.

    Files of the same name are replaced, other files in `folder` stay. Entering already fails with `InputError` if
    `folder` cannot be written, so that nobody computes for a place that refuses.
    """
    folder = Path(folder)
    made = next((parent for parent in reversed([folder, *folder.parents]) if not parent.exists()), None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".part-", dir=folder))
    except OSError as error:
        raise InputError(f"{folder}: the output folder cannot be written ({error.strerror})") from None
    try:
        yield staging
        for path in sorted(staging.iterdir()):
            os.replace(path, folder / path.name)
        made = None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
