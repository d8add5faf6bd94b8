"""DenseUAV's baseline: its backbones of timm, and its heads."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.named import NamedTokens, filled_map, matching
from lpn.models.adapters.network import PartBranch
from lpn.models.adapters.pooled import (
    TOKEN_POOLS,
    FixedWeights,
    MapCells,
    PooledTokens,
    RegionWeights,
    StrongestTokens,
    first_alone,
)
from lpn.models.adapters.published import (
    PublishedParts,
    by_view,
    check_option,
    count_regions,
    region_names,
    regions_level,
    size_of,
)
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.vit import NAMES, Tokens, trained_side
from lpn.models.contract import part_names
from lpn.models.partition import Partition

# Backbones by timm's name, in the order of recognition: an entry, with its shape, that no later one has.
_BACKBONES: dict[str, tuple[str, tuple[int, ...]]] = {
    "resnet50": ("layer3.5.conv3.weight", (1024, 256, 1, 1)),
    "convnext_tiny": ("stages.2.blocks.8.conv_dw.weight", (384, 1, 7, 7)),
}
# Heads by their unique entries; the option `head` may have one of the endings, by the backbone.
_GLOBAL, _RINGS, _GEM = "global_classifier.add_block.0.weight", "classifier_lpn_", "pool.gem2.p"
_FIRST = "classifier1.add_block.0.weight"
_HEADS = {
    "FSRA": _FIRST,
    "LPN": f"{_RINGS}1.add_block.0.weight",
    "GeM": _GEM,
    "SingleBranch": "classifier.add_block.0.weight",
}
_ENDINGS = re.compile(r"(_?CNN|Swin)$")


class _Head(NamedTuple):
    """A head on a trunk.

    Attributes:
        names: of its parts.
        level: the contract's arguments for the exactness of its evidence.
        blocks: the option `block`; the released code divides several parts by its root.
    """

    branch: PartBranch
    names: list[str]
    level: dict[str, Any]
    blocks: int = 1


def build(entries: Entries) -> PublishedParts:
    """Build a model of DenseUAV's code, on a vision transformer, a ResNet-50, a ConvNeXt-T, or any network of timm by its name.

    Raises:
        ModelFileError: if entries are missing, have wrong shapes, contradict the options, or belong to an unsupported backbone
            or head.
        InputError: if timm is needed and cannot be imported.
    """
    trunk, backbone, size = _backbone(entries)
    head = entries.under("head.head.")
    _check_head(entries, head)
    made = _head(entries, head, trunk)
    model = by_view(entries, lambda _: made.branch, "DenseUAV", backbone, size, names=made.names, **made.level)
    # The released code divides the parts by their norms times the root of `block`.
    return replace(model, length=math.sqrt(len(made.names) / made.blocks))


def _backbone(entries: Entries) -> tuple[Any, str, tuple[int, int]]:
    """Return the module for tokens (B, prefix + N, C), its name, and the input size."""
    own = entries.under("backbone.backbone.")
    stated = entries.options.get("model")
    name = str(stated) if isinstance(stated, str) else matching(_BACKBONES, own)
    if name is None and "cls_token" in own.state and "dist_token" not in own.state:
        size = size_of(entries, trained_side(own), own.shape("patch_embed.proj.weight", 4)[2])
        tokens = Tokens(own, size)
        return tokens, NAMES.get(tokens.channels, "ViT"), size
    if name is None:
        entry = next((own.file_name(key) for key in own.state), "nothing")
        raise ModelFileError(
            f"{entries.name} is DenseUAV's, of a backbone that its entries do not tell (found {entry}); write its network's name "
            "in timm as `model: NAME` into an opts.yaml beside the file."
        )
    size = size_of(entries, (224, 224))
    network = filled_map(name, own, size)
    if network.patch is not None:
        return NamedTokens(network, network.grid), name, size
    return MapCells(network, network.grid, network.channels), name, size


def _check_head(entries: Entries, head: Entries) -> None:
    """Refuse an unsupported head, and options that contradict the head."""
    own = next((name for name, key in _HEADS.items() if key in head.state), None)
    stated = entries.options.get("head")
    if own is None or "netvlad.centroids" in head.state:
        entry = next((f"{head.prefix}{key}" for key in head.state if not key.startswith("classifier.")), "nothing")
        raise ModelFileError(
            f"{entries.name} is DenseUAV's, of a head that is not read (found {entry}); expected one of {', '.join(_HEADS)}."
        )
    if stated is not None and _ENDINGS.sub("", str(stated)) != own:
        raise ModelFileError(
            f"{entries.name} has DenseUAV's head {own}, but the opts.yaml beside it says head: {stated}; correct or remove it."
        )


def _head(entries: Entries, head: Entries, trunk: Any) -> _Head:
    count, tokens = trunk.prefix + trunk.grid[0] * trunk.grid[1], trunk.prefix > 0
    if rings := head.count_heads(_RINGS):
        return _rings(entries, head, trunk, rings)
    if _FIRST in head.state:
        regions = count_regions(head)
        heads = head.heads(["classifier1", *(f"classifier_heat{i + 1}" for i in range(regions))], trunk.channels)
        if regions:
            weights = RegionWeights(regions, count, tokens, whole=0)
            names = ["class token" if tokens else "whole", *region_names(regions)]
            return _Head(PooledTokens(trunk, weights, heads), names, regions_level(regions), regions)
        return _class_token(trunk, heads, count) if tokens else _mean(trunk, heads, count)
    heads = head.heads(["classifier"], trunk.channels)
    if _GEM in head.state:
        # Its weights are a softmax over the places, equal for all pictures.
        _check_plain(entries, trunk, "GeM")
        shares = torch.softmax(head.tensor(_GEM, (count - 1,)), 0)
        branch = PooledTokens(trunk, FixedWeights(nn.functional.pad(shares, (1, 0))[None]), heads)
        return _Head(branch, ["whole"], {"level": "exact"})
    pool = entries.options.get("head_pool", "avg") if tokens else "avg"
    if pool not in TOKEN_POOLS:
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says head_pool: {pool}; expected one of {', '.join(TOKEN_POOLS)}."
        )
    if pool == "global":
        return _class_token(trunk, heads, count)
    if pool == "avg":
        return _mean(trunk, heads, count)
    level = {"level": "exact, with held", "held": "the cells of the maxima"}
    return _Head(StrongestTokens(trunk, heads, pool == "avg+max"), ["whole"], level)


def _rings(entries: Entries, head: Entries, trunk: Any, rings: int) -> _Head:
    """Return the head LPN, whose first part is the class token, or LPN_CNN, which has rings alone."""
    check_option(entries, "block", rings)
    names = [f"{_RINGS}{number + 1}" for number in range(rings)]
    partition = Partition("rings", rings)
    weights = torch.from_numpy(partition.weights(*trunk.grid)).flatten(1)
    # The numbers of the partition's names are removed, as `by_view` adds its own.
    parts = [name.partition(" ")[2] or "ring" for name in part_names(partition)]
    if _GLOBAL not in head.state:
        if trunk.prefix:
            raise ModelFileError(
                f"{entries.name} lacks {head.prefix}{_GLOBAL}, which DenseUAV's head LPN has on a vision transformer; the file "
                "is incomplete, so give a whole checkpoint."
            )
        branch = PooledTokens(trunk, FixedWeights(weights), head.heads(names, trunk.channels))
        return _Head(branch, parts, {"level": "exact"}, rings)
    _check_plain(entries, trunk, "LPN")
    heads = head.heads(["global_classifier", *names], trunk.channels)
    first = nn.functional.pad(torch.ones(1, 1), (0, weights.shape[1]))
    branch = PooledTokens(trunk, FixedWeights(torch.cat([first, nn.functional.pad(weights, (1, 0))])), heads)
    level = {"level": "exact, with held", "held": "the class token"}
    return _Head(branch, ["class token", *parts], level, rings)


def _class_token(trunk: Any, heads: tuple[Tensor, Tensor], count: int) -> _Head:
    branch = PooledTokens(trunk, first_alone(count), heads, cells=False)
    return _Head(branch, ["whole"], {"level": "one vector"})


def _mean(trunk: Any, heads: tuple[Tensor, Tensor], count: int) -> _Head:
    """Return a head on the mean of all tokens but the class token. A distillation token counts."""
    first = min(trunk.prefix, 1)
    weights = FixedWeights(nn.functional.pad(torch.full((1, count - first), 1.0 / (count - first)), (first, 0)))
    level = {"level": "exact, with held", "held": "the distillation token"} if trunk.prefix > 1 else {"level": "exact"}
    return _Head(PooledTokens(trunk, weights, heads), ["whole"], level)


def _check_plain(entries: Entries, trunk: Any, head: str) -> None:
    if trunk.prefix != 1 or trunk.grid[0] != trunk.grid[1]:
        raise ModelFileError(
            f"{entries.name} has DenseUAV's head {head} on {trunk.grid[0]} x {trunk.grid[1]} cells behind {trunk.prefix} tokens; "
            "its code takes a square of cells behind one class token."
        )


ADAPTERS = (
    Adapter(
        "denseuav",
        (r"backbone\.backbone\.", r"head\.head\."),
        build,
        r"^head\.head\..*classifier\w*\.classifier\.|^backbone\.backbone\.(head|fc|classifier)\.|^head\.head\.pool\.",
    ),
)
