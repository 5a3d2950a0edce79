"""Disparity and flow files: exact values, codes for the unknown, damage."""

import io
import zipfile

import cv2
import numpy as np
import pytest

from cgsf.errors import InputError
from cgsf.formats import flo, kitti_png, npz, pfm, ply
from cgsf.formats.files import all_or_nothing, write_bytes

SHAPE = (5, 8)


@pytest.fixture
def disparity(rng):
    values = rng.integers(1, 65536, SHAPE).astype(np.float32) / 256
    values[1, 2] = np.nan
    return values


@pytest.fixture
def flow(rng):
    values = rng.integers(-32768, 32768, (*SHAPE, 2)).astype(np.float32) / 64
    values[3, 1] = np.nan
    return values


def test_kitti_disparity_code(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[0, 1, 256], [640, 65535, 0]], np.uint16))
    expected = [[np.nan, 1 / 256, 1], [2.5, 65535 / 256, np.nan]]
    np.testing.assert_array_equal(kitti_png.read_disparity(tmp_path / "d.png"), np.float32(expected))


def test_kitti_flow_code(tmp_path):
    # OpenCV writes BGR, so the file's channels (u, v, valid) are given in the order valid, v, u
    cv2.imwrite(str(tmp_path / "f.png"), np.array([[[1, 32768 - 64, 32768 + 128], [0, 7, 9]]], np.uint16))
    np.testing.assert_array_equal(kitti_png.read_flow(tmp_path / "f.png"), np.float32([[[2, -1], [np.nan, np.nan]]]))


def test_kitti_round_trip(tmp_path, disparity, flow):
    kitti_png.write_disparity(tmp_path / "d.png", disparity)
    kitti_png.write_flow(tmp_path / "f.png", flow)
    np.testing.assert_array_equal(kitti_png.read_disparity(tmp_path / "d.png"), disparity)
    np.testing.assert_array_equal(kitti_png.read_flow(tmp_path / "f.png"), flow)


def test_kitti_values_beyond_the_code_are_cut(tmp_path):
    kitti_png.write_disparity(tmp_path / "d.png", np.float32([[-3, 0, 1e-4, 300]]))
    read = kitti_png.read_disparity(tmp_path / "d.png")
    np.testing.assert_array_equal(read, np.float32([[1, 1, 1, 65535]]) / 256)
    kitti_png.write_flow(tmp_path / "f.png", np.float32([[[-600, 600]]]))
    np.testing.assert_array_equal(kitti_png.read_flow(tmp_path / "f.png"), [[[-512, 32767 / 64]]])


def test_kitti_kinds_are_not_confused(tmp_path, disparity, flow):
    kitti_png.write_disparity(tmp_path / "d.png", disparity)
    kitti_png.write_flow(tmp_path / "f.png", flow)
    cv2.imwrite(str(tmp_path / "8.png"), np.zeros(SHAPE, np.uint8))
    for read, name in ((kitti_png.read_disparity, "f"), (kitti_png.read_disparity, "8"), (kitti_png.read_flow, "d")):
        with pytest.raises(InputError, match="no KITTI"):
            read(tmp_path / f"{name}.png")


def test_flo_agrees_with_opencv(tmp_path, flow):
    known = np.nan_to_num(flow)
    flo.write_flo(tmp_path / "ours.flo", known)
    np.testing.assert_array_equal(cv2.readOpticalFlow(str(tmp_path / "ours.flo")), known)
    cv2.writeOpticalFlow(str(tmp_path / "theirs.flo"), known)
    np.testing.assert_array_equal(flo.read_flo(tmp_path / "theirs.flo"), known)
    flo.write_flo(tmp_path / "nan.flo", flow)
    np.testing.assert_array_equal(flo.read_flo(tmp_path / "nan.flo"), flow)


@pytest.mark.parametrize("shape", [SHAPE, (*SHAPE, 3)])
def test_pfm_round_trip_and_row_order(tmp_path, rng, shape):
    values = rng.normal(size=shape).astype(np.float32)
    values[0, 0] = np.inf
    pfm.write_pfm(tmp_path / "a.pfm", values)
    np.testing.assert_array_equal(pfm.read_pfm(tmp_path / "a.pfm"), values)
    content = (tmp_path / "a.pfm").read_bytes()
    last_row = np.frombuffer(content, "<f4", values[-1].size, len(content) - 4 * values.size)
    np.testing.assert_array_equal(last_row, values[-1].ravel())  # the bottom row is stored first


def test_pfm_big_endian(tmp_path):
    (tmp_path / "a.pfm").write_bytes(b"Pf\n2 1\n1.0\n" + np.array([3, -4], ">f4").tobytes())
    np.testing.assert_array_equal(pfm.read_pfm(tmp_path / "a.pfm"), [[3, -4]])


def test_npz_round_trip(tmp_path, flow):
    arrays = {"flow": flow, "visible": flow[..., 0] > 0, "columns": np.asfortranarray(flow[..., 0])}
    npz.write_arrays(tmp_path / "a.npz", arrays)
    read = npz.read_arrays(tmp_path / "a.npz", ["flow"])
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        np.testing.assert_array_equal(np.load(tmp_path / "a.npz")[name], array)
    with pytest.raises(InputError, match="lacks disparity"):
        npz.read_arrays(tmp_path / "a.npz", ["disparity"])


