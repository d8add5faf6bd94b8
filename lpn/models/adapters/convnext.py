"""ConvNeXt models: Sample4Geo, DAC, and CAMP (one vector), and MCCG (two gated parts and one vector)."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, HeldNorm, MeanVector, PartBranch, by_heads
from lpn.models.backbones import Bottleneck, ResNet

# The names of the original implementation by those of timm.
_TIMM_NAMES = {
    r"downsample_layers\.0\.": "stem.",
    r"downsample_layers\.(\d+)\.": r"stages.\1.downsample.",
    r"stages\.(\d+)\.(\d+)\.dwconv\.": r"stages.\1.blocks.\2.conv_dw.",
    r"stages\.(\d+)\.(\d+)\.pwconv1\.": r"stages.\1.blocks.\2.mlp.fc1.",
    r"stages\.(\d+)\.(\d+)\.pwconv2\.": r"stages.\1.blocks.\2.mlp.fc2.",
    r"stages\.(\d+)\.(\d+)\.(norm|gamma)": r"stages.\1.blocks.\2.\3",
    r"norm\.": "head.norm.",
}
# ConvNeXts by the blocks of their third stage and the channels of their first.
_CONVNEXTS = {
    (9, 96): "ConvNeXt-T",
    (27, 96): "ConvNeXt-S",
    (27, 128): "ConvNeXt-B",
    (27, 192): "ConvNeXt-L",
    (27, 256): "ConvNeXt-XL",
}
# Pixels along a side of one cell of the map.
STRIDE = 32


def with_timm_names(entries: Entries) -> Entries:
    """Return the entries of a ConvNeXt of the original implementation under timm's names."""
    return entries.renamed(_TIMM_NAMES)


def is_second(entries: Entries) -> bool:
    """Return whether entries of timm's names are of a ConvNeXt V2."""
    return "stages.0.blocks.0.mlp.grn.weight" in entries.state


def name_of(entries: Entries) -> str:
    """Return the name of a ConvNeXt of timm's names by its depth and width."""
    depth = entries.count("stages.2.blocks.{}.conv_dw.weight")
    width = entries.shape("stages.0.blocks.0.conv_dw.weight", 4)[0]
    name = _CONVNEXTS.get((depth, width), "ConvNeXt")
    return name.replace("ConvNeXt", "ConvNeXt V2") if is_second(entries) else name


class Trunk(nn.Module):
    """A ConvNeXt, also V2, up to its map: (B, 3, H, W) -> (B, C, H/32, W/32)."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        depths = tuple(max(entries.count(f"stages.{stage}.blocks.{{}}.conv_dw.weight"), 1) for stage in range(4))
        widths = tuple(entries.shape(f"stages.{stage}.blocks.0.conv_dw.weight", 4)[0] for stage in range(4))
        # The smallest networks have convolutions of one pixel in place of linear layers.
        first = entries.state.get("stages.0.blocks.0.mlp.fc1.weight")
        convolutional = first is not None and first.ndim == 4
        self.network = timm_networks.convnext(depths, widths, is_second(entries), convolutional)
        entries.fill(self.network)
        self.channels = widths[-1]

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]

    def norm(self) -> HeldNorm:
        """Return the norm of the mean over the map."""
        norm = self.network.get_submodule("head.norm")
        return HeldNorm(cast(Tensor, norm.weight).detach(), cast(Tensor, norm.bias).detach())


def grid_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return the map's (h, w) for an input size."""
    return size[0] // STRIDE, size[1] // STRIDE


def vector(entries: Entries, size: tuple[int, int]) -> MeanVector:
    """Build the branch of Sample4Geo, DAC, or CAMP from a ConvNeXt of timm's names."""
    trunk = Trunk(entries)
    return MeanVector(trunk, trunk.norm(), grid_of(size), STRIDE)


