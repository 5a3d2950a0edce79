"""Doubling convolutions against torch's transposed ones, which have the same parameters."""

import pytest
import torch
import torch.nn.functional as F

from learned.transposed import DoublingConvolution2d, DoublingConvolution3d

CASES = [(DoublingConvolution2d, F.conv_transpose2d, (2, 5, 4, 7)),
         (DoublingConvolution3d, F.conv_transpose3d, (2, 5, 3, 4, 7)),
         (DoublingConvolution3d, F.conv_transpose3d, (1, 5, 1, 4, 2))]


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("layer", "function", "shape"), CASES)
def test_equals_the_transposed_convolution_forward_and_backward(layer, function, shape, bias):
    torch.manual_seed(1)
    net = layer(5, 3, bias=bias).double()
    x = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    ours, theirs = net(x), function(x, net.weight, net.bias, stride=2, padding=1)
    torch.testing.assert_close(ours, theirs)
    seed = torch.randn(theirs.shape, dtype=torch.float64)
    inputs = (x, *net.parameters())
    for a, b in zip(torch.autograd.grad(ours, inputs, seed), torch.autograd.grad(theirs, inputs, seed), strict=True):
        torch.testing.assert_close(a, b)


@torch.no_grad()
@pytest.mark.parametrize("channels", [2, 64])
def test_large_and_small_volumes_in_float32(channels):
    """Whichever way a size takes."""
    torch.manual_seed(2)
    net, x = DoublingConvolution3d(channels, 3), torch.randn(1, channels, 9, 40, 3)
    torch.testing.assert_close(net(x), F.conv_transpose3d(x, net.weight, net.bias, 2, 1), rtol=1e-4, atol=1e-4)
    with torch.autocast("cpu", torch.bfloat16):
        assert net(x).dtype == torch.bfloat16
