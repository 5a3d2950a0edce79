"""Images of any common kind to float32 in [0, 1], grey (H, W, 1) or BGR (H, W, 3)."""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from cgsf.errors import InputError
from cgsf.formats.files import check_size, read_bytes, write_bytes


def decode(path: str | Path) -> np.ndarray:
    """The pixels of an image file as they are stored: (H, W) or (H, W, c), any depth, colours as BGR(A).

    Pillow reads the header, for the size, and checks that the file is whole (OpenCV's decoders fill the missing rows
    of a truncated file with grey, depending on format and version); OpenCV decodes, because it knows 16-bit colour.

    Raises
    ------
    InputError
        If the file is missing, no image, truncated, or claims an absurd size.
    """
    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what Pillow warns of is either harmless or an error below
            with Image.open(io.BytesIO(content)) as image:
                check_size(path, *image.size)
                if image.format == "PNG":
                    image.verify()  # by check sums; Pillow cannot load all 16-bit kinds
                else:
                    image.load()
    except InputError:
        raise
    except Image.UnidentifiedImageError:
        raise InputError(f"{path}: is no image that can be read") from None
    except Image.DecompressionBombError:
        raise InputError(f"{path}: the header claims an absurd number of pixels") from None
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, MemoryError):
        raise InputError(f"{path}: the image is truncated or damaged") from None
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise InputError(f"{path}: the image is truncated, damaged or of a kind that cannot be read")
    return pixels


def read_image(path: str | Path) -> np.ndarray:
    """An image as float32 in [0, 1], (H, W, 1) if it is grey, else (H, W, 3) in BGR order; alpha is left out.

    Raises
    ------
    InputError
        Whatever `decode` and `to_unit_range` refuse.
    """
    try:
        return to_unit_range(decode(path))
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(str(path)) else f"{path}: {message}") from None


def to_unit_range(image: np.ndarray) -> np.ndarray:
    """An image array of any accepted kind as C-contiguous float32 (H, W, 1 or 3) in [0, 1].

    Parameters
    ----------
    image : ndarray (H, W), (H, W, 1), (H, W, 2), (H, W, 3) or (H, W, 4)
        uint8 (divided by 255), uint16 (by 65535), bool, or floating point in [0, 1] already; two channels are grey and
        alpha, three BGR, four BGR and alpha. Alpha is left out.

    Raises
    ------
    InputError
        For another shape or type, for NaN or infinity, and for floats outside [0, 1].
    """
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or image.size == 0:
        raise InputError(f"an image must be (H, W) or (H, W, 1 to 4), got the shape {image.shape}")
    image = image[..., : 3 if image.shape[2] > 2 else 1]
    if image.dtype == np.uint8 or image.dtype == np.uint16:
        return np.ascontiguousarray(image * np.float32(1 / np.iinfo(image.dtype).max))
    if image.dtype == bool:
        return np.ascontiguousarray(image, np.float32)
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"an image must be uint8, uint16 or floating point, got {image.dtype}")
    if not np.isfinite(image).all():
        raise InputError("the image contains NaN or infinity; fill or crop these pixels first")
    if image.min() < 0 or image.max() > 1:
        low, high = image.min(), image.max()
        raise InputError(f"a floating-point image must lie in [0, 1], got {low:.4g} to {high:.4g}; divide by its white")
    return np.ascontiguousarray(image, np.float32)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """An image in [0, 1], (H, W, c), as uint8 (H, W, 3) BGR, for OpenCV's algorithms and for pictures."""
    scaled = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(scaled, (*scaled.shape[:2], 3)) if scaled.shape[2] == 1 else scaled)


def write_png(path: str | Path, pixels: np.ndarray) -> None:
    """Write uint8 or uint16 pixels, (H, W) or (H, W, 3) BGR, as PNG."""
    ok, content = cv2.imencode(".png", pixels)
    if not ok:
        raise ValueError(f"OpenCV cannot encode {pixels.dtype} {pixels.shape} as PNG")
    write_bytes(path, content.tobytes())
