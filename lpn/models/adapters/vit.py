"""Vision transformers of timm's names, built from the shapes of their entries."""

from __future__ import annotations

import math
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import on_grid

NAMES = {192: "ViT-Ti", 384: "ViT-S", 512: "ViT-M", 768: "ViT-B", 1024: "ViT-L"}
# FSRA's attention has 8 heads, and scales logits by their total width.
_FSRA_HEADS = 8
# Other vision transformers have heads of 64 numbers up to the large size. Wider ones have heads of several widths.
_HEAD_WIDTH, _WIDEST = 64, 1024
# DINOv2's code resamples positions with a scale for sides that are this much longer than the original ones.
_LONGER = 0.1


class Tokens(nn.Module):
    """A ViT up to its last norm: (B, 3, H, W) to all tokens, (B, prefix + cells, C).

    The class token, if any, comes first, then registers, then the cells row by row.

    Args:
        entries: with timm's names. The option `heads` is their number unless they have 64 numbers each.
        wide_scale: FSRA's attention: 8 heads, and logits scaled by C^-0.5 in place of (C / 8)^-0.5.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], wide_scale: bool = False) -> None:
        super().__init__()
        state = entries.state
        width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
        count, depth = entries.shape("pos_embed", 3)[1], entries.count("blocks.{}.norm1.weight")
        registers = entries.shape("reg_token", 3)[1] if "reg_token" in state else 0
        self.prefix = registers + ("cls_token" in state)
        self.grid = size[0] // patch, size[1] // patch
        cells = self.grid[0] * self.grid[1]
        if not cells or count not in (cells, cells + self.prefix) or size[0] % patch or size[1] % patch:
            raise ModelFileError(
                f"{entries.name} has positions for {count - self.prefix} patches of {patch} pixels; {size[0]} x {size[1]} pixels "
                f"give {self.grid[0]} x {self.grid[1]}, so put the h and w that it was trained with into the opts.yaml beside it."
            )
        heads = _FSRA_HEADS if wide_scale else entries.options.get("heads", width // _HEAD_WIDTH)
        if depth == 0 or not isinstance(heads, int) or heads < 1 or width % heads or width > _WIDEST:
            raise ModelFileError(
                f"{entries.name} has {depth} blocks of the width {width}; expected at least one, and a width up to {_WIDEST} of "
                f"{f'{_FSRA_HEADS} heads' if wide_scale else f'heads of {_HEAD_WIDTH} numbers'}."
            )
        self.network = timm_networks.vision_transformer(
            width,
            depth,
            entries.shape("blocks.0.mlp.fc1.weight", 2)[0],
            size,
            patch,
            heads,
            qkv_bias="blocks.0.attn.qkv.bias" in state,
            class_token="cls_token" in state,
            registers=registers,
            cells_only=count == cells,
            layer_scale="blocks.0.ls1.gamma" in state,
            last_norm="norm.weight" in state,
        )
        entries.fill(self.network)
        self.channels = width
        if wide_scale:
            with torch.no_grad():
                for block in cast(Any, self.network).blocks:
                    # timm scales logits by the width of one head; the queries take the rest.
                    weight = block.attn.qkv.weight.clone()
                    weight[:width] *= _FSRA_HEADS**-0.5
                    block.attn.qkv.weight = nn.Parameter(weight)

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]


class TokenMap(nn.Module):
    """A ViT's patch tokens as a map: (B, 3, H, W) -> (B, C, h, w).

    Args:
        tokens: gives all tokens, with `prefix` of them before the cells.
        patch: pixels along a side of one cell.
    """

    def __init__(self, tokens: nn.Module, prefix: int, patch: int) -> None:
        super().__init__()
        self.tokens, self.prefix, self.patch = tokens, prefix, patch

    def forward(self, images: Tensor) -> Tensor:
        grid = images.shape[2] // self.patch, images.shape[3] // self.patch
        return on_grid(cast(Tensor, self.tokens(images))[:, self.prefix :].transpose(1, 2), grid)


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
        ModelFileError: if entries are missing or have wrong shapes, or the size is no multiple of the patches'.
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
    return Tokens(entries.with_tensor("pos_embed", positions), size)
