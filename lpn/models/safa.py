"""The parts of SAFA (Shi et al. 2019) and SAFA + LPN: sums over each strip's cells, with weights computed from the picture."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import InputError
from lpn.models.backbones import map_size
from lpn.models.partition import Partition
from lpn.models.spec import ModelSpec


class SpatialAware(nn.Module):
    """The spatial-aware layers for one part of P cells.

    Each of M weight maps is computed from the maximum over channels by two linear layers without an activation between them,
    P to P/2 to P.
    """

    def __init__(self, cells: int, maps: int) -> None:
        super().__init__()
        half = max(cells // 2, 1)
        self.weight1 = nn.Parameter(nn.init.trunc_normal_(torch.empty(maps, cells, half), std=0.005, a=-0.01, b=0.01))
        self.bias1 = nn.Parameter(torch.full((maps, 1, half), 0.1))
        self.weight2 = nn.Parameter(nn.init.trunc_normal_(torch.empty(maps, half, cells), std=0.005, a=-0.01, b=0.01))
        self.bias2 = nn.Parameter(torch.full((maps, 1, cells), 0.1))

    def forward(self, features: Tensor) -> Tensor:
        """Return the weight of each cell in each map: (B, C, h, w) -> (B, M, h w)."""
        strongest = features.amax(dim=1).flatten(1).unsqueeze(0)
        hidden = torch.matmul(strongest, self.weight1) + self.bias1
        return (torch.matmul(hidden, self.weight2) + self.bias2).transpose(0, 1)


def spatial_aware_layers(spec: ModelSpec, partition: Partition, backbone: nn.Module) -> nn.ModuleList:
    """Return the layers of each part of a branch.

    Raises:
        InputError: if the backbone's map has fewer columns than there are parts.
    """
    height, width = map_size(backbone, spec.input_size)
    if width < spec.n_parts:
        raise InputError(
            f"The feature map is {height} x {width} cells, too few for {spec.n_parts} strips; use wider pictures or fewer parts."
        )
    _, _, begin, end = partition.box(0, height, width)
    return nn.ModuleList([SpatialAware(height * (end - begin), spec.maps) for _ in range(spec.n_parts)])


def attention(features: Tensor, partition: Partition, layers: Iterable[nn.Module]) -> Tensor:
    """Return the weight of each cell in each map of each part, 0 outside of the part: (B, C, h, w) -> (B, n, M, h, w)."""
    height, width = features.shape[2:]
    maps = []
    for part, own in enumerate(layers):
        _, _, begin, end = partition.box(part, height, width)
        weights = cast(Tensor, own(features[..., begin:end]))
        weights = weights.reshape(*weights.shape[:2], height, end - begin)
        maps.append(F.pad(weights, (begin, width - end)))
    return torch.stack(maps, 1)


def weigh(features: Tensor, attention: Tensor) -> Tensor:
    """Return the part embeddings: features (B, C, h, w) and weights (B, n, M, h, w) give (B, n, M C), map by map."""
    cells = features.flatten(2).transpose(1, 2).unsqueeze(1)
    return torch.matmul(attention.flatten(3), cells).flatten(2)


def by_part(features: Tensor, attention: Tensor) -> tuple[Tensor, Tensor]:
    """Return a weighted map of M C channels for each part, and the part's cells (0 or 1).

    Args:
        features: (B, C, h, w).
        attention: (B, n, M, h, w).

    Returns:
        Maps (B, n, M C, h, w), whose sums over cells are the part embeddings, and cells (B, n, h, w).
    """
    weighted = attention.unsqueeze(3) * features[:, None, None]
    return weighted.flatten(2, 3), (attention != 0).any(dim=2).to(features.dtype)
