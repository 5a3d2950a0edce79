"""SGA and LGA: the kernels against the plain torch versions, and those against numeric derivatives."""

import pytest
import torch

from learned.guided_aggregation import (
    local_aggregation,
    local_aggregation_reference,
    semi_global_aggregation,
    semi_global_aggregation_reference,
)

SGA = (semi_global_aggregation, semi_global_aggregation_reference)
LGA = (local_aggregation, local_aggregation_reference)


def _inputs(operator, batch, channels, depth, height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    volume = (batch, channels, depth, height, width) if operator is SGA else (batch, depth, height, width)
    guides = 20 * channels if operator is SGA else 75
    return torch.randn(volume, generator=generator), torch.randn((batch, guides, height, width), generator=generator)


def _with_gradients(function, cost, guidance, dtype):
    cost, guidance = cost.to(dtype, copy=True).requires_grad_(), guidance.to(dtype, copy=True).requires_grad_()
    out = function(cost, guidance)
    seed = torch.randn(out.shape, generator=torch.Generator().manual_seed(9)).to(dtype)
    return out, *torch.autograd.grad(out, (cost, guidance), seed)


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
@pytest.mark.parametrize("shape", [(2, 3, 7, 11, 13), (1, 33, 3, 5, 4), (1, 70, 2, 3, 5), (1, 1, 1, 2, 1),
                                   (1, 2, 2, 1, 3)])
def test_kernels_equal_the_reference_forward_and_backward(operator, shape):
    inputs = _inputs(operator, *shape)
    fast = _with_gradients(operator[0], *inputs, torch.float32)
    plain = _with_gradients(operator[1], *inputs, torch.float64)
    for ours, theirs in zip(fast, plain, strict=True):
        assert ours.shape == theirs.shape
        # at a single pixel normalised weights leave signs alone: the true gradient is zero, float32's is rounding
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
def test_the_reference_has_the_derivative_that_differences_show(operator):
    cost, guidance = (t.double().requires_grad_() for t in _inputs(operator, 1, 2, 3, 4, 3, seed=2))
    assert torch.autograd.gradcheck(operator[1], (cost, guidance), fast_mode=True)


def test_sga_first_pixel_is_the_cost_and_the_second_follows_the_formula():
    """One channel, one row of two pixels: the recursion to the right, by hand."""
    cost = torch.tensor([[1.0, 5.0], [2.0, 7.0], [3.0, 6.0]]).view(1, 1, 3, 1, 2)
    guidance = torch.zeros(1, 4, 5, 1, 1, 2)
    guidance[0, :, 0] = -1  # the other three directions: minus the cost, never the largest
    guidance[0, 2, :, 0, 0, 0] = torch.tensor([10.0, 0, 0, 0, 0])
    guidance[0, 2, :, 0, 0, 1] = torch.tensor([1.0, 2, 3, 4, 10])
    w = torch.tensor([1.0, 2, 3, 4, 10]) / 20
    a = [1.0, 2.0, 3.0]
    c = [5.0, 7.0, 6.0]
    expected = [w[0] * c[0] + w[1] * a[0] + w[2] * c[0] + w[3] * a[1] + w[4] * 3,
                w[0] * c[1] + w[1] * a[1] + w[2] * a[0] + w[3] * a[2] + w[4] * 3,
                w[0] * c[2] + w[1] * a[2] + w[2] * a[1] + w[3] * c[2] + w[4] * 3]
    out = semi_global_aggregation(cost, guidance.view(1, 20, 1, 2))
    torch.testing.assert_close(out[0, 0, :, 0, 0], torch.tensor(a))
    torch.testing.assert_close(out[0, 0, :, 0, 1], torch.stack(expected))


def test_lga_of_a_constant_volume_is_the_constant_times_the_signed_sum_of_weights():
    _, guidance = _inputs(LGA, 1, 1, 4, 6, 7)
    share = guidance.sum(1) / guidance.abs().sum(1)
    out = local_aggregation(torch.full((1, 4, 6, 7), 3.0), guidance, times=1)
    torch.testing.assert_close(out, (3 * share)[:, None].expand_as(out))


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
def test_results_have_the_same_bits_for_one_and_two_threads(operator):
    inputs = _inputs(operator, 1, 5, 6, 17, 23)
    threads = torch.get_num_threads()
    results = []
    for count in (1, 2):
        torch.set_num_threads(count)
        try:
            results.append(_with_gradients(operator[0], *inputs, torch.float32))
        finally:
            torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_sga_of_bfloat16_is_that_of_the_same_numbers_in_float32_rounded_once():
    cost, guidance = (maps.bfloat16() for maps in _inputs(SGA, 2, 5, 6, 7, 9))
    in_half, in_full = semi_global_aggregation(cost, guidance), semi_global_aggregation(cost.float(), guidance.float())
    assert in_half.dtype == torch.bfloat16
    assert torch.equal(in_half, in_full.bfloat16())
    # with a graph to build, the kernels work on float32 copies
    assert torch.equal(semi_global_aggregation(cost.requires_grad_(), guidance), in_half)


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
def test_memory_layout_does_not_matter_and_inputs_stay(operator):
    cost, guidance = _inputs(operator, 2, 3, 4, 5, 6)
    before = cost.clone(), guidance.clone()
    inside_out = cost.transpose(-1, -2).contiguous().transpose(-1, -2)
    channels_last = guidance.to(memory_format=torch.channels_last)
    assert torch.equal(operator[0](cost, guidance), operator[0](inside_out, channels_last))
    assert torch.equal(cost, before[0])
    assert torch.equal(guidance, before[1])


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
def test_bfloat16_costs_a_rounding_only(operator):
    cost, guidance = _inputs(operator, 1, 3, 4, 5, 6)
    rounded = operator[0](cost.bfloat16(), guidance.bfloat16())
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), operator[0](cost.bfloat16().float(), guidance.bfloat16().float()),
                               rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("operator", [SGA, LGA], ids=["sga", "lga"])
def test_guidance_of_another_size_is_refused(operator):
    cost, guidance = _inputs(operator, 1, 3, 4, 5, 6)
    with pytest.raises(ValueError, match="does not fit"):
        operator[0](cost, guidance[:, 1:])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_sga_then_scaled_shifted_and_rectified(dtype):
    cost, guidance = (maps.to(dtype) for maps in _inputs(SGA, 2, 5, 6, 7, 9))
    scale, shift = torch.linspace(-1, 2, 5), torch.linspace(0.5, -0.5, 5)
    plain = semi_global_aggregation(cost, guidance) * scale.view(-1, 1, 1, 1) + shift.view(-1, 1, 1, 1)
    with torch.no_grad():
        fused = semi_global_aggregation(cost, guidance, (scale, shift))
    assert fused.dtype == dtype
    tolerance = {"rtol": 1e-2, "atol": 1e-2} if dtype == torch.bfloat16 else {}
    torch.testing.assert_close(fused, plain.relu().to(dtype), **tolerance)
    with torch.enable_grad():
        torch.testing.assert_close(semi_global_aggregation(cost, guidance, (scale, shift)), fused, **tolerance)


@torch.no_grad()
def test_lga_takes_strips_and_bands_of_any_size():
    """More columns and rows than a task of the kernel has."""
    cost, guidance = _inputs(LGA, 1, 1, 4, 35, 67)
    torch.testing.assert_close(local_aggregation(cost, guidance), local_aggregation_reference(cost, guidance))
