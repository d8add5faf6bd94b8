"""MFRGN: one vector of tokens of several scales, which attend to each other, and of the same scales' maps under gates."""

from __future__ import annotations

import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS
from lpn.models.adapters import convnext
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, PartBranch, on_grid, whole_mean
from lpn.models.adapters.published import PublishedParts, fixed_size, published

# Sides of the pyramid that the finest map is pooled to, heads of the attention, groups of the GroupNorm.
_PYRAMID = (1, 6, 12, 21)
_HEADS, _GROUPS, _EPSILON = 4, 32, 1e-6
_MOST = 2048
_HELD = "the gates of each scale"


class Scales(nn.Module):
    """A ConvNeXt up to its last three maps: (B, 3, H, W) -> (B, C, h, w) of the strides 8, 16, and 32."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        trunk = convnext.Trunk(entries)
        self.network = trunk.network
        self.channels = [entries.shape(f"stages.{stage}.blocks.0.conv_dw.weight", 4)[0] for stage in (1, 2, 3)]

    def forward(self, images: Tensor) -> list[Tensor]:
        network = self.network
        maps = [network.get_submodule("stages.0")(network.get_submodule("stem")(images))]
        for stage in (1, 2, 3):
            maps.append(network.get_submodule(f"stages.{stage}")(maps[-1]))
        return maps[1:]


class _Layer(nn.Module):
    """Linear attention of tokens over other tokens and themselves, and a hidden layer, each under a LayerNorm of the sum."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.query_proj, self.key_proj, self.value_proj = (nn.Linear(width, width) for _ in range(3))
        self.merge = nn.Linear(width, width, bias=False)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, hidden, bias=False), nn.GELU(), nn.Identity(), nn.Linear(hidden, width, bias=False)
        )

    def forward(self, tokens: Tensor, others: Tensor) -> Tensor:
        seen = torch.cat([others, tokens], 1)
        query, key, value = (
            self._heads(one)
            for one in (self.query_proj(tokens), self.key_proj(seen), self.value_proj(seen) / seen.shape[1])
        )
        query, key = F.elu(query) + 1, F.elu(key) + 1
        total = torch.matmul(query, key.sum(2).unsqueeze(3)) + _EPSILON
        pooled = torch.matmul(query, torch.matmul(key.transpose(2, 3), value)) / total * seen.shape[1]
        tokens = self.norm1(tokens + self.merge(pooled.transpose(1, 2).flatten(2)))
        return cast(Tensor, self.norm2(tokens + self.mlp(tokens)))

    @staticmethod
    def _heads(values: Tensor) -> Tensor:
        return values.reshape(values.shape[0], values.shape[1], _HEADS, -1).transpose(1, 2)


