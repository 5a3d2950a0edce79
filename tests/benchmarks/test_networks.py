"""Time of the networks and of guided aggregation on two threads, warm, at 384 x 1248; peak memory of the deep GA-Net.

``python -m tests.benchmarks.test_networks [CASE ...]`` prints the machine's own rates, then one line a case (no CASE: all,
about two minutes) with its arithmetic, and for the aggregation the speed-up over the torch reference;
``pytest tests/benchmarks/test_networks.py`` records the same.
"""

import resource
import sys
from functools import cache
from statistics import median
from time import perf_counter

import numba
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from cgsf.threads import keep_freed_memory
from learned import ganet, pwcnet
from learned.feedforward import FeedforwardModule, fold_normalisation
from learned.guided_aggregation import semi_global_aggregation, semi_global_aggregation_reference

SIZE = (384, 1248)
COSTS = (1, 32, 65, 64, 208)
"""A semi-global layer's costs: the deep model's channels and disparities, on a sixth of its pixels: the reference fits."""
THREADS = min(2, numba.config.NUMBA_NUM_THREADS)


@cache
def images(size, count):
    """Seeded noise at a quarter of the size, enlarged; made once, so that no time of a network holds it."""
    noise = torch.rand((count, 1, 3, size[0] // 4, size[1] // 4), generator=torch.Generator().manual_seed(1))
    return [torch.nn.functional.interpolate(image, size, mode="bilinear", align_corners=False) for image in noise]


def network(build, config, dtype, passes):
    """A function of no arguments, warmed up at a small size: `passes` passes of a folded network."""
    keep_freed_memory()  # as `cgsf run` does
    torch.manual_seed(3)
    net = fold_normalisation(build(config).eval())

    @torch.inference_mode()
    def run(size=SIZE):
        first, second, *_ = images(size, 2)
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            return net.both_ways(first, second) if passes == 2 else net(first, second)

    run((96, 192))
    return run


def feedforward():
    keep_freed_memory()
    torch.manual_seed(3)
    networks = (fold_normalisation(net.eval()) for net in (ganet.GANet(ganet.COMPACT), pwcnet.PWCNet(pwcnet.COMPACT)))
    module = FeedforwardModule(*networks, "bfloat16").eval()

    @torch.inference_mode()
    def run(size=SIZE):
        return module(*images(size, 4))

    return run


def aggregation(function, backward):
    generator = torch.Generator().manual_seed(2)
    # channels innermost, as the networks have them
    cost = torch.randn(COSTS, generator=generator).contiguous(memory_format=torch.channels_last_3d)
    batch, channels, _, height, width = COSTS
    guidance = torch.randn((batch, 20 * channels, height, width), generator=generator)
    guidance = guidance.contiguous(memory_format=torch.channels_last)
    cost.requires_grad_(backward)
    guidance.requires_grad_(backward)

    def run():
        out = function(cost, guidance)
        if backward:
            torch.autograd.grad(out.sum(), (cost, guidance))

    return run


FLOAT, HALF = torch.float32, torch.bfloat16
CASES = {
    "pwcnet float32": lambda: network(pwcnet.PWCNet, pwcnet.PWCNetConfig(), FLOAT, 1),
    "pwcnet bfloat16": lambda: network(pwcnet.PWCNet, pwcnet.PWCNetConfig(), HALF, 1),
    "compact disparity": lambda: network(ganet.GANet, ganet.COMPACT, HALF, 1),
    "compact flow": lambda: network(pwcnet.PWCNet, pwcnet.COMPACT, HALF, 1),
    "compact flow both ways": lambda: network(pwcnet.PWCNet, pwcnet.COMPACT, HALF, 2),
    "compact feedforward": feedforward,
    "aggregation forward": lambda: aggregation(semi_global_aggregation, False),
    "aggregation forward, reference": lambda: aggregation(semi_global_aggregation_reference, False),
    "aggregation and backward": lambda: aggregation(semi_global_aggregation, True),
    "aggregation and backward, reference": lambda: aggregation(semi_global_aggregation_reference, True),
    "ganet deep float32": lambda: network(ganet.GANet, ganet.GANetConfig(), FLOAT, 1),
    "ganet deep bfloat16": lambda: network(ganet.GANet, ganet.GANetConfig(), HALF, 1),
}
ROUNDS = {"ganet deep float32": 1, "ganet deep bfloat16": 1, "aggregation forward, reference": 2,
          "aggregation and backward, reference": 2}


@pytest.mark.parametrize("case", CASES)
def test_pass(benchmark, case):
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    benchmark.pedantic(CASES[case](), rounds=ROUNDS.get(case, 5), warmup_rounds=0 if "deep" in case else 1)
    torch.set_num_threads(before)


def seconds(case):
    """The times of some rounds, the last result and the GFLOP; the deep model runs once, warmed up at a small size."""
    function = CASES[case]()
    work = 0.0 if "aggregation" in case else arithmetic(case, function)
    if "deep" not in case:
        function()
    times = []
    for _ in range(ROUNDS.get(case, 12)):
        start = perf_counter()
        result = function()
        times.append(perf_counter() - start)
    return times, result, work


def best_seconds(function, rounds=8):
    """The best of a few calls after a first one."""
    times = []
    for _ in range(rounds + 1):
        start = perf_counter()
        function()
        times.append(perf_counter() - start)
    return min(times[1:])


@torch.inference_mode()
def machine():
    """What this machine does at this moment: matrix products, convolutions (GFLOP/s) and copies (GB/s)."""
    rates = []
    for dtype in (FLOAT, HALF):
        matrix, image = torch.randn(2048, 2048).to(dtype), torch.randn(1, 128, 96, 312).to(dtype)
        image = image.contiguous(memory_format=torch.channels_last)
        kernel = torch.randn(128, 128, 3, 3).to(dtype)
        products = 2 * 2048**3 / best_seconds(lambda matrix=matrix: matrix @ matrix)
        arithmetic = 2 * 9 * 128 * 128 * 96 * 312
        seconds_each = best_seconds(lambda image=image, kernel=kernel: torch.conv2d(image, kernel, padding=1))
        rates.append(f"{str(dtype)[6:]} {products / 1e9:.0f} (matrices), {arithmetic / seconds_each / 1e9:.0f} (3x3) GFLOP/s")
    source = torch.ones(32 << 20)
    target = torch.empty_like(source)
    rates.append(f"copy {2 * source.nbytes / best_seconds(lambda: target.copy_(source)) / 1e9:.1f} GB/s")
    return "; ".join(rates)


def arithmetic(case, function):
    """GFLOP of a network's convolutions and matrix products; the deep model's are counted on a 17th of the pixels."""
    size = (96, 288) if "deep" in case else SIZE
    torch.set_num_threads(1)  # nothing runs side by side: the counter sees its own thread
    with FlopCounterMode(display=False) as counter:
        function(size)
    torch.set_num_threads(THREADS)
    return counter.get_total_flops() / 1e9 * SIZE[0] * SIZE[1] / (size[0] * size[1])


def report(names):
    """Print the table."""
    if unknown := [name for name in names if name not in CASES]:
        sys.exit(f"no case {unknown[0]!r}; there are {', '.join(CASES)}")
    torch.set_num_threads(THREADS)
    print(f"machine: {machine()}")
    times, disparities = {}, {}
    for name in names:
        each, disparities[name], work = seconds(name)
        times[name] = min(each)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        rate = f"{work:.0f} GFLOP, {work / times[name]:.0f} GFLOP/s" if work else ""
        middle = f"(median {1000 * median(each):9.1f})" if len(each) > 2 else ""
        print(f"{name:36} {1000 * times[name]:9.1f} ms {middle:18}  peak so far {peak:.2f} GB   {rate}", flush=True)
        fast, slow = name.removesuffix(", reference"), name
        if fast != slow and fast in times:
            print(f"{fast:36} {times[slow] / times[fast]:9.1f} times the reference", flush=True)
    deep = [disparities[name] for name in disparities if "deep" in name]
    if len(deep) == 2:
        print(f"ganet deep, bfloat16 against float32: {(deep[0] - deep[1]).abs().mean():.4f} px on average")


if __name__ == "__main__":
    report(sys.argv[1:] or list(CASES))
