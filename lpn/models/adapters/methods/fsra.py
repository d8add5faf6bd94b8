"""FSRA: regions of a vision transformer's tokens by their heat, and its class token, each with a head."""

from __future__ import annotations

from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import PartBranch
from lpn.models.adapters.pooled import PooledTokens, RegionWeights, first_alone
from lpn.models.adapters.published import (
    PublishedParts,
    by_view,
    count_regions,
    region_names,
    regions_level,
    size_of,
)
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.vit import Tokens


def build(entries: Entries) -> PublishedParts:
    """Build FSRA with any number of regions; one block is the class token alone."""
    size = size_of(entries, (256, 256))
    regions = count_regions(entries.under("model_1."))

    def branch(own: Entries) -> PartBranch:
        trunk = Tokens(own.under("transformer."), size, wide_scale=True)
        heads = own.heads([*(f"classifier_heat{i + 1}" for i in range(regions)), "classifier1"], trunk.channels)
        count = 1 + trunk.grid[0] * trunk.grid[1]
        weights = RegionWeights(regions, count, class_token=True, whole=-1) if regions else first_alone(count)
        return PooledTokens(trunk, weights, heads, cells=regions > 0)

    names = [*region_names(regions), "class token"]
    return by_view(entries, branch, "FSRA", "ViT-S", size, names=names, **regions_level(regions))


ADAPTERS = (
    Adapter(
        "fsra",
        (r"model_1\.transformer\.blocks\.", r"model_1\.classifier1\.add_block\."),
        build,
        r"\.classifier(1|_heat\d+)\.classifier\.|\.classifier_heat1\.|^model_\d\.transformer\.(fc|head)\.",
    ),
)
