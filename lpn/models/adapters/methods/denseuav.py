"""DenseUAV's baseline: a vision transformer, or any network of timm by its name, under one head."""

from __future__ import annotations

from typing import Any

from lpn.core.errors import ModelFileError
from lpn.models.adapters.named import filled_map
from lpn.models.adapters.network import FirstToken, MeanVector, PartBranch, TokenMap
from lpn.models.adapters.published import PublishedParts, by_view, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.trunks import Tokens, Trunk, trained_side
from lpn.models.entries import Entries

_HEAD = "classifier.add_block.0.weight"
_POOLS = ("avg", "global")


def build(entries: Entries) -> PublishedParts:
    """Build the head SingleBranch on the mean of a network's cells (`head_pool: avg`), or on its class token (`global`)."""
    head, own = entries.under("head.head."), entries.under("backbone.backbone.")
    others = [f"{head.prefix}{key}" for key in head.state if not key.startswith("classifier.")]
    if _HEAD not in head.state or others:
        raise ModelFileError(
            f"{entries.name} is a model of DenseUAV with an unsupported head (found {next(iter(others), 'nothing')}); expected "
            "SingleBranch, the head of its released checkpoint."
        )
    pool, stated = entries.options.get("head_pool", "avg"), entries.options.get("model")
    if pool not in _POOLS:
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says head_pool: {pool}; expected one of {', '.join(_POOLS)}."
        )
    tokens: Any
    mapped: Any
    if isinstance(stated, str):
        size, name = size_of(entries, (224, 224)), stated
        mapped = filled_map(name, own, size)
        tokens, grid, prefix = Trunk(mapped.network, mapped.channels, name), mapped.grid, mapped.prefix
        if prefix > 1:
            raise ModelFileError(
                f"{entries.name} has {prefix} tokens before the cells on timm's {name}; DenseUAV's heads take one class token."
            )
    elif "cls_token" in own.state and "dist_token" not in own.state:
        size = size_of(entries, trained_side(own), own.shape("patch_embed.proj.weight", 4)[2])
        tokens = Tokens(own, size)
        mapped, grid, prefix, name = TokenMap(tokens), tokens.grid, 1, tokens.title
    else:
        raise ModelFileError(
            f"{entries.name} is a model of DenseUAV with an unknown backbone (found "
            f"{next((own.file_name(key) for key in own.state), 'nothing')}); write its network's name in timm as `model: NAME` "
            "into an opts.yaml beside the file."
        )
    heads = head.heads(["classifier"], tokens.channels)
    if pool == "global" and prefix:
        branch: PartBranch = FirstToken(tokens, heads)
    else:
        branch = MeanVector(mapped, None, grid, heads)
    return published(by_view(entries, [branch]), "DenseUAV", name, size, ["whole"])


ADAPTERS = (
    Adapter(
        "denseuav",
        (r"backbone\.backbone\.", r"head\.head\."),
        build,
        r"^head\.head\..*classifier\w*\.classifier\.|^backbone\.backbone\.(head|fc|classifier)\.",
    ),
)
