"""Build the branches and the contract of each published model from the entries of its checkpoint."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.core.views import View
from lpn.models.adapters import convnext, sdpl, transformers
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import PartBranch
from lpn.models.adapters.recognise import Kind
from lpn.models.contract import Contract, Level, Role

log = logging.getLogger(__name__)

_PAIR: tuple[View, ...] = ("satellite", "drone")
_TRIPLE: tuple[View, ...] = ("satellite", "street", "drone")
# Entries that the published code keeps and does not use for descriptors.
_UNUSED = re.compile(
    r".*(\bclassifier\.\d+\.|num_batches_tracked$)|(bn|gem\d+|model\.fc|transformer\.fc|convnext\.head)\."
)
_NORM_HELD = "the LayerNorm's mean and variance"
_CONVNEXTS = {(9, 96): "ConvNeXt-T", (27, 96): "ConvNeXt-S", (27, 128): "ConvNeXt-B", (27, 192): "ConvNeXt-L"}


@dataclass(frozen=True)
class PublishedParts:
    """A model as its checkpoint tells.

    Attributes:
        contract: what the model says of itself.
        branches: by view, or by role where the contract's roles are "role".
        length: of a descriptor that the released test code writes.
    """

    contract: Contract
    branches: Mapping[View | Role, PartBranch]
    length: float = 1.0


def build(kind: Kind, entries: Entries) -> PublishedParts:
    """Build a model other than an LPN.

    Raises:
        ModelFileError: if entries are missing, have wrong shapes, or contradict the options.
        InputError: if timm is needed and cannot be imported.
    """
    return _BUILDERS[kind](entries)


def _fsra(entries: Entries) -> PublishedParts:
    size = _size(entries, (256, 256))
    regions = _regions(entries.under("model_1."))

    def branch(name: str) -> PartBranch:
        own = entries.under(name)
        trunk = transformers.Tokens(own.under("transformer."), size, wide_scale=True)
        heads = own.heads([*(f"classifier_heat{i + 1}" for i in range(regions)), "classifier1"], trunk.channels)
        return transformers.TokenRegions(trunk, heads, token=-1)

    return _by_view(
        entries,
        branch,
        "FSRA",
        "ViT-S",
        size,
        names=[*region_names(regions), "class token"],
        **_regions_level(regions),
    )


def _mccg(entries: Entries) -> PublishedParts:
    size = _size(entries, (256, 256), convnext.STRIDE)
    blocks = entries.under("model_1.").count_heads("classifier_mcb")
    _check_option(entries, "block", blocks)
    if blocks not in (1, 2):
        raise ModelFileError(
            f"{entries.name} has {blocks} heads classifier_mcb; MCCG has one for each of its 1 or 2 gates."
        )
    if _has(entries, "model_2.") and not _equal(entries, "model_1.", "model_2."):
        log.warning(
            "%s has two networks of different weights. As in the released test, which loads the second over the first, model_2 "
            "describes all views.",
            printable(entries.name),
        )
        entries = Entries(
            entries.name,
            {key: value for key, value in entries.state.items() if not key.startswith("model_1.")}
            | {f"model_1.{key}": value for key, value in entries.under("model_2.").state.items()},
            entries.options,
        )

    def branch(name: str) -> PartBranch:
        return convnext.Mccg(entries.under(name), size, blocks)

    backbone = _convnext_name(convnext.with_timm_names(entries.under("model_1.convnext.")))
    return _by_view(
        entries,
        branch,
        "MCCG",
        backbone,
        size,
        level="exact, with held",
        held="the gates and " + _NORM_HELD,
        names=[*("gate of columns", "gate of rows")[:blocks], "whole"],
    )


def _sdpl(entries: Entries) -> PublishedParts:
    size = _size(entries, (512, 512))
    if size[0] != size[1] or size[0] % sdpl.SIDE_STEP or size[0] < sdpl.SMALLEST:
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says {size[0]} x {size[1]} pixels; SDPL takes squares of a multiple of "
            f"{sdpl.SIDE_STEP} pixels from {sdpl.SMALLEST}."
        )
    _check_views(entries, 2)
    names = ["model_1.", "model_2."] if _has(entries, "model_2.") else ["model_1."]
    shared = len(names) == 1 or _equal(entries, *names)
    first = sdpl.Sdpl(entries.under(names[0]), entries, size)
    contract = Contract(
        method="SDPL",
        title=f"SDPL ResNet-50, n = {sdpl.PARTS}, {size[0]} x {size[1]}",
        views=_PAIR,
        input_size=size,
        n_parts=sdpl.PARTS,
        embedding=first.bias.shape[1],
        level="exact, with held",
        held="the pooled values and the weights of the shifts",
        **_roles(shared),
        part_names=dict.fromkeys(_PAIR, sdpl.PART_NAMES),
    )
    if shared:
        return PublishedParts(contract, dict.fromkeys(_PAIR, first))
    return PublishedParts(contract, {"query": first, "gallery": sdpl.Sdpl(entries.under("model_2."), entries, size)})


def _sample4geo(entries: Entries) -> PublishedParts:
    prefix = "" if _has(entries, "stem.") else "model."
    return _vector(entries.under(prefix), "Sample4Geo")


def _dac(entries: Entries) -> PublishedParts:
    return _vector(convnext.with_timm_names(entries.under("model_1.convnext.")), "DAC")


def _camp(entries: Entries) -> PublishedParts:
    return _vector(convnext.with_timm_names(entries.under("model_1.convnext.")), "CAMP")


def _vector(entries: Entries, method: str) -> PublishedParts:
    """Build a model of one ConvNeXt for both views."""
    size = _size(entries, (384, 384), convnext.STRIDE)
    branch = convnext.vector(entries, size)
    contract = _vector_contract(method, _convnext_name(entries), size, branch.norm.weight.shape[0])
    return PublishedParts(contract, dict.fromkeys(contract.views, branch))


def _vector_contract(
    method: str,
    backbone: str,
    size: tuple[int, int],
    channels: int,
    mean: Triple = MEAN,
    std: Triple = STD,
    shared: bool = True,
) -> Contract:
    return Contract(
        method=method,
        title=f"{method} {backbone}, {size[0]} x {size[1]}",
        views=_PAIR,
        input_size=size,
        n_parts=1,
        embedding=channels,
        level="exact, with held",
        held=_NORM_HELD,
        **_roles(shared),
        resize="linear",
        mean=mean,
        std=std,
        mirror="none",
        part_names=dict.fromkeys(_PAIR, ("1 whole",)),
    )


def _game4loc(entries: Entries) -> PublishedParts:
    names = ["model."] if _has(entries, "model.") else ["model1.", "model2."]
    if not _has(entries, names[0]) and _has(entries, "blocks."):
        names = [""]
    size = _size(entries, (384, 384), 16)
    shared = len(names) == 1 or _equal(entries, *names)
    made = [transformers.rotary_vector(entries.under(name), size) for name in names[: 1 if shared else 2]]
    branch, configuration = made[0]
    width = branch.norm.weight.shape[0]
    contract = _vector_contract(
        "Game4Loc",
        {512: "ViT-M", 640: "ViT-Betwixt", 768: "ViT-B"}[width] + " with rotary positions",
        size,
        width,
        cast(Triple, tuple(configuration["mean"])),
        cast(Triple, tuple(configuration["std"])),
        shared,
    )
    if shared:
        return PublishedParts(contract, dict.fromkeys(_PAIR, branch))
    return PublishedParts(contract, {"query": branch, "gallery": made[1][0]})


def _denseuav(entries: Entries) -> PublishedParts:
    own = entries.under("backbone.backbone.")
    if "patch_embed.proj.weight" not in own.state or "cls_token" not in own.state or "dist_token" in own.state:
        raise ModelFileError(
            f"{entries.name} is DenseUAV's, of a backbone that is no plain vision transformer (found "
            f"{', '.join(list(own.state)[:2]) or 'nothing'}); expected one of ViTS-224, ViTS-384, and ViTB-224."
        )
    patch = own.shape("patch_embed.proj.weight", 4)[2]
    side = math.isqrt(own.shape("pos_embed", 3)[1] - 1) * patch
    size = _size(entries, (side, side), patch)
    trunk = transformers.Tokens(own, size)
    head = entries.under("head.head.")
    backbone = {384: "ViT-S", 768: "ViT-B"}.get(trunk.channels, "ViT")
    names = ["whole"]
    branch: PartBranch
    level: dict[str, Any]
    if "classifier1.add_block.0.weight" in head.state:
        regions = _regions(head)
        heads = head.heads(["classifier1", *(f"classifier_heat{i + 1}" for i in range(regions))], trunk.channels)
        branch, level = transformers.TokenRegions(trunk, heads, token=0), _regions_level(regions)
        names = ["class token", *region_names(regions)]
    else:
        pool = entries.options.get("head_pool", "avg")
        if pool not in transformers.TOKEN_POOLS:
            raise ModelFileError(
                f"The opts.yaml beside {entries.name} says head_pool: {pool}; expected one of "
                f"{', '.join(transformers.TOKEN_POOLS)}."
            )
        branch = transformers.PooledTokens(trunk, head.heads(["classifier"], trunk.channels), pool)
        level = (
            {"level": "exact"} if pool == "avg" else {"level": "exact, with held", "held": "the cells of the maxima"}
        )
        level = {"level": "one vector"} if pool == "global" else level
    made = _by_view(entries, lambda _: branch, "DenseUAV", backbone, size, names=names, **level)
    # The released code divides k + 1 parts by sqrt(k).
    parts = made.contract.n_parts
    return replace(made, length=math.sqrt(parts / (parts - 1))) if parts > 1 else made


def _by_view(
    entries: Entries,
    branch: Callable[[str], PartBranch],
    method: str,
    backbone: str,
    size: tuple[int, int],
    names: list[str],
    level: Level,
    held: str = "",
) -> PublishedParts:
    """Build a model whose satellite and drone share `model_1`; `model_2`, where there is one, describes the street."""
    three = _has(entries, "model_2.")
    _check_views(entries, 3 if three else 2)
    shared = not three or _equal(entries, "model_1.", "model_2.")
    first = branch("model_1.")
    numbered = tuple(f"{number + 1} {name}" for number, name in enumerate(names))
    branches: dict[View | Role, PartBranch] = dict.fromkeys(_TRIPLE if three else _PAIR, first)
    if not shared:
        branches["street"] = branch("model_2.")
    bias = cast(torch.Tensor, first.bias)
    parts, embedding = bias.shape
    views = _TRIPLE if three else _PAIR
    return PublishedParts(
        Contract(
            method=method,
            title=f"{method} {backbone}, n = {parts}, {size[0]} x {size[1]}",
            views=views,
            input_size=size,
            n_parts=parts,
            embedding=embedding,
            level=level,
            held=held,
            groups=(views,) if shared else (_PAIR, ("street",)),
            part_names=dict.fromkeys(views, numbered),
        ),
        branches,
    )


def _regions(entries: Entries) -> int:
    """Return the number of regions by the heads beside that of the class token.

    With one block the released code describes by the class token alone, so its region's head may be there or not.
    """
    count = entries.count_heads("classifier_heat")
    if count or entries.options.get("block") != 1:
        _check_option(entries, "block", count)
    return count if count > 1 else 0


def region_names(count: int) -> list[str]:
    """Return a short name for each region of tokens, in the order of falling heat."""
    middle = ["region"] * max(count - 2, 0)
    return ["hottest", *middle, "coolest"][:count]


def _regions_level(regions: int) -> dict[str, Any]:
    return {"level": "exact, with held", "held": "the regions of each picture"} if regions else {"level": "one vector"}


def _roles(shared: bool) -> dict[str, Any]:
    """Return roles and groups of a contract; a branch for each role is a group for the view of that role outside of a task."""
    return {} if shared else {"roles": "role", "groups": (("satellite",), ("drone",))}


def _has(entries: Entries, prefix: str) -> bool:
    return any(key.startswith(prefix) for key in entries.state)


def _equal(entries: Entries, first: str, second: str) -> bool:
    """Return whether two branches describe alike."""
    one, other = (entries.under(prefix).state for prefix in (first, second))
    return all(key in other and torch.equal(value, other[key]) for key, value in one.items() if not _UNUSED.match(key))


def _size(entries: Entries, default: tuple[int, int], step: int = 1) -> tuple[int, int]:
    """Return the input size of the options, by default that of the released script.

    Raises:
        ModelFileError: if it is no multiple of `step`, or huge.
    """
    size = (int(entries.options.get("h", default[0])), int(entries.options.get("w", default[1])))
    if any(side % step or side > 4096 for side in size):
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says {size[0]} x {size[1]} pixels; expected multiples of {step} up to 4096."
        )
    return size


def _check_views(entries: Entries, found: int) -> None:
    said = entries.options.get("views", found)
    if said != found:
        raise ModelFileError(
            f"{entries.name} describes {found} views by the networks that it holds, but the opts.yaml beside it says "
            f"views: {said}; correct or remove it."
        )


def _check_option(entries: Entries, option: str, found: int) -> None:
    said = entries.options.get(option, found)
    if said != found:
        raise ModelFileError(
            f"{entries.name} has {found} of these heads, but the opts.yaml beside it says {option}: {said}; correct or remove it."
        )


def _convnext_name(entries: Entries) -> str:
    depth = entries.count("stages.2.blocks.{}.conv_dw.weight")
    width = entries.shape("stages.0.blocks.0.conv_dw.weight", 4)[0]
    return _CONVNEXTS.get((depth, width), "ConvNeXt")


_BUILDERS: dict[Kind, Callable[[Entries], PublishedParts]] = {
    "fsra": _fsra,
    "mccg": _mccg,
    "sdpl": _sdpl,
    "sample4geo": _sample4geo,
    "dac": _dac,
    "camp": _camp,
    "game4loc": _game4loc,
    "denseuav": _denseuav,
}
