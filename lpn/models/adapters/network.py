"""The common base of the adapters' networks: one branch from pictures to parts, and the equations of its parts."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError


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

    Attributes:
        grid: (h, w) of the map of a picture of the model's input size; 1 x 1 without cells.
        weight: A, the static heads, (n, D, C); None if features include them, or there are none.
    """

    grid: tuple[int, int]
    weight: Tensor | None

    def __init__(self, grid: tuple[int, int], weight: Tensor | None = None) -> None:
        super().__init__()
        self.grid = grid
        self.register_buffer("weight", weight)

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw parts of pictures: (B, 3, H, W) -> (B, n, D)."""
        return self.account(images).parts

    def account(self, images: Tensor) -> Account:
        """Return the raw parts of pictures with their account."""
        raise NotImplementedError

    def check_size(self, size: tuple[int, int], trained: tuple[int, int]) -> None:
        """Raise InputError unless the network takes pictures (height, width); by default only of its training size."""
        self._check_size(size, trained, size == trained, "pictures of that size alone")

    @staticmethod
    def _check_size(size: tuple[int, int], trained: tuple[int, int], fits: bool, wanted: str) -> None:
        if not fits:
            raise InputError(
                f"The images are {size[0]} x {size[1]}; this model was trained with {trained[0]} x {trained[1]} and takes "
                f"{wanted}."
            )


class HeldNorm(nn.Module):
    """A LayerNorm of a pooled vector, which is affine in the vector once its mean and variance are held."""

    def __init__(self, weight: Tensor, bias: Tensor, epsilon: float = 1e-6) -> None:
        super().__init__()
        self.weight, self.bias, self.epsilon = nn.Buffer(weight), nn.Buffer(bias), epsilon

    def affine(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """Return scale and offset of each channel, (B, C) each: the norm of (B, C) is scale * pooled + offset."""
        variance, mean = torch.var_mean(pooled, dim=1, correction=0, keepdim=True)
        scale = self.weight / torch.sqrt(variance + self.epsilon)
        return scale, self.bias - scale * mean

    def forward(self, pooled: Tensor) -> Tensor:
        return nn.functional.layer_norm(pooled, self.weight.shape, self.weight, self.bias, self.epsilon)


class MeanVector(PartBranch):
    """One vector without a head: the mean over the cells of a map, plain or under a LayerNorm.

    Args:
        trunk: gives a map (B, C, h, w).
        norm: of the mean; None for none.
        step: pixels along a side of one cell.
        fixed: whether pictures must have the network's training size.
    """

    def __init__(
        self, trunk: nn.Module, norm: HeldNorm | None, grid: tuple[int, int], step: int, fixed: bool = False
    ) -> None:
        super().__init__(grid)
        self.trunk, self.norm, self.step, self.fixed = trunk, norm, step, fixed

    def check_size(self, size: tuple[int, int], trained: tuple[int, int]) -> None:
        """Check that both sides are multiples of a cell's, or equal the training size."""
        if self.fixed:
            super().check_size(size, trained)
        else:
            self._check_size(
                size, trained, not any(side % self.step for side in size), f"multiples of {self.step} pixels"
            )

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw vector of pictures: (B, 3, H, W) -> (B, 1, C)."""
        pooled = self.trunk(images).mean((2, 3))
        return cast(Tensor, pooled if self.norm is None else self.norm(pooled)).unsqueeze(1)

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the norm's mean and variance held."""
        features = self.trunk(images)
        pooled = features.mean((2, 3))
        if self.norm is None:
            return Account(pooled.unsqueeze(1), features, whole_mean(features), torch.zeros_like(pooled).unsqueeze(1))
        scale, offset = self.norm.affine(pooled)
        return Account(
            self.norm(pooled).unsqueeze(1),
            features * scale[:, :, None, None],
            whole_mean(features),
            offset.unsqueeze(1),
        )


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
