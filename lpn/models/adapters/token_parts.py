"""Parts of a network's tokens by a named pooling, see `lpn.models.token_pooling`."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.models.adapters.network import Account, HeldNorm, PartBranch, on_grid
from lpn.models.token_pooling import EPSILON, TokenPooling


class CellsAndClass(nn.Module):
    """A network's map and the vector of its class token: (B, 3, H, W) to (B, C, h, w) and (B, C), the latter None without one.

    Args:
        network: of timm.
        prefix: the number of tokens in front of the cells.
        channels_last: whether the network gives a map (B, h, w, C); only if it gives no tokens.
        class_norm: of the class token; None if the network has normalised it.
    """

    def __init__(
        self,
        network: nn.Module,
        grid: tuple[int, int],
        prefix: int = 0,
        channels_last: bool = False,
        class_norm: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.network, self.grid, self.prefix, self.channels_last = network, grid, prefix, channels_last
        self.class_norm = class_norm
        own: Any = network
        self.pool = getattr(own, "attn_pool", None)
        self.has_class = self.pool is not None or getattr(own, "cls_token", None) is not None

    def forward(self, images: Tensor, with_class: bool) -> tuple[Tensor, Tensor | None]:
        values = cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]
        if values.ndim == 4:
            return (values.permute(0, 3, 1, 2) if self.channels_last else values), None
        features = on_grid(values[:, self.prefix :].transpose(1, 2), self.grid)
        if not with_class:
            return features, None
        if self.pool is not None:
            return features, cast(Tensor, self.pool(values))
        first = values[:, 0]
        return features, first if self.class_norm is None else cast(Tensor, self.class_norm(first))


class TokenParts(PartBranch):
    """The parts of a map of tokens under a pooling by name, without a head.

    Args:
        norm: a LayerNorm behind the network's own mean; only with the pooling "mean".
    """

    def __init__(self, trunk: CellsAndClass, pooling: TokenPooling, norm: HeldNorm | None = None) -> None:
        partition = pooling.partition
        super().__init__((1, 1) if partition is None else trunk.grid)
        self.trunk, self.pooling, self.norm = trunk, pooling, norm
        shares = None if partition is None else torch.from_numpy(partition.weights(*trunk.grid))
        self.register_buffer("shares", shares)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account."""
        features, first = self.trunk(images, self.pooling.needs_class_token)
        if self.shares is None:
            return Account(cast(Tensor, first).unsqueeze(1))
        shares = cast(Tensor, self.shares)
        constants = None
        if self.pooling.name == "gem":
            powers = features.clamp(min=EPSILON).pow(self.pooling.power)
            means = self._means(powers, shares)
            features = powers * means.pow(1 / self.pooling.power - 1).transpose(1, 2).unsqueeze(3)
            parts = means.pow(1 / self.pooling.power)
        else:
            parts = self._means(features, shares)
        if first is not None:
            constants = nn.functional.pad(first, (0, first.shape[1])).unsqueeze(1)
            features = nn.functional.pad(features, (0, 0, 0, 0, first.shape[1], 0))
            parts = torch.cat([first.unsqueeze(1), parts], 2)
        if self.norm is not None:
            scale, offset = self.norm.affine(parts[:, 0])
            parts, constants = self.norm(parts), offset.unsqueeze(1)
            features = features * scale[:, :, None, None]
        return Account(parts, features, shares.expand(images.shape[0], -1, -1, -1), constants)

    @staticmethod
    def _means(features: Tensor, shares: Tensor) -> Tensor:
        """Return the mean of a map over the cells of each part: (B, C, h, w) and (n, h, w) to (B, n, C)."""
        return torch.matmul(shares.flatten(1), features.flatten(2).transpose(1, 2))
