"""Images: every accepted kind gives the same float32 picture; every damaged file one line."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from cgsf.errors import InputError
from cgsf.formats.images import read_image, to_bytes, to_unit_range


@pytest.fixture
def bgr(rng):
    return rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)


def chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def test_colour_is_bgr_in_unit_range(tmp_path, bgr):
    cv2.imwrite(str(tmp_path / "a.png"), bgr)
    image = read_image(tmp_path / "a.png")
    assert image.dtype == np.float32
    assert image.flags.c_contiguous
    np.testing.assert_allclose(image, bgr / 255, atol=1e-7)


def test_sixteen_bits_grey_and_alpha(tmp_path, bgr):
    cv2.imwrite(str(tmp_path / "deep.png"), bgr.astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "grey.png"), bgr[..., 0])
    cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([bgr, bgr[..., :1]]))
    np.testing.assert_allclose(read_image(tmp_path / "deep.png"), bgr / 255, atol=1e-6)
    np.testing.assert_allclose(read_image(tmp_path / "grey.png"), bgr[..., :1] / 255, atol=1e-7)
    np.testing.assert_allclose(read_image(tmp_path / "alpha.png"), bgr / 255, atol=1e-7)


@pytest.mark.parametrize("extension", ["png", "jpg", "bmp", "ppm", "tiff", "webp"])
@pytest.mark.parametrize("share", [0.3, 0.97])
def test_truncated_image_is_refused(tmp_path, rng, extension, share):
    ok, content = cv2.imencode(f".{extension}", rng.integers(0, 256, (40, 50, 3), dtype=np.uint8))
    assert ok
    path = tmp_path / f"a.{extension}"
    path.write_bytes(content.tobytes())
    assert read_image(path).shape == (40, 50, 3)
    path.write_bytes(content.tobytes()[: int(share * len(content))])
    with pytest.raises(InputError, match=r"a\.") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)


def test_flipped_bit_in_a_png_is_noticed(tmp_path, bgr):
    content = bytearray(cv2.imencode(".png", bgr)[1].tobytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(bytes(content))
    with pytest.raises(InputError):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("size", [(30000, 30000), (2**31 - 1, 1), (0, 5)])
def test_header_with_an_absurd_size_is_refused(tmp_path, size):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    with pytest.raises(InputError, match=r"bomb\.png"):
        read_image(tmp_path / "bomb.png")


@pytest.mark.parametrize("content", [b"", b"no image", b"\x89PNG\r\n\x1a\n", b"P6\n3 x\n"])
def test_no_image(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png"):
        read_image(tmp_path / "a.png")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "a.png")
    with pytest.raises(InputError, match="is a folder"):
        read_image(tmp_path)


def test_arrays_of_every_kind_agree(bgr):
    expected = to_unit_range(bgr)
    np.testing.assert_allclose(to_unit_range(bgr.astype(np.uint16) * 257), expected, atol=1e-6)
    np.testing.assert_allclose(to_unit_range(bgr / 255), expected, atol=1e-6)
    np.testing.assert_array_equal(to_unit_range(bgr[..., 0]), expected[..., :1])
    np.testing.assert_array_equal(to_unit_range(bgr[..., :2]), expected[..., :1])
    np.testing.assert_array_equal(to_bytes(expected), bgr)
    np.testing.assert_array_equal(to_bytes(expected[..., :1]), np.repeat(bgr[..., :1], 3, -1))


def test_an_array_is_never_the_callers(bgr):
    image = np.ascontiguousarray(bgr / 255, np.float32)
    before = image.copy()
    to_unit_range(image)
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.full((3, 4), np.nan), "NaN"),
        (np.full((3, 4), np.inf), "infinity"),
        (np.full((3, 4), 200.0), r"\[0, 1\]"),
        (np.full((3, 4), -0.1), r"\[0, 1\]"),
        (np.zeros((3, 4), np.int64), "uint8"),
        (np.zeros((3, 4, 5)), "shape"),
        (np.zeros(3), "shape"),
        (np.zeros((0, 4)), "shape"),
    ],
)
def test_arrays_that_are_no_images(bad, message):
    with pytest.raises(InputError, match=message):
        to_unit_range(bad)
