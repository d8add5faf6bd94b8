"""SALAD and MegaLoc: a DINOv2's cells, assigned to clusters by optimal transport, beside a vector of the class token."""

from __future__ import annotations

import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, PartBranch, by_heads, on_grid, whole_mean
from lpn.models.adapters.published import PublishedParts, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.vit import NAMES, Tokens, dinov2

# The published input size of SALAD, steps of the optimal transport, and the least length for a division.
_SIZE = (322, 322)
_STEPS, _LEAST = 3, 1e-12
_HELD = "the clusters' shares of each cell, and the lengths of the clusters"


class _Layers(nn.Module):
    """Two linear layers with a ReLU between them, over the last axis."""

    def __init__(self, entries: Entries, channels: int, second: str, sides: int) -> None:
        super().__init__()
        hidden, out = (entries.shape(f"{name}.weight", sides)[0] for name in ("0", second))
        ones = (1,) * (sides - 2)
        self.first = nn.Buffer(entries.tensor("0.weight", (hidden, channels, *ones)).flatten(1))
        self.second = nn.Buffer(entries.tensor(f"{second}.weight", (out, hidden, *ones)).flatten(1))
        self.first_bias = nn.Buffer(entries.tensor("0.bias", (hidden,)))
        self.second_bias = nn.Buffer(entries.tensor(f"{second}.bias", (out,)))

    def forward(self, values: Tensor) -> Tensor:
        return F.linear(F.relu(F.linear(values, self.first, self.first_bias)), self.second, self.second_bias)


class Salad(PartBranch):
    """SALAD's vector: the class token's, then the sum of the cells in each cluster, each scaled to length 1.

    A cell's vector depends on that cell alone. With its shares in the clusters and the clusters' lengths held, each cell has a
    share in the vector. MegaLoc adds a linear layer.

    Args:
        trunk: a DINOv2.
        entries: those under `aggregator.` of SALAD, or under `aggregator.agg.` of MegaLoc.
        head: A (1, D, token + l m) and c (1, D) of MegaLoc, for m clusters of l numbers.
    """

    def __init__(self, trunk: Tokens, entries: Entries, head: tuple[Tensor, Tensor] | None = None) -> None:
        super().__init__(trunk.grid, None if head is None else head[0])
        self.trunk, channels = trunk, trunk.channels
        self.bias = None if head is None else nn.Buffer(head[1])
        self.token = _Layers(entries.under("token_features."), channels, "2", 2)
        self.values = _Layers(entries.under("cluster_features."), channels, "3", 4)
        self.scores = _Layers(entries.under("score."), channels, "3", 4)
        self.dust_bin = nn.Buffer(entries.tensor("dust_bin", ()))

    @property
    def clusters(self) -> int:
        """The number of clusters."""
        return len(self.scores.second_bias)

    @property
    def width(self) -> int:
        """The numbers of the vector before MegaLoc's linear layer."""
        return len(self.token.second_bias) + self.clusters * len(self.values.second_bias)

    def forward(self, images: Tensor) -> Tensor:
        """Return the vector of pictures: (B, 3, H, W) -> (B, 1, D)."""
        token, values, shares = self._shared(images)
        return self._headed(torch.cat([token, torch.matmul(shares, values).transpose(1, 2).flatten(1)], 1))

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the shares of the clusters and the lengths held."""
        token, values, shares = self._shared(images)
        parts = torch.matmul(shares, values)
        by_cell = (values.transpose(1, 2).unsqueeze(2) * shares.unsqueeze(1)).flatten(1, 2) * values.shape[1]
        features = on_grid(F.pad(by_cell, (0, 0, token.shape[1], 0)), self.grid)
        constants = F.pad(token, (0, by_cell.shape[1]))
        vector = torch.cat([token, parts.transpose(1, 2).flatten(1)], 1)
        return Account(self._headed(vector), features, whole_mean(features), self._headed(constants))

    def _headed(self, vector: Tensor) -> Tensor:
        if self.weight is None:
            return vector.unsqueeze(1)
        return by_heads(vector.unsqueeze(1), self.weight, cast(Tensor, self.bias))

    def _shared(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the class token's part (B, T), the cells' vectors (B, N, l), and their shares in the clusters (B, m, N).

        Shares and token are divided by the lengths, so that the vector of token and clusters has length 1.
        """
        tokens = self.trunk(images)
        token, cells = tokens[:, 0], tokens[:, self.trunk.prefix :]
        values = self.values(cells)
        shares = transport(self.scores(cells).transpose(1, 2), self.dust_bin)
        lengths = torch.linalg.vector_norm(torch.matmul(shares, values), dim=2, keepdim=True).clamp(min=_LEAST)
        scale = (self.clusters + 1) ** -0.5
        return F.normalize(self.token(token), dim=1) * scale, values, shares / lengths * scale


