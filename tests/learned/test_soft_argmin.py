"""Enlargement, softmin and expectation against what torch has for them."""

import pytest
import torch
import torch.nn.functional as F

from learned.soft_argmin import enlarged, expectation, softmin


@pytest.fixture
def volume():
    return 5 * torch.randn((2, 5, 4, 6), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("size", [(13, 12, 18), (5, 4, 6), (7, 9, 20)])
def test_enlarged_as_torch_does(volume, size):
    plain = F.interpolate(volume[:, None], size, mode="trilinear", align_corners=False)[:, 0]
    torch.testing.assert_close(enlarged(volume, size), plain)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(enlarged(volume, size), plain)


def test_softmin_is_over_disparities(volume):
    torch.testing.assert_close(softmin(volume), F.softmin(volume, 1))


def test_expectation_in_mixed_precision_is_no_multiple_of_bfloat16s_steps():
    probability = torch.rand((2, 150, 3, 4), generator=torch.Generator().manual_seed(4)).softmax(1)
    with torch.autocast("cpu", torch.bfloat16):
        mean = expectation(probability)
    torch.testing.assert_close(mean, (probability * torch.arange(150.0)[:, None, None]).sum(1))
