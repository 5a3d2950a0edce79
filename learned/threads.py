"""Work of our own on several threads: kernels over ranges of tasks, and whole networks side by side.

``torch.set_num_threads`` bounds both. Numba's own parallel loops are not used: their pool may be called from one thread at
a time only, and it changes the number of torch's threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

import torch

# Ranges a thread: whoever is held up by another process leaves its next ones to the others.
_RANGES = 4


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """The helpers beside the calling thread. None ever waits for another: ranges are not cut into ranges."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


def over_tasks(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """``kernel(first, last, *arguments)`` on ranges of the tasks ``0 ... count - 1``; `last` is excluded.

    No two tasks write to the same place, and none depends on its range: results are the same for any number of threads.
    """
    threads = min(torch.get_num_threads(), count)
    pieces = min(count, threads * _RANGES) if threads > 1 else 1
    ranges = iter(list(pairwise([count * piece // pieces for piece in range(pieces + 1)])))
    helpers = [_pool().submit(_work, kernel, ranges, arguments) for _ in range(threads - 1)]
    _work(kernel, ranges, arguments)
    for helper in helpers:
        if not helper.cancel():  # one that has not begun would find nothing left
            helper.result()


def _work(kernel: Callable[..., None], ranges: Iterator[tuple[int, int]], arguments: tuple[Any, ...]) -> None:
    for first, last in ranges:  # one iterator for all threads: each takes the next range
        kernel(first, last, *arguments)


def side_by_side(*tasks: Callable[[], Any]) -> list[Any]:
    """Results of functions that do not depend on one another, run at the same time, torch's threads shared out among them.

    For inference on the CPU: no graphs are built; autocast is the caller's. Small layers hardly gain from a second thread,
    and each of a layer's threads waits for the last one, whatever holds that up; whole networks do not.
    """
    threads = torch.get_num_threads()
    if torch.is_grad_enabled():
        raise ValueError("side by side no graph is built: enter torch.no_grad() or torch.inference_mode()")
    if threads == 1 or not torch.backends.openmp.is_available():  # other pools cannot be shared out
        return [task() for task in tasks]
    mode = torch.inference_mode if torch.is_inference_mode_enabled() else torch.no_grad
    autocast, dtype = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")

    def run(task: Callable[[], Any]) -> Any:
        torch.set_num_threads(max(1, threads // len(tasks)))
        with mode(), torch.autocast("cpu", dtype, enabled=autocast):
            return task()

    try:
        with ThreadPoolExecutor(min(threads, len(tasks)), "networks") as pool:
            return list(pool.map(run, tasks))
    finally:
        torch.set_num_threads(threads)  # what a thread sets is every later thread's beginning
