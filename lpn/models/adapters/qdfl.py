"""QDFL: parts of learned queries over DINOv2's tokens with adapters, the class token, and GeM."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, PartBranch, by_heads, on_grid
from lpn.models.adapters.published import PublishedParts, published
from lpn.models.adapters.vit import dinov2, network_of_entries

_SIZE = (280, 280)
# Heads of the attention of queries, the share of the second adapter, and the least number under GeM's power.
_HEADS, _SHARE, _EPSILON = 8, 0.2, 1e-7
_HELD = "the attention of the queries, their norms, and the power means and lengths of GeM"


class _Adapter(nn.Module):
    """Two linear layers with a ReLU between them."""

    def __init__(self, entries: Entries, width: int) -> None:
        super().__init__()
        hidden = entries.shape("D_fc1.weight", 2)[0]
        self.D_fc1, self.D_fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)
        entries.fill(self)

    def forward(self, values: Tensor) -> Tensor:
        return cast(Tensor, self.D_fc2(F.relu(self.D_fc1(values))))


class _AdaptedAttention(nn.Module):
    """A block's attention, and what its adapter adds to it."""

    def __init__(self, attention: nn.Module, adapter: _Adapter) -> None:
        super().__init__()
        self.attention, self.adapter = attention, adapter

    def forward(self, values: Tensor, **options: Any) -> Tensor:
        attended = self.attention(values, **options)
        return cast(Tensor, attended + self.adapter(attended))


class _AdaptedMlp(nn.Module):
    """A block's hidden layer, and the share of an adapter beside it."""

    def __init__(self, mlp: nn.Module, adapter: _Adapter) -> None:
        super().__init__()
        self.mlp, self.adapter = mlp, adapter

    def forward(self, values: Tensor) -> Tensor:
        return cast(Tensor, self.mlp(values) + _SHARE * self.adapter(values))


class _Attended(NamedTuple):
    """The result of an attention of Q queries over N tokens.

    Attributes:
        values: (B, Q, C).
        weights: of each token for each head and query, (B, heads, Q, N).
    """

    values: Tensor
    weights: Tensor


