"""Correlations and warping: kernels against plain torch, and the conventions pinned by moving an image."""

import pytest
import torch

from learned.correlation import (
    correlation,
    correlation_reference,
    disparity_correlation,
)
from learned.cosine_costs import cosine_costs
from learned.warp import warp


def _features(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("shape", "radius"), [((2, 5, 7, 11), 4), ((1, 3, 2, 3), 4), ((1, 4, 9, 6), 1)])
def test_correlation_kernels_equal_the_reference(shape, radius):
    first, second = (_features(*shape, seed=s).requires_grad_() for s in (0, 1))
    fast, plain = correlation(first, second, radius), correlation_reference(first, second, radius)
    torch.testing.assert_close(fast, plain)
    seed = _features(*fast.shape, seed=2)
    for ours, theirs in zip(torch.autograd.grad(fast, (first, second), seed),
                            torch.autograd.grad(plain, (first, second), seed), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_correlation_peaks_at_the_displacement_with_x_innermost():
    first = _features(1, 64, 12, 14)
    second = first.roll((2, -3), (2, 3))  # first(x, y) is at second(x - 3, y + 2)
    volume = correlation(first, second)[0, :, 6, 7]
    assert volume.argmax() == (2 + 4) * 9 + (-3 + 4)


@pytest.mark.parametrize("groups", [1, 4])
@pytest.mark.parametrize("width", [13, 3])
def test_disparity_correlation_kernel_equals_autograd_in_double(groups, width):
    left, right = (_features(2, 8, 5, width, seed=s).requires_grad_() for s in (0, 1))
    fast = disparity_correlation(left, right, 6, groups)
    double = [t.detach().double().requires_grad_() for t in (left, right)]
    plain = disparity_correlation(*double, 6, groups)
    torch.testing.assert_close(fast.double(), plain, rtol=1e-5, atol=1e-6)
    seed = _features(*fast.shape, seed=2)
    for ours, theirs in zip(torch.autograd.grad(fast, (left, right), seed),
                            torch.autograd.grad(plain, double, seed.double()), strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-4, atol=1e-5)


def test_disparity_correlation_is_one_at_the_disparity_and_zero_left_of_it():
    left = _features(1, 8, 4, 20)
    right = left.roll(-3, 3)  # left(x) is at right(x - 3)
    volume = disparity_correlation(left, right, 6, groups=2)
    torch.testing.assert_close(volume[:, :, 3, :, 3:], torch.ones(1, 2, 4, 17))
    assert (volume[:, :, 5, :, :5] == 0).all()


@pytest.mark.parametrize(("u", "v"), [(2, 0), (0, -1), (-3, 2)])
def test_warp_looks_up_where_the_motion_points(u, v):
    source = _features(1, 2, 9, 12)
    flow = torch.tensor([u, v], dtype=torch.float32).view(1, 2, 1, 1).expand(1, 2, 9, 12)
    warped = warp(source, flow)
    for y in range(9):
        for x in range(12):
            inside = 0 <= x + u < 12 and 0 <= y + v < 9
            expected = source[0, :, y + v, x + u] if inside else torch.zeros(2)
            torch.testing.assert_close(warped[0, :, y, x], expected, rtol=1e-4, atol=1e-4)


def test_warp_drops_what_touches_the_outside():
    flow = torch.zeros(1, 2, 4, 5)
    flow[:, 0] = 0.01
    warped = warp(torch.ones(1, 1, 4, 5), flow)
    assert (warped[..., -1] == 0).all()
    torch.testing.assert_close(warped[..., :-1], torch.ones(1, 1, 4, 4))


def test_warp_differentiates():
    source, flow = _features(1, 2, 4, 5).double().requires_grad_(), 0.3 * _features(1, 2, 4, 5, seed=3).double() + 0.1
    assert torch.autograd.gradcheck(lambda s, f: warp(s, f)[..., 1:-1, 1:-1], (source, flow.requires_grad_()))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        correlation(_features(1, 2, 4, 5), _features(1, 2, 4, 6))
    with pytest.raises(ValueError, match="3 groups"):
        disparity_correlation(_features(1, 8, 4, 5), _features(1, 8, 4, 5), 4, groups=3)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 0.01)])
@pytest.mark.parametrize(("shape", "radius"), [((2, 5, 7, 11), 4), ((1, 8, 9, 6), 1)])
def test_the_cosine_kernels_do_what_is_written_plainly(shape, radius, dtype, tolerance, moves):
    """With motion that crosses the border, and leads far outside."""
    first, second = (_features(*shape, seed=s).to(dtype, memory_format=torch.channels_last) for s in (0, 1))
    flow = 3 * _features(shape[0], 2, *shape[2:], seed=2) if moves else None
    plain = cosine_costs(first, second, flow, radius)
    with torch.no_grad():
        fast = cosine_costs(first, second, flow, radius)
        assert not torch.allclose(cosine_costs(second, first, flow, radius), plain, atol=0.1)
    assert fast.dtype == dtype
    assert fast.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(fast, plain, rtol=0, atol=tolerance)


@torch.no_grad()
def test_cosines_of_features_that_nothing_matches_are_zero():
    features, flow = _features(1, 4, 5, 6), torch.zeros(1, 2, 5, 6)
    flow[0, :, 2, 3] = torch.tensor([torch.nan, 1.0])
    flow[0, 0, 1, 4] = 1e9
    costs = cosine_costs(features, features, flow, 0)[0, 0]
    assert costs[2, 3] == costs[1, 4] == 0
    torch.testing.assert_close(costs.sum(), torch.tensor(28.0))
