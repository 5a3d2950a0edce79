"""Work on several threads: every task once, results in order, and torch's threads as they were."""

import numpy as np
import pytest
import torch

from learned.threads import over_tasks, side_by_side


@pytest.fixture(params=[1, 2, 5])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 3, 1000])
def test_every_task_is_done_once(threads, count):
    done = np.zeros(count, int)

    def kernel(first, last, amount):
        for task in range(first, last):
            done[task] += amount

    over_tasks(kernel, count, 3)
    assert (done == 3).all()


def test_an_error_in_a_task_arrives(threads):
    def kernel(first, last):
        if last == 40:
            raise ValueError("the last range")

    with pytest.raises(ValueError, match="the last range"):
        over_tasks(kernel, 40)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_side_by_side_keeps_the_order_the_mode_and_the_number_of_threads(threads, mode):
    def task(number):
        return number, torch.get_num_threads(), torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    with mode():
        results = side_by_side(*(lambda number=number: task(number) for number in range(4)))
    share = max(1, threads // 4)
    assert results == [(number, share, False, mode is torch.inference_mode) for number in range(4)]
    assert torch.get_num_threads() == threads


def test_an_error_side_by_side_arrives_and_the_number_of_threads_stays(threads):
    def fails():
        raise ValueError("in a thread")

    with pytest.raises(ValueError, match="in a thread"), torch.no_grad():
        side_by_side(lambda: 1, fails)
    assert torch.get_num_threads() == threads


def test_side_by_side_takes_the_callers_precision_and_refuses_graphs():
    def task():
        return torch.ones(2, 2) @ torch.ones(2, 2)

    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        assert [result.dtype for result in side_by_side(task, task)] == [torch.bfloat16] * 2
    with pytest.raises(ValueError, match="no graph is built"):
        side_by_side(task, task)
