"""Time of the solver as a whole, on a scene of two layers of any size; warm, with the presets' settings.

Run with ``pytest tests/benchmarks/test_solver.py``. Time per stage, in seconds, is in each record's ``extra_info``.
"""

import pytest

from tests.variational.scenes import two_layers
from variational.camera import StereoCamera
from variational.solver import SolverConfig, solve

CONFIGS = {
    "default": SolverConfig(),
    "fast": SolverConfig(most_pixels=200_000),
}


@pytest.mark.parametrize("size", [(188, 620), (375, 1242)], ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", CONFIGS)
def test_solve(benchmark, name, size):
    height, width = size
    frames = two_layers(height, width).frames
    camera = StereoCamera(0.58 * width, 0.58 * width, (width - 1) / 2, (height - 1) / 2, 0.54)
    solution = solve(frames, CONFIGS[name], camera)
    assert solution.visible.any()
    solution = benchmark.pedantic(solve, (frames, CONFIGS[name], camera), rounds=5)
    benchmark.extra_info.update(seconds=solution.seconds)
