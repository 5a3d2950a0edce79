"""The energy and its gradient: against the plain twin, Taylor's theorem, symmetries, precision, threads."""

from dataclasses import replace

import numba
import numpy as np
import pytest

from cgsf.gradcheck import random_scene, smooth_noise
from tests import naive
from tests.tolerances import EXACT, SINGLE_GRADIENT, SINGLE_MAP, TAYLOR_ORDER
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames
from variational.jit import total
from variational.state import D1, D2, C, U, V

OPTIONS = EnergyConfig(drop_outside=True, charbonnier_intensity=0.01, charbonnier_px=0.05, edge_sharpness=7,
                       ssim_share=0.6)
TERMS = {
    "stereo": EnergyConfig(1, 0, 0, 0), "flow": EnergyConfig(0, 1, 0, 0), "coupling": EnergyConfig(0, 0, 1, 0),
    "smoothness": EnergyConfig(0, 0, 0, 1), "paper": EnergyConfig(), "options": OPTIONS,
}
SIZES = [(13, 21), (1, 9), (9, 1), (2, 2), (1, 1), (3, 40)]


def problem(size, seed=0, channels=3):
    """Frames, a state whose motion crosses the border, and a backward flow."""
    if min(size) < 4:  # noise has no range to stretch there
        rng = np.random.default_rng(seed)
        frames = Frames(*(rng.random((*size, channels)) for _ in range(4)))
        return frames, rng.normal(0, 3, (5, *size)), rng.normal(0, 3, (*size, 2))
    scene = random_scene(size, seed, channels)
    return scene.frames, scene.state, scene.backward_flow


def close(a, b, relative):
    assert np.abs(a - b).max() <= relative * max(np.abs(b).max(), 1e-12)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("term", TERMS)
def test_map_equals_naive(size, term):
    frames, state, back = problem(size, channels=3 if size[0] % 2 else 1)
    loss, _ = Energy(frames, TERMS[term], back).value_and_gradient(state)
    close(loss, naive.energy_map(frames, state, back, TERMS[term]), EXACT)


def remainder_orders(config, gradient_error=None):
    """Taylor order for three random directions, on a smooth energy."""
    frames, state, back = problem((14, 19))
    energy = Energy(frames, config, back)
    loss, gradient = energy.value_and_gradient(state)
    visible = naive.visible_mask(state[3:].transpose(1, 2, 0), back, config.visible_relative, config.visible_absolute)
    if gradient_error is not None:
        gradient = gradient_error(gradient)
    rng, steps, orders = np.random.default_rng(1), np.array([4e-6, 2e-6, 1e-6]), []
    for _ in range(3):
        direction = rng.choice([-1.0, 1.0], state.shape)
        slope = (gradient * direction).sum()
        moved = [energy.value_and_gradient(state + h * direction, visible)[0] for h in steps]
        remainders = [abs((m - loss).sum() - h * slope) for m, h in zip(moved, steps, strict=True)]
        orders.append(np.polyfit(np.log(steps), np.log(remainders), 1)[0])
    return np.median(orders)


@pytest.mark.parametrize("weights", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1, 1, 1, 0.1)])
def test_taylor_order_two(weights):
    assert remainder_orders(EnergyConfig(*weights, charbonnier_intensity=0.01, charbonnier_px=0.1)) > TAYLOR_ORDER


