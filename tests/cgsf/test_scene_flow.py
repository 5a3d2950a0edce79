"""The result: files, names, metres."""

import cv2
import numpy as np
import pytest

from cgsf.calibration import Calibration
from cgsf.errors import InputError
from cgsf.formats import kitti_png, npz, ply
from cgsf.scene_flow import SceneFlow
from variational.state import D1, D2, C, U, V

H, W = 6, 11
CALIBRATION = Calibration(fx=70.0, fy=90.0, cx=4.5, cy=2.25, baseline_m=0.4)


@pytest.fixture
def state(rng):
    state = rng.uniform(2, 9, (5, H, W)).astype(np.float32)
    state[C] -= 5
    state[U : V + 1] -= 5
    return state


@pytest.fixture
def result(state, rng):
    return SceneFlow.from_state(
        state,
        rng.random((H, W)) < 0.5,
        confidence=rng.random((H, W)).astype(np.float32),
        camera_motion=np.eye(4),
        calibration=CALIBRATION,
    )


def test_state_channels_get_their_names(state, result):
    np.testing.assert_array_equal(result.disparity1, state[D1])
    np.testing.assert_array_equal(result.disparity2, state[D2])
    np.testing.assert_array_equal(result.disparity_change, state[C])
    np.testing.assert_array_equal(result.flow, np.stack([state[U], state[V]], -1))
    np.testing.assert_array_equal(result.disparity2_on_left1, state[D1] + state[C])
    np.testing.assert_array_equal(result.state(), state)
    assert result.shape == (H, W)


def test_files_are_the_contract(tmp_path, state, result):
    names = result.save(tmp_path / "out")
    assert sorted(names) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert set(names) == {"scene_flow.npz", "disp_0.png", "disp_1.png", "flow.png", "points.ply"}
    arrays = npz.read_arrays(tmp_path / "out" / "scene_flow.npz")
    for name in ("disparity1", "disparity2", "disparity_change", "flow"):
        assert arrays[name].dtype == np.float32
    assert arrays["visible"].dtype == bool
    assert arrays["flow"].shape == (H, W, 2)
    np.testing.assert_allclose(kitti_png.read_disparity(tmp_path / "out/disp_0.png"), state[D1], atol=1 / 512)
    np.testing.assert_allclose(
        kitti_png.read_disparity(tmp_path / "out/disp_1.png"), np.maximum(state[D1] + state[C], 1 / 256), atol=1 / 511
    )
    np.testing.assert_allclose(kitti_png.read_flow(tmp_path / "out/flow.png"), result.flow, atol=1 / 127)
    raw = cv2.imread(str(tmp_path / "out/flow.png"), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16
    assert (raw[..., 0] == 1).all()


def test_load_gives_back_what_was_saved(tmp_path, result):
    result.save(tmp_path)
    loaded = SceneFlow.load(tmp_path)
    np.testing.assert_array_equal(loaded.state(), result.state())
    for name in ("visible", "confidence", "camera_motion"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(result, name))
    assert loaded.calibration == CALIBRATION
    assert loaded.moving is None


def test_load_accepts_three_maps_and_refuses_less(tmp_path, state):
    arrays = {"disparity1": state[D1], "disparity_change": state[C], "flow": np.moveaxis(state[U:], 0, -1)}
    npz.write_arrays(tmp_path / "scene_flow.npz", arrays)
    loaded = SceneFlow.load(tmp_path)
    assert np.isnan(loaded.disparity2).all()
    assert loaded.visible.all()
    npz.write_arrays(tmp_path / "scene_flow.npz", arrays | {"flow": arrays["flow"].transpose(1, 0, 2)})
    with pytest.raises(InputError, match="flow must be"):
        SceneFlow.load(tmp_path)
    del arrays["flow"]
    npz.write_arrays(tmp_path / "scene_flow.npz", arrays)
    with pytest.raises(InputError, match="lacks flow"):
        SceneFlow.load(tmp_path / "scene_flow.npz")


def test_without_calibration_there_are_no_metres(tmp_path, state):
    result = SceneFlow.from_state(state, np.ones((H, W), bool))
    with pytest.raises(InputError, match="calibration"):
        _ = result.depth
    assert "points.ply" not in result.save(tmp_path)


def test_points_of_a_moving_point_in_metres():
    """A point at (1, -0.5, 4) m that moves by (0.2, 0.1, -0.5) m, projected by hand, comes back."""
    before, after = np.array([1, -0.5, 4]), np.array([1.2, -0.4, 3.5])

    def project(point):
        return np.array([70 * point[0] / point[2] + 4.5, 90 * point[1] / point[2] + 2.25, 70 * 0.4 / point[2]])

    (x1, y1, d1), (x2, y2, d2) = project(before), project(after)
    points = CALIBRATION.points(np.full((H, W), d1), np.broadcast_to([x1, y1], (H, W, 2)) - grid())
    np.testing.assert_allclose(points[3, 2], before, rtol=1e-5)
    # the flow is that of a pixel which stands where the point is seen: the camera is moved there
    moved = Calibration(70.0, 90.0, 4.5 - x1 + 2, 2.25 - y1 + 3, 0.4)
    motion = moved.motion(np.full((H, W), d1), np.full((H, W), d2 - d1), np.broadcast_to([x2 - x1, y2 - y1], (H, W, 2)))
    np.testing.assert_allclose(motion[3, 2], after - before, atol=1e-5)


def grid():
    return np.moveaxis(np.indices((H, W))[::-1], 0, -1)


def test_points_behind_the_camera_are_unknown(tmp_path, state):
    state = state.copy()
    state[D1, 2, 3], state[D1, 0, 0] = 0, -1
    result = SceneFlow.from_state(state, np.ones((H, W), bool), calibration=CALIBRATION)
    unknown = np.isnan(result.points).all(-1)
    assert set(zip(*np.nonzero(unknown), strict=True)) == {(2, 3), (0, 0)}
    result.save(tmp_path)
    both = np.isfinite(result.points).all(-1) & np.isfinite(result.motion).all(-1)
    assert len(ply.read_ply(tmp_path / "points.ply")) == both.sum()


def test_maps_of_another_size_or_type_are_refused(state):
    with pytest.raises(InputError, match="visible"):
        SceneFlow.from_state(state, np.ones((W, H), bool))
    with pytest.raises(InputError, match="float32"):
        SceneFlow(*np.float64(state[:3]), np.zeros((H, W, 2), np.float32), np.ones((H, W), bool))
