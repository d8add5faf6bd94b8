"""Parts that are heads on weighted means of a network's cells and prefix tokens."""

from __future__ import annotations

from typing import Any, Literal, cast, get_args

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models.adapters.network import Account, PartBranch, by_heads, on_grid

TokenPool = Literal["global", "avg", "max", "avg+max"]
TOKEN_POOLS: tuple[TokenPool, ...] = get_args(TokenPool)


class MapCells(nn.Module):
    """The cells of a convolutional network's map as tokens: (B, 3, H, W) -> (B, h w, C).

    Args:
        network: gives a map (B, C, h, w).
        grid: its (h, w).
    """

    prefix = 0

    def __init__(self, network: nn.Module, grid: tuple[int, int], channels: int) -> None:
        super().__init__()
        self.network, self.grid, self.channels = network, grid, channels

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network(images)).flatten(2).transpose(1, 2)


class FixedWeights(nn.Module):
    """Constant weights of tokens.

    Args:
        weights: (n, prefix + N).
    """

    def __init__(self, weights: Tensor) -> None:
        super().__init__()
        self.weights = nn.Buffer(weights)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the weight of each token in each part: (B, prefix + N, C) -> (B, n, prefix + N)."""
        return self.weights.expand(tokens.shape[0], -1, -1)


def first_alone(count: int) -> FixedWeights:
    """Return the weights of one part that is the first of `count` tokens."""
    return FixedWeights(nn.functional.pad(torch.ones(1, 1), (0, count - 1)))


class RegionWeights(nn.Module):
    """FSRA's regions: tokens by falling heat, cut into k regions of floor(N / k), with the rest in the last one.

    A token's heat is the mean over its channels. One extra part is the class token, or without one the mean of all tokens.

    Args:
        regions: k.
        class_token: whether the first token is the class token, which is in no region.
        whole: the number of the extra part.

    Raises:
        ModelFileError: if there are more regions than tokens.
    """

    def __init__(self, regions: int, count: int, class_token: bool, whole: int) -> None:
        super().__init__()
        if regions > count - class_token:
            raise ModelFileError(
                f"The model has {regions} regions for {count - class_token} tokens; expected fewer regions."
            )
        self.regions, self.class_token, self.whole = regions, class_token, whole % (regions + 1)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the weight of each token in each part: (B, prefix + N, C) -> (B, k + 1, prefix + N)."""
        first = int(self.class_token)
        heat = tokens[:, first:].mean(2)
        count = heat.shape[1]
        own, other = heat[:, :, None], heat[:, None, :]
        earlier = torch.ones(count, count, dtype=torch.bool, device=heat.device).tril(-1)
        # Ranks by comparison are stable, and ONNX has no stable sort.
        rank = ((other > own) | ((other == own) & earlier)).sum(2)
        size = count // self.regions
        regions = torch.clamp(rank // size, max=self.regions - 1)
        sizes = [size] * (self.regions - 1) + [count - size * (self.regions - 1)]
        parts = [(regions == number) / size for number, size in enumerate(sizes)]
        if self.class_token:
            parts = [nn.functional.pad(part, (1, 0)) for part in parts]
            whole = nn.functional.pad(torch.ones_like(heat[:, :1]), (0, count))
        else:
            whole = torch.full_like(heat, 1.0 / count)
        parts.insert(self.whole, whole)
        return torch.stack(parts, 1)


class PooledTokens(PartBranch):
    """A head for each part on a weighted mean of tokens.

    Tokens before the cells, such as a class token, have no place in the picture. Their share of a part is a constant.

    Args:
        trunk: gives tokens (B, prefix + N, C), with those of the cells last, row by row; it has the attributes `prefix` and
            `grid`.
        weights: of the tokens in the parts.
        heads: A (n, D, C) and c (n, D).
        cells: False if no part pools over the map; the branch then gives no evidence.
    """

    def __init__(self, trunk: Any, weights: nn.Module, heads: tuple[Tensor, Tensor], cells: bool = True) -> None:
        super().__init__(trunk.grid if cells else (1, 1), heads[0])
        self.trunk, self.weights, self.bias, self.cells = trunk, weights, nn.Buffer(heads[1]), cells

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the weights held."""
        tokens, weight = self.trunk(images), cast(Tensor, self.weight)
        shares, first = self.weights(tokens), self.trunk.prefix
        parts = by_heads(torch.matmul(shares, tokens), weight, self.bias)
        if not self.cells:
            return Account(parts)
        constants = self.bias.expand(tokens.shape[0], -1, -1)
        if first:
            constants = by_heads(torch.matmul(shares[:, :, :first], tokens[:, :first]), weight, self.bias)
        return Account(
            parts,
            on_grid(tokens[:, first:].transpose(1, 2), self.grid),
            on_grid(shares[:, :, first:], self.grid),
            constants,
        )


class StrongestTokens(PartBranch):
    """DenseUAV's SingleBranch with `head_pool` "max" or "avg+max": a head on the maximum of all tokens but the class token.

    Each channel belongs to the token that attains it; the account includes the head.

    Args:
        trunk: as for `PooledTokens`, with a class token.
        mean: whether to add the mean of these tokens.
    """

    def __init__(self, trunk: Any, heads: tuple[Tensor, Tensor], mean: bool) -> None:
        super().__init__(trunk.grid, heads[0])
        self.trunk, self.mean, self.bias = trunk, mean, nn.Buffer(heads[1])

    def account(self, images: Tensor) -> Account:
        """Return the part and its account, with the tokens of the maxima held."""
        tokens, weight = self.trunk(images)[:, 1:].transpose(1, 2), cast(Tensor, self.weight)
        strongest, where = tokens.max(2, keepdim=True)
        shares = torch.zeros_like(tokens).scatter(2, where, strongest)
        shares = shares + tokens / tokens.shape[2] if self.mean else shares
        first, batch = self.trunk.prefix - 1, tokens.shape[0]
        cells = shares[:, :, first:]
        constants = self.bias.expand(batch, -1, -1)
        if first:
            constants = by_heads(shares[:, :, :first].sum(2).unsqueeze(1), weight, self.bias)
        count = cells.shape[2]
        return Account(
            by_heads(shares.sum(2).unsqueeze(1), weight, self.bias),
            # All cells weigh 1 / N.
            on_grid(cells * count, self.grid),
            cells.new_full((batch, 1, *self.grid), 1.0 / count),
            constants,
        )