DAMAGES = {
    "sign of C": lambda g: g * np.array([1, 1, -1, 1, 1])[:, None, None],
    "1 % of u": lambda g: g * np.array([1, 1, 1, 1.01, 1])[:, None, None],
    "D2 off by one": lambda g: np.stack([g[0], np.roll(g[1], 1, axis=1), *g[2:]]),
    "u and v swapped": lambda g: g[[0, 1, 2, 4, 3]],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_gradient_is_found(damage):
    config = EnergyConfig(charbonnier_intensity=0.01, charbonnier_px=0.1)
    assert remainder_orders(config, DAMAGES[damage]) < TAYLOR_ORDER


def test_coupling_gradient_by_d2_is_adjoint_of_sampling():
    """<S d, r> = <d, S^T r>: the scatter against sampling, with motion across the border."""
    frames, state, _ = problem((17, 23))
    state[D1] += 100  # residuals of one sign, so that the term is linear in D2
    config = TERMS["coupling"]
    loss, gradient = Energy(frames, config).value_and_gradient(state)
    other = state.copy()
    other[D2] = np.random.default_rng(3).normal(size=(17, 23))
    moved, _ = Energy(frames, config).value_and_gradient(other)
    assert (moved - loss).sum() == pytest.approx((gradient[D2] * (other[D2] - state[D2])).sum(), rel=1e-11)


def test_flipped_upside_down():
    """Rows have no preferred direction: a vertical flip of everything flips map and gradient, and turns v."""
    frames, state, back = problem((16, 22))
    loss, gradient = Energy(frames, OPTIONS, back).value_and_gradient(state)
    flip = np.array([1, 1, 1, 1, -1.0])[:, None, None]
    images = (frames.left1, frames.right1, frames.left2, frames.right2)
    flipped = Frames(*(np.ascontiguousarray(image[::-1]) for image in images))
    loss_f, gradient_f = Energy(flipped, OPTIONS, back[::-1] * [1, -1]).value_and_gradient(
        np.ascontiguousarray(state[:, ::-1] * flip))
    close(gradient_f[:, ::-1] * flip, gradient, 1e-10)
    assert loss_f.sum() == pytest.approx(loss.sum(), rel=1e-12)


def test_perfect_match_costs_nothing():
    """left1 shifted by known disparity and flow: the photometric and coupling terms vanish where matches are inside."""
    rng = np.random.default_rng(0)
    left1 = np.stack([smooth_noise(rng, (20, 40), 0, 1, 1) for _ in range(3)], axis=2)
    shift = {"right1": -3, "left2": 2, "right2": -2}  # D1 = 3, u = 2, D2 = 4, hence C = 1
    others = {name: np.roll(left1, columns, axis=1) for name, columns in shift.items()}
    state = np.zeros((5, 20, 40))
    state[D1], state[D2], state[C], state[U], state[V] = 3, 4, 1, 2, 0
    loss, _ = Energy(Frames(left1=left1, **others), EnergyConfig()).value_and_gradient(state)
    assert loss[:, 8:-8].max() < 1e-12
    state[V] = 1
    assert Energy(Frames(left1=left1, **others), EnergyConfig()).value(state) > 10


@pytest.mark.parametrize("config", [EnergyConfig(), OPTIONS], ids=["paper", "options"])
def test_float32_agrees_with_float64(config):
    frames, state, back = problem((33, 47))
    single = Energy(frames.astype(np.float32), config, back).value_and_gradient(state.astype(np.float32))
    frames64, state64 = frames.astype(np.float32).astype(np.float64), state.astype(np.float32).astype(np.float64)
    double = Energy(frames64, config, back).value_and_gradient(state64)
    assert single[0].dtype == single[1].dtype == np.float32
    close(single[0], double[0], SINGLE_MAP)
    assert np.mean(np.abs(single[1] - double[1]) > SINGLE_GRADIENT * np.abs(double[1]).max()) < 1e-3  # but for kinks


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_same_bits_for_one_and_two_threads(dtype):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    frames, state, back = problem((75, 51))
    energy = Energy(frames.astype(dtype), EnergyConfig(), back)
    state = state.astype(dtype)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            loss, gradient = energy.value_and_gradient(state)
            results.append((loss.tobytes(), gradient.tobytes(), total(loss), energy.value(state)))
    finally:
        numba.set_num_threads(before)
    assert results[0] == results[1]


def test_inputs_unchanged_and_value_is_the_sum():
    frames, state, back = problem((15, 18))
    arrays = [frames.left1, frames.right1, frames.left2, frames.right2, state, back]
    copies = [array.copy() for array in arrays]
    energy = Energy(frames, EnergyConfig(), back)
    loss, _ = energy.value_and_gradient(state)
    assert energy.value(state) == pytest.approx(loss.sum(), rel=1e-13)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, copies, strict=True))


def test_weights_are_linear_and_zero_switches_off():
    frames, state, back = problem((15, 18))
    whole, _ = Energy(frames, EnergyConfig(0.5, 2, 3, 0.25), back).value_and_gradient(state)
    parts = [Energy(frames, EnergyConfig(*np.eye(4)[i]), back).value_and_gradient(state)[0] for i in range(4)]
    close(whole, 0.5 * parts[0] + 2 * parts[1] + 3 * parts[2] + 0.25 * parts[3], EXACT)
    loss, gradient = Energy(frames, EnergyConfig(0, 0, 0, 0), back).value_and_gradient(state)
    assert not loss.any()
    assert not gradient.any()


def test_masks_switch_pixels_off():
    frames, state, _ = problem((15, 18))
    hidden = np.zeros((15, 18), bool)
    config = EnergyConfig(smoothness_weight=0)
    energy = Energy(frames, config, None, hidden, hidden)
    assert energy.value(state) > 0
    assert energy.value(state, visible=hidden) == 0


def test_nan_is_seen_and_does_no_harm():
    frames, state, back = problem((15, 18))
    state[:, 7, 9] = np.nan
    state[U, 3, 3] = np.inf
    loss, _ = Energy(frames, EnergyConfig(), back).value_and_gradient(state)
    assert np.isnan(loss[7, 9])
    assert np.isfinite(loss[12, 2])


def test_out_is_written():
    frames, state, back = problem((15, 18))
    energy = Energy(frames, EnergyConfig(), back)
    out = np.full((15, 18), np.nan), np.full((5, 15, 18), np.nan)
    loss, gradient = energy.value_and_gradient(state, out=out)
    assert loss is out[0]
    assert gradient is out[1]
    close(gradient, energy.value_and_gradient(state)[1], 0)


def test_bad_input_is_named():
    frames, state, back = problem((15, 18))
    with pytest.raises(ValueError, match="state must have shape"):
        Energy(frames).value(state[:, 1:])
    with pytest.raises(ValueError, match="C-contiguous"):
        Energy(frames).value(np.asfortranarray(state))
    with pytest.raises(ValueError, match="backward_flow must have shape"):
        Energy(frames, EnergyConfig(), back[1:])
    with pytest.raises(ValueError, match="bool"):
        Energy(frames).value(state, visible=np.ones((15, 18)))
    with pytest.raises(ValueError, match=r"EnergyConfig.flow_weight"):
        replace(EnergyConfig(), flow_weight=-1.0)