def test_npz_with_pickle_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", evil=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="plain arrays"):
        npz.read_arrays(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="pickle"):
        npz.write_arrays(tmp_path / "b.npz", {"evil": np.array([None])})


def test_npz_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "LARGEST_FILE", 1 << 20)
    npz.write_arrays(tmp_path / "a.npz", {"a": np.zeros(1 << 17), "b": np.zeros(1 << 17)})
    assert (tmp_path / "a.npz").stat().st_size < 1 << 14
    with pytest.raises(InputError, match="expands"):
        npz.read_arrays(tmp_path / "a.npz")


def test_npz_header_that_lies_is_refused(tmp_path):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": (1 << 40,), "fortran_order": False, "descr": "<f4"})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", file.getvalue() + bytes(16))
    with pytest.raises(InputError, match="plain arrays"):
        npz.read_arrays(tmp_path / "a.npz")


def test_ply_keeps_the_known_points(tmp_path, rng):
    points, motion = rng.normal(size=(2, *SHAPE, 3)).astype(np.float32)
    bgr = rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    points[0, 3, 2], motion[2, 2, 0] = np.nan, np.inf
    count = ply.write_ply(tmp_path / "a.ply", points, motion, bgr)
    vertices = ply.read_ply(tmp_path / "a.ply")
    assert count == len(vertices) == points[..., 0].size - 2
    keep = np.ones(SHAPE, bool)
    keep[0, 3] = keep[2, 2] = False
    np.testing.assert_array_equal(vertices["y"], points[keep][:, 1])
    np.testing.assert_array_equal(vertices["motion_z"], motion[keep][:, 2])
    np.testing.assert_array_equal(vertices["red"], bgr[keep][:, 2])


WRITERS = {
    "a.flo": (lambda path: flo.write_flo(path, np.ones((*SHAPE, 2))), flo.read_flo),
    "a.pfm": (lambda path: pfm.write_pfm(path, np.ones(SHAPE)), pfm.read_pfm),
    "a.npz": (lambda path: npz.write_arrays(path, {"a": np.arange(99)}), npz.read_arrays),
    "a.ply": (lambda path: ply.write_ply(path, *np.ones((2, 9, 3)), np.ones((9, 3), np.uint8)), ply.read_ply),
    "d.png": (lambda path: kitti_png.write_disparity(path, np.ones(SHAPE)), kitti_png.read_disparity),
    "f.png": (lambda path: kitti_png.write_flow(path, np.ones((*SHAPE, 2))), kitti_png.read_flow),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("kept", ["half", "all but one byte", "header", "nothing", "noise"])
def test_truncated_maps_are_refused(tmp_path, rng, name, kept):
    write, read = WRITERS[name]
    path = tmp_path / name
    write(path)
    read(path)
    content = path.read_bytes()
    length = {"half": len(content) // 2, "all but one byte": len(content) - 1, "header": 10, "nothing": 0}.get(kept)
    path.write_bytes(rng.bytes(200) if length is None else content[:length])
    with pytest.raises(InputError, match=name) as caught:
        read(path)
    assert "\n" not in str(caught.value)


PLY = b"ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("name", "content", "read"),
    [
        ("a.flo", b"PIEH" + np.array([2**30, 2**30], "<i4").tobytes(), flo.read_flo),
        ("a.flo", b"PIEH" + np.array([-4, -2], "<i4").tobytes() + bytes(64), flo.read_flo),
        ("a.pfm", b"PF\n999999999 999999999\n-1\n", pfm.read_pfm),
        ("a.pfm", b"Pf\n2 2\n0\n" + bytes(16), pfm.read_pfm),
        ("a.ply", PLY + b"element vertex 999999999\nproperty float x\nend_header\n", ply.read_ply),
        ("a.ply", PLY + b"element vertex 1\nproperty list uchar int x\nend_header\n\0", ply.read_ply),
    ],
)
def test_hostile_headers_are_refused(tmp_path, name, content, read):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read(tmp_path / name)


def test_a_failed_write_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("a file where a folder is needed")
    with pytest.raises(InputError, match="cannot be written"):
        write_bytes(tmp_path / "file" / "a.npz", b"content")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_write_replaces_the_old_file_whole(tmp_path):
    write_bytes(tmp_path / "deep" / "a", b"old")
    write_bytes(tmp_path / "deep" / "a", b"new")
    assert (tmp_path / "deep" / "a").read_bytes() == b"new"
    assert len(list((tmp_path / "deep").iterdir())) == 1


def test_all_or_nothing(tmp_path):
    def cut_short():
        with all_or_nothing(tmp_path / "new" / "out") as folder:
            (folder / "a").write_text("half")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power"):
        cut_short()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "kept").write_text("mine")
    with all_or_nothing(tmp_path / "out") as folder:
        (folder / "a").write_text("whole")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a", "kept"]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder"), all_or_nothing(tmp_path / "file" / "out"):
        pass