class _Head(nn.Module):
    """The weights behind the maps, under the last parts of their released names."""

    def __init__(self, entries: Entries, channels: list[int], pooled: bool) -> None:
        super().__init__()
        width = entries.shape("input_proj.0.0.weight", 4)[0]
        hidden = entries.shape("transformer_H.0.mlp.0.weight", 2)[0]
        kernel = entries.shape("proj_gl.0.0.weight", 3)[2]
        if pooled:
            self.norm1 = nn.LayerNorm(width)
        projections = [nn.Conv2d(count, width, 1) for count in channels]
        projections.append(nn.Conv2d(channels[-1], width, 3, 2, 1))
        self.input_proj = nn.ModuleList(nn.Sequential(one, nn.GroupNorm(_GROUPS, width)) for one in projections)
        self.transformer_H, self.transformer_L = (
            nn.ModuleList(_Layer(width, hidden) for _ in range(count))
            for count in (entries.count("transformer_H.{}.merge.weight"), 1)
        )
        sums, count = entries.shape("proj.weight", 2)
        self.proj = nn.Linear(count, sums)
        scales = [*channels, width]
        self.proj_gl = nn.ModuleList(
            nn.Sequential(
                nn.Conv1d(width, width, kernel, padding=kernel // 2),
                nn.BatchNorm1d(width),
                nn.Conv1d(width, count, kernel, padding=kernel // 2),
                nn.GELU(),
                nn.BatchNorm1d(count),
            )
            for count in scales
        )
        self.ch = nn.ModuleList(nn.Conv2d(count, count, 1) for count in scales)
        kernels = [entries.shape(f"sp.{scale}.weight", 4)[2:] for scale in range(len(scales))]
        self.sp = nn.ModuleList(nn.Conv2d(1, 1, (h, w), padding=(h // 2, w // 2)) for h, w in kernels)
        self.proj_local = nn.Linear(sum(scales), entries.shape("proj_local.weight", 2)[0])


class Mfrgn(PartBranch):
    """MFRGN's vector: a few weighted sums of all tokens, and the means of all scales under their gates.

    The cells are those of the map of stride 16. A token of another scale, or of the pyramid that the finest map is pooled to, is
    spread evenly over the cells that it covers.
    """

    def __init__(self, entries: Entries, side: int, pooled: bool) -> None:
        trunk = Scales(entries.under("backbone.backbone."))
        sides = _sides(side)
        super().__init__((sides[1], sides[1]))
        self.trunk, self.sides, self.pooled = trunk, sides, pooled
        self.width = entries.shape("embed.input_proj.0.0.weight", 4)[0]
        own = entries.renamed({r"embed\.": "", r"(transformer_[HL])\.layers\.": r"\1."})
        with torch.device("meta"):
            self.head = _Head(own, trunk.channels, pooled)
        own.fill(self.head)
        self.bias = nn.Buffer(torch.cat([self.head.proj.bias.repeat(self.width), self.head.proj_local.bias]).detach())
        self.positions = nn.ParameterList(
            nn.Parameter(_positions(self.width, length), requires_grad=False) for length in sides
        )
        # The finest map's tokens are its cells, or the cells of the pyramid.
        pools = [_pooling(sides[0], length) for length in _PYRAMID] if pooled else [torch.eye(sides[0])]
        self.pools = nn.ParameterList(nn.Parameter(pool, requires_grad=False) for pool in pools)
        finest = _spread(sides[0], sides[1])
        spreads = [finest @ pool.T for pool in pools] + [_spread(length, sides[1]) for length in sides[1:]]
        self.spreads = nn.ParameterList(nn.Parameter(spread, requires_grad=False) for spread in spreads)
        self.finest = nn.Buffer(finest)

    def forward(self, images: Tensor) -> Tensor:
        """Return the vector of pictures: (B, 3, H, W) -> (B, 1, D)."""
        return self._vector(*self._scales(images))

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the gates held."""
        maps, tokens, gates = self._scales(images)
        local = torch.split(self.head.proj_local.weight, [*self.trunk.channels, self.width], 1)
        of_scales = []
        for scale, (values, (channels, places), weight) in enumerate(zip(maps, gates, local, strict=True)):
            count = places.shape[2]
            if scale == 0:
                # Each cell of the map has a share in all cells of the pyramid that it is pooled to.
                plain, gated = (self._unpooled(one) / count for one in (torch.ones_like(places), places))
                values, spread = values * (plain + channels[..., None] * gated), cast(Tensor, self.finest)
            else:
                values = values * on_grid(1 + channels * places, values.shape[2:]) / count
                spread = self.spreads[len(self.pools) + scale - 1]
            of_scales.append(spread @ F.conv2d(values, weight[..., None, None]) @ spread.T)
        features = torch.cat([self._token_shares(tokens), torch.stack(of_scales).sum(0)], 1)
        features = features * (self.grid[0] * self.grid[1])
        constants = cast(Tensor, self.bias).expand(images.shape[0], 1, -1)
        return Account(self._vector(maps, tokens, gates), features, whole_mean(features), constants)

    def _scales(self, images: Tensor) -> tuple[list[Tensor], Tensor, list[tuple[Tensor, Tensor]]]:
        """Return the maps of the four scales, all tokens (B, N, width), and the gates of each scale."""
        head, maps = self.head, self.trunk(images)
        projected = [one(map_) for one, map_ in zip(head.input_proj, [*maps, maps[-1]], strict=True)]
        embedded = [map_ + place for map_, place in zip(projected, self.positions, strict=True)]
        low = self._pooled(embedded[0]).transpose(1, 2)
        if self.pooled:
            low = head.norm1(low)
        high = torch.cat([map_.flatten(2).transpose(1, 2) for map_ in embedded[1:]], 1)
        for layer in head.transformer_H:
            high = layer(high, low)
        low = head.transformer_L[0](low, high)
        by_scale = [low, *torch.split(high, [side * side for side in self.sides[1:]], 1)]
        gates = [self._gates(scale, own.transpose(1, 2)) for scale, own in enumerate(by_scale)]
        return [*maps, projected[-1]], torch.cat([low, high], 1), gates

    def _vector(self, maps: list[Tensor], tokens: Tensor, gates: list[tuple[Tensor, Tensor]]) -> Tensor:
        values = [self._pooled(maps[0]), *(map_.flatten(2) for map_ in maps[1:])]
        means = [(own * (1 + channels * places)).mean(2) for own, (channels, places) in zip(values, gates, strict=True)]
        summed = self.head.proj(tokens.transpose(1, 2)).flatten(1)
        return torch.cat([summed, self.head.proj_local(torch.cat(means, 1))], 1).unsqueeze(1)

    def _pooled(self, values: Tensor) -> Tensor:
        """Return the finest map (B, C, h, w) by its tokens, (B, C, N)."""
        return torch.cat([(pool @ values @ pool.T).flatten(2) for pool in self.pools], 2)

    def _unpooled(self, values: Tensor) -> Tensor:
        """Return numbers of the finest map's tokens (B, 1, N), each spread evenly over its cells, as a map (B, 1, h, w)."""
        by_pool = torch.split(values, [len(pool) ** 2 for pool in self.pools], 2)
        spread = [
            pool.T @ on_grid(one, (len(pool), len(pool))) @ pool for one, pool in zip(by_pool, self.pools, strict=True)
        ]
        return torch.stack(spread).sum(0)

    def _gates(self, scale: int, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gates of a scale's channels (B, C, 1) and places (B, 1, N) by its tokens (B, width, N)."""
        head = self.head
        values = head.proj_gl[scale](tokens)
        strongest = values.amax(1, keepdim=True)
        # The cells of a pyramid lie in one column.
        shape = (strongest.shape[2], 1) if scale == 0 and self.pooled else (self.sides[scale], self.sides[scale])
        places = head.sp[scale](on_grid(strongest, shape)).flatten(2)
        channels = head.ch[scale](values.mean(2)[..., None, None]).flatten(2)
        return torch.sigmoid(channels), torch.sigmoid(places)

    def _token_shares(self, tokens: Tensor) -> Tensor:
        """Return the share of each cell in the sums of all tokens: (B, N, width) -> (B, width * sums, h, w)."""
        weight = self.head.proj.weight
        sides = [*(len(pool) for pool in self.pools), *self.sides[1:]]
        counts = [side * side for side in sides]
        total = torch.zeros(1, device=tokens.device)
        split = zip(
            torch.split(tokens.transpose(1, 2), counts, 2), torch.split(weight, counts, 1), self.spreads, strict=True
        )
        for side, (own, weights, spread) in zip(sides, split, strict=True):
            weighted = on_grid((own.unsqueeze(2) * weights).flatten(1, 2), (side, side))
            total = total + spread @ weighted @ spread.T
        return total


def _sides(side: int) -> list[int]:
    """Return the sides of the four scales of a picture."""
    maps = [side // stride for stride in (8, 16, 32)]
    return [*maps, math.ceil(maps[-1] / 2)]


def _positions(width: int, side: int) -> Tensor:
    """Return sines and cosines of column and row, counted from 1, (1, width, side, side)."""
    place = torch.arange(1, side + 1, dtype=torch.float32)
    rates = torch.exp(torch.arange(0, width // 2, 2).float() * (-math.log(10000.0) / (width // 2)))
    angles = rates[:, None] * place
    columns, rows = angles[:, None].expand(-1, side, -1), angles[:, :, None].expand(-1, -1, side)
    return torch.stack([columns.sin(), columns.cos(), rows.sin(), rows.cos()], 1).reshape(1, width, side, side)


def _pooling(cells: int, bins: int) -> Tensor:
    """Return the matrix (bins, cells) of an adaptive mean along one side."""
    matrix = torch.zeros(bins, cells)
    for number in range(bins):
        first, last = number * cells // bins, -(-(number + 1) * cells // bins)
        matrix[number, first:last] = 1 / (last - first)
    return matrix


def _spread(source: int, target: int) -> Tensor:
    """Return the matrix (target, source) that spreads each of the source's intervals evenly over those of the target."""
    ends = torch.arange(target + 1, dtype=torch.float64)[:, None] * source / target
    covered = (ends - torch.arange(source, dtype=torch.float64)).clamp(0, 1)
    return covered.diff(dim=0).float()


def build_mfrgn(entries: Entries) -> PublishedParts:
    """Build MFRGN's model of University-1652, which describes all views alike.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the network or its pictures are others.
        InputError: if timm is needed and cannot be imported.
    """
    if "backbone.backbone.stages.0.blocks.0.conv_dw.weight" not in entries.state:
        raise ModelFileError(
            f"{entries.name} is a checkpoint of MFRGN without a ConvNeXt (backbone.backbone.stages.0.blocks.0.conv_dw.weight); "
            "MFRGN on a ResNet is not read."
        )
    pooled = "norm1.weight" in entries.state
    count = entries.shape("proj.weight", 2)[1]
    fitting = (side for side in range(32, _MOST + 1, 32) if _tokens(side, pooled) == count)
    trained = next(fitting, None)
    if trained is None:
        raise ModelFileError(
            f"In {entries.name}, proj.weight is for {count} tokens, which no square picture of 32, 64 ... {_MOST} pixels gives; "
            "expected a model of University-1652."
        )
    size = fixed_size(entries, (trained, trained))
    branch = Mfrgn(entries, trained, pooled)
    return published(
        dict.fromkeys(VIEWS, branch),
        "MFRGN",
        convnext.name_of(entries.under("backbone.backbone.")),
        size,
        level="exact, with held",
        held=_HELD,
        embedding=branch.bias.shape[0],
        resize="area",
        mirror="none",
    )


def _tokens(side: int, pooled: bool) -> int:
    finest, *others = (length * length for length in _sides(side))
    return sum(others) + (sum(length * length for length in _PYRAMID) if pooled else finest)
