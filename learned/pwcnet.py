"""PWC-Net with dense connections: optical flow and disparity change by pyramid, warping and cost volume.

Sun, Yang, Liu, Kautz: PWC-Net, CVPR 2018 (arXiv:1709.02371). The levels are a loop, from coarse to fine; every size and
scale factor follows from the configuration. Weights of the authors load through ``learned.checkpoint``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.correlation import correlation
from learned.cosine_costs import cosine_costs
from learned.threads import side_by_side
from learned.transposed import DoublingConvolution2d
from learned.warp import warp

#: The network speaks in pixels of the input / 20, as the authors trained it.
MOTION_UNIT_PX = 20.0


@dataclass(frozen=True)
class PWCNetConfig:
    """Sizes of a PWC-Net; the defaults are the published network (with a third output, the disparity change)."""

    outputs: int = 3
    """Motion channels: u, v and the disparity change C; 2 for plain optical flow."""
    pyramid: tuple[int, ...] = (16, 32, 64, 96, 128, 196)
    """Feature channels at 1/2, 1/4, ...; its length is the coarsest level."""
    convolutions: int = 3
    """Convolutions a pyramid level, the first with stride 2."""
    finest: int = 2
    """Level that the decoder stops at: the motion is estimated at 1 / 2**finest of the image."""
    radius: int = 4
    """Search radius of the correlation in pixels of each level; the cost grows with its square."""
    decoder: tuple[int, ...] = (128, 128, 96, 64, 32)
    """Channels of each level's decoder convolutions, densely connected."""
    context: tuple[tuple[int, int], ...] = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))
    """(channels, dilation) of the context network at the finest level."""
    upsampled_features: int = 2
    """Feature channels handed to the next level."""
    cosine: bool = False
    """Correlate l2-normalised features (their cosine) instead of raw ones: trains from scratch in far fewer steps."""
    residual: bool = False
    """Each level corrects the bilinearly upsampled motion instead of predicting it anew: survives bfloat16."""

    def __post_init__(self) -> None:
        if not 0 < self.finest < len(self.pyramid):
            raise ValueError(f"finest level {self.finest} must lie in 1 ... {len(self.pyramid) - 1}")


#: For a CPU: a third of the arithmetic, and the two changes that let it learn from scratch in hours.
COMPACT = PWCNetConfig(pyramid=(16, 32, 64, 96, 128), convolutions=2, decoder=(64, 64, 48, 32),
                       context=((64, 1), (64, 2), (48, 4), (32, 8), (32, 1)), cosine=True, residual=True)


