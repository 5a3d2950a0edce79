"""The renderer's truth, checked against what it must explain: the other images, 3D motion, brute-force rays."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cgsf.datasets.sample import Sample
from cgsf.synthetic import RenderConfig, make_sample, make_scene, make_video
from cgsf.synthetic.materials import paint
from cgsf.synthetic.meshes import box, polygon
from cgsf.synthetic.render import Renderer, truth_of
from cgsf.synthetic.scene import CameraPath, Motion, Scene
from cgsf.synthetic.truth import View, follow, seen

HEIGHT, WIDTH = 96, 160
FAMILIES = ("street", "things")


@pytest.fixture(scope="module", params=FAMILIES)
def ideal(request: pytest.FixtureRequest) -> Sample:
    """A sample by an ideal sensor with dull surfaces: the images must agree where the truth says so."""
    return make_sample(request.param, 3, HEIGHT, WIDTH, sensor=False, gloss=0.0, shadows=False)


def warp(source: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cv2.remap(source, np.nan_to_num(x).astype(np.float32), np.nan_to_num(y).astype(np.float32), cv2.INTER_LINEAR)


def views(family: str, seed: int) -> tuple[Renderer, list[View]]:
    renderer = Renderer(make_scene(family, seed, HEIGHT, WIDTH), HEIGHT, WIDTH, RenderConfig())
    left1, right1, _, _ = renderer.stereo(0.0)
    left2, right2, _, _ = renderer.stereo(1.0)
    return renderer, [left1, right1, left2, right2]


def test_truth_warps_the_other_three_images_onto_left1(ideal: Sample) -> None:
    truth = ideal.truth
    y, x = np.indices((HEIGHT, WIDTH)).astype(np.float32)
    u, v = truth.flow[..., 0], truth.flow[..., 1]
    cases = {
        "right1": (ideal.right1, x - truth.disparity1, y, truth.visible_stereo),
        "left2": (ideal.left2, x + u, y + v, truth.visible_flow),
        "right2": (ideal.right2, x + u - truth.disparity2, y + v, truth.visible_change),
    }
    for name, (image, at_x, at_y, visible) in cases.items():
        residual = np.abs(warp(image, at_x, at_y) - ideal.left1).mean(-1)
        assert visible.mean() > 0.4, name
        assert np.median(residual[visible]) < 0.012, name  # bilinear warping of a textured image; no noise
        shifted = np.abs(warp(image, at_x + 2, at_y + 1) - ideal.left1).mean(-1)
        assert np.median(shifted[visible]) > 2 * np.median(residual[visible]), name


def test_disparity_of_left2_at_the_flow_target_is_disparity2() -> None:
    """On planes inverse depth is linear in the image: bilinear interpolation inside one plane is exact."""
    renderer, (left1, right1, left2, right2) = views("things", 5)
    truth = truth_of(renderer, left1, right1, left2, right2)
    place, _ = follow(left1, left2)
    x0, y0 = np.floor(np.nan_to_num(place[..., 0])).astype(int), np.floor(np.nan_to_num(place[..., 1])).astype(int)
    inside = (x0 >= 0) & (y0 >= 0) & (x0 < WIDTH - 1) & (y0 < HEIGHT - 1) & truth.visible_flow & (left1.hit >= 0)
    rows, columns = y0[inside], x0[inside]
    one_plane = np.ones(len(rows), bool)
    for down in (0, 1):
        for right in (0, 1):
            one_plane &= left2.hit[rows + down, columns + right] == left1.hit[inside]
    assert one_plane.sum() > 2000
    ax, ay = place[..., 0][inside] - columns, place[..., 1][inside] - rows
    d = truth.disparity_left2.astype(np.float64)
    sampled = (1 - ay) * ((1 - ax) * d[rows, columns] + ax * d[rows, columns + 1])
    sampled += ay * ((1 - ax) * d[rows + 1, columns] + ax * d[rows + 1, columns + 1])
    np.testing.assert_allclose(sampled[one_plane], truth.disparity2[inside][one_plane], rtol=2e-5, atol=2e-5)


def test_calibration_turns_truth_into_the_objects_rigid_motion() -> None:
    for family in FAMILIES:
        sample = make_sample(family, 7, HEIGHT, WIDTH)
        scene = make_scene(family, 7, HEIGHT, WIDTH)
        truth, camera = sample.truth, sample.calibration
        points1 = camera.points(truth.disparity1).astype(np.float64)
        points2 = camera.points(truth.disparity2, truth.flow).astype(np.float64)
        to_world = np.linalg.inv(scene.path.pose(0.0))
        motions = {0: np.eye(4)}
        for part in scene.parts:
            whole = all(other.motion is part.motion for other in scene.parts if other.object_id == part.object_id)
            if part.motion is not None and whole:
                motions[part.object_id] = Motion.poses([part.motion], 1.0)[0]
        checked = 0
        for number, motion in motions.items():
            pixels = (truth.objects == number) & np.isfinite(points1).all(-1) & np.isfinite(points2).all(-1)
            pixels &= points1[..., 2] < 40
            expected = scene.path.pose(1.0) @ motion @ to_world
            moved = points1[pixels] @ expected[:3, :3].T + expected[:3, 3]
            assert np.all(np.linalg.norm(moved - points2[pixels], axis=-1) < 2e-3 * (1 + points1[pixels][:, 2]))
            checked += int(pixels.sum())
        assert checked > 0.4 * HEIGHT * WIDTH


def _met_before(corners: np.ndarray, culled: np.ndarray, point: np.ndarray) -> bool:
    """Does any triangle cut the segment from the camera to `point`? Moeller and Trumbore, all triangles, float64."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(point, edge2)
    determinant = np.einsum("ni,ni->n", edge1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = -corners[:, 0]
        u = np.einsum("ni,ni->n", back, across) / determinant
        q = np.cross(back, edge1)
        v = q @ point / determinant
        t = np.einsum("ni,ni->n", edge2, q) / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.05 / point[2]) & (t < 1 - 1e-5)
    facing = np.einsum("ni,ni->n", np.cross(edge1, edge2), corners[:, 0]) < 0
    return bool(np.any(hit & (facing | ~culled)))


