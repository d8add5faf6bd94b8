"""SALAD and MegaLoc: a DINOv2's cells, assigned to clusters by optimal transport, beside a vector of the class token."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import replace
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS
from lpn.models.adapters.network import Account, PartBranch, on_grid, whole_mean
from lpn.models.adapters.published import PublishedParts, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.trunks import dinov2
from lpn.models.entries import Entries

# The published input size of SALAD, steps of the optimal transport, and the least length for a division.
_SIZE = (322, 322)
_STEPS, _LEAST = 3, 1e-12


class Salad(PartBranch):
    """SALAD's vector: a vector of the class token, then the sum of the cells in each cluster, each scaled to length 1.

    A cell's vector depends on that cell alone. With its shares in the clusters and the clusters' lengths held, each cell has a
    share in the vector. MegaLoc adds a linear layer.

    Args:
        entries: of the whole checkpoint.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or pictures have fewer cells than there are clusters.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], mega: bool) -> None:
        trunk = dinov2(entries.under("backbone." if mega else "backbone.model."), size)
        own, channels = entries.under("aggregator.agg." if mega else "aggregator."), trunk.channels
        names = {"token_features": "2", "cluster_features": "3", "score": "3"}
        layers = [_layers(own.under(f"{name}."), channels, second) for name, second in names.items()]
        length, numbers, self.clusters = (cast(nn.Linear, some[-1]).out_features for some in layers)
        self.width = length + self.clusters * numbers
        heads = None
        if mega:
            weight, bias = entries.linear("aggregator.linear", self.width)
            heads = weight[None], bias[None]
        super().__init__(trunk.grid, heads, "the clusters' shares of each cell, and the lengths of the clusters")
        self.trunk, (self.token, self.values, self.scores) = trunk, layers
        self.dust_bin = nn.Buffer(own.tensor("dust_bin", ()))
        if (cells := self.grid[0] * self.grid[1]) <= self.clusters:
            raise ModelFileError(
                f"{entries.name} has {self.clusters} clusters, and pictures of {size[0]} x {size[1]} have {cells} cells; set h "
                "and w in an opts.yaml beside the file to larger ones."
            )

    def forward(self, images: Tensor) -> Tensor:
        """Return the vector of pictures: (B, 3, H, W) -> (B, 1, D)."""
        return self.headed(self._shared(images)[0])

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the shares of the clusters and the lengths held."""
        vector, token, values, shares = self._shared(images)
        by_cell = (values.transpose(1, 2).unsqueeze(2) * shares.unsqueeze(1)).flatten(1, 2) * values.shape[1]
        features = on_grid(F.pad(by_cell, (0, 0, token.shape[1], 0)), self.grid)
        constants = F.pad(token, (0, by_cell.shape[1]))
        return Account(self.headed(vector), features, whole_mean(features), self.headed(constants[:, None]))

    def _shared(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the vector before the head (B, 1, D), and its terms, which are divided by their lengths.

        These are the class token's part (B, T), the cells' vectors (B, N, l), and their shares in the clusters (B, m, N).
        """
        tokens = self.trunk(images)
        token, cells = tokens[:, 0], tokens[:, self.trunk.prefix :]
        values = self.values(cells)
        shares = transport(self.scores(cells).transpose(1, 2), self.dust_bin)
        lengths = torch.linalg.vector_norm(torch.matmul(shares, values), dim=2, keepdim=True).clamp(min=_LEAST)
        scale = (self.clusters + 1) ** -0.5
        first, shares = F.normalize(self.token(token), dim=1) * scale, shares / lengths * scale
        vector = torch.cat([first, torch.matmul(shares, values).transpose(1, 2).flatten(1)], 1)
        return vector[:, None], first, values, shares


def _layers(entries: Entries, channels: int, second: str) -> nn.Sequential:
    """Return two linear layers with a ReLU between them; 1 x 1 convolutions are read as linear layers."""
    state = {key: value.flatten(1) if value.ndim == 4 else value for key, value in entries.state.items()}
    flat = replace(entries, state=state)
    hidden, out = (flat.shape(f"{name}.weight", 2)[0] for name in ("0", second))
    with torch.device("meta"):
        named = {"0": nn.Linear(channels, hidden), "relu": nn.ReLU(), second: nn.Linear(hidden, out)}
    layers = nn.Sequential(OrderedDict(named))
    flat.fill(layers)
    return layers


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
    """Build SALAD or MegaLoc on a DINOv2; one branch describes all views."""
    mega, size = entries.has("aggregator.agg."), size_of(entries, _SIZE)
    branch = Salad(entries, size, mega)
    return published(
        dict.fromkeys(VIEWS, branch),
        "MegaLoc" if mega else "SALAD",
        f"DINOv2 {branch.trunk.title}",
        size,
        embedding=branch.width if branch.bias is None else branch.bias.shape[1],
        resize="bilinear",
        mirror="none",
    )


_OWN = (r"aggregator\.(agg\.)?dust_bin$", r"aggregator\.(agg\.)?cluster_features\.")
ADAPTERS = (Adapter("salad", (r"backbone\.(model\.)?blocks\.", *_OWN), build, r"mask_token$"),)
