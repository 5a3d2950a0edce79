"""Configurations, sizes and gradients of GA-Net and PWC-Net; that they compute the published: test_published.py."""

import math
from dataclasses import replace

import pytest
import torch

from learned import ganet, pwcnet
from learned.feedforward import FeedforwardModule, fold_normalisation, select_device
from learned.ganet import GANet, GANetConfig, convex_upsampling
from learned.losses import disparity_loss, multiscale_motion_loss
from learned.pwcnet import PWCNet, PWCNetConfig

SMALL_DISPARITY = replace(ganet.COMPACT, max_disparity=64)
SMALL_MOTION = PWCNetConfig(pyramid=(8, 16, 16), decoder=(16, 8), context=((8, 1), (8, 2)), cosine=True, residual=True)


def _images(height, width, batch=1, seed=0):
    return torch.rand((4, batch, 3, height, width), generator=torch.Generator().manual_seed(seed)).unbind()


def _seeded(build, config):
    torch.manual_seed(3)
    return build(config)


@pytest.mark.parametrize(("height", "width"), [(64, 96), (61, 75), (33, 130)])
@torch.no_grad()
def test_any_size_goes_in_and_comes_out(height, width):
    first, second, *_ = _images(height, width)
    assert _seeded(GANet, SMALL_DISPARITY).eval()(first, second).shape == (1, height, width)
    assert _seeded(PWCNet, SMALL_MOTION).eval()(first, second).shape == (1, 3, height, width)


