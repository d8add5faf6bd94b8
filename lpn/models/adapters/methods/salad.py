"""SALAD and MegaLoc: a DINOv2's cells, assigned to clusters by optimal transport, beside a vector of the class token."""

from __future__ import annotations

import math
from dataclasses import replace

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
        length, numbers, self.clusters = (
            own.shape(f"{name}.bias", 1)[0] for name in ("token_features.2", "cluster_features.3", "score.3")
        )
        self.width = length + self.clusters * numbers
        token = _layers(own.under("token_features."), channels, "2")
        values, scores = (_layers(own.under(f"{name}."), channels, "3") for name in ("cluster_features", "score"))
        weight, bias = entries.linear("aggregator.linear", self.width) if mega else (None, None)
        held = "the clusters' shares of each cell, and the lengths of the clusters"
        super().__init__(trunk.grid, None if weight is None or bias is None else (weight[None], bias[None]), held=held)
        self.trunk, self.token, self.values, self.scores = trunk, token, values, scores
        self.dust_bin = nn.Buffer(own.tensor("dust_bin", ()))
        if (cells := self.grid[0] * self.grid[1]) <= self.clusters:
            raise ModelFileError(
                f"{entries.name} has {self.clusters} clusters, and pictures of {size[0]} x {size[1]} have {cells} cells; set h "
                "and w in an opts.yaml beside the file to larger ones."
            )

    def forward(self, images: Tensor) -> Tensor:
        """Return the vector of pictures: (B, 3, H, W) -> (B, 1, D)."""
        token, values, shares = self._shared(images)
        return self.headed(torch.cat([token, torch.matmul(shares, values).transpose(1, 2).flatten(1)], 1)[:, None])

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the shares of the clusters and the lengths held."""
        token, values, shares = self._shared(images)
        parts = torch.matmul(shares, values)
        by_cell = (values.transpose(1, 2).unsqueeze(2) * shares.unsqueeze(1)).flatten(1, 2) * values.shape[1]
        features = on_grid(F.pad(by_cell, (0, 0, token.shape[1], 0)), self.grid)
        constants = F.pad(token, (0, by_cell.shape[1]))
        vector = torch.cat([token, parts.transpose(1, 2).flatten(1)], 1)
        return Account(self.headed(vector[:, None]), features, whole_mean(features), self.headed(constants[:, None]))

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


def _layers(entries: Entries, channels: int, second: str) -> nn.Sequential:
    """Return two linear layers with a ReLU between them; 1 x 1 convolutions are read as linear layers."""
    entries = entries.renamed({rf"{second}\.": "2."})
    flat = replace(
        entries, state={key: value.flatten(1) if value.ndim == 4 else value for key, value in entries.state.items()}
    )
    hidden, out = (flat.shape(f"{name}.weight", 2)[0] for name in ("0", "2"))
    with torch.device("meta"):
        layers = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, out))
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
