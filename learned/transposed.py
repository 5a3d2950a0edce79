"""Transposed convolutions that double the resolution, as ordinary convolutions: faster on a CPU, the same parameters.

Output 2 y + phase of stride 2, padding 1 is the sum over taps k of ``weight[k] input[(2 y + phase + 1 - k) / 2]``.
"""

from __future__ import annotations

from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# For each phase the taps in the order of the input. A kernel of three gives an odd size, 2 n - 1.
_TAPS = {3: ((1,), (2, 0)), 4: ((3, 1), (2, 0))}


class DoublingConvolution2d(nn.ConvTranspose2d):
    """``nn.ConvTranspose2d`` of stride 2 and padding 1 with a kernel of 4, for few outputs.

    One convolution with a kernel of 3 gives all four phases as channels.
    """

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__(inputs, outputs, 4, stride=2, padding=1, bias=bias)

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        # the even phase sees the pixel before and its own, the odd one its own and the next; tap 4 is a zero
        taps = torch.tensor([3, 1, 4, 4, 2, 0], device=self.weight.device)
        weight = F.pad(self.weight, (0, 1, 0, 1)).index_select(2, taps).index_select(3, taps)
        weight = weight.unflatten(3, (2, 3)).unflatten(2, (2, 3)).permute(1, 2, 4, 0, 3, 5).flatten(0, 2)
        bias = None if self.bias is None else self.bias.repeat_interleave(4)
        return F.pixel_shuffle(F.conv2d(x, weight, bias, padding=1), 2)


class DoublingConvolution3d(nn.ConvTranspose3d):
    """``nn.ConvTranspose3d`` of stride 2 and padding 1 with a kernel of 3 x 4 x 4: (D, H, W) to (2 D - 1, 2 H, 2 W).

    Each of the eight phases is a small convolution with its share of the taps: nothing is multiplied with the zeros
    between the pixels.
    """

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__(inputs, outputs, (3, 4, 4), stride=2, padding=1, bias=bias)

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        batch, _, depth, height, width = x.shape
        # below this torch takes its own loops for a float32 convolution on a CPU, not oneDNN's
        small = batch == 1 and x[..., 0].numel() <= 20480
        if small and not (x.dtype == torch.bfloat16 or torch.is_autocast_enabled(x.device.type)):
            return super().forward(x)
        out: Tensor | None = None
        for a, b, c in product((0, 1), repeat=3):
            weight = self.weight.transpose(0, 1)
            for axis, taps in ((2, _TAPS[3][a]), (3, _TAPS[4][b]), (4, _TAPS[4][c])):
                weight = weight.index_select(axis, torch.tensor(taps, device=weight.device))
            # a border on both sides is one too many for two taps: the phase says which result to drop
            phase = F.conv3d(x, weight, self.bias, padding=(0, 1, 1))[:, :, :, b : b + height, c : c + width]
            if out is None:
                out = torch.empty((batch, phase.shape[1], 2 * depth - 1, 2 * height, 2 * width), dtype=phase.dtype,
                                  device=x.device, memory_format=torch.channels_last_3d)
            out[:, :, a::2, b::2, c::2] = phase
        assert out is not None
        return out
