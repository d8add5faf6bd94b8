"""EfficientNet-Lite: small convolutional networks without squeeze-and-excitation that quantise well, as backbones of LPN.

Entries have the names of the published PyTorch weights (`_conv_stem`, `_blocks.0._depthwise_conv`, ...), so these files load
unchanged.
"""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core import images

# Kernel size and expansion of each stage, and its strides; a stage's first block has the stride.
_KERNELS = (3, 3, 5, 3, 5, 5, 3)
_EXPANSIONS = (1, 6, 6, 6, 6, 6, 6)
_STRIDES = (1, 2, 2, 2, 1, 2, 1)
_STEM, HEAD_CHANNELS = 32, 1280
# Stages up to the last one at 1/16: the network is cut before the last stride.
_CUT = 5
# Channels and blocks of each stage. Depth and width of Lite1 are those of Lite0 times 1.1 and 1.0, of Lite2 times 1.2 and 1.1.
STAGES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "efficientnet_lite0": ((16, 24, 40, 80, 112, 192, 320), (1, 2, 2, 3, 3, 4, 1)),
    "efficientnet_lite1": ((16, 24, 40, 80, 112, 192, 320), (1, 3, 3, 4, 4, 5, 1)),
    "efficientnet_lite2": ((16, 24, 48, 88, 120, 208, 352), (1, 3, 3, 4, 4, 5, 1)),
}
# The weights were trained on (picture - 127) / 128 of values from 0 to 255.
_ZERO, _UNIT = 127.0, 128.0


def last_block(name: str, whole: bool) -> tuple[int, int]:
    """Return the number of the last block, from 0, and its channels.

    Args:
        whole: of the whole network, else of the one that ends with layer3.
    """
    widths, depths = STAGES[name]
    stages = len(depths) if whole else _CUT
    return sum(depths[:stages]) - 1, widths[stages - 1]


class SameConv2d(nn.Conv2d):
    """A convolution without bias whose output has the input's size / stride, rounded up.

    It is padded as TensorFlow does: where the stride leaves an odd number of pixels, the right and the lower side get the one
    more. Strides above 1 therefore see other pixels than with the symmetric padding of torchvision.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        padding = kernel // 2 if stride == 1 else 0
        super().__init__(in_channels, out_channels, kernel, stride, padding, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if self.stride != (1, 1):
            rows, columns = (self._pads(length) for length in x.shape[2:])
            x = F.pad(x, (*columns, *rows))
        return super().forward(x)

    def _pads(self, length: int) -> tuple[int, int]:
        kernel, stride = self.kernel_size[0], self.stride[0]
        total = max((-(-length // stride) - 1) * stride + kernel - length, 0)
        return total // 2, total - total // 2


def _norm(channels: int) -> nn.BatchNorm2d:
    """Make a BatchNorm with the weights' epsilon. Its statistics move as PyTorch's do, as trainings here are short."""
    return nn.BatchNorm2d(channels, eps=1e-3)


class InvertedResidual(nn.Module):
    """A 1 x 1 expansion, a depthwise convolution, which carries the stride, and a 1 x 1 projection without activation."""

    def __init__(self, in_channels: int, out_channels: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        width = in_channels * expansion
        self.expands, self.adds = expansion > 1, stride == 1 and in_channels == out_channels
        if self.expands:
            self._expand_conv, self._bn0 = SameConv2d(in_channels, width, 1), _norm(width)
        self._depthwise_conv, self._bn1 = SameConv2d(width, width, kernel, stride, groups=width), _norm(width)
        self._project_conv, self._bn2 = SameConv2d(width, out_channels, 1), _norm(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        out = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        out = F.relu6(self._bn1(self._depthwise_conv(out)))
        out = self._bn2(self._project_conv(out))
        return cast(Tensor, out + x if self.adds else out)


class EfficientNetLite(nn.Module):
    """An EfficientNet-Lite up to a feature map at 1/16: (B, 3, H, W) -> (B, channels, H/16, W/16), sizes rounded up.

    Pictures are normalised by ImageNet's mean and standard deviation, as for all backbones, and mapped to the values that the
    weights were trained on.

    Args:
        name: one of `STAGES`.
        whole: end with the convolution before the classifier (1280 channels), else with the last stage that has stride 16 by
            itself (112 or 120 channels).
        last_stride: stride of the sixth stage, the last one that has a stride: 1, or 2 as it was trained, which gives H/32.
    """

    def __init__(self, name: str, whole: bool = True, last_stride: int = 1) -> None:
        super().__init__()
        scale, offset = (torch.from_numpy(values)[:, None, None] for values in images.scale_and_offset())
        # The network's input is value * scale + offset; the weights' is (value - _ZERO) / _UNIT.
        self.scale = nn.Buffer(1 / (scale * _UNIT), persistent=False)
        self.offset = nn.Buffer(-(offset / scale + _ZERO) / _UNIT, persistent=False)
        self._conv_stem, self._bn0 = SameConv2d(3, _STEM, 3, 2), _norm(_STEM)
        widths, depths = STAGES[name]
        strides = (*_STRIDES[:_CUT], last_stride, *_STRIDES[_CUT + 1 :])
        blocks: list[nn.Module] = []
        for stage, (before, after) in enumerate(pairwise((_STEM, *widths))):
            if stage == _CUT and not whole:
                break
            for block in range(depths[stage]):
                first = block == 0
                blocks.append(
                    InvertedResidual(
                        before if first else after,
                        after,
                        _EXPANSIONS[stage],
                        _KERNELS[stage],
                        strides[stage] if first else 1,
                    )
                )
        self._blocks = nn.Sequential(*blocks)
        self.channels = HEAD_CHANNELS if whole else widths[_CUT - 1]
        self.whole = whole
        if whole:
            self._conv_head, self._bn1 = SameConv2d(widths[-1], HEAD_CHANNELS, 1), _norm(HEAD_CHANNELS)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu6(self._bn0(self._conv_stem(x * self.scale + self.offset)))
        x = self._blocks(x)
        return F.relu6(self._bn1(self._conv_head(x))) if self.whole else x