class Gate(nn.Module):
    """MCCG's gate: a convolution over a plane of maxima and a plane of means, normalised, through a sigmoid."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        self.conv, self.bn = nn.Conv2d(2, 1, 7, padding=3, bias=False), nn.BatchNorm2d(1)
        entries.fill(self)

    def forward(self, strongest: Tensor, mean: Tensor) -> Tensor:
        """Return the gate of planes (B, rows, columns) each."""
        return torch.sigmoid(self.bn(self.conv(torch.stack([strongest, mean], 1))))[:, 0]


def on_resnet(entries: Entries) -> bool:
    """Return whether a branch of MCCG has a ResNet under `convnext.model`."""
    return "convnext.model.conv1.weight" in entries.state


def resnet_depths(entries: Entries) -> list[int]:
    """Return the number of blocks in each stage of a ResNet of torchvision's names."""
    return [max(entries.count(f"layer{stage}.{{}}.conv1.weight"), 1) for stage in range(1, 5)]


def resnet(entries: Entries) -> ResNet:
    """Build the ResNet of MCCG and DAC up to its map, from entries of torchvision's names."""
    with torch.device("meta"):
        network = ResNet(Bottleneck, resnet_depths(entries), "layer4", last_stride=2)
    entries.fill(network)
    return network


class Mccg(PartBranch):
    """MCCG: the means of the map under one or two gates, and the LayerNorm of its plain mean, a head each.

    On a ResNet-101 the plain mean has no LayerNorm.

    The first gate has a value for each channel and column, the second for each row and channel.

    Args:
        entries: of one branch, such as those under `model_1.`.
        blocks: the number of gated parts, 1 or 2.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], blocks: int) -> None:
        trunk, norm = self._trunk(entries)
        names = [*(f"classifier_mcb{number + 1}" for number in range(blocks)), "classifier1"]
        weight, bias = entries.heads(names, trunk.channels)
        super().__init__(grid_of(size), weight)
        self.trunk, self.norm, self.bias = trunk, norm, nn.Buffer(bias)
        gates = entries.under("tri_layer.")
        self.gates = nn.ModuleList([Gate(gates.under(f"{name}.conv.")) for name in ("cw", "hc")[:blocks]])

    @staticmethod
    def _trunk(entries: Entries) -> tuple[Trunk | ResNet, HeldNorm | None]:
        """Return the network up to its map, and the norm of its mean; a ResNet-101 has none."""
        if on_resnet(entries):
            return resnet(entries.under("convnext.model.")), None
        trunk = Trunk(with_timm_names(entries.under("convnext.")))
        return trunk, trunk.norm()

    def check_size(self, size: tuple[int, int], trained: tuple[int, int]) -> None:
        """Check that both sides are multiples of a cell's."""
        self._check_size(size, trained, not any(side % STRIDE for side in size), f"multiples of {STRIDE} pixels")

    def gated(self, features: Tensor) -> list[Tensor]:
        """Return the map under each gate, (B, C, h, w) each."""
        columns = self.gates[0](features.amax(2), features.mean(2))
        maps = [features * columns[:, :, None]]
        if len(self.gates) > 1:
            # The plane of the second gate has rows and channels as its sides.
            rows = self.gates[1](features.amax(3).transpose(1, 2), features.mean(3).transpose(1, 2))
            maps.append(features * rows.transpose(1, 2)[..., None])
        return maps

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw parts of pictures: (B, 3, H, W) -> (B, n, D)."""
        features = self.trunk(images)
        whole = features.mean((2, 3))
        pooled = [gated.mean((2, 3)) for gated in self.gated(features)]
        pooled.append(whole if self.norm is None else self.norm(whole))
        return by_heads(torch.stack(pooled, 1), cast(Tensor, self.weight), self.bias)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the gates and the norm's mean and variance held."""
        features = self.trunk(images)
        weight = cast(Tensor, self.weight)
        constants, whole = self.bias.expand(features.shape[0], -1, -1).clone(), features
        if self.norm is not None:
            scale, offset = self.norm.affine(features.mean((2, 3)))
            whole = features * scale[:, :, None, None]
            constants[:, -1] += offset @ weight[-1].T
        maps = torch.stack([*self.gated(features), whole], 1)
        batch, parts, _, height, width = maps.shape
        pooled = maps.mean((3, 4))
        return Account(
            torch.matmul(weight, pooled.unsqueeze(3)).squeeze(3) + constants,
            maps,
            maps.new_full((batch, parts, height, width), 1.0 / (height * width)),
            constants,
        )
