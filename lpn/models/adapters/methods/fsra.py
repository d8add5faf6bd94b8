"""FSRA: regions of a vision transformer's tokens by their heat, and its class token, each with a head."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models.adapters.network import Account, FirstToken, PartBranch, on_grid
from lpn.models.adapters.published import PublishedParts, by_view, check_option, numbered, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.trunks import Tokens
from lpn.models.entries import Entries


class Regions(PartBranch):
    """The means of k regions of tokens, and the class token, each with a head.

    N tokens, hottest first (by the mean over channels), are cut into k regions of floor(N / k); the last takes the rest, too.

    Args:
        heads: of the regions, hottest first, then of the class token.

    Raises:
        ModelFileError: if there are more regions than tokens.
    """

    def __init__(self, trunk: Tokens, regions: int, heads: tuple[Tensor, Tensor]) -> None:
        super().__init__(trunk.grid, heads, held="the regions of each picture")
        self.trunk, self.regions = trunk, regions
        if regions > (cells := trunk.grid[0] * trunk.grid[1]):
            raise ModelFileError(f"The model has {regions} regions for {cells} tokens; expected fewer regions.")

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the regions held; the class token is a constant."""
        tokens = self.trunk(images)
        first, cells = tokens[:, :1], tokens[:, 1:]
        shares = self.shares(cells.mean(2))
        parts = self.headed(torch.cat([torch.matmul(shares, cells), first], 1))
        nothing = torch.zeros_like(first).expand(-1, self.regions, -1)
        return Account(
            parts,
            on_grid(cells.transpose(1, 2), self.grid),
            on_grid(nn.functional.pad(shares, (0, 0, 0, 1)), self.grid),
            self.headed(torch.cat([nothing, first], 1)),
        )

    def shares(self, heat: Tensor) -> Tensor:
        """Return the weight of each cell in each region: (B, N) -> (B, k, N)."""
        count = heat.shape[1]
        own, other = heat[:, :, None], heat[:, None, :]
        earlier = torch.ones(count, count, dtype=torch.bool, device=heat.device).tril(-1)
        # Ranks by comparison are stable, and ONNX has no stable sort.
        rank = ((other > own) | ((other == own) & earlier)).sum(2)
        size = count // self.regions
        region = torch.clamp(rank // size, max=self.regions - 1)
        sizes = [size] * (self.regions - 1) + [count - size * (self.regions - 1)]
        return torch.stack([(region == number) / size for number, size in enumerate(sizes)], 1)


def build(entries: Entries) -> PublishedParts:
    """Build FSRA with any number of regions; with `block` 1 there is only the class token."""
    size = size_of(entries, (256, 256))
    blocks = entries.under("model_1.").count_heads("classifier_heat")
    if blocks or entries.options.get("block") != 1:
        check_option(entries, "block", blocks)
    regions = blocks if blocks > 1 else 0

    def branch(own: Entries) -> PartBranch:
        trunk = Tokens(own.under("transformer."), size, wide_scale=True)
        heads = own.heads([*(f"classifier_heat{i + 1}" for i in range(regions)), "classifier1"], trunk.channels)
        return Regions(trunk, regions, heads) if regions else FirstToken(trunk, heads)

    names = [*["hottest", *["region"] * max(regions - 2, 0), "coolest"][:regions], "class token"]
    return published(by_view(entries, list(map(branch, numbered(entries)))), "FSRA", "ViT-S", size, names)


ADAPTERS = (
    Adapter(
        "fsra",
        (r"model_1\.transformer\.blocks\.", r"model_1\.classifier1\.add_block\."),
        build,
        r"\.classifier(1|_heat\d+)\.classifier\.|\.classifier_heat1\.|^model_\d\.transformer\.(fc|head)\.",
    ),
)
