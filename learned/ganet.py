"""GA-Net: disparity by a concatenation or correlation volume, guided aggregation and soft-argmin.

Zhang, Prisacariu, Yang, Torr: GA-Net, CVPR 2019 (arXiv:1904.06587), the deep model. Stacked U-Nets, hourglasses and
aggregation blocks are loops over the configuration. Weights of the authors load through ``learned.checkpoint``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, zip_longest
from math import prod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.bfloat16 import to_array
from learned.correlation import disparity_correlation
from learned.guided_aggregation import local_aggregation, semi_global_aggregation
from learned.soft_argmin import enlarged, expectation, softmin
from learned.threads import over_tasks
from learned.transposed import DoublingConvolution3d
from learned.upsampling_kernels import convex_upsampling as upsampling_kernel


@dataclass(frozen=True)
class GANetConfig:
    """Sizes of a GA-Net; the defaults are the published deep model."""

    normalised_input: bool = True
    """Images are turned to RGB and to zero mean and unit deviation, each channel of each image, as the authors do; if
    False they enter as they are."""
    max_disparity: int = 192
    """Largest disparity in pixels; a multiple of the volume's reduction."""
    stem: tuple[tuple[int, int, int], ...] = ((32, 3, 1), (32, 5, 3), (32, 3, 1))
    """(channels, kernel, stride) of the first convolutions; the product of the strides is the volume's reduction."""
    features: tuple[int, ...] = (48, 64, 96, 128)
    """Channels of the feature U-Nets, each at half the resolution of the one before; the stem's are the top."""
    unets: int = 2
    """Stacked feature U-Nets."""
    correlation_groups: int = 0
    """0: the volume concatenates both images' features; otherwise their cosine in this many groups of channels."""
    volume: tuple[int, ...] = (32, 48, 64)
    """Channels of the 3D hourglasses, each level at half the resolution."""
    hourglasses: int = 2
    """Stacked 3D hourglasses; each has a disparity head, and one more comes before the first."""
    aggregated_levels: tuple[int, ...] = (0, 1)
    """Hourglass levels with semi-global aggregation blocks (never the coarsest)."""
    guidance_stem: int = 16
    """Channels of the guidance subnet's full-resolution layers."""
    full_resolution_head: bool = True
    """Softmin and local aggregation on the upsampled volume, guided at full resolution. If False, both happen at the
    volume's resolution and the disparity is upsampled by learned convex weights: a hundredth of the time."""

    def __post_init__(self) -> None:
        step = self.reduction * 2 ** (len(self.volume) - 1)
        if self.max_disparity < step or self.max_disparity % step:
            raise ValueError(f"max_disparity must be a positive multiple of {step}, not {self.max_disparity}")
        if self.correlation_groups and self.stem[-1][0] % self.correlation_groups:
            raise ValueError(f"correlation_groups must divide the {self.stem[-1][0]} feature channels")

    @property
    def reduction(self) -> int:
        """Image pixels per pixel of the volume."""
        return prod(stride for _, _, stride in self.stem)

    @property
    def cells(self) -> int:
        """Sides of an image must be multiples of this; ``GANet`` pads them."""
        return self.reduction * 2 ** max(len(self.features), len(self.volume) - 1)

    @property
    def blocks(self) -> dict[int, int]:
        """Semi-global blocks on each aggregated level: two an hourglass, at the top one before the first."""
        return {level: 2 * self.hourglasses if level else self.hourglasses + 1 for level in self.aggregated_levels}


#: For a CPU: a correlation volume at 1/8, one hourglass, aggregation at its top level, learned upsampling.
COMPACT = GANetConfig(stem=((16, 3, 2), (32, 3, 2), (48, 3, 2), (48, 3, 1)), features=(64, 96), unets=1,
                      correlation_groups=16, volume=(32, 48, 64), hourglasses=1, aggregated_levels=(0,),
                      full_resolution_head=False)


