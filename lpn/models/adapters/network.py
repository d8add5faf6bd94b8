"""The common base of the adapters' networks: one branch from pictures to parts, and the equations of its parts."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

NORM_HELD = "the LayerNorm's mean and variance"


class Account(NamedTuple):
    """The parts of B pictures as sums over cells, see `lpn.models.contract`.

    Attributes:
        parts: raw parts, (B, n, D).
        features: a map for all parts, (B, C, h, w), or one for each part, (B, n, C, h, w); None without cells.
        cells: the weight of each cell in each part, (B, n, h, w); None without cells.
        constants: (B, n, D); None without cells.
    """

    parts: Tensor
    features: Tensor | None = None
    cells: Tensor | None = None
    constants: Tensor | None = None


class PartBranch(nn.Module):
    """One branch of a published model, without dropout and class layers.

    Args:
        grid: (h, w) of the map of a picture of the model's input size; 1 x 1 without cells.
        heads: A (n, D, C) and c (n, D) of static heads; None if features include them, or there are none.
        held: the quantities that the account holds for each picture, "" for none; None without cells.

    Attributes:
        weight, bias: of the heads, or None.
    """

    weight: Tensor | None
    bias: Tensor | None

    def __init__(
        self,
        grid: tuple[int, int],
        heads: tuple[Tensor, Tensor] | None = None,
        held: str | None = None,
    ) -> None:
        super().__init__()
        self.grid, self.held = grid, held
        weight, bias = heads or (None, None)
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw parts of pictures: (B, 3, H, W) -> (B, n, D)."""
        return self.account(images).parts

    def account(self, images: Tensor) -> Account:
        """Return the raw parts of pictures with their account."""
        raise NotImplementedError

    def headed(self, pooled: Tensor) -> Tensor:
        """Apply the head of each part, if there are heads: (B, n, C) -> (B, n, D)."""
        if self.weight is None or self.bias is None:
            return pooled
        return by_heads(pooled, self.weight, self.bias)


class HeldNorm(nn.Module):
    """A LayerNorm of a pooled vector, which is affine in the vector once its mean and variance are held.

    Args:
        norm: a LayerNorm, or timm's LayerNorm of a map.
    """

    def __init__(self, norm: Any) -> None:
        super().__init__()
        self.weight, self.bias = (nn.Buffer(values.detach()) for values in (norm.weight, norm.bias))
        self.epsilon = norm.eps

    def affine(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """Return scale and offset of each channel, (B, C) each: the norm of (B, C) is scale * pooled + offset."""
        variance, mean = torch.var_mean(pooled, dim=1, correction=0, keepdim=True)
        scale = self.weight / torch.sqrt(variance + self.epsilon)
        return scale, self.bias - scale * mean

    def forward(self, pooled: Tensor) -> Tensor:
        return nn.functional.layer_norm(pooled, self.weight.shape, self.weight, self.bias, self.epsilon)


class MeanVector(PartBranch):
    """One vector: the mean over the cells of a map, plain, under a LayerNorm, or under a head.

    Args:
        trunk: gives a map (B, C, h, w).
        norm: of the mean; None for none.
        grid, heads: see `PartBranch`.
    """

    def __init__(
        self,
        trunk: nn.Module,
        norm: HeldNorm | None,
        grid: tuple[int, int],
        heads: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        super().__init__(grid, heads, "" if norm is None else NORM_HELD)
        self.trunk, self.norm = trunk, norm

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the norm's mean and variance held."""
        features = self.trunk(images)
        pooled, cells = features.mean((2, 3)), whole_mean(features)
        if self.norm is None:
            zero = self.headed(torch.zeros_like(pooled).unsqueeze(1))
            return Account(self.headed(pooled.unsqueeze(1)), features, cells, zero)
        scale, offset = self.norm.affine(pooled)
        return Account(self.norm(pooled).unsqueeze(1), features * scale[:, :, None, None], cells, offset.unsqueeze(1))


class FirstToken(PartBranch):
    """One vector without cells, plain or under a head: the first token, or the network's pooled vector.

    Args:
        trunk: returns tokens (B, T, C) or the pooled vector (B, C); a ViT's class token comes first.
        heads: see `PartBranch`.
    """

    def __init__(self, trunk: nn.Module, heads: tuple[Tensor, Tensor] | None = None) -> None:
        super().__init__((1, 1), heads)
        self.trunk = trunk

    def account(self, images: Tensor) -> Account:
        """Return the vector; it has no account."""
        values = self.trunk(images)
        return Account(self.headed(values[:, :1] if values.ndim == 3 else values.unsqueeze(1)))


class TokenMap(nn.Module):
    """The tokens of the cells as a map: (B, 3, H, W) -> (B, C, h, w).

    Args:
        tokens: gives tokens (B, prefix + h w, C), and has `prefix` and `grid`.
    """

    def __init__(self, tokens: Any) -> None:
        super().__init__()
        self.tokens = tokens

    def forward(self, images: Tensor) -> Tensor:
        return on_grid(self.tokens(images)[:, self.tokens.prefix :].transpose(1, 2), self.tokens.grid)


def whole_mean(features: Tensor) -> Tensor:
    """Return the cell weights of a mean over the whole map: (B, C, h, w) -> (B, 1, h, w)."""
    batch, _, height, width = features.shape
    return features.new_full((batch, 1, height, width), 1.0 / (height * width))


def on_grid(values: Tensor, grid: tuple[int, ...]) -> Tensor:
    """Reshape values (..., h w) to (..., h, w)."""
    return values.reshape(*values.shape[:-1], *grid)


def by_heads(pooled: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply a head to each part: (B, n, C) -> (B, n, D), by A (n, D, C) and c (n, D)."""
    return torch.matmul(weight, pooled.unsqueeze(3)).squeeze(3) + bias
