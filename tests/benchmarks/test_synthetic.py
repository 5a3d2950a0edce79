"""Time of a rendered sample, four images with all truth, on one thread and always with scenes that are new to the process.

Run with ``pytest tests/benchmarks/test_synthetic.py``, or for the table alone ``python -m tests.benchmarks.test_synthetic``.
A process makes the fixed sets of textures and props as its scenes ask for them: *first* are its first scenes, *warm* those
after 100 scenes of each family. Kernels are compiled before. Linear cost shows in equal times per megapixel of one image.
"""

from itertools import count
from statistics import median
from time import process_time

import cv2
import numba
import pytest

from cgsf.synthetic import FAMILIES, make_sample, make_scene

SIZES = [(256, 512), (512, 1024)]
SCENES = 6
_seeds = count(5_000_000)


def fill_sets(scenes=100):
    """Make the textures and props that nearly all later scenes use."""
    for family in sorted(FAMILIES):
        for seed in range(scenes):
            make_scene(family, seed, 64, 128)


def seconds(family, height, width):
    """Median processor time over new scenes: others on the machine disturb it less than the clock."""
    times = []
    for _ in range(SCENES):
        start = process_time()
        make_sample(family, next(_seeds), height, width)
        times.append(process_time() - start)
    return median(times)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = numba.get_num_threads(), cv2.getNumThreads()
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    fill_sets()
    yield
    numba.set_num_threads(threads[0])
    cv2.setNumThreads(threads[1])


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_new_scenes(benchmark, family, size):
    make_sample(family, next(_seeds), *size)
    benchmark.pedantic(lambda: make_sample(family, next(_seeds), *size), rounds=SCENES)
    per_megapixel = 1e9 * benchmark.stats.stats.median / (size[0] * size[1])
    benchmark.extra_info.update(milliseconds_per_megapixel=round(per_megapixel))


def report():
    """Print the table."""
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    for family in sorted(FAMILIES):
        make_sample(family, next(_seeds), 64, 128)
    first = {family: seconds(family, *SIZES[0]) for family in sorted(FAMILIES)}
    fill_sets()
    print("family   size         first s   warm s   warm ms per megapixel   (processor time)")
    for family in sorted(FAMILIES):
        for height, width in SIZES:
            warm = seconds(family, height, width)
            early = f"{first[family]:7.3f}" if (height, width) == SIZES[0] else " " * 7
            print(f"{family:8} {height:4} x {width:4}  {early} {warm:8.3f} {1e9 * warm / (height * width):10.0f}", flush=True)


if __name__ == "__main__":
    report()
