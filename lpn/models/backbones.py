"""The backbones of LPN and SAFA: ResNet-18, ResNet-50, and VGG-16 with and without batch normalisation.

Parameter names are torchvision's, so its weights and the published checkpoints load unchanged. There are no final pooling and
class layers, because LPN reads the last feature map.
"""

from __future__ import annotations

import copy
from typing import cast

import torch
from torch import Tensor, nn

from lpn.models.spec import TIMM, ModelSpec
from lpn.models.timm_networks import TimmMap

# Channels of the last feature map, by backbone and last layer.
CHANNELS: dict[tuple[str, str], int] = {
    ("resnet18", "layer3"): 256,
    ("resnet18", "layer4"): 512,
    ("resnet50", "layer3"): 1024,
    ("resnet50", "layer4"): 2048,
    ("vgg16", "layer4"): 512,
    ("vgg16_bn", "layer4"): 512,
}


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a shortcut (He et al. 2016, ResNet-18)."""

    expansion = 1

    def __init__(self, in_channels: int, width: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(in_channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = torch.relu(self.bn1(self.conv1(x)))
        out = self.bn2(self.conv2(out))
        return torch.relu(out + (x if self.downsample is None else self.downsample(x)))


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 (which carries the stride), 1 x 1 convolutions and a shortcut (ResNet-50)."""

    expansion = 4

    def __init__(self, in_channels: int, width: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = _shortcut(in_channels, 4 * width, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = torch.relu(self.bn1(self.conv1(x)))
        out = torch.relu(self.bn2(self.conv2(out)))
        out = self.bn3(self.conv3(out))
        return torch.relu(out + (x if self.downsample is None else self.downsample(x)))


class ResNet(nn.Module):
    """A ResNet up to its last feature map: (B, 3, H, W) -> (B, channels, H/16, W/16) with `last_stride` 1.

    Without layer4 (`last_layer` "layer3") the map has half the channels and the same resolution. `last_stride` is the stride
    of layer4, 1 as published or 2.
    """

    def __init__(
        self, block: type[BasicBlock | Bottleneck], depths: list[int], last_layer: str, last_stride: int
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = 64
        self.stages: list[str] = []
        for index, depth in enumerate(depths[: 3 if last_layer == "layer3" else 4]):
            width, stride = 64 * 2**index, (1, 2, 2, last_stride)[index]
            blocks = [block(channels, width, stride)]
            channels = width * block.expansion
            blocks += [block(channels, width) for _ in range(depth - 1)]
            self.stages.append(f"layer{index + 1}")
            self.add_module(self.stages[-1], nn.Sequential(*blocks))
        self.channels = channels

    def forward(self, x: Tensor) -> Tensor:
        x = self.maxpool(torch.relu(self.bn1(self.conv1(x))))
        for stage in self.stages:
            x = self.get_submodule(stage)(x)
        return x


class VGG16(nn.Module):
    """VGG-16 up to its last pooling: (B, 3, H, W) -> (B, 512, h, w), each pooling halving both sides.

    Args:
        batch_norm: normalise after each convolution.
        dropout: probability, in training only, after each of the six convolutions from conv4_1 to conv5_3.
        ceil_mode: round the size of a pooled map up, which keeps the last row and column of odd maps; torchvision rounds down.
    """

    channels = 512

    def __init__(self, batch_norm: bool, dropout: float = 0.0, ceil_mode: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width, depth, rate in ((64, 2, 0), (128, 2, 0), (256, 3, 0), (512, 3, dropout), (512, 3, dropout)):
            for _ in range(depth):
                layers.append(nn.Conv2d(channels, width, 3, padding=1))
                if batch_norm:
                    layers.append(nn.BatchNorm2d(width))
                relu = nn.ReLU(inplace=True)
                # Dropout shares the activation's entry, so that torchvision's layer numbers stay valid.
                layers.append(nn.Sequential(relu, nn.Dropout(rate)) if rate else relu)
                channels = width
            layers.append(nn.MaxPool2d(2, 2, ceil_mode=ceil_mode))
        self.features = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return cast(Tensor, self.features(x))


def map_size(backbone: nn.Module, input_size: tuple[int, int]) -> tuple[int, int]:
    """Return (h, w) of the feature map for an input size, without computing it."""
    with torch.device("meta"):
        shadow = copy.deepcopy(backbone).to("meta").eval()
        return cast("tuple[int, int]", tuple(shadow(torch.zeros(1, 3, *input_size)).shape[2:]))


def backbone_of(spec: ModelSpec) -> ResNet | VGG16 | TimmMap:
    """Build the backbone of one branch of a spec with random weights (He initialisation)."""
    network: ResNet | VGG16
    if spec.backbone.startswith(TIMM):
        return TimmMap(spec.backbone.removeprefix(TIMM), spec.input_size)
    if spec.backbone == "resnet18":
        network = ResNet(BasicBlock, [2, 2, 2, 2], spec.last_layer, spec.last_stride)
    elif spec.backbone == "resnet50":
        network = ResNet(Bottleneck, [3, 4, 6, 3], spec.last_layer, spec.last_stride)
    else:
        # Released SAFA pools with TensorFlow's padding SAME: 112 x 616 pixels give 4 x 20 cells, not 3 x 19.
        network = VGG16(spec.backbone == "vgg16_bn", spec.backbone_dropout, ceil_mode=spec.pooling == "safa")
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    return network


def _shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and in_channels == out_channels:
        return None
    return nn.Sequential(nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels))
