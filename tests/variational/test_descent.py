"""Data term, relaxation, first-order descent and the stages built on them."""

import numpy as np
import pytest
from scipy.sparse.linalg import cg

from tests.variational.scenes import two_layers
from variational.descent import DescentConfig, FromZeroConfig, RefineConfig, descend_energy, from_zero, refine
from variational.energy import EnergyConfig
from variational.matching import MatchingConfig
from variational.minimise import GROUPS, DescendConfig, RelaxConfig, descend, relax
from variational.terms.constancy import Constancy, ConstancyConfig, features

ORDER = [0, 2, 3, 4]  # the state's channels in the order of a pixel's system


def _naive_energy(planes, y, x, z, d2_map, config, thetas=None):
    """E of one pixel of left1 in float64; returns it and the thetas used, which a second call may hold fixed."""
    left1, right1, left2, right2 = planes
    d1, change, u, v = z

    def bilinear(plane, px, py):
        i, j = int(px), int(py)
        fx, fy = px - i, py - j
        square = plane[j : j + 2, i : i + 2].astype(np.float64)
        value = (1 - fy) * ((1 - fx) * square[0, 0] + fx * square[0, 1]) + fy * ((1 - fx) * square[1, 0] + fx * square[1, 1])
        dx = (1 - fy) * (square[0, 1] - square[0, 0]) + fy * (square[1, 1] - square[1, 0])
        dy = (1 - fx) * (square[1, 0] - square[0, 0]) + fx * (square[1, 1] - square[0, 1])
        return value, dx, dy

    energy, used = 0.0, []
    pairs = [
        (right1, x - d1, y, config.stereo_weight), (left2, x + u, y + v, config.flow_weight),
        (right2, x + u - d1 - change, y + v, config.cross_weight),
    ]  # fmt: skip
    for n, (other, px, py, weight) in enumerate(pairs):
        value, dx, dy = bilinear(other, px, py)
        theta = 1 / (dx**2 + dy**2 + config.zeta**2) if thetas is None else thetas[n]
        used.append(theta)
        energy += weight * np.sqrt((theta * (value - left1[y, x]) ** 2).sum() + config.eps_px**2)
    d2, _, _ = bilinear(d2_map[..., None], x + u, y + v)
    return energy + config.coupling_weight * np.sqrt((d1 + change - d2[0]) ** 2 + config.eps_px**2), used


def test_the_systems_hold_the_energy_and_its_gradient():
    scene = two_layers()
    config = ConstancyConfig()
    rng = np.random.default_rng(1)
    state = scene.state + rng.uniform(0.1, 0.4, scene.state.shape).astype(np.float32)
    everywhere = np.ones(scene.frames.shape, bool)
    systems = Constancy(scene.frames, config).systems(state, (everywhere,) * 3)
    images = (scene.frames.left1, scene.frames.right1, scene.frames.left2, scene.frames.right2)
    planes = [features(np.ascontiguousarray(image[..., 0]), config) for image in images]
    for y, x in ((20, 30), (40, 50), (11, 77), (50, 61)):
        z = state[ORDER, y, x].astype(np.float64)
        energy, thetas = _naive_energy(planes, y, x, z, state[1], config)
        assert systems[y, x, 16] == pytest.approx(energy, rel=2e-4)
        for k in range(4):
            step = 1e-4 * np.eye(4)[k]
            ahead, back = (_naive_energy(planes, y, x, z + s * step, state[1], config, thetas)[0] for s in (1, -1))
            assert systems[y, x, 10 + k] == pytest.approx((ahead - back) / 2e-4, rel=5e-3, abs=5e-3)


def test_the_systems_are_positive_semidefinite():
    scene = two_layers()
    everywhere = np.ones(scene.frames.shape, bool)
    s = Constancy(scene.frames, ConstancyConfig()).systems(scene.state, (everywhere,) * 3).astype(np.float64)
    matrices = np.zeros((*s.shape[:2], 4, 4))
    for k, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3)]):
        matrices[..., i, j] = matrices[..., j, i] = s[..., k]
    assert np.linalg.eigvalsh(matrices).min() > -1e-3


def _random_problem(height=6, width=9, seed=0):
    rng = np.random.default_rng(seed)
    systems = np.zeros((height, width, 18), np.float32)
    roots = rng.normal(size=(height, width, 4, 4))
    matrices = roots @ roots.swapaxes(-1, -2)
    systems[..., :10] = matrices[..., *np.triu_indices(4)]
    systems[..., 10:14] = rng.normal(size=(height, width, 4))
    systems[..., 14] = rng.uniform(0.5, 2, (height, width))
    systems[..., 15] = rng.normal(size=(height, width))
    state = rng.normal(size=(5, height, width)).astype(np.float32)
    reference = rng.normal(size=(5, height, width)).astype(np.float32)
    edges = rng.uniform(0.2, 1, (2, 2, height, width)).astype(np.float32)
    pull = rng.uniform(0.1, 0.5, (height, width, GROUPS)).astype(np.float32)
    return state, reference, systems, matrices, edges, pull


