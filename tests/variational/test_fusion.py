"""Fusion: the chains are exact, choices follow the evidence; projection agrees with its plain twin."""

import numba
import numpy as np
import pytest

from tests import naive_matching
from variational.census import census
from variational.fusion import FORBIDDEN, FusionConfig, _chains, choose, costs_of_ends, motion_costs
from variational.visibility import backward_flow, project_visibility

RNG_SEED = 7


def random_problem(count: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(RNG_SEED)
    candidates = rng.normal(0, 4, (count, 3, height, width)).astype(np.float32)
    return candidates, rng.random((count, height, width), np.float32), rng.random((height, width), np.float32)


def test_a_chain_equals_the_best_of_all_labellings() -> None:
    candidates, costs, price = random_problem(3, 6, 5)
    best = np.empty_like(costs)
    _chains(0, costs.shape[2], candidates, costs, price, np.float32(1 / 10), best)
    for x in range(5):
        expected = naive_matching.chain_minimum(candidates[..., x], costs[..., x], price[:, x], 10)
        difference = best[..., x] - expected
        # equal but for a constant a pixel, which no choice between labels sees
        np.testing.assert_allclose(difference - difference[:1], 0, atol=1e-5)
        damaged = naive_matching.chain_minimum(candidates[..., x], costs[..., x], 1.1 * price[:, x], 10)
        assert np.abs((best[..., x] - damaged) - (best[..., x] - damaged)[:1]).max() > 1e-3


def test_the_order_of_candidates_and_mirroring_change_nothing() -> None:
    candidates, costs, grey = random_problem(3, 20, 31)
    disparity = np.random.default_rng(1).random((20, 31), np.float32) * 4
    config = FusionConfig()
    labels = choose(candidates, costs, disparity, grey, config)
    order = np.array([2, 0, 1])
    np.testing.assert_array_equal(order[choose(candidates[order], costs[order], disparity, grey, config)], labels)
    mirrored = [np.ascontiguousarray(a[..., ::-1]) for a in (candidates, costs, disparity, grey)]
    np.testing.assert_array_equal(choose(*mirrored, config)[:, ::-1], labels)


def test_a_missing_candidate_is_never_chosen_and_threads_do_not_matter() -> None:
    candidates, costs, grey = random_problem(3, 50, 70)
    candidates[1, :, 10:30, 20:50] = np.nan
    costs[1, 10:30, 20:50] = FORBIDDEN
    results, before = [], numba.get_num_threads()
    try:
        for threads in (1, min(2, before)):
            numba.set_num_threads(threads)
            results.append(choose(candidates, costs, grey, grey, FusionConfig()))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(results[0], results[1])
    assert not (results[0][10:30, 20:50] == 1).any()
    assert (results[0] == 1).any()


def test_the_true_motion_is_chosen_and_outside_costs_a_constant() -> None:
    rng = np.random.default_rng(2)
    left1 = rng.random((40, 60), np.float32)
    left2 = np.roll(left1, (2, 5), (0, 1))  # u = 5, v = 2
    right2 = np.roll(left2, -3, 1)  # disparity 3 at time 2
    words = (census(left1), census(left2), census(right2))
    disparity = np.full((40, 60), 4, np.float32)
    candidates = np.empty((3, 3, 40, 60), np.float32)
    candidates[0], candidates[1], candidates[2] = (
        np.reshape(c, (3, 1, 1)) for c in ((-1, 5, 2), (-1, -5, -2), (-1, 500, 0))
    )
    costs = motion_costs(candidates, disparity, words, FusionConfig())
    assert costs[0, 12:-12, 12:-12].max() < 0.05 < 0.5 < costs[1, 12:-12, 12:-12].min()
    np.testing.assert_allclose(costs[2], FusionConfig().outside_cost)
    labels = choose(candidates, costs, disparity, left1, FusionConfig())
    assert (labels[8:-8, 8:-10] == 0).mean() > 0.99


def test_a_rigid_motion_may_lead_one_pixel_beside() -> None:
    """All the eight ways round, in both images of time 2; two pixels are too far, and the measured motion may not."""
    left1 = np.random.default_rng(3).random((41, 63), np.float32)
    left2 = np.roll(left1, (2, 5), (0, 1))
    words = (census(left1), census(left2), census(np.roll(left2, -3, 1)))
    disparity = np.full((41, 63), 4, np.float32)
    offsets = [(0, 0)] + [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)] + [(2, 0), (0, -2)]
    candidates = np.empty((len(offsets), 3, 41, 63), np.float32)
    for k, (x, y) in enumerate(offsets):
        candidates[k] = np.reshape((-1, 5 + x, 2 + y), (3, 1, 1))
    costs = motion_costs(candidates, disparity, words, FusionConfig())[:, 12:-12, 12:-12].max((1, 2))
    assert costs[:-2].max() < 0.05
    assert costs[-2:].min() > 0.5
    candidates[0, 1] += 1
    assert motion_costs(candidates, disparity, words, FusionConfig())[0, 12:-12, 12:-12].min() > 0.5