class PWCNet(nn.Module):
    """Motion from the first image to the second.

    Images are (B, 3, H, W) in [0, 1], BGR, of any size: they are padded on the right and at the bottom by repeating the
    border, and the result is cropped back.
    """

    def __init__(self, config: PWCNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or PWCNetConfig()
        self.pyramid = nn.ModuleList()
        previous = 3
        for channels in config.pyramid:
            steps = [_convolution(previous, channels, stride=2)]
            steps += [_convolution(channels, channels) for _ in range(config.convolutions - 1)]
            self.pyramid.append(nn.Sequential(*steps))
            previous = channels
        self.decoders = nn.ModuleList(_Decoder(config, level) for level in self.levels)
        dense = (2 * config.radius + 1) ** 2 + config.pyramid[config.finest - 1] + config.outputs
        dense += config.upsampled_features + sum(config.decoder)
        layers: list[nn.Module] = []
        for channels, dilation in config.context:
            layers.append(_convolution(dense, channels, dilation=dilation))
            dense = channels
        self.context = nn.Sequential(*layers, nn.Conv2d(dense, config.outputs, 3, padding=1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_in", a=0.1)
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]

    @property
    def levels(self) -> range:
        """Decoded pyramid levels, coarse to fine."""
        return range(len(self.config.pyramid), self.config.finest - 1, -1)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Motion (B, outputs, H, W) at full resolution, in pixels: first(x, y) matches second(x + u, y + v)."""
        finest = self.estimate(self._pad(first), self._pad(second))[-1]
        return self._full_resolution(finest, first.shape)

    def both_ways(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """``forward(first, second)`` and ``forward(second, first)`` with one feature pyramid of each image."""
        images = self._pad(first), self._pad(second)
        if first.device.type == "cpu" and not torch.is_grad_enabled():
            one, other = side_by_side(*(partial(self._pyramid, image) for image in images))
            there, back = zip(one, other, strict=True), zip(other, one, strict=True)
            finest = side_by_side(*(partial(self._decode, pairs) for pairs in (list(there), list(back))))
            forward, backward = (self._full_resolution(motions[-1], first.shape) for motions in finest)
            return forward, backward
        pyramid = self._pyramid(torch.cat(images))
        pairs = [(features, torch.cat(features.chunk(2)[::-1])) for features in pyramid]
        forward, backward = self._full_resolution(self._decode(pairs)[-1], first.shape).chunk(2)
        return forward, backward

    def _full_resolution(self, finest: Tensor, shape: torch.Size) -> Tensor:
        """The finest level's motion in pixels of the image, cropped to its shape."""
        scale = 2**self.config.finest
        finest = finest.contiguous() * MOTION_UNIT_PX  # of so few channels each is better enlarged on its own
        full = F.interpolate(finest, scale_factor=scale, mode="bilinear", align_corners=False)
        return full[..., : shape[-2], : shape[-1]]

    def estimate(self, first: Tensor, second: Tensor) -> list[Tensor]:
        """Motion of every decoded level, coarse to fine, each (B, outputs, H / 2**level, W / 2**level) float32.

        In the network's own unit: pixels of the input / 20. The sides must be multiples of ``2**len(pyramid)``; the
        training loss compares every level, the last one is the answer.
        """
        cells = 2 ** len(self.config.pyramid)
        if first.shape[-2] % cells or first.shape[-1] % cells:
            raise ValueError(f"image sides must be multiples of {cells}, not {tuple(first.shape[-2:])}")
        # both images as one batch: fewer and larger convolutions
        return self._decode([features.chunk(2) for features in self._pyramid(torch.cat([first, second]))])

    def _pyramid(self, images: Tensor) -> list[Tensor]:
        """Features of every level, fine to coarse."""
        # channels innermost: half as fast again on a CPU, four times as fast in bfloat16
        images = images.contiguous(memory_format=torch.channels_last)
        features = []
        for level in self.pyramid:
            images = level(images)
            features.append(images)
        return features

    def _decode(self, pyramid: Sequence[Sequence[Tensor]]) -> list[Tensor]:
        """Motion of every decoded level from (first's, second's) features of every level."""
        motions: list[Tensor] = []
        coarser: tuple[Tensor, Tensor] | None = None
        for level, decoder in zip(self.levels, self.decoders, strict=True):
            motion, dense, coarser = decoder(*pyramid[level - 1], coarser)
            motions.append(motion)
        motions[-1] = motions[-1] + _at_least_float32(self.context(dense))
        return motions

    def _pad(self, image: Tensor) -> Tensor:
        cells = 2 ** len(self.config.pyramid)
        bottom, right = (-side % cells for side in image.shape[-2:])
        return F.pad(image, (0, right, 0, bottom), mode="replicate") if bottom or right else image


class _Decoder(nn.Module):
    """One level: warp, correlate, estimate, hand on."""

    def __init__(self, config: PWCNetConfig, level: int) -> None:
        super().__init__()
        self.config = config
        self.finest = level == config.finest
        self.pixels = MOTION_UNIT_PX / 2**level  # network unit -> pixels of this level
        channels = (2 * config.radius + 1) ** 2
        if level < len(config.pyramid):
            channels += config.pyramid[level - 1] + config.outputs + config.upsampled_features
        self.convolutions = nn.ModuleList()
        for width in config.decoder:
            self.convolutions.append(_convolution(channels, width))
            channels += width
        self.channels = channels
        self.predict = nn.Conv2d(channels, config.outputs, 3, padding=1)
        if not self.finest:
            self.upsample_features = DoublingConvolution2d(channels, config.upsampled_features)
            if not config.residual:
                self.upsample_motion = DoublingConvolution2d(config.outputs, config.outputs)

    def forward(self, first: Tensor, second: Tensor, coarser: tuple[Tensor, Tensor] | None
                ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor] | None]:
        """Motion of this level, its dense features, and motion and features upsampled for the next level."""
        if coarser is None:
            dense = self._costs(first, second, None)
        else:
            upsampled, features = coarser
            costs = self._costs(first, second, upsampled[:, :2] * self.pixels)
            dense = torch.cat([costs, first, _planar(upsampled, first.dtype), features], 1)
        dense = _planar(dense, dense.dtype)  # or every convolution would convert it again
        for convolution in self.convolutions:
            dense = torch.cat([convolution(dense), dense], 1)
        if self.config.residual:
            motion = _at_least_float32(self.predict(dense)) + (0 if coarser is None else coarser[0])
        else:
            motion = _precise(self.predict, dense)
        return motion, dense, None if self.finest else (self._upsample(motion), self.upsample_features(dense))

    def _costs(self, first: Tensor, second: Tensor, flow: Tensor | None) -> Tensor:
        if self.config.cosine:
            return cosine_costs(first, second, flow, self.config.radius)
        second = second if flow is None else warp(second, flow)
        return F.leaky_relu(correlation(first, second, self.config.radius), 0.1)

    def _upsample(self, motion: Tensor) -> Tensor:
        if self.config.residual:
            return F.interpolate(motion, scale_factor=2, mode="bilinear", align_corners=False)
        return _precise(self.upsample_motion, motion)


def _convolution(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation), nn.LeakyReLU(0.1, inplace=True))


def _precise(module: nn.Module, features: Tensor) -> Tensor:
    """Apply a module outside mixed precision: a motion of 100 px in bfloat16 is known to a third of a pixel only."""
    with torch.autocast(features.device.type, enabled=False):
        return module(_at_least_float32(features))


def _planar(maps: Tensor, dtype: torch.dtype) -> Tensor:
    """Channels innermost, as convolutions want them, and in this type."""
    return maps.to(dtype, memory_format=torch.channels_last)


def _at_least_float32(tensor: Tensor) -> Tensor:
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))
