"""Vision transformers: the tokens of FSRA and DenseUAV's baseline, and one vector (Game4Loc, Sample4Geo)."""

from __future__ import annotations

import math
import re
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, HeldNorm, MeanVector, PartBranch, on_grid

# The entries of a plain vision transformer of timm. Others, such as CLIP's, distilled ones, and those of SwiGLU, have more.
_PLAIN = re.compile(
    r"(cls_token|reg_token|pos_embed|patch_embed\.proj\.(weight|bias)|(norm|fc_norm|head)\.(weight|bias)|"
    r"blocks\.\d+\.((norm1|norm2|attn\.qkv|attn\.proj|mlp\.fc1|mlp\.fc2)\.(weight|bias)|ls[12]\.gamma))$"
)
NAMES = {192: "ViT-Ti", 384: "ViT-S", 512: "ViT-M", 768: "ViT-B", 1024: "ViT-L"}
# FSRA's attention has 8 heads, and scales logits by the width of all of them together.
_FSRA_HEADS = 8
# Other vision transformers have heads of 64 numbers up to the large size. Wider ones have heads of several widths.
HEAD_WIDTH, WIDEST = 64, 1024


class Tokens(nn.Module):
    """A ViT up to its last norm: (B, 3, H, W) to all tokens, (B, prefix + cells, C).

    The class token comes first where there is one, then registers, then the cells row by row.

    Args:
        entries: with timm's names.
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
        heads = _FSRA_HEADS if wide_scale else width // HEAD_WIDTH
        if depth == 0 or heads == 0 or width % heads or width > WIDEST:
            raise ModelFileError(
                f"{entries.name} has {depth} blocks of the width {width}; expected at least one, and a width up to {WIDEST} of "
                f"{f'{_FSRA_HEADS} heads' if wide_scale else f'heads of {HEAD_WIDTH} numbers'}."
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


def foreign_entry(entries: Entries) -> str | None:
    """Return an entry that shows that this is no plain vision transformer of timm: one too many, or one that is missing.

    None for a plain one.
    """
    lacking = (key for key in ("patch_embed.proj.weight", "pos_embed") if key not in entries.state)
    return next((key for key in entries.state if not _PLAIN.match(key)), next(lacking, None))


def trained_side(entries: Entries) -> tuple[int, int]:
    """Return the size (height, width) of the square pictures that a ViT's positions are for."""
    patch, count = entries.shape("patch_embed.proj.weight", 4)[2], entries.shape("pos_embed", 3)[1]
    registers = entries.shape("reg_token", 3)[1] if "reg_token" in entries.state else 0
    cells = count - registers - ("cls_token" in entries.state)
    # Some networks have no positions for the tokens in front.
    side = patch * math.isqrt(cells if cells > 0 and math.isqrt(cells) ** 2 == cells else count)
    return side, side


class RotaryMap(nn.Module):
    """A rotary ViT's patch tokens as a map: (B, 3, H, W) -> (B, C, h, w)."""

    def __init__(self, network: nn.Module, registers: int, patch: int) -> None:
        super().__init__()
        self.network, self.registers, self.patch = network, registers, patch

    def forward(self, images: Tensor) -> Tensor:
        grid = images.shape[2] // self.patch, images.shape[3] // self.patch
        tokens = cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]
        return on_grid(tokens[:, self.registers :].transpose(1, 2), grid)


class TokenMap(nn.Module):
    """A ViT's patch tokens as a map: (B, 3, H, W) -> (B, C, h, w)."""

    def __init__(self, tokens: Tokens) -> None:
        super().__init__()
        self.tokens = tokens

    def forward(self, images: Tensor) -> Tensor:
        return on_grid(self.tokens(images)[:, self.tokens.prefix :].transpose(1, 2), self.tokens.grid)


class ClassToken(PartBranch):
    """One vector, a ViT's class token after the last norm, without a head and without cells."""

    def __init__(self, trunk: Tokens) -> None:
        super().__init__((1, 1))
        self.trunk = trunk

    def account(self, images: Tensor) -> Account:
        """Return the vector; it has no account."""
        return Account(self.trunk(images)[:, :1])


def vector(entries: Entries, size: tuple[int, int]) -> MeanVector | ClassToken:
    """Build a branch of one vector from a ViT of timm: its class token, or the mean of its cells.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes.
    """
    trunk = Tokens(entries, size)
    if "cls_token" in entries.state:
        return ClassToken(trunk)
    width = (trunk.channels,)
    norm = None
    if "norm.weight" not in entries.state:
        norm = HeldNorm(entries.tensor("fc_norm.weight", width), entries.tensor("fc_norm.bias", width))
    patch = entries.shape("patch_embed.proj.weight", 4)[2]
    return MeanVector(TokenMap(trunk), norm, trunk.grid, patch, fixed=True)


def rotary_vector(entries: Entries, size: tuple[int, int]) -> tuple[MeanVector, Any]:
    """Build a branch of Game4Loc, and return it with timm's configuration of its network."""
    width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
    network, configuration = timm_networks.rotary_transformer(width, entries.count("blocks.{}.norm1.weight"), size)
    entries.fill(network)
    registers = entries.shape("reg_token", 3)[1]
    grid = size[0] // patch, size[1] // patch
    norm = HeldNorm(entries.tensor("fc_norm.weight", (width,)), entries.tensor("fc_norm.bias", (width,)))
    return MeanVector(RotaryMap(network, registers, patch), norm, grid, patch), configuration