@pytest.mark.parametrize("family", FAMILIES)
def test_visibility_equals_brute_force(family: str) -> None:
    renderer, (left1, right1, left2, right2) = views(family, 11)
    truth = truth_of(renderer, left1, right1, left2, right2)
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(0, HEIGHT, 120), rng.integers(0, WIDTH, 120)
    for target, mask in ((right1, truth.visible_stereo), (left2, truth.visible_flow)):
        place, inverse_depth = follow(left1, target)
        hidden = 0
        for row, column in zip(rows, columns, strict=True):
            x, y = place[row, column]
            inside = -1e-6 <= x <= WIDTH - 1 + 1e-6 and -1e-6 <= y <= HEIGHT - 1 + 1e-6
            if not inside or inverse_depth[row, column] == 0:
                assert inside or not mask[row, column]
                continue
            fx, fy, cx, cy = renderer.intrinsics
            point = np.array([(x - cx) / fx, (y - cy) / fy, 1.0]) / inverse_depth[row, column]
            met = _met_before(target.caster.corners, renderer.soup.culled, point)
            assert mask[row, column] == (not met), (row, column)
            hidden += met
        assert 0 < hidden < 60


def test_nearest_along_a_ray_is_the_brute_force_minimum() -> None:
    _, (left1, _, _, _) = views("street", 2)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.4, WIDTH - 0.6, 80), rng.uniform(-0.4, HEIGHT - 0.6, 80)
    inverse_depth = left1.caster.nearest(np.stack([x, y], -1))
    plane = left1.caster.plane
    live = left1.caster.bounds[:, 1] >= left1.caster.bounds[:, 0]
    for i in range(80):
        b = plane[live] @ np.array([x[i], y[i], 1.0])
        w = b.sum(-1)
        hits = w[(b >= -1e-9 * w[:, None]).all(-1) & (w > 0) & (w < 20)]
        assert inverse_depth[i] == pytest.approx(hits.max() if len(hits) else 0.0, rel=1e-9, abs=1e-12)


def test_same_seed_same_bytes_and_another_seed_another_scene() -> None:
    first, again, other = (make_sample("street", seed, 48, 80) for seed in (4, 4, 5))
    for a, b in zip(first.images, again.images, strict=True):
        assert a.tobytes() == b.tobytes()
    assert first.truth.flow.tobytes() == again.truth.flow.tobytes()
    assert np.abs(first.left1 - other.left1).mean() > 0.02