class _Attention(nn.Module):
    """Attention with several heads under the names of torch's `MultiheadAttention`."""

    def __init__(self, entries: Entries, width: int) -> None:
        super().__init__()
        self.width = width
        self.matrix = nn.Buffer(entries.tensor("in_proj_weight", (3 * width, width)))
        self.bias = nn.Buffer(entries.tensor("in_proj_bias", (3 * width,)))
        self.out, self.out_bias = (nn.Buffer(one) for one in entries.linear("out_proj", width))

    def forward(self, queries: Tensor, tokens: Tensor) -> _Attended:
        query, key, value = (
            self._heads(F.linear(given, matrix, bias))
            for given, matrix, bias in zip(
                (queries, tokens, tokens), self.matrix.chunk(3), self.bias.chunk(3), strict=True
            )
        )
        weights = (torch.matmul(query, key.transpose(2, 3)) * (self.width // _HEADS) ** -0.5).softmax(3)
        pooled = torch.matmul(weights, value).transpose(1, 2).flatten(2)
        return _Attended(F.linear(pooled, self.out, self.out_bias), weights)

    def _heads(self, values: Tensor) -> Tensor:
        return values.reshape(values.shape[0], values.shape[1], _HEADS, -1).transpose(1, 2)

    def shares(self, tokens: Tensor) -> Tensor:
        """Return what each token gives to the result by each head, under a weight of 1: (B, N, C) to (B, heads, N, C)."""
        by_head = self._heads(F.linear(tokens, self.matrix.chunk(3)[2]))
        return torch.matmul(by_head, self.out.reshape(self.width, _HEADS, -1).permute(1, 2, 0))

    @property
    def constant(self) -> Tensor:
        """The bias of the result, (C,): the weights of all tokens add up to 1."""
        return F.linear(self.bias.chunk(3)[2], self.out, self.out_bias)


class _Cycle(nn.Module):
    """A 1 x 1 convolution whose channels see three neighbouring columns in turn: the own one, the right, the left."""

    def __init__(self, entries: Entries, width: int) -> None:
        super().__init__()
        self.matrix = nn.Buffer(entries.tensor("weight", (width, width, 1, 1)))
        self.bias = nn.Buffer(entries.tensor("bias", (width,)))
        turn = torch.arange(width) % 3
        self.turns = nn.Buffer(torch.stack([turn == number for number in range(3)]).float()[:, None, :, None, None])

    def forward(self, features: Tensor) -> Tensor:
        padded = F.pad(features, (1, 1))
        seen = (features, padded[..., 2:], padded[..., :-2])
        mixed = sum((own * turn for own, turn in zip(seen, self.turns, strict=True)), torch.zeros_like(features))
        return F.conv2d(mixed, self.matrix, self.bias)


class _Fusion(nn.Module):
    """QDFL's fusion of a map with its neighbours along rows and columns, (B, C, h, w) of a square map.

    The map along columns stays transposed, as it is in the released code.
    """

    def __init__(self, entries: Entries, width: int) -> None:
        super().__init__()
        self.rows, self.columns = (_Cycle(entries.under(f"{name}."), width) for name in ("cycle1", "cycle2"))
        first = entries.linear("reweight.fc1", width)
        self.first, self.first_bias = (nn.Buffer(one) for one in first)
        self.second, self.second_bias = (nn.Buffer(one) for one in entries.linear("reweight.fc2", len(first[1])))

    def forward(self, features: Tensor) -> Tensor:
        rows = self.rows(features)
        # The second convolution sees the transposed map, along whose columns lie the neighbours.
        columns = self.columns(features).transpose(2, 3)
        mean = (rows + columns + features).mean((2, 3))
        weights = F.linear(F.relu(F.linear(mean, self.first, self.first_bias)), self.second, self.second_bias)
        shares = weights.reshape(*mean.shape, 3).softmax(2)[:, :, None, None]
        return cast(Tensor, rows * shares[..., 0] + columns * shares[..., 1] + features * shares[..., 2] + features)


class _Norm(nn.Module):
    """A LayerNorm over the last axis, which is affine once its mean and variance are held."""

    def __init__(self, entries: Entries, width: int) -> None:
        super().__init__()
        self.gain, self.bias = (nn.Buffer(entries.tensor(name, (width,))) for name in ("weight", "bias"))

    def forward(self, values: Tensor) -> Tensor:
        return F.layer_norm(values, self.gain.shape, self.gain, self.bias, 1e-5)

    def affine(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return scale and offset of each number: the norm of values is scale * values + offset."""
        variance, mean = torch.var_mean(values, dim=-1, correction=0, keepdim=True)
        scale = self.gain / torch.sqrt(variance + 1e-5)
        return scale, self.bias - scale * mean


class Qdfl(PartBranch):
    """The parts of QDFL: those of remapped queries, the class token, and GeM, a head each.

    The released test scales each part of the picture to length 1, and adds that of the mirror as it is. Both passes are computed
    here, and the mirror's map is turned back.

    Args:
        trunk: gives the map (B, C, h, w) and the class token (B, C).
        entries: those under `components.`.
    """

    def __init__(self, trunk: Any, entries: Entries, width: int) -> None:
        own = entries.under("AQEU.")
        inner, channels, _, _ = own.shape("fc.weight", 4)
        self.queries_out = own.shape("query_remap.weight", 2)[0]
        pairs = [entries.head(f"classifier{number}", inner) for number in range(self.queries_out)]
        token = entries.head("token_classifier", width)
        fused = entries.head("gem_feature_classifier", inner)
        weight = torch.stack([matrix for matrix, _ in pairs] + [torch.zeros_like(fused[0]), fused[0]])
        super().__init__(trunk.grid, weight)
        self.trunk, self.inner = trunk, inner
        self.bias = nn.Buffer(torch.stack([bias for _, bias in pairs] + [token[1], fused[1]]))
        self.token = nn.Buffer(token[0])
        self.reduce = nn.Buffer(own.tensor("fc.weight", (inner, channels, 1, 1)))
        self.reduce_bias = nn.Buffer(own.tensor("fc.bias", (inner,)))
        coarse = own.under("coarse.")
        self.queries = nn.Buffer(coarse.tensor("queries", coarse.shape("queries", 3)))
        self.among_tokens, self.among_queries, self.coarse = (
            _Attention(coarse.under(f"{name}."), inner) for name in ("self_attn0", "self_attn", "cross_attn")
        )
        self.norm_x, self.norm_q, self.norm_coarse = (
            _Norm(coarse.under(f"{name}."), inner) for name in ("norm_x", "norm_q", "norm_out")
        )
        self.fusion = _Fusion(own.under("FFU."), inner)
        self.fine = _Attention(own.under("cross_attn."), inner)
        self.norm_fine_q, self.norm_fine = (_Norm(own.under(f"{name}."), inner) for name in ("norm_q", "norm_out"))
        self.remap, self.remap_bias = (nn.Buffer(one) for one in own.linear("query_remap", self.queries.shape[1]))
        self.power = nn.Buffer(entries.tensor("gem_fusion.p", (1,)))

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the attention of queries, norms, and GeM's power means held."""
        count, weight = images.shape[0], cast(Tensor, self.weight)
        # Both passes are one batch, so that the graph has one trunk.
        maps, constants = self._maps(torch.cat([images, images.flip(3)]))
        parts = by_heads(maps.mean((3, 4)), weight, constants)
        scale = 1 / torch.linalg.vector_norm(parts[:count], dim=2, keepdim=True)
        features = maps[:count] * scale[..., None, None] + maps[count:].flip(4)
        return Account(
            parts[:count] * scale + parts[count:],
            features,
            features.new_full((count, len(weight), *self.grid), 1.0 / (self.grid[0] * self.grid[1])),
            constants[:count] * scale + constants[count:],
        )

    def _maps(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return a map for each part, (B, n, C, h, w), and constants (B, n, D): the mean under the head plus them is the part."""
        features, token = self.trunk(images, True)
        tokens = F.conv2d(features, self.reduce, self.reduce_bias).flatten(2).transpose(1, 2)
        coarse = self.norm_x(tokens + self.among_tokens(tokens, tokens).values)
        queries = self.queries.expand(tokens.shape[0], -1, -1)
        queries = self.norm_q(queries + self.among_queries(queries, queries).values)
        queries = self.norm_fine_q(self.norm_coarse(self.coarse(queries, coarse).values))
        fine = self.fusion(on_grid((coarse + tokens).transpose(1, 2), self.grid))
        cells = fine.flatten(2).transpose(1, 2)
        attended = self.fine(queries, cells)
        scale, offset = self.norm_fine.affine(queries + attended.values)

        # The share of each cell in each remapped query: its value under each head, weighted by attention, norm, and remapping.
        weights = attended.weights.permute(0, 1, 3, 2)[:, None] * self.remap[None, :, None, None]
        by_head = torch.matmul(weights, scale[:, None, None]) * self.fine.shares(cells)[:, None]
        asked = on_grid(by_head.sum(2).transpose(2, 3) * cells.shape[1], self.grid)
        rest = scale * (queries + self.fine.constant) + offset
        remapped = torch.matmul(self.remap, rest) + self.remap_bias[:, None]

        powers = fine.clamp(min=_EPSILON).pow(self.power)
        means = powers.mean((2, 3))
        pooled = means.pow(1 / self.power)
        length = torch.linalg.vector_norm(pooled, dim=1, keepdim=True)
        gem = powers * (means.pow(1 / self.power - 1) / length)[:, :, None, None]

        maps = torch.cat([asked, torch.zeros_like(gem)[:, None], gem[:, None]], 1)
        weight = cast(Tensor, self.weight)
        nothing = remapped.new_zeros(token.shape[0], 2, self.inner)
        constants = by_heads(torch.cat([remapped, nothing], 1), weight, self.bias)
        of_token = F.pad(F.linear(token, self.token).unsqueeze(1), (0, 0, self.queries_out, 1))
        return maps, constants + of_token


def build_qdfl(entries: Entries) -> PublishedParts:
    """Build QDFL on a DINOv2; it describes all views alike.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the network or its pictures are others.
        InputError: if timm is needed and cannot be imported.
    """
    network = network_of_entries(dinov2(entries.under("backbone.model.")), None, _SIZE)
    if network.size[0] != network.size[1]:
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says {network.size[0]} x {network.size[1]} pixels; QDFL takes squares alone."
        )
    blocks = entries.under("backbone.model.blocks.")
    for number, block in enumerate(cast(Any, network.trunk.network).blocks):
        first, second = (_Adapter(blocks.under(f"{number}.adapter{one}."), network.channels) for one in (1, 2))
        block.attn, block.mlp = _AdaptedAttention(block.attn, first), _AdaptedMlp(block.mlp, second)
    branch = Qdfl(network.trunk, entries.under("components."), network.channels)
    names = [f"{number + 1} query" for number in range(branch.queries_out)]
    made = published(
        dict.fromkeys(VIEWS, branch),
        "QDFL",
        network.title,
        network.size,
        level="exact, with held",
        held=_HELD,
        parts=[*names, f"{len(names) + 1} class token", f"{len(names) + 2} GeM"],
        # The branch adds the mirror itself.
        mirror="none",
    )
    return PublishedParts(made.contract, made.branches, (len(names) + 2) ** 0.5)