@torch.no_grad()
def test_both_ways_are_two_passes():
    first, second, *_ = _images(61, 75, batch=2)
    net = _seeded(PWCNet, SMALL_MOTION).eval()
    forward, backward = net.both_ways(first, second)
    torch.testing.assert_close(forward, net(first, second), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(backward, net(second, first), rtol=1e-4, atol=1e-4)
    assert not torch.allclose(forward, backward, atol=0.01)
    with torch.enable_grad():  # both as one batch, in place of side by side
        for one, other in zip(net.both_ways(first, second), (forward, backward), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_padding_does_not_move_the_image():
    """What lies far from the added border is what an unpadded image gives."""
    net = _seeded(PWCNet, SMALL_MOTION).eval()
    first, second, *_ = _images(160, 160)
    full, cropped = net(first, second), net(first[..., :157, :155], second[..., :157, :155])
    torch.testing.assert_close(cropped[..., :60, :60], full[..., :60, :60], rtol=0.05, atol=0.05)


@pytest.mark.parametrize("max_disparity", [0, 50, -12])
def test_disparities_that_the_architecture_does_not_admit_are_refused(max_disparity):
    with pytest.raises(ValueError, match="positive multiple of 12"):
        GANetConfig(max_disparity=max_disparity)


def test_sizes_for_training_must_fit():
    first, second, *_ = _images(60, 96)
    with pytest.raises(ValueError, match="multiples of 32"):
        _seeded(GANet, SMALL_DISPARITY).estimate(first, second)
    with pytest.raises(ValueError, match="multiples of 8"):
        _seeded(PWCNet, SMALL_MOTION).estimate(first, second)


@pytest.mark.parametrize("published_head", [False, True])
def test_every_parameter_of_ganet_learns(published_head):
    config = replace(SMALL_DISPARITY, unets=2, hourglasses=2, aggregated_levels=(0, 1), max_disparity=32,
                     full_resolution_head=published_head)
    net = _seeded(GANet, config).train()
    first, second, *_ = _images(64, 64)
    heads = net.estimate(first, second)
    assert [h.shape for h in heads] == [(1, 64, 64)] * 3
    disparity_loss(heads, torch.full((1, 64, 64), 7.0), 32).backward()
    still = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert not still
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


def test_every_parameter_of_pwcnet_learns():
    net = _seeded(PWCNet, SMALL_MOTION).train()
    first, second, *_ = _images(32, 48)
    truth = torch.ones(1, 3, 32, 48)
    multiscale_motion_loss(net.estimate(first, second), truth).backward()
    assert not [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


def test_gradients_stay_finite_where_warping_looks_outside():
    net = _seeded(PWCNet, SMALL_MOTION).train()
    for decoder in net.decoders:
        torch.nn.init.constant_(decoder.predict.bias, 1e3)
    first, second, *_ = _images(32, 48)
    net.estimate(first, second)[-1].sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


def test_motion_loss_ignores_what_is_unknown():
    generator = torch.Generator().manual_seed(5)
    estimates = [torch.randn(1, 3, 4, 6, generator=generator), torch.randn(1, 3, 8, 12, generator=generator)]
    truth = 20 * torch.randn(1, 3, 32, 48, generator=generator)
    partly = truth.clone()
    partly[..., :8] = torch.nan
    other = truth.clone()
    other[..., :8] = 1e6
    loss = multiscale_motion_loss([e[..., e.shape[-1] // 6 :] for e in estimates], truth[..., 8:])
    torch.testing.assert_close(multiscale_motion_loss(estimates, partly), loss, rtol=1e-4, atol=1e-4)
    assert multiscale_motion_loss(estimates, other) > 10 * loss
    assert multiscale_motion_loss(estimates, torch.full_like(truth, torch.nan)) < 1e-3


def test_robust_losses_of_the_networks():
    off = torch.tensor([3.0, 0, 4]).view(1, 3, 1, 1) / pwcnet.MOTION_UNIT_PX  # 5 px
    weight = multiscale_motion_loss([off], torch.zeros(1, 3, 1, 1)) * pwcnet.MOTION_UNIT_PX / 5
    robust = multiscale_motion_loss([off], torch.zeros(1, 3, 1, 1), robust_px=2)
    torch.testing.assert_close(robust, weight * 2 * math.log(3.5) / pwcnet.MOTION_UNIT_PX)
    estimate, truth = torch.full((1, 1, 2), 2.0), torch.tensor([[[2.0, 5.0]]])  # smooth L1: 0, 2.5
    torch.testing.assert_close(disparity_loss([estimate], truth, 192, robust_px=2), torch.tensor(math.log(2.25)))


def test_disparity_loss_ignores_what_is_unknown_or_out_of_range():
    estimate, truth = torch.full((1, 4, 4), 2.0), torch.full((1, 4, 4), 5.0)
    truth[0, 0, 0], truth[0, 0, 1] = torch.nan, 300
    torch.testing.assert_close(disparity_loss([estimate], truth, 192), torch.tensor(2.5))
    assert disparity_loss([estimate], torch.full_like(truth, torch.nan), 192) == 0


def test_convex_upsampling_keeps_planes_inside_their_neighbourhood():
    disparity = torch.arange(20.0).view(1, 4, 5)
    out = convex_upsampling(disparity, torch.randn(1, 9 * 4, 4, 5, generator=torch.Generator().manual_seed(0)), 2)
    assert out.shape == (1, 8, 10)
    assert out.min() >= 0
    assert out.max() <= 19
    sharp = torch.zeros(1, 9, 4, 4, 5)
    sharp[:, 4] = 100  # the centre
    torch.testing.assert_close(convex_upsampling(disparity, sharp.view(1, 36, 4, 5), 2)[:, ::2, ::2], disparity)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_upsampling_kernel_does_what_is_written_plainly(dtype):
    generator = torch.Generator().manual_seed(1)
    disparity = 50 * torch.rand(2, 5, 7, generator=generator)
    guidance = (9 * torch.randn(2, 9 * 16, 5, 7, generator=generator)).to(dtype)
    plain = convex_upsampling(disparity, guidance, 4)
    for layout in (torch.contiguous_format, torch.channels_last):
        with torch.no_grad():
            torch.testing.assert_close(convex_upsampling(disparity, guidance.contiguous(memory_format=layout), 4), plain)


@torch.no_grad()
def test_folded_normalisation_changes_nothing():
    net = _seeded(GANet, SMALL_DISPARITY)
    generator = torch.Generator().manual_seed(2)
    for name, buffer in net.named_buffers():
        if name.endswith(("running_mean", "running_var")):
            buffer.copy_(0.5 + torch.rand(buffer.shape, generator=generator))
    first, second, *_ = _images(64, 64)
    before = net.eval()(first, second)
    torch.testing.assert_close(fold_normalisation(net)(first, second), before, rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="evaluation mode"):
        fold_normalisation(net.train())


def _brightness(first, second):
    """A dummy: any callable of two images will do."""
    return (first - second).mean(1)


def test_feedforward_takes_any_networks_and_orders_the_state():
    def motion(first, second):
        return torch.stack([_brightness(first, second) + k for k in (10, 20, 30)], 1)

    left1, right1, left2, right2 = _images(5, 7, batch=2)
    state, backward = FeedforwardModule(_brightness, motion)(left1, right1, left2, right2)
    forward = _brightness(left1, left2)
    expected = (_brightness(left1, right1), _brightness(left2, right2), forward + 30, forward + 10, forward + 20)
    torch.testing.assert_close(state, torch.stack(expected, 1))
    torch.testing.assert_close(backward, torch.stack([10 - forward, 20 - forward], 1))


def test_feedforward_refuses_networks_that_break_the_protocol():
    images = _images(5, 7)
    with pytest.raises(ValueError, match="must return motion"):
        FeedforwardModule(_brightness, lambda a, b: a[:, :2] - b[:, :2])(*images)


@torch.no_grad()
def test_bfloat16_stays_near_float32():
    net = FeedforwardModule(_seeded(GANet, SMALL_DISPARITY).eval(), _seeded(PWCNet, SMALL_MOTION).eval())
    images = _images(64, 96)
    exact, _ = net(*images)
    net.precision = "bfloat16"
    rounded, _ = net(*images)
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    assert (rounded - exact).abs().mean() < 0.05 * exact.abs().mean()


def test_a_device_that_is_missing_is_named():
    assert select_device("cpu") == torch.device("cpu")
    missing = next(name for name in ("mps", "cuda", "xpu") if not getattr(torch, name).is_available())
    with pytest.raises(ValueError, match=f"device '{missing}' is not available here; available: cpu"):
        select_device(missing)
    with pytest.raises(ValueError, match="'toaster' is not available"):
        select_device("toaster")


def test_the_finest_level_must_exist():
    with pytest.raises(ValueError, match="finest level 3"):
        PWCNetConfig(pyramid=(8, 16, 16), finest=3)


def test_compact_networks_are_the_same_code_with_fewer_parameters():
    sizes = {c: sum(p.numel() for p in net.parameters())
             for c, net in (("compact", GANet(ganet.COMPACT)), ("deep", GANet()))}
    assert sizes["compact"] < sizes["deep"] / 2
    assert sum(p.numel() for p in PWCNet(pwcnet.COMPACT).parameters()) < 3e6
