"""Speed of value and gradient: the handwritten kernels, the same through the torch bridge, and the twin's autograd.

Run with ``pytest tests/benchmarks/test_energy.py --benchmark-group-by=param:size``, or for the ratios alone
``python -m tests.benchmarks.test_energy``. Everything is warm, float32, three
channels, all terms, two threads for both libraries. Time per pixel and peak memory are in each record's ``extra_info``.
"""

import gc
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numba
import numpy as np
import pytest
import torch

from cgsf.gradcheck import random_scene
from learned.consistency import consistency_map
from learned.oracle import Oracle
from tests.benchmarks.test_networks import machine
from variational.energy import Energy, EnergyConfig
from variational.frames import Frames

SIZES = [(96, 128), (192, 256), (375, 1242), (540, 960), (1080, 1920)]
BYTES_A_PIXEL, OPERATIONS_A_PIXEL = 456, 900
"""Of one value and gradient, counted by hand: 114 planes read or written by sweeps that keep nothing in the cache, and the
photometric terms' arithmetic."""
THREADS = min(2, numba.config.NUMBA_NUM_THREADS)


def single(size):
    """A random scene in float32, as arrays and as tensors with a batch axis; the largest is 2 x 2 times a quarter."""
    tiles = 2 if size[0] > 1000 else 1  # making the scene would take longer than everything measured
    scene = random_scene((size[0] // tiles, size[1] // tiles))
    frames = Frames(*(np.tile(image.astype(np.float32), (tiles, tiles, 1)) for image in
                      (scene.frames.left1, scene.frames.right1, scene.frames.left2, scene.frames.right2)))
    state = np.tile(scene.state.astype(np.float32), (1, tiles, tiles))
    back = np.tile(scene.backward_flow.astype(np.float32), (tiles, tiles, 1))
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
    Path("/proc/self/clear_refs").write_text("5")  # Linux: forget the peak, which making the scene has set
    before = _kilobytes("VmRSS")
    function()
    print((_kilobytes("VmHWM") - before) * 1024)


def _kilobytes(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(field)))


def test_peak_memory_is_a_quarter_of_the_twins():
    ours, twin = (peak_memory(kind, (540, 960)) for kind in ("numba", "twin"))
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
    start = perf_counter()
    function()
    return perf_counter() - start


def report(size=(375, 1242)):
    """Print the best time of each way and the speed-ups, then the kernels' time per pixel over the sizes."""
    numba.set_num_threads(THREADS)
    torch.set_num_threads(THREADS)
    best = {}
    for kind, rounds in (("numba", 40), ("bridge", 40), ("twin", 5)):
        function = runner(kind, size)
        function()
        best[kind] = min(_seconds(function) for _ in range(rounds))
        print(f"{kind:8} {1000 * best[kind]:8.2f} ms", flush=True)
    pixels = size[0] * size[1]
    print(machine())
    print(f"the kernels move {BYTES_A_PIXEL * pixels / best['numba'] / 1e9:.1f} GB/s and do "
          f"{OPERATIONS_A_PIXEL * pixels / best['numba'] / 1e9:.0f} GFLOP/s, as counted in docs/results.md")
    print(f"the twin takes {best['twin'] / best['numba']:.1f} times the kernels' time, "
          f"{best['twin'] / best['bridge']:.1f} times the bridge's")
    for size in SIZES:
        function = runner("numba", size)
        nanoseconds = min(_seconds(function) for _ in range(30)) / (size[0] * size[1]) * 1e9
        print(f"{size[0]:5} x {size[1]:4} {nanoseconds:6.1f} ns per pixel", flush=True)


if __name__ == "__main__":
    report()
