"""ConvNeXts and ResNets of published models, built from the shapes of their entries."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import HeldNorm
from lpn.models.backbones import Bottleneck, ResNet

# Names of the original implementation by timm's names.
_TIMM_NAMES = {
    r"downsample_layers\.0\.": "stem.",
    r"downsample_layers\.(\d+)\.": r"stages.\1.downsample.",
    r"stages\.(\d+)\.(\d+)\.dwconv\.": r"stages.\1.blocks.\2.conv_dw.",
    r"stages\.(\d+)\.(\d+)\.pwconv1\.": r"stages.\1.blocks.\2.mlp.fc1.",
    r"stages\.(\d+)\.(\d+)\.pwconv2\.": r"stages.\1.blocks.\2.mlp.fc2.",
    r"stages\.(\d+)\.(\d+)\.(norm|gamma)": r"stages.\1.blocks.\2.\3",
    r"norm\.": "head.norm.",
}
# ConvNeXts by the blocks of their third stage and the channels of their first; ResNets by the blocks of their third stage.
_CONVNEXTS = {
    (9, 96): "ConvNeXt-T",
    (27, 96): "ConvNeXt-S",
    (27, 128): "ConvNeXt-B",
    (27, 192): "ConvNeXt-L",
    (27, 256): "ConvNeXt-XL",
}
RESNETS = {6: "ResNet-50", 23: "ResNet-101", 36: "ResNet-152"}
# Pixels along a side of one cell of the map.
STRIDE = 32


def with_timm_names(entries: Entries) -> Entries:
    """Return the entries of an original ConvNeXt under timm's names."""
    return entries.renamed(_TIMM_NAMES)


class Trunk(nn.Module):
    """A ConvNeXt, also V2, with timm's names, up to its map: (B, 3, H, W) -> (B, C, H/32, W/32)."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        depths = tuple(max(entries.count(f"stages.{stage}.blocks.{{}}.conv_dw.weight"), 1) for stage in range(4))
        widths = tuple(entries.shape(f"stages.{stage}.blocks.0.conv_dw.weight", 4)[0] for stage in range(4))
        # The smallest networks have convolutions of one pixel in place of linear layers.
        first = entries.state.get("stages.0.blocks.0.mlp.fc1.weight")
        second = "stages.0.blocks.0.mlp.grn.weight" in entries.state
        self.network = timm_networks.convnext(depths, widths, second, first is not None and first.ndim == 4)
        entries.fill(self.network)
        self.channels = widths[-1]
        self.title = _CONVNEXTS.get((depths[2], widths[0]), "ConvNeXt").replace("Xt", "Xt V2" if second else "Xt")

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]

    def norm(self) -> HeldNorm:
        """Return the norm of the mean over the map."""
        norm = self.network.get_submodule("head.norm")
        return HeldNorm(cast(Tensor, norm.weight).detach(), cast(Tensor, norm.bias).detach())


class ResNetTrunk(nn.Module):
    """A bottleneck ResNet with torchvision's names, up to its map of stride 32."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        depths = [max(entries.count(f"layer{stage}.{{}}.conv1.weight"), 1) for stage in range(1, 5)]
        with torch.device("meta"):
            self.network = ResNet(Bottleneck, depths, "layer4", last_stride=2)
        entries.fill(self.network)
        self.channels = self.network.channels
        self.title = RESNETS.get(depths[2], "ResNet")

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network(images))

    def norm(self) -> None:
        """Return None: the mean over the map has no norm."""
        return


def hand_made_trunk(entries: Entries) -> Trunk | ResNetTrunk:
    """Build the trunk under `convnext.` of MCCG and its successors: a ConvNeXt, or a ResNet under `convnext.model.`."""
    if entries.has("convnext.model.conv1.weight"):
        return ResNetTrunk(entries.under("convnext.model."))
    return Trunk(with_timm_names(entries.under("convnext.")))


def grid_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return the map's (h, w) for an input size."""
    return size[0] // STRIDE, size[1] // STRIDE