def transport(scores: Tensor, dust_bin: Tensor) -> Tensor:
    """Assign N cells to m clusters by entropic optimal transport in three Sinkhorn steps: (B, m, N) -> (B, m, N).

    A further cluster, with a constant score, takes N - m of them, and is removed from the result.
    """
    batch, clusters, cells = scores.shape
    scores = torch.cat([scores, dust_bin.expand(batch, 1, cells)], 1)
    norm = -math.log(cells + clusters)
    of_clusters = scores.new_tensor([norm] * clusters + [norm + math.log(cells - clusters)])
    of_cells = scores.new_zeros(batch, cells)
    for _ in range(_STEPS):
        by_cluster = of_clusters - torch.logsumexp(scores + of_cells.unsqueeze(1), 2)
        of_cells = norm - torch.logsumexp(scores + by_cluster.unsqueeze(2), 1)
    return torch.exp(scores + by_cluster.unsqueeze(2) + of_cells.unsqueeze(1) - norm)[:, :-1]


def build(entries: Entries) -> PublishedParts:
    """Build SALAD or MegaLoc on a DINOv2; one branch describes all views.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or pictures have fewer cells than there are clusters.
        InputError: if timm is needed and cannot be imported.
    """
    mega = entries.has("aggregator.agg.")
    size = size_of(entries, _SIZE)
    trunk = dinov2(entries.under("backbone." if mega else "backbone.model."), size)
    head = None
    if mega:
        out, width = entries.shape("aggregator.linear.weight", 2)
        matrix, bias = entries.linear("aggregator.linear", width)
        head = matrix.reshape(1, out, width), bias[None]
    branch = Salad(trunk, entries.under("aggregator.agg." if mega else "aggregator."), head)
    if head is not None and branch.width != head[0].shape[2]:
        raise ModelFileError(
            f"In {entries.name}, aggregator.linear.weight takes {head[0].shape[2]} numbers; expected the {branch.width} of the "
            "class token and the clusters."
        )
    cells = trunk.grid[0] * trunk.grid[1]
    if cells <= branch.clusters:
        raise ModelFileError(
            f"{entries.name} has {branch.clusters} clusters, and pictures of {size[0]} x {size[1]} have {cells} cells; set h and "
            "w in an opts.yaml beside the file to larger ones."
        )
    return published(
        dict.fromkeys(VIEWS, branch),
        "MegaLoc" if mega else "SALAD",
        f"DINOv2 {NAMES.get(trunk.channels, 'ViT')}",
        size,
        level="exact, with held",
        held=_HELD,
        embedding=branch.width if head is None else head[0].shape[1],
        resize="bilinear",
        mirror="none",
    )


_OWN = (r"aggregator\.(agg\.)?dust_bin$", r"aggregator\.(agg\.)?cluster_features\.")
ADAPTERS = (Adapter("salad", (r"backbone\.(model\.)?blocks\.", *_OWN), build, r"mask_token$"),)
