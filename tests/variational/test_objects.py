"""Lost objects: found again where they went, and nothing where nothing is seen again."""

from typing import Any

import cv2
import numpy as np
import pytest

from variational import objects
from variational.camera import StereoCamera
from variational.census import census
from variational.frames import Frames
from variational.fusion import FusionConfig
from variational.initialise import Start, dense_inverse_search
from variational.matching import StereoMatch
from variational.objects import DOUBT, EVEN, ObjectsConfig, _judge, evident, follow, searches, telling_of, unexplained_surfaces
from variational.patches import Patches, PatchesConfig
from variational.rigid import RigidMotion, displacements

SHAPE = (120, 200)
PROJECTION = StereoCamera(150.0, 160.0, 90.0, 70.0, 0.5).projection()
SHIFT = (27, -19)
FAR = ObjectsConfig(patches=PatchesConfig(pixels=1500, reach=0.2))


def texture(seed: int, shape: tuple[int, int] = SHAPE, blur: float = 1.5) -> np.ndarray:
    image = cv2.GaussianBlur(np.random.default_rng(seed).random(shape, dtype=np.float32), (0, 0), blur)
    return (image - image.min()) / (image.max() - image.min())


def jumping_box(left: int = 60, top: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """left1, left2 and where a box is that goes by SHIFT before a standing background."""
    box, background = texture(1, (40, 50)), texture(2)
    images = []
    for right, down in ((0, 0), SHIFT):
        wide = cv2.copyMakeBorder(background, 60, 60, 60, 60, cv2.BORDER_REFLECT)
        wide[60 + top + down : 100 + top + down, 60 + left + right : 110 + left + right] = box
        images.append(np.ascontiguousarray(wide[60:-60, 60:-60]))
    surface = np.zeros(SHAPE, bool)
    surface[max(top, 0) : top + 40, max(left, 0) : left + 50] = True
    return images[0], images[1], surface


def start_with(disparity: np.ndarray, matched: np.ndarray) -> Start:
    """A start of which only the disparities at time 2 are asked."""
    words = np.zeros((2, *SHAPE), np.uint64)
    match = StereoMatch(disparity, matched, words, words, 30)
    return Start(np.zeros((5, *SHAPE), np.float32), np.zeros((*SHAPE, 2), np.float32), match, match)


def found_in(start: Start, state: np.ndarray, frames: Frames, surfaces: list[np.ndarray]) -> list[RigidMotion]:
    left1, _, left2, right2 = frames.grey
    words = census(left1), census(left2), census(right2)
    found = [search() for search in searches(start, state, frames, surfaces, words, PROJECTION, FAR, FusionConfig())]
    return [motion for motion in found if motion is not None]


def standing(disparity: np.ndarray) -> np.ndarray:
    """The state in which nothing moves."""
    state = np.zeros((5, *SHAPE), np.float32)
    state[0] = disparity
    return state


def test_surfaces_end_where_the_disparity_jumps():
    disparity = np.full((30, 40), 5, np.float32)
    disparity[:, 20:] = 9
    cost = np.full((30, 40), 0.1, np.float32)
    cost[5:25, 10:30] = 0.9
    visible = matched = np.ones((30, 40), bool)
    surfaces = unexplained_surfaces(disparity, cost, visible, matched, ObjectsConfig(least_px=50))
    assert len(surfaces) == 2
    assert all(150 < surface.sum() <= 200 for surface in surfaces)
    assert not unexplained_surfaces(disparity, cost, ~visible, matched, ObjectsConfig(least_px=50))
    assert not unexplained_surfaces(disparity, cost, visible, ~matched, ObjectsConfig(least_px=50))


@pytest.mark.parametrize("corner", [(60, 50), (-12, 90)])
def test_dense_flow_measures_what_a_motion_leaves(corner: tuple[int, int]) -> None:
    """Two pixels off, and partly outside: the homography moves by SHIFT, and a little wrong."""
    left1, left2, surface = jumping_box(*corner)
    homography = np.eye(4)
    homography[:2, 3] = SHIFT[0] + 2, SHIFT[1] - 1
    followed, telling = follow(left1, left2, surface, np.full(SHAPE, 12, np.float32), homography, FAR)
    assert len(followed) == len(telling) == surface.sum()
    assert surface[followed[:, 1].astype(int), followed[:, 0].astype(int)].all()
    moved = followed[:, 2:] - followed[:, :2]
    assert (np.linalg.norm(moved - SHIFT, axis=1) < 0.5).mean() > 0.9


def test_a_lost_box_gets_its_motion() -> None:
    left1, left2, surface = jumping_box()
    frames = Frames(*(np.dstack([image] * 3) for image in (left1, left1, left2, left2)))
    disparity = np.where(surface, 12, 5).astype(np.float32)
    disparity2 = np.full(SHAPE, 5, np.float32)
    disparity2[50 + SHIFT[1] : 90 + SHIFT[1], 60 + SHIFT[0] : 110 + SHIFT[0]] = 12
    start = start_with(disparity2, np.ones(SHAPE, bool))
    (motion,) = found_in(start, standing(disparity), frames, [surface])
    labels = np.zeros((1, *SHAPE), np.int32)
    change, u, v = displacements(motion.homography[None], labels, disparity)[0][:, surface]
    assert abs(np.median(change)) < 0.2
    assert abs(np.median(u) - SHIFT[0]) < 0.5
    assert abs(np.median(v) - SHIFT[1]) < 0.5
    np.testing.assert_array_equal(motion.support, surface)


def test_dense_flow_is_fitted_by_what_it_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    """The patches' places count whole, dense flow's by direction."""
    left1, left2, surface = jumping_box()
    frames = Frames(*(image[..., None] for image in (left1, left1, left2, left2)))
    told, fit = [], objects.fit_from

    def watched(transform: np.ndarray, first: np.ndarray, *rest: Any, telling: np.ndarray | None = None, **more: Any) -> Any:
        told.append((more["translates"], None if telling is None else telling.shape == (len(first), 2, 2)))
        return fit(transform, first, *rest, telling=telling, **more)

    monkeypatch.setattr(objects, "fit_from", watched)
    disparity = np.full(SHAPE, 12, np.float32)
    found_in(start_with(disparity, np.ones(SHAPE, bool)), standing(disparity), frames, [surface])
    assert {(True, None), (False, True)} == set(told)


def test_the_images_tell_what_dense_flow_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patches and flow lead four pixels beside the truth, where the images agree no better than where nothing moves."""
    left1, left2, surface = jumping_box()
    frames = Frames(*(image[..., None] for image in (left1, left1, left2, np.roll(left2, -12, axis=1))))
    truth = np.float32(SHIFT)

    def beside(*images: np.ndarray) -> np.ndarray:
        return dense_inverse_search(*images) + np.float32([-3, 3])

    def patches(self: Patches, surfaces: list[np.ndarray], most: int) -> list[np.ndarray]:
        places = np.argwhere(surfaces[0])[::50, ::-1]
        return [np.hstack([places, places + truth + (-3, 3)])]

    monkeypatch.setattr(objects, "dense_inverse_search", beside)
    monkeypatch.setattr(Patches, "follow", patches)
    disparity = np.full(SHAPE, 12, np.float32)
    start = start_with(disparity, np.ones(SHAPE, bool))
    monkeypatch.setattr(objects, "NEARLY", 0.0)
    assert found_in(start, standing(disparity), frames, [surface]) == []
    monkeypatch.setattr(objects, "NEARLY", 0.1)
    (motion,) = found_in(start, standing(disparity), frames, [surface])
    flow = displacements(motion.homography[None], np.zeros((1, *SHAPE), np.int32), disparity)[0][1:, surface]
    assert np.linalg.norm(flow - truth[:, None], axis=0).mean() < 1.5


@pytest.mark.parametrize("matched", [False, True])
def test_wrong_disparities_at_time_2_do_not_hide_it(matched: bool) -> None:
    left1, left2, surface = jumping_box()
    frames = Frames(*(image[..., None] for image in (left1, left1, left2, left2)))
    disparity = np.full(SHAPE, 12, np.float32)
    disparity2 = np.random.default_rng(5).uniform(3, 60, SHAPE).astype(np.float32)
    (motion,) = found_in(start_with(disparity2, np.full(SHAPE, matched)), standing(disparity), frames, [surface])
    flow = displacements(motion.homography[None], np.zeros((1, *SHAPE), np.int32), disparity)[0][1:, surface]
    assert np.linalg.norm(np.median(flow, axis=1) - SHIFT) < 2


@pytest.mark.parametrize("case", ["no surface", "nothing seen again", "not lost", "hardly lost", "no better than so far"])
def test_nothing_is_invented(case: str) -> None:
    left1, left2, surface = jumping_box()
    start = start_with(np.full(SHAPE, 12, np.float32), np.ones(SHAPE, bool))
    if case == "no better than so far":  # the box is seen where it went, and where it was
        left2 = np.where(surface, left1, left2)
    left2 = texture(8) if case == "nothing seen again" else left2
    surfaces = [] if case == "no surface" else [surface]
    state = standing(np.full(SHAPE, 12, np.float32))
    if case in ("not lost", "hardly lost"):  # the latter is for the refinement to mend
        state[3], state[4] = np.array(SHIFT) + (1.5 if case == "hardly lost" else 0)
    frames = Frames(*(image[..., None] for image in (left1, left1, left2, left2)))
    assert found_in(start, state, frames, surfaces) == []


def test_motions_are_judged_against_the_state() -> None:
    """Nothing to gain on the state's own motion; on a state that leads out of the image, the cost of that."""
    left1, left2, surface = jumping_box()
    words = census(left1), census(left2), census(np.roll(left2, -12, axis=1))
    state, motion = standing(np.full(SHAPE, 12, np.float32)), np.eye(4)
    state[3], state[4] = SHIFT
    motion[:2, 3] = SHIFT[0] * 0.5 / 12, SHIFT[1] * 150.0 * 0.5 / 12 / 160.0
    inside = cv2.erode(surface.astype(np.uint8), np.ones((13, 13))).astype(bool)
    assert abs(_judge(state, inside, words, PROJECTION, FusionConfig())(motion)) < 0.02
    state[3] = 500
    gain = _judge(state, inside, words, PROJECTION, FusionConfig())(motion)
    assert 0.35 < gain <= 0.4
    state[3], state[4] = 0, 0
    assert _judge(state, inside, words, PROJECTION, FusionConfig())(motion) > 0.4


def moved_by(x: float, y: float, support: np.ndarray) -> RigidMotion:
    homography = np.eye(4)
    homography[:2, 3] = x, y
    return RigidMotion(np.eye(4), homography, support)


def test_objects_are_those_that_the_images_show(caplog: pytest.LogCaptureFixture) -> None:
    """Not what fits worse than the camera's motion, nor what stands where that leads out of the image."""
    left1, left2, surface = jumping_box()
    words = census(left1), census(left2), census(np.roll(left2, -12, axis=1))
    inside = cv2.erode(surface.astype(np.uint8), np.ones((13, 13))).astype(bool)
    wall = np.zeros(SHAPE, bool)
    wall[10:30, 20:50] = True
    nowhere = np.zeros(SHAPE, bool)
    still, gone = moved_by(0, 0, ~surface), moved_by(500, 0, ~surface)
    box, slipped, empty = moved_by(*SHIFT, inside), moved_by(9, 4, wall), moved_by(*SHIFT, nowhere)
    disparity = np.full(SHAPE, 12, np.float32)
    with caplog.at_level("INFO"):
        assert evident([still], disparity, words, FusionConfig()) == [still]
        assert not caplog.records
        assert evident([still, slipped, box, empty], disparity, words, FusionConfig()) == [still, box]
    assert "2 of 3 moving objects dropped" in caplog.text
    assert evident([gone, box], disparity, words, FusionConfig()) == [gone]


def test_what_flow_tells_by_direction() -> None:
    """An even surface, a vertical edge (dx alone), a corner, and an edge across the diagonal."""
    steep = 100 * EVEN**2
    told = telling_of(np.array([[0, 0, 0], [steep, 0, 0], [steep, 0, steep], [steep, steep, steep]], np.float32))
    np.testing.assert_allclose(told, told.transpose(0, 2, 1))
    np.testing.assert_allclose(told[0], DOUBT * np.eye(2), atol=1e-6)
    assert told[1, 0, 0] > 0.99
    assert abs(told[1, 1, 1] - DOUBT) < 1e-6
    assert abs(told[1, 0, 1]) < 1e-6
    np.testing.assert_allclose(told[2], told[1, 0, 0] * np.eye(2), atol=1e-6)
    across, along = np.array([1, 1]) / np.sqrt(2), np.array([1, -1]) / np.sqrt(2)
    assert across @ told[3] @ across > 0.99
    assert abs(along @ told[3] @ along - DOUBT) < 1e-3


def test_surfaces_with_most_matches_come_first_however_large_and_plain() -> None:
    cost = np.zeros((60, 80), np.float32)
    cost[:30] = cost[40:50, 5:35] = cost[40:50, 45:65] = 0.9
    everywhere = np.ones(cost.shape, bool)
    matched = everywhere.copy()
    matched[:30] = False
    disparity, config = np.full(cost.shape, 5, np.float32), ObjectsConfig(least_px=50)
    surfaces = unexplained_surfaces(disparity, cost, everywhere, matched, config)
    assert [surface.sum() for surface in surfaces] == [300, 200]
    matched[2:28, 2:12] = True  # a tenth of it
    surfaces = unexplained_surfaces(disparity, cost, everywhere, matched, config)
    assert [surface.sum() for surface in surfaces] == [300, 2400, 200]
    assert len(unexplained_surfaces(disparity, cost, everywhere, matched, ObjectsConfig(least_px=50, most=1))) == 1