@pytest.mark.parametrize("family", FAMILIES)
def test_a_finer_camera_sees_the_same_points(family: str) -> None:
    """Three times the pixels: the centre of pixel (x, y) is the centre of (3x + 1, 3y + 1), and truth scales by 3."""
    coarse, fine = make_sample(family, 9, 48, 80, sensor=False), make_sample(family, 9, 144, 240, sensor=False)
    scale = fine.calibration.fx / coarse.calibration.fx
    assert scale == pytest.approx(3)
    middle = (coarse.calibration.cx + 0.5) * 3 - 0.5
    offset = fine.calibration.cx - middle, fine.calibration.cy - ((coarse.calibration.cy + 0.5) * 3 - 0.5)
    assert offset == pytest.approx((0, 0), abs=1e-9)
    np.testing.assert_allclose(fine.truth.disparity1[1::3, 1::3], 3 * coarse.truth.disparity1, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(fine.truth.flow[1::3, 1::3], 3 * coarse.truth.flow, rtol=1e-4, atol=1e-3)


def test_a_mirrored_world_gives_the_mirrored_pair() -> None:
    """Mirror the world in the plane between the two cameras: left and right exchange, and each image is flipped."""
    scene = make_scene("things", 13, HEIGHT, WIDTH)
    still = [replace(part, motion=None) for part in scene.parts]
    scene = Scene(scene.camera, CameraPath(*np.zeros((4, 3))), scene.light, scene.sky, still)
    assert scene.camera.cx == (WIDTH - 1) / 2
    mirrored = Scene(scene.camera, scene.path, scene.light, scene.sky)
    for part in scene.parts:
        mesh = part.mesh.moved(part.place[:3, 3])
        points = mesh.points[:, ::-1] * (-1, 1, 1) + (scene.camera.baseline_m, 0, 0)
        mirrored.add(replace(mesh, points=points, normals=mesh.normals[:, ::-1] * (-1, 1, 1), uv=mesh.uv[:, ::-1]), part.material)
    left, right, _, _ = Renderer(scene, HEIGHT, WIDTH, RenderConfig()).stereo(0.0)
    left_m, right_m, _, _ = Renderer(mirrored, HEIGHT, WIDTH, RenderConfig()).stereo(0.0)
    np.testing.assert_allclose(left_m.inverse_depth[:, ::-1], right.inverse_depth, rtol=1e-9)
    np.testing.assert_allclose(right_m.inverse_depth[:, ::-1], left.inverse_depth, rtol=1e-9)


def _box_scene(velocity: tuple[float, float, float]) -> Scene:
    scene = make_scene("things", 1, HEIGHT, WIDTH)
    path = CameraPath(*np.zeros((4, 3)))
    plain = Scene(scene.camera, path, scene.light, scene.sky)
    material = paint(np.random.default_rng(0))
    wall = np.array([(-50, -50, 8), (50, -50, 8), (50, 50, 8), (-50, 50, 8)], float)
    plain.add(polygon(wall), material)
    middle = np.array([0.0, 0.0, 4.0])
    plain.add(box((1, 1, 1)).moved(middle), material, Motion(middle, np.array(velocity), np.zeros(3)), 1)
    return plain


def test_a_box_before_a_wall_has_the_disparity_and_flow_of_the_textbook() -> None:
    scene = _box_scene((0.1, 0.2, 0.5))
    renderer = Renderer(scene, HEIGHT, WIDTH, RenderConfig())
    left1, right1, _, _ = renderer.stereo(0.0)
    left2, right2, _, _ = renderer.stereo(1.0)
    truth = truth_of(renderer, left1, right1, left2, right2)
    row, column = HEIGHT // 2, WIDTH // 2
    camera = scene.camera
    assert truth.objects[row, column] == 1
    assert truth.disparity1[row, column] == pytest.approx(camera.fx * camera.baseline_m / 3.5, rel=1e-6)
    assert truth.disparity2[row, column] == pytest.approx(camera.fx * camera.baseline_m / 4.0, rel=1e-6)
    x, y = (column - camera.cx) * 3.5 / camera.fx, (row - camera.cy) * 3.5 / camera.fy
    expected = camera.fx * (x + 0.1) / 4 + camera.cx - column, camera.fy * (y + 0.2) / 4 + camera.cy - row
    assert truth.flow[row, column] == pytest.approx(expected, abs=1e-5)
    assert np.all(truth.flow[truth.objects == 0] == pytest.approx(0, abs=1e-5))
    edge = round(camera.cx - camera.fx * 0.5 / 3.5)  # left of the box the wall is hidden from the right camera
    assert truth.visible_stereo[row, edge + 2]
    assert not truth.visible_stereo[row, edge - 2]
    assert seen(left1, *follow(left1, left1)).all()


def test_a_video_shares_frames_and_truth_chains() -> None:
    first, second = make_video("street", 6, 48, 80, 3)
    assert first.left2 is second.left1
    assert first.right2 is second.right1
    assert np.array_equal(first.truth.disparity_left2, second.truth.disparity1)
    assert first.name != second.name


def test_motion_blur_smears_images_and_leaves_truth_alone() -> None:
    sharp = make_sample("street", 3, 48, 80, sensor=False)
    blurred = make_sample("street", 3, 48, 80, sensor=False, shutter=0.8)
    assert np.array_equal(sharp.truth.flow, blurred.truth.flow, equal_nan=True)
    moving = np.nan_to_num(np.linalg.norm(sharp.truth.flow, axis=-1)) > 3
    gradient = [np.abs(np.diff(sample.left1, axis=1)).mean(-1)[moving[:, 1:]].mean() for sample in (sharp, blurred)]
    assert gradient[1] < 0.9 * gradient[0]
