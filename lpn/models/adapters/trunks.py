"""Trunks of published models, built from the shapes of their entries: vision transformers, ConvNeXts, and ResNets."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models.adapters.network import HeldNorm
from lpn.models.backbones import Bottleneck, ResNet
from lpn.models.entries import Entries
from lpn.models.timm_networks import import_timm

VITS = {192: "ViT-Ti", 384: "ViT-S", 512: "ViT-M", 768: "ViT-B", 1024: "ViT-L"}
# FSRA's attention has 8 heads, and scales logits by their total width.
_FSRA_HEADS = 8
# Other vision transformers have heads of 64 numbers up to ViT-L. Larger ones have heads of several widths.
_HEAD_WIDTH, _WIDEST = 64, 1024
# DINOv2's code adds this many cells to each side of the grid before it computes the scale of positions.
_LONGER = 0.1
# timm's names by the names of the original ConvNeXt.
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
# Pixels along a side of one cell of the map of a ConvNeXt or ResNet.
STRIDE = 32


class Trunk(nn.Module):
    """A network of timm up to its features, before its pooling.

    Attributes:
        channels: C of the features.
        title: the name of the network for headers.
    """

    def __init__(self, network: nn.Module, channels: int, title: str) -> None:
        super().__init__()
        self.network, self.channels, self.title = network, channels, title

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]


class Tokens(Trunk):
    """A ViT up to its last norm: (B, 3, H, W) to all tokens, (B, 1 + cells, C).

    The class token comes first, then the cells row by row.

    Args:
        entries: with timm's names. The option `heads` is the number of heads, else width / 64.
        wide_scale: FSRA's attention: 8 heads, and logits scaled by C^-0.5 in place of (C / 8)^-0.5.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], wide_scale: bool = False) -> None:
        state = entries.state
        width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
        count, depth = entries.shape("pos_embed", 3)[1], entries.count("blocks.{}.norm1.weight")
        grid = size[0] // patch, size[1] // patch
        if count != grid[0] * grid[1] + 1 or count < 2 or size[0] % patch or size[1] % patch:
            raise ModelFileError(
                f"{entries.name} has positions for {count - 1} patches of {patch} pixels; {size[0]} x {size[1]} pixels "
                f"give {grid[0]} x {grid[1]}, so put the h and w that it was trained with into the opts.yaml beside it."
            )
        heads = _FSRA_HEADS if wide_scale else entries.options.get("heads", width // _HEAD_WIDTH)
        if depth == 0 or not isinstance(heads, int) or heads < 1 or width % heads or width > _WIDEST:
            raise ModelFileError(
                f"{entries.name} has {depth} blocks of the width {width}; expected at least one, and a width up to {_WIDEST} of "
                f"{f'{_FSRA_HEADS} heads' if wide_scale else f'heads of {_HEAD_WIDTH} numbers'}."
            )
        import_timm()
        from timm.models.vision_transformer import VisionTransformer

        with torch.device("meta"):
            network = VisionTransformer(
                img_size=size,
                patch_size=patch,
                embed_dim=width,
                depth=depth,
                num_heads=heads,
                # timm rounds the product of width and ratio down.
                mlp_ratio=(entries.shape("blocks.0.mlp.fc1.weight", 2)[0] + 0.5) / width,
                qkv_bias="blocks.0.attn.qkv.bias" in state,
                init_values=1.0 if "blocks.0.ls1.gamma" in state else None,
                num_classes=0,
            )
        super().__init__(network, width, VITS.get(width, "ViT"))
        self.prefix, self.grid = 1, grid
        entries.fill(network)
        if wide_scale:
            with torch.no_grad():
                for block in cast(Any, network).blocks:
                    # timm scales logits by the width of one head; the rest of the scale goes into the queries' weights.
                    weight = block.attn.qkv.weight.clone()
                    weight[:width] *= _FSRA_HEADS**-0.5
                    block.attn.qkv.weight = nn.Parameter(weight)


def trained_side(entries: Entries) -> tuple[int, int]:
    """Return the training size (height, width) of a ViT's square pictures, from its positions."""
    patch, count = entries.shape("patch_embed.proj.weight", 4)[2], entries.shape("pos_embed", 3)[1]
    registers = entries.shape("reg_token", 3)[1] if "reg_token" in entries.state else 0
    cells = count - registers - ("cls_token" in entries.state)
    # Some networks have no positions for prefix tokens.
    side = patch * math.isqrt(cells if cells > 0 and math.isqrt(cells) ** 2 == cells else count)
    return side, side


def dinov2(entries: Entries, size: tuple[int, int]) -> Tokens:
    """Build torch.hub's DINOv2 without registers for an input size, with positions resampled as in its own code.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the size is no multiple of the patch size.
    """
    width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
    for key, sides in (("cls_token", 3), ("blocks.0.ls1.gamma", 1)):
        entries.shape(key, sides)
    count, grid = entries.shape("pos_embed", 3)[1], (size[0] // patch, size[1] // patch)
    side = math.isqrt(count - 1)
    if size[0] % patch or size[1] % patch or side * side != count - 1:
        raise ModelFileError(
            f"{entries.name} has patches of {patch} pixels, and pictures of {size[0]} x {size[1]}; set h and w in an opts.yaml "
            f"beside the file to multiples of {patch}."
        )
    positions = entries.tensor("pos_embed", (1, count, width))
    if grid != (side, side):
        square = positions[:, 1:].transpose(1, 2).reshape(1, width, side, side)
        scale = [(length + _LONGER) / side for length in grid]
        mapped = F.interpolate(square, scale_factor=scale, mode="bicubic", align_corners=False)
        positions = torch.cat([positions[:, :1], mapped.flatten(2).transpose(1, 2)], 1)
    return Tokens(replace(entries, state={**entries.state, "pos_embed": positions}), size)


class ConvNeXt(Trunk):
    """A ConvNeXt, also V2, with timm's names, up to its map: (B, 3, H, W) -> (B, C, H/32, W/32).

    Attributes:
        norm: the norm after the mean over the map.
    """

    def __init__(self, entries: Entries) -> None:
        import_timm()
        from timm.models import convnext

        depths = tuple(max(entries.count(f"stages.{stage}.blocks.{{}}.conv_dw.weight"), 1) for stage in range(4))
        widths = tuple(entries.shape(f"stages.{stage}.blocks.0.conv_dw.weight", 4)[0] for stage in range(4))
        # The smallest networks have convolutions of one pixel in place of linear layers.
        first = entries.state.get("stages.0.blocks.0.mlp.fc1.weight")
        second = "stages.0.blocks.0.mlp.grn.weight" in entries.state
        scale: dict[str, Any] = {"use_grn": True, "ls_init_value": None} if second else {}
        with torch.device("meta"):
            network = convnext.ConvNeXt(
                depths=depths, dims=widths, num_classes=0, conv_mlp=first is not None and first.ndim == 4, **scale
            )
        title = _CONVNEXTS.get((depths[2], widths[0]), "ConvNeXt").replace("Xt", "Xt V2" if second else "Xt")
        super().__init__(network, widths[-1], title)
        entries.fill(network)
        self.norm = HeldNorm(network.head.norm)


class ResNetMap(nn.Module):
    """A bottleneck ResNet with torchvision's names, up to its map of stride 32, without a norm."""

    norm = None

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        depths = [max(entries.count(f"layer{stage}.{{}}.conv1.weight"), 1) for stage in range(1, 5)]
        with torch.device("meta"):
            self.network = ResNet(Bottleneck, depths, "layer4", last_stride=2)
        entries.fill(self.network)
        self.channels, self.title = self.network.channels, RESNETS.get(depths[2], "ResNet")

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network(images))


def hand_made_trunk(entries: Entries) -> ConvNeXt | ResNetMap:
    """Build the trunk under `convnext.` of MCCG and its successors: a ConvNeXt, or a ResNet under `convnext.model.`."""
    if entries.has("convnext.model.conv1.weight"):
        return ResNetMap(entries.under("convnext.model."))
    return ConvNeXt(entries.under("convnext.").renamed(_TIMM_NAMES))