def test_relaxation_finds_the_minimum_of_the_quadratic():
    state, reference, systems, matrices, edges, pull = _random_problem()
    # A large eps makes the smoothness quadratic, with weight lambda * edge / eps.
    config = RelaxConfig(disparity=300.0, change=200.0, flow=500.0, eps_px=1000.0, sweeps=400, omega=1.3)
    found, _ = relax(state, reference, systems, edges[0], edges[1], pull, config)
    strengths = {0: (0.3, 0, 0), 2: (0.2, 0, 1), 3: (0.5, 0, 2), 4: (0.5, 0, 2), 1: (0.3, 1, 3)}  # weight, grid, group

    def apply(flat):
        x = flat.reshape(5, 6, 9)
        out = np.zeros_like(x)
        out[ORDER] = np.einsum("yxij,jyx->iyx", matrices, x[ORDER])
        out[1] = systems[..., 14] * x[1]
        for channel, (weight, grid, group) in strengths.items():
            out[channel] += pull[..., group] * x[channel]
            for axis in (0, 1):
                edge = edges[grid, 1 - axis].astype(np.float64)
                difference = weight * np.diff(x[channel], axis=axis) * (edge[1:] if axis == 0 else edge[:, 1:])
                low, high = [slice(None)] * 2, [slice(None)] * 2
                low[axis], high[axis] = slice(None, -1), slice(1, None)
                out[channel][tuple(high)] += difference
                out[channel][tuple(low)] -= difference
        return out.ravel()

    field = (state - reference).astype(np.float64)
    right = np.zeros((5, 6, 9))
    right[ORDER] = np.einsum("yxij,jyx->iyx", matrices, field[ORDER]) - systems[..., 10:14].transpose(2, 0, 1)
    right[1] = systems[..., 14] * field[1] - systems[..., 15]
    from scipy.sparse.linalg import LinearOperator

    exact, failed = cg(LinearOperator((270, 270), matvec=apply, dtype=np.float64), right.ravel(), rtol=1e-12, maxiter=5000)
    assert not failed
    np.testing.assert_allclose(found - reference, exact.reshape(5, 6, 9), atol=2e-3)


def test_descent_reaches_the_minimum_and_never_returns_worse():
    target = np.random.default_rng(0).normal(size=(5, 4, 6))
    found, energies, reason = descend(
        lambda x: (float(((x - target) ** 2).sum()), 2 * (x - target)), np.zeros((5, 4, 6)), DescendConfig(steps=300)
    )
    assert np.abs(found - target).max() < 0.05
    assert reason in ("converged", "step limit")
    assert energies[0] == pytest.approx((target**2).sum())
    uphill, _, _ = descend(lambda x: (float((x**2).sum()), -2 * x), np.ones((5, 2, 2)), DescendConfig(steps=20))
    np.testing.assert_array_equal(uphill, np.ones((5, 2, 2)))


def test_descent_stops_at_what_is_not_finite():
    def value_and_gradient(x):
        energy = float((x**2).sum())
        return (np.nan if x.max() < 0.9 else energy), 2 * x

    found, _, reason = descend(value_and_gradient, np.ones((5, 2, 3)), DescendConfig(steps=50))
    assert reason == "not finite"
    assert np.isfinite(found).all()


def test_refinement_mends_a_fraction_of_a_pixel():
    scene = two_layers()
    # Half a pixel too far everywhere; the disparities are whole, so that an error is the solver's.
    blurred = scene.state + np.float32([0.4, 0.4, 0, 0.4, -0.4])[:, None, None]
    before = blurred.copy()
    everywhere = np.ones(scene.frames.shape, bool)
    config = RefineConfig(warps=4, pull=0.01)
    found, history = refine(scene.frames, blurred, ~everywhere, (everywhere, everywhere), config, ConstancyConfig())
    np.testing.assert_array_equal(blurred, before)
    for channel in (0, 1, 3, 4):
        assert np.median(np.abs(found[channel] - scene.state[channel])) < 0.15, channel
    assert np.abs(found - blurred).max() <= config.most_px + 1e-5
    assert [h["energy"] for h in history] == sorted((h["energy"] for h in history), reverse=True)


def test_from_zero_finds_both_layers():
    scene = two_layers()
    start, history = from_zero(scene.frames, FromZeroConfig(), ConstancyConfig(), MatchingConfig(speckle_px=10))
    for channel, share in ((0, 0.85), (1, 0.85), (3, 0.8), (4, 0.8)):
        assert (np.abs(start.state[channel] - scene.state[channel]) < 1).mean() > share, channel
    assert {h["level"] for h in history} == set(range(max(h["level"] for h in history) + 1))


def test_descent_of_the_energy_lowers_it_on_every_level():
    scene = two_layers()
    state = scene.state + np.random.default_rng(2).normal(0, 0.5, scene.state.shape).astype(np.float32)
    before = state.copy()
    backward = np.zeros((*scene.frames.shape, 2), np.float32)
    found, history, _ = descend_energy(scene.frames, state, backward, DescentConfig(levels=2), EnergyConfig())
    np.testing.assert_array_equal(state, before)
    assert np.isfinite(found).all()
    for level in (0, 1):
        energies = [h["energy"] for h in history if h["level"] == level]
        assert min(energies) < energies[0]