class GANet(nn.Module):
    """Disparity of the left image.

    Images are (B, 3, H, W) in [0, 1], BGR, of any size: they are padded at the top and on the right by repeating the
    border, and the result is cropped back.
    """

    def __init__(self, config: GANetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or GANetConfig()
        top = config.stem[-1][0]
        self.features = _Features(config)
        self.to_left, self.to_right = _convolution(top, top), _convolution(top, top)
        self.guidance = _Guidance(config)
        self.aggregation = _Aggregation(config)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Conv3d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    @property
    def light(self) -> bool:
        """Whether a pass takes so little memory that two may run side by side."""
        return not self.config.full_resolution_head

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Disparity (B, H, W) in pixels, float32: left(x, y) matches right(x - disparity, y)."""
        height, width = left.shape[-2:]
        padded = [self._pad(self._normalised(image)) for image in (left, right)]
        return self._estimate(*padded)[-1][:, -height:, :width]

    def estimate(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """Disparity (B, H, W) of every head in training, of the last one only in evaluation.

        The sides must be multiples of ``config.cells``.
        """
        if left.shape[-2] % self.config.cells or left.shape[-1] % self.config.cells:
            raise ValueError(f"image sides must be multiples of {self.config.cells}, not {tuple(left.shape[-2:])}")
        return self._estimate(self._normalised(left), self._normalised(right))

    def _normalised(self, image: Tensor) -> Tensor:
        if self.config.normalised_input:
            centred = image - image.mean((-2, -1), keepdim=True)
            deviation = centred.square().mean((-2, -1), keepdim=True).clamp(min=1e-12).sqrt()
            image = (centred / deviation).flip(1)
        return image

    def _estimate(self, left: Tensor, right: Tensor) -> list[Tensor]:
        # channels innermost: twice as fast on a CPU, four times in bfloat16
        left, right = (image.contiguous(memory_format=torch.channels_last) for image in (left, right))
        if self.training:  # as the authors do: batch statistics do not mix left and right
            left_features, right_features = self.features(left), self.features(right)
        else:
            left_features, right_features = self.features(torch.cat([left, right])).chunk(2)
        volume = self._volume(self.to_left(left_features), self.to_right(right_features))
        return self.aggregation(volume, self.guidance(left, left_features))

    def _volume(self, left: Tensor, right: Tensor) -> Tensor:
        disparities = self.config.max_disparity // self.config.reduction + 1
        if self.config.correlation_groups:
            volume = disparity_correlation(left, right, disparities, self.config.correlation_groups)
            return volume.contiguous(memory_format=torch.channels_last_3d)
        return concatenation_volume(left, right, disparities)

    def _pad(self, image: Tensor) -> Tensor:
        top, right = (-side % self.config.cells for side in image.shape[-2:])
        return F.pad(image, (0, right, top, 0), mode="replicate") if top or right else image


def concatenation_volume(left: Tensor, right: Tensor, disparities: int) -> Tensor:
    """(B, 2 C, D, H, W): left features over the right ones moved by each disparity, zero where x < disparity."""
    batch, channels, height, width = left.shape
    channels_last = left.is_contiguous(memory_format=torch.channels_last)
    layout = torch.channels_last_3d if channels_last else torch.contiguous_format
    volume = torch.empty((batch, 2 * channels, disparities, height, width), dtype=left.dtype, device=left.device,
                         memory_format=layout)
    for d in range(disparities):
        volume[:, :, d, :, : min(d, width)] = 0
        if d < width:
            volume[:, :channels, d, :, d:] = left[..., d:]
            volume[:, channels:, d, :, d:] = right[..., : width - d]
    return volume


class _Features(nn.Module):
    """Stem and stacked U-Nets; every skip connection of a U-Net is updated on the way down and up for the next one."""

    def __init__(self, config: GANetConfig) -> None:
        super().__init__()
        stem, previous = [], 3
        for channels, kernel, stride in config.stem:
            stem.append(_convolution(previous, channels, kernel, stride))
            previous = channels
        self.stem = nn.Sequential(*stem)
        widths = (previous, *config.features)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for unet in range(config.unets):
            pairs = list(pairwise(widths))
            self.down.append(nn.ModuleList(_convolution(a, b, 3, 2) if unet == 0 else _Join(a, b) for a, b in pairs))
            self.up.append(nn.ModuleList(_Join(b, a, up=True) for a, b in reversed(pairs)))

    def forward(self, image: Tensor) -> Tensor:
        x = self.stem(image)
        skips = [x]
        for unet, (down, up) in enumerate(zip(self.down, self.up, strict=True)):
            for level, layer in enumerate(_layers(down), start=1):
                if unet == 0:
                    x = layer(x)
                    skips.append(x)
                else:
                    x = skips[level] = layer(x, skips[level])
            for below, layer in enumerate(_layers(up), start=2):
                x = skips[-below] = layer(x, skips[-below])
        return x


class _Guidance(nn.Module):
    """From the left image and its features to the weights of every aggregation layer.

    Returns, for each hourglass level, the guidance of its blocks in the order of use, and then the head's: the weights
    of two local aggregations, or of one and of the convex upsampling.
    """

    def __init__(self, config: GANetConfig) -> None:
        super().__init__()
        self.config = config
        top, stem = config.stem[-1][0], config.guidance_stem
        if config.full_resolution_head:
            self.image = nn.Sequential(_convolution(3, stem), _convolution(stem, 2 * stem))
            self.feature = nn.Conv2d(top, top, 3, padding=1, bias=False)
            self.feature_norm = nn.BatchNorm2d(top)
            self.join = _convolution(2 * stem + top, stem)
            reduce = (_convolution(stem, top, 5, config.reduction), _convolution(top, top))
            self.head = nn.ModuleList(nn.Sequential(_convolution(stem, stem), _weights(stem, 75)) for _ in range(2))
        else:
            reduce = (_convolution(top, top), _convolution(top, top))
            outputs = (75, 9 * config.reduction**2)
            self.head = nn.ModuleList(nn.Sequential(_convolution(top, top), _weights(top, n)) for n in outputs)
        self.steps, self.weights = nn.ModuleList(), nn.ModuleList()
        previous = top
        for level in range(max(config.aggregated_levels, default=-1) + 1):
            # as wide as the volume it guides
            width = top if level == 0 else config.volume[level]
            steps = [nn.Sequential(*reduce) if level == 0 else
                     nn.Sequential(_convolution(previous, width, 3, 2), _convolution(width, width))]
            count = config.blocks.get(level, 0)
            steps += [_convolution(width, width) for _ in range(count - 1)]
            self.steps.append(nn.ModuleList(steps))
            self.weights.append(nn.ModuleList(_weights(width, 20 * config.volume[level]) for _ in range(count)))
            previous = width

    def forward(self, left: Tensor, features: Tensor) -> tuple[list[list[Tensor]], list[Tensor]]:
        x = features
        if self.config.full_resolution_head:
            upsampled = F.interpolate(self.feature(features), scale_factor=self.config.reduction, mode="bilinear",
                                      align_corners=False)
            x = self.join(torch.cat([self.image(left), F.relu(self.feature_norm(upsampled))], 1))
        head = [layer(x) for layer in self.head]
        levels = []
        for steps, weights in zip(self.steps, self.weights, strict=True):
            guidance: list[Tensor] = []
            # a level without aggregation blocks is only passed through
            for step, weight in zip_longest(_layers(steps), _layers(weights)):
                x = step(x)
                guidance += [weight(x)] if weight else []
            levels.append(guidance)
        return levels, head


class _Aggregation(nn.Module):
    """The 3D side: hourglasses with aggregation blocks, a disparity head before the first and after each."""

    def __init__(self, config: GANetConfig) -> None:
        super().__init__()
        self.config = config
        inputs = config.correlation_groups or 2 * config.stem[-1][0]
        self.start = _convolution(inputs, config.volume[0], dims=3, relu=False)
        pairs = list(pairwise(config.volume))
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for hourglass in range(config.hourglasses):
            self.down.append(nn.ModuleList(_convolution(a, b, 3, 2, dims=3) if hourglass == 0 else _Join(a, b, dims=3)
                                           for a, b in pairs))
            # the aggregation block that follows at the top adds before it rectifies
            self.up.append(nn.ModuleList(_Join(b, a, up=True, dims=3, relu=level > 0)
                                         for level, (a, b) in reversed(list(enumerate(pairs)))))
        self.blocks = nn.ModuleList(nn.ModuleList(_AggregationBlock(config.volume[level])
                                                  for _ in range(config.blocks.get(level, 0)))
                                    for level in range(len(config.volume)))
        self.heads = nn.ModuleList(nn.Conv3d(config.volume[0], 1, 3, padding=1, bias=False)
                                   for _ in range(config.hourglasses + 1))

    def forward(self, volume: Tensor, guidance: tuple[list[list[Tensor]], list[Tensor]]) -> list[Tensor]:
        levels, head = guidance
        turns = [iter(zip(_layers(blocks), weights, strict=True))
                 for blocks, weights in zip(self.blocks, levels, strict=False)]

        def aggregate(x: Tensor, level: int) -> Tensor:
            if level not in self.config.aggregated_levels:
                return F.relu(x)
            block, weights = next(turns[level])
            return block(x, weights)

        coarsest = len(self.config.volume) - 1
        x = aggregate(self.start(volume), 0)
        del volume  # the largest tensor of all
        skips, costs = [x], [self.heads[0](x)] if self.training else []
        for hourglass, (down, up) in enumerate(zip(self.down, self.up, strict=True)):
            for level, layer in enumerate(_layers(down), start=1):
                x = layer(x) if hourglass == 0 else layer(x, skips[level])
                x = aggregate(x, level) if level < coarsest else x
                skips[level:] = [x, *skips[level + 1 :]]
            for level, layer in zip(range(coarsest - 1, -1, -1), _layers(up), strict=True):
                x = skips[level] = aggregate(layer(x, skips[level]), level)
            # outside training only the last head is asked
            if self.training or hourglass == self.config.hourglasses - 1:
                costs.append(self.heads[hourglass + 1](x))
        return [*(self._disparity(cost, []) for cost in costs[:-1]), self._disparity(costs[-1], head)]

    def _disparity(self, cost: Tensor, guidance: list[Tensor]) -> Tensor:
        """(B, 1, D, h, w) to (B, H, W) in pixels; without guidance, as the heads on the way are, by plain softmin."""
        # bfloat16 ends here: it would leave the softmin eight bits
        cost = cost.squeeze(1).to(torch.promote_types(cost.dtype, torch.float32))
        reduction = self.config.reduction
        if self.config.full_resolution_head:
            cost = enlarged(cost, (self.config.max_disparity + 1, cost.shape[2] * reduction, cost.shape[3] * reduction))
            if not guidance:
                return expectation(softmin(cost))
            probability = local_aggregation(softmin(local_aggregation(cost, guidance[0])), guidance[1])
            return expectation(probability) / torch.linalg.vector_norm(probability, 1, dim=1).clamp(min=1e-12)
        if guidance:
            cost = local_aggregation(cost, guidance[0])
        disparity = expectation(softmin(cost)) * reduction
        if guidance:
            return convex_upsampling(disparity, guidance[1], reduction)
        return F.interpolate(disparity[:, None], scale_factor=reduction, mode="bilinear", align_corners=False)[:, 0]


def convex_upsampling(disparity: Tensor, guidance: Tensor, factor: int) -> Tensor:
    """Every fine pixel is a convex combination of the 3 x 3 coarse ones around it (Teed and Deng, RAFT, ECCV 2020).

    ``disparity`` (B, H, W), ``guidance`` (B, 9 * factor^2, H, W) before the softmax -> (B, factor H, factor W). Without a
    graph to build, on a CPU, a kernel does it in one pass.
    """
    batch, height, width = disparity.shape
    kernel_may = disparity.dtype == torch.float32 and guidance.dtype in (torch.float32, torch.bfloat16)
    if disparity.device.type == "cpu" and kernel_may and not torch.is_grad_enabled():
        out = torch.empty((batch, height * factor, width * factor))
        innermost = to_array(guidance.movedim(1, -1).contiguous())
        over_tasks(upsampling_kernel, batch * height, disparity.contiguous().numpy(), innermost, factor, out.numpy())
        return out
    weights = guidance.to(disparity.dtype).view(batch, 9, factor**2, height, width).softmax(1)
    neighbours = F.unfold(F.pad(disparity[:, None], (1, 1, 1, 1), mode="replicate"), 3)
    return F.pixel_shuffle((weights * neighbours.view(batch, 9, 1, height, width)).sum(1), factor)[:, 0]


class _AggregationBlock(nn.Module):
    """Semi-global aggregation and a 3D convolution around a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm3d(channels)
        self.refine = _convolution(channels, channels, dims=3, relu=False)

    def forward(self, x: Tensor, guidance: Tensor) -> Tensor:
        if self.training:
            aggregated = F.relu_(self.norm(semi_global_aggregation(x, guidance)))
        else:
            aggregated = semi_global_aggregation(x, guidance, _scale_and_shift(self.norm))
        return F.relu_(self.refine(aggregated).add_(x))


def _scale_and_shift(norm: nn.BatchNorm3d) -> tuple[Tensor, Tensor]:
    """What batch normalisation does in evaluation, a channel at a time."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


class _Join(nn.Module):
    """Halve or double the resolution, concatenate the skip connection, convolve."""

    def __init__(self, inputs: int, outputs: int, up: bool = False, dims: int = 2, relu: bool = True) -> None:
        super().__init__()
        self.resize = _convolution(inputs, outputs, 4 if up else 3, 2, dims, transposed=up)
        self.fuse = _convolution(2 * outputs, outputs, dims=dims, relu=relu)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return self.fuse(torch.cat([self.resize(x), skip], 1))


def _convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dims: int = 2, relu: bool = True,
                 transposed: bool = False) -> nn.Sequential:
    """Convolution without bias, batch normalisation, ReLU unless something is still to be added."""
    layer: nn.Module
    if not transposed:
        layer = (nn.Conv2d if dims == 2 else nn.Conv3d)(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    elif dims == 2:
        layer = nn.ConvTranspose2d(inputs, outputs, kernel, stride, 1, bias=False)
    else:
        layer = DoublingConvolution3d(inputs, outputs, bias=False)
    layers = [layer, nn.BatchNorm2d(outputs) if dims == 2 else nn.BatchNorm3d(outputs)]
    return nn.Sequential(*layers, nn.ReLU(inplace=True)) if relu else nn.Sequential(*layers)


def _layers(modules: nn.Module) -> list[nn.Module]:
    return list(modules.children())


def _weights(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