def test_costs_of_single_pixels_equal_their_plain_twin() -> None:
    random, (height, width) = np.random.default_rng(8), (19, 27)
    words = tuple(random.integers(0, 2**63, (2, height, width), np.uint64) for _ in range(3))
    places = np.column_stack([random.integers(0, width, 300), random.integers(0, height, 300)])
    ends = random.uniform((-3, -3, -4), (width + 2, height + 2, 12), (300, 3))
    words[1][:, 5:9, 8:14] = words[0][:, 2:6, 3:9]
    words[2][:, 5:9, 4:10] = words[0][:, 2:6, 3:9]
    places[0], ends[0] = (4, 3), (9, 6, 4)  # equal in both images
    places[1], ends[1] = (4, 3), (10, 5, 4)  # beside
    places[2], ends[2] = (4, 3), (11, 6, 4)  # two pixels: too far
    ends[3], ends[4] = np.nan, (9, 6, np.inf)
    expected = np.full(300, np.nan, np.float32)
    for n, ((x, y), end) in enumerate(zip(places, ends, strict=True)):
        if not np.isfinite(end).all():
            continue
        to_x, to_y = np.rint(end[:2]).astype(int)
        if not (0 <= to_x < width and 0 <= to_y < height):
            continue
        apart = int(np.rint(end[0] - end[2])) - to_x
        costs = []
        for at_y in range(max(to_y - 1, 0), min(to_y + 2, height)):
            for at_x in range(max(to_x - 1, 0), min(to_x + 2, width)):
                compared = [words[1][:, at_y, at_x]]
                if 0 <= at_x + apart < width:
                    compared.append(words[2][:, at_y, at_x + apart])
                bits = [sum(int(a ^ b).bit_count() for a, b in zip(words[0][:, y, x], each, strict=True)) for each in compared]
                costs.append(np.mean([min(b / (0.4 * 124), 1) for b in bits]))
        expected[n] = min(costs)
    found = costs_of_ends(places, ends, words, FusionConfig())
    assert found[0] == found[1] == 0 < found[2]
    assert np.isnan(found[3:5]).all()
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("margin", "height", "spread_px"), [(0.5, 29, 3), (1.5, 29, 3), (1.0, 100, 3), (1.0, 100, 40)])
def test_projection_equals_its_plain_twin(margin: float, height: int, spread_px: float) -> None:
    rng = np.random.default_rng(4)
    state = rng.normal(0, spread_px, (5, height, 37)).astype(np.float32)
    state[0] = rng.uniform(0, 12, state[0].shape)
    kept = state.copy()
    np.testing.assert_array_equal(project_visibility(state, margin), naive_matching.visible(state, margin))
    assert (project_visibility(state, margin) != naive_matching.visible(state, margin + 0.5)).any()
    np.testing.assert_array_equal(state, kept)


def test_the_nearer_hides_the_farther_and_the_backward_flow_leads_back() -> None:
    state = np.zeros((5, 26, 60), np.float32)
    state[0] = 4
    state[0, 5:20, 20:30], state[3, 5:20, 20:30] = 12, 6  # a near square that moves right
    visible = project_visibility(state)
    assert visible[5:20, 20:30].all()
    assert not visible[6:19, 31:35].any()
    assert visible[:, 40:].all()
    backward = backward_flow(state, np.full((26, 60, 2), 9.0))
    np.testing.assert_array_equal(backward[6:19, 26:36], np.broadcast_to(np.float32([-6, 0]), (13, 10, 2)))
    np.testing.assert_array_equal(backward[6:19, 20:26], np.full((13, 6, 2), 9, np.float32))  # nothing lands: fallback
