"""Vision transformers: FSRA and DenseUAV's baseline (regions of tokens), and Game4Loc (rotary positions)."""

from __future__ import annotations

from typing import Any, Literal, cast, get_args

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models.adapters import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, HeldNorm, MeanVector, PartBranch, by_heads, on_grid

TokenPool = Literal["global", "avg", "max", "avg+max"]
TOKEN_POOLS: tuple[TokenPool, ...] = get_args(TokenPool)
# FSRA's attention has 8 heads, and scales logits by the width of all of them together.
_FSRA_HEADS = 8
# Other vision transformers of every size have heads of 64 numbers.
HEAD_WIDTH = 64


class Tokens(nn.Module):
    """A ViT up to its last norm: (B, 3, H, W) to all tokens, the class token first, (B, 1 + cells, C).

    Args:
        entries: of timm's names.
        wide_scale: FSRA's attention: 8 heads, and logits scaled by C^-0.5 in place of (C / 8)^-0.5.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], wide_scale: bool = False) -> None:
        super().__init__()
        width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
        count, depth = entries.shape("pos_embed", 3)[1], entries.count("blocks.{}.norm1.weight")
        self.grid = size[0] // patch, size[1] // patch
        if count < 2 or count != 1 + self.grid[0] * self.grid[1] or size[0] % patch or size[1] % patch:
            raise ModelFileError(
                f"{entries.name} has positions for {count - 1} patches of {patch} pixels; {size[0]} x {size[1]} pixels give "
                f"{self.grid[0]} x {self.grid[1]}, so put the h and w that it was trained with into the opts.yaml beside it."
            )
        heads = _FSRA_HEADS if wide_scale else width // HEAD_WIDTH
        if depth == 0 or heads == 0 or width % heads:
            raise ModelFileError(
                f"{entries.name} has {depth} blocks of the width {width}; expected at least one, and a width of "
                f"{f'{_FSRA_HEADS} heads' if wide_scale else f'heads of {HEAD_WIDTH} numbers'}."
            )
        self.network = timm_networks.vision_transformer(
            width,
            depth,
            entries.shape("blocks.0.mlp.fc1.weight", 2)[0],
            size,
            patch,
            "blocks.0.attn.qkv.bias" in entries.state,
            heads,
        )
        entries.fill(self.network)
        self.channels = width
        if wide_scale:
            with torch.no_grad():
                for block in cast(Any, self.network).blocks:
                    # timm scales logits by the width of one head; the queries take the rest.
                    weight = block.attn.qkv.weight.clone()
                    weight[:width] *= _FSRA_HEADS**-0.5
                    block.attn.qkv.weight = nn.Parameter(weight)

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]


class TokenRegions(PartBranch):
    """FSRA: heads on the means of k regions of tokens, and on the class token.

    A token's heat is the mean of its numbers. Tokens in the order of falling heat are cut into k regions of floor(N / k), of
    which the last takes the rest. With k = 1 there are no regions, and one head on the class token.

    Args:
        token: the number of the class token's part, the last one for FSRA and the first one for DenseUAV.
    """

    def __init__(self, trunk: Tokens, heads: tuple[Tensor, Tensor], token: int) -> None:
        weight, bias = heads
        super().__init__(trunk.grid if len(bias) > 1 else (1, 1), weight)
        self.regions = len(bias) - 1
        if self.regions > trunk.grid[0] * trunk.grid[1]:
            raise ModelFileError(
                f"The model has {self.regions} regions for {trunk.grid[0]} x {trunk.grid[1]} tokens; expected fewer regions."
            )
        self.trunk, self.bias = trunk, nn.Buffer(bias)
        self.token = token % len(bias)

    def weights(self, tokens: Tensor) -> Tensor:
        """Return the weight of each token in each part, 0 in the class token's: (B, 1 + N, C) -> (B, n, N)."""
        heat = tokens[:, 1:].mean(2)
        count = heat.shape[1]
        own, other = heat[:, :, None], heat[:, None, :]
        earlier = torch.ones(count, count, dtype=torch.bool, device=heat.device).tril(-1)
        # Ranks by comparison are stable, and ONNX has no stable sort.
        rank = ((other > own) | ((other == own) & earlier)).sum(2)
        size = count // self.regions
        regions = torch.clamp(rank // size, max=self.regions - 1)
        sizes = [size] * (self.regions - 1) + [count - size * (self.regions - 1)]
        parts = [(regions == number) / size for number, size in enumerate(sizes)]
        parts.insert(self.token, torch.zeros_like(parts[0]))
        return torch.stack(parts, 1)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the regions held; the class token's part is a constant."""
        tokens = self.trunk(images)
        weight = cast(Tensor, self.weight)
        if not self.regions:
            return Account(by_heads(tokens[:, :1], weight, self.bias))
        cells = self.weights(tokens)
        pooled = torch.matmul(cells, tokens[:, 1:])
        constants = self.bias.expand(len(tokens), -1, -1).clone()
        constants[:, self.token] += tokens[:, 0] @ weight[self.token].T
        return Account(
            torch.matmul(weight, pooled.unsqueeze(3)).squeeze(3) + constants,
            on_grid(tokens[:, 1:].transpose(1, 2), self.grid),
            on_grid(cells, self.grid),
            constants,
        )


class PooledTokens(PartBranch):
    """DenseUAV's SingleBranch: one head on the class token, or on the mean, the maximum, or the sum of both over all others.

    With a maximum, each channel belongs to the cell that attains it; the account then has the head applied.
    """

    def __init__(self, trunk: Tokens, heads: tuple[Tensor, Tensor], pool: TokenPool) -> None:
        super().__init__((1, 1) if pool == "global" else trunk.grid, heads[0])
        self.trunk, self.pool, self.bias = trunk, pool, nn.Buffer(heads[1])

    def account(self, images: Tensor) -> Account:
        """Return the part and its account, with the cells of the maxima held."""
        tokens, weight = self.trunk(images), cast(Tensor, self.weight)
        if self.pool == "global":
            return Account(by_heads(tokens[:, :1], weight, self.bias))
        cells = tokens[:, 1:].transpose(1, 2)
        count = cells.shape[2]
        shares = cells if self.pool == "avg" else torch.zeros_like(cells)
        if self.pool != "avg":
            strongest, where = cells.max(2, keepdim=True)
            # The cells' weight is 1 / N for all pools.
            shares = shares.scatter(2, where, strongest * count)
            shares = shares + cells if self.pool == "avg+max" else shares
        batch = len(tokens)
        return Account(
            by_heads(shares.mean(2).unsqueeze(1), weight, self.bias),
            on_grid(shares, self.grid),
            cells.new_full((batch, 1, *self.grid), 1.0 / count),
            self.bias.expand(batch, -1, -1),
        )


class RotaryMap(nn.Module):
    """A rotary ViT's patch tokens as a map: (B, 3, H, W) -> (B, C, h, w)."""

    def __init__(self, network: nn.Module, registers: int, patch: int) -> None:
        super().__init__()
        self.network, self.registers, self.patch = network, registers, patch

    def forward(self, images: Tensor) -> Tensor:
        grid = images.shape[2] // self.patch, images.shape[3] // self.patch
        tokens = cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]
        return on_grid(tokens[:, self.registers :].transpose(1, 2), grid)


def rotary_vector(entries: Entries, size: tuple[int, int]) -> tuple[MeanVector, Any]:
    """Build a branch of Game4Loc, and return it with timm's configuration of its network."""
    width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
    network, configuration = timm_networks.rotary_transformer(width, entries.count("blocks.{}.norm1.weight"), size)
    entries.fill(network)
    registers = entries.shape("reg_token", 3)[1]
    grid = size[0] // patch, size[1] // patch
    norm = HeldNorm(entries.tensor("fc_norm.weight", (width,)), entries.tensor("fc_norm.bias", (width,)))
    return MeanVector(RotaryMap(network, registers, patch), norm, grid, patch), configuration
