"""Properties of the gradient oracle over all sizes, weights, types and thread counts: the twin judges."""

from dataclasses import asdict

import numba
import numpy as np
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from learned.consistency import consistency_map
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames
from variational.jit import total

PHASES = (Phase.explicit, Phase.generate)  # shrinking a numerical failure costs minutes and tells little
SIDES = st.one_of(st.sampled_from([1, 2, 3]), st.integers(4, 70))
WEIGHTS = st.one_of(st.just(0.0), st.floats(0.01, 10))
CONFIGS = st.builds(EnergyConfig, WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS, ssim_share=st.floats(0, 1),
                    edge_sharpness=st.floats(0, 20), drop_outside=st.booleans(),
                    charbonnier_intensity=st.sampled_from([0.0, 0.01]), charbonnier_px=st.sampled_from([0.0, 0.1]))


def problem(height, width, channels, seed):
    rng = np.random.default_rng(seed)
    frames = Frames(*(rng.random((height, width, channels)) for _ in range(4)))
    state = rng.normal(0, 1, (5, height, width)) * np.array([width, width, 3, width, height])[:, None, None] / 4
    backward = -state[3:].transpose(1, 2, 0) + rng.normal(0, 0.3, (height, width, 2))
    return frames, state, backward


@settings(max_examples=40, deadline=None, derandomize=True, phases=PHASES)
@given(SIDES, SIDES, st.sampled_from([1, 3]), st.integers(0, 1000), CONFIGS)
def test_analytic_equals_autograd(height, width, channels, seed, config):
    frames, state, backward = problem(height, width, channels, seed)
    loss, gradient = Energy(frames, config, backward).value_and_gradient(state)
    arrays = (frames.left1, frames.right1, frames.left2, frames.right2, backward)
    leaf = torch.from_numpy(state)[None].requires_grad_()
    images = [torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))[None] for array in arrays]
    twin = consistency_map(leaf, *images, **asdict(config))
    expected = torch.autograd.grad(twin.sum(), leaf)[0][0].numpy() if twin.requires_grad else np.zeros_like(state)
    twin = twin[0].detach().numpy()
    assert np.abs(loss - twin).max() <= 1e-10 * max(np.abs(twin).max(), 1)
    assert abs(total(loss) - twin.sum()) <= 1e-12 * max(twin.sum(), 1)
    assert np.abs(gradient - expected).max() <= 1e-10 * max(np.abs(expected).max(), 1)


@settings(max_examples=20, deadline=None, derandomize=True, phases=PHASES)
@given(SIDES, SIDES, st.sampled_from([1, 3]), st.integers(0, 1000), CONFIGS, st.sampled_from([np.float32, np.float64]))
def test_threads_do_not_change_a_bit(height, width, channels, seed, config, dtype):
    frames, state, backward = problem(height, width, channels, seed)
    energy, state = Energy(frames.astype(dtype), config, backward), state.astype(dtype)
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            loss, gradient = energy.value_and_gradient(state)
            results.append((loss.tobytes(), gradient.tobytes(), energy.value(state)))
    finally:
        numba.set_num_threads(before)
    assert results[0] == results[1]
    assert loss.dtype == gradient.dtype == dtype
