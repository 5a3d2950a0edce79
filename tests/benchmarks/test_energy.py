"""Speed of value and gradient: the handwritten kernels, the same through the torch bridge, and the twin's autograd.

Run with ``pytest tests/benchmarks/test_energy.py --benchmark-group-by=param:size``. Everything is warm, float32, three
channels, all terms, two threads for both libraries. Time per pixel and peak memory are in each record's ``extra_info``.
"""

import gc
import resource
import subprocess
import sys

import numba
import numpy as np
import pytest
import torch

from cgsf.gradcheck import random_scene
from learned.consistency import consistency_map
from learned.oracle import Oracle
from variational.energy import Energy, EnergyConfig

SIZES = [(96, 128), (192, 256), (375, 1242), (540, 960), (1080, 1920)]
THREADS = min(2, numba.config.NUMBA_NUM_THREADS)


def single(size):
    """A random scene in float32, as arrays and as tensors with a batch axis."""
    scene = random_scene(size)
    frames = scene.frames.astype(np.float32)
    state, back = scene.state.astype(np.float32), scene.backward_flow.astype(np.float32)
    arrays = (frames.left1, frames.right1, frames.left2, frames.right2, back)
    tensors = [torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))[None] for array in arrays]
    return frames, state, back, torch.from_numpy(state)[None], tensors


def twin_gradient(state, tensors):
    leaf = state.detach().requires_grad_()
    loss = consistency_map(leaf, *tensors)
    return loss, torch.autograd.grad(loss.sum(), leaf)


def runner(kind, size):
    """A warm function of no arguments."""
    frames, state, back, state_tensor, tensors = single(size)
    if kind == "numba":
        energy = Energy(frames, EnergyConfig(), back)
        return lambda: energy.value_and_gradient(state)
    if kind == "bridge":
        oracle = Oracle(*tensors)
        return lambda: oracle.features(state_tensor)
    return lambda: twin_gradient(state_tensor, tensors)


@pytest.fixture(autouse=True)
def two_threads():
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(THREADS)
    torch.set_num_threads(THREADS)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("kind", ["numba", "bridge", "twin"])
def test_value_and_gradient(benchmark, kind, size):
    function = runner(kind, size)
    function()
    gc.collect()
    benchmark.pedantic(function, rounds=6 if kind == "twin" else 30, warmup_rounds=2)
    benchmark.extra_info["ns_per_pixel"] = benchmark.stats.stats.min / (size[0] * size[1]) * 1e9


def peak_memory(kind, size):
    """Bytes that a fresh process's peak grows by in one warm value and gradient at `size`."""
    code = f"from tests.benchmarks.test_energy import measure_peak; measure_peak({kind!r}, {size!r})"
    return int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def measure_peak(kind, size):
    """Print that number; called in the fresh process."""
    runner(kind, (96, 128))()  # compile and load outside the measurement
    function = runner(kind, size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    function()
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)


def test_peak_memory_is_a_quarter_of_the_twins():
    ours, twin = (peak_memory(kind, (1080, 1920)) for kind in ("numba", "twin"))
    assert ours <= twin / 4


def test_speed_up_at_the_headline_size(benchmark):
    """At least 8 times the twin, and 7 through the bridge, at 375 x 1242."""
    size = (375, 1242)
    functions = {kind: runner(kind, size) for kind in ("numba", "bridge", "twin")}
    best = {}
    for kind, function in functions.items():
        function()
        best[kind] = min(_seconds(function) for _ in range(6 if kind == "twin" else 30))
    benchmark.extra_info.update({kind: 1000 * seconds for kind, seconds in best.items()})
    benchmark.pedantic(functions["numba"], rounds=10)
    assert best["twin"] / best["numba"] >= 8
    assert best["twin"] / best["bridge"] >= 7


def _seconds(function):
    from time import perf_counter

    start = perf_counter()
    function()
    return perf_counter() - start
