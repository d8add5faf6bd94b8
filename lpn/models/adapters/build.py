"""Build the branches and the contract of each published model from the entries of its checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, NoReturn, cast

import torch

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.models import timm_networks
from lpn.models.adapters import convnext, sdpl, transformers
from lpn.models.adapters.denseuav import build_denseuav
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.mfrgn import build_mfrgn
from lpn.models.adapters.named import named_vector
from lpn.models.adapters.network import MeanVector, PartBranch
from lpn.models.adapters.pooled import PooledTokens, RegionWeights, first_alone
from lpn.models.adapters.published import (
    NORM_HELD,
    PublishedParts,
    by_role,
    by_view,
    check_option,
    check_views,
    count_regions,
    distinct,
    equal,
    has,
    numbered,
    published,
    region_names,
    regions_level,
    size_of,
)
from lpn.models.adapters.qdfl import build_qdfl
from lpn.models.adapters.recognise import Kind
from lpn.models.adapters.salad import build_salad
from lpn.models.adapters.sues import build_sues
from lpn.models.contract import AccountLevel

log = logging.getLogger(__name__)

# ResNets by the blocks of their third stage.
RESNETS = {6: "ResNet-50", 23: "ResNet-101", 36: "ResNet-152"}
# Entries of Game4Loc's vision transformer with rotary positions, which has neither positions nor a class token.
_ROTARY = frozenset({"reg_token", "fc_norm.weight", "fc_norm.bias", "blocks.0.attn.q_bias", "blocks.0.gamma_1"})
# Methods of one vector, each with the prefixes of its networks of timm, see `_one_vector`.
_VECTORS: dict[Kind, tuple[str, tuple[tuple[str, ...], ...]]] = {
    "sample4geo": ("Sample4Geo", (("model.",),)),
    "game4loc": ("Game4Loc", (("model.",), ("model1.", "model2."))),
    "dac": ("DAC", ()),
    "camp": ("CAMP", ()),
    "mean": ("MEAN", ()),
    "dmnil": ("DMNIL", ()),
}


def build(kind: Kind, entries: Entries) -> PublishedParts:
    """Build a model other than an LPN.

    Raises:
        ModelFileError: if entries are missing, have wrong shapes, or contradict the options.
        InputError: if timm is needed and cannot be imported.
    """
    return _BUILDERS[kind](entries)


def _fsra(entries: Entries) -> PublishedParts:
    size = size_of(entries, (256, 256))
    regions = count_regions(entries.under("model_1."))

    def branch(own: Entries) -> PartBranch:
        trunk = transformers.Tokens(own.under("transformer."), size, wide_scale=True)
        heads = own.heads([*(f"classifier_heat{i + 1}" for i in range(regions)), "classifier1"], trunk.channels)
        count = 1 + trunk.grid[0] * trunk.grid[1]
        weights = RegionWeights(regions, count, class_token=True, whole=-1) if regions else first_alone(count)
        return PooledTokens(trunk, weights, heads, cells=regions > 0)

    return by_view(
        entries,
        branch,
        "FSRA",
        "ViT-S",
        size,
        names=[*region_names(regions), "class token"],
        **regions_level(regions),
    )


def _mccg(entries: Entries) -> PublishedParts:
    size = size_of(entries, (256, 256), convnext.STRIDE)
    blocks = entries.under("model_1.").count_heads("classifier_mcb")
    check_option(entries, "block", blocks)
    if blocks not in (1, 2):
        raise ModelFileError(
            f"{entries.name} has {blocks} heads classifier_mcb; MCCG has one for each of its 1 or 2 gates."
        )
    if has(entries, "model_2.") and not equal(entries, "model_1.", "model_2."):
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
            read=entries.read,
        )

    own = entries.under("model_1.")
    resnet = convnext.on_resnet(own)
    if resnet:
        backbone = _resnet_name(own.under("convnext.model."))
    else:
        backbone = convnext.name_of(convnext.with_timm_names(own.under("convnext.")))
    return by_view(
        entries,
        lambda branch: convnext.Mccg(branch, size, blocks),
        "MCCG",
        backbone,
        size,
        level="exact, with held",
        held="the gates" if resnet else "the gates and " + NORM_HELD,
        names=[*("gate of columns", "gate of rows")[:blocks], "whole"],
    )


def _sdpl(entries: Entries) -> PublishedParts:
    check_views(entries, 2)
    size = size_of(entries, (512, 512))
    shifted = has(entries, "model_1.shift_blocks.")
    made = [sdpl.build_branch(branch, entries, size) for branch in numbered(entries)]
    return published(
        by_role([branch for branch, _ in made]),
        "SDPL",
        "ResNet-50",
        size,
        level="exact, with held" if shifted else "exact",
        held="pooled values and shift weights" if shifted else "",
        parts=made[0][1],
    )


def _hand_made_network(entries: Entries, resnet: bool) -> _Network:
    """Build the ConvNeXt of DAC, CAMP, MEAN, or DMNIL, or the ResNet-101 that the code of all but CAMP takes as well."""
    own = entries.under("model_1.convnext.")
    if resnet and convnext.on_resnet(entries.under("model_1.")):
        size = size_of(entries, (384, 384), convnext.STRIDE)
        trunk = convnext.resnet(own.under("model."))
        branch = MeanVector(trunk, None, convnext.grid_of(size), convnext.STRIDE)
        return _Network(branch, _resnet_name(own.under("model.")), trunk.channels, size, level="exact", held="")
    if "downsample_layers.0.0.weight" not in own.state:
        entry = next((f"{own.prefix}{key}" for key in own.state), next(iter(entries.state), "nothing"))
        raise ModelFileError(
            f"{entries.name} holds {entry}; expected a ConvNeXt (model_1.convnext.downsample_layers.0.0.weight), as DAC, "
            "CAMP, MEAN, and DMNIL were published with."
        )
    return _network_of_timm(convnext.with_timm_names(own))


class _Network(NamedTuple):
    """A network of one vector and what its entries tell."""

    branch: PartBranch
    name: str
    width: int
    size: tuple[int, int]
    mean: Triple = MEAN
    std: Triple = STD
    level: AccountLevel = "exact, with held"
    held: str = NORM_HELD
    tells_normalisation: bool = True


def _one_vector(method: str, prefixes: tuple[tuple[str, ...], ...], entries: Entries) -> PublishedParts:
    """Build a model of one network for both views, or of one for queries and one for the gallery.

    Args:
        prefixes: those that the entries of one or two networks of timm may have; none for the hand-made ones.
    """
    held = [names for names in prefixes if has(entries, names[0])]
    if len(held) > 1:
        _refuse_two(entries, *(names[0] for names in held))
    networks = distinct(entries, *(held or [("",)])[0])
    made = [_network_of_timm(one) if prefixes else _hand_made_network(one, method != "CAMP") for one in networks]
    own = made[0]
    mean, std = own.mean, own.std
    stated = entries.options.get("model")
    if isinstance(stated, str) and prefixes:
        mean, std = timm_networks.normalisation(stated)
    elif not own.tells_normalisation:
        log.warning(
            "%s does not say which network of timm it holds; pictures are normalised with the mean %s and the standard "
            "deviation %s. If its network takes others, write its name as `model: NAME` into an opts.yaml beside the file.",
            printable(entries.name),
            mean,
            std,
        )
    branches = by_role([network.branch for network in made])
    further: dict[str, Any] = {"resize": "linear", "mean": mean, "std": std, "mirror": "none"}
    return published(branches, method, own.name, own.size, own.level, own.held, embedding=own.width, **further)


def _network_of_timm(entries: Entries) -> _Network:
    """Build a ConvNeXt, a vision transformer with rotary positions, a plain one, or any network of timm that the options name."""
    if "stages.0.blocks.0.conv_dw.weight" in entries.state:
        if "patch_embed.proj.weight" in entries.state:
            _refuse_two(entries, "stages.0.blocks.0.conv_dw.weight", "patch_embed.proj.weight")
        size = size_of(entries, (384, 384), convnext.STRIDE)
        convolutional, width = convnext.vector(entries, size), entries.shape("head.norm.weight", 1)[0]
        return _Network(convolutional, convnext.name_of(entries), width, size)
    # A file that lost one of these entries is of the same network.
    without = not {"pos_embed", "cls_token"} & entries.state.keys()
    rotary_tokens = without and len(_ROTARY & entries.state.keys()) >= len(_ROTARY) - 1
    foreign = transformers.foreign_entry(entries)
    if not rotary_tokens and foreign is not None:
        return _named_network(entries, foreign)
    width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
    if rotary_tokens:
        size = size_of(entries, (384, 384), patch)
        rotary, published = transformers.rotary_vector(entries, size)
        name = {512: "ViT-M", 640: "ViT-Betwixt", 768: "ViT-B"}[width] + " with rotary positions"
        mean, std = (cast(Triple, tuple(published[key])) for key in ("mean", "std"))
        return _Network(rotary, name, width, size, mean, std)
    size = size_of(entries, transformers.trained_side(entries), patch)
    branch = transformers.vector(entries, size)
    network = _Network(
        branch, f"{transformers.NAMES.get(width, 'ViT')}/{patch}", width, size, tells_normalisation=False
    )
    # DINOv2 and DeiT III have a scale for each layer and ImageNet's values; most others of timm have 0.5.
    if "cls_token" not in entries.state or "blocks.0.ls1.gamma" not in entries.state:
        network = network._replace(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
    if isinstance(branch, transformers.ClassToken):
        return network._replace(level="one vector", held="")
    return network if branch.norm is not None else network._replace(level="exact", held="")


def _refuse_two(entries: Entries, first: str, second: str) -> NoReturn:
    raise ModelFileError(
        f"{entries.name} holds two networks ({entries.prefix}{first} and {entries.prefix}{second}); give a file with one of them."
    )


def _named_network(entries: Entries, foreign: str) -> _Network:
    """Build the network of timm that the option `model` names.

    Args:
        foreign: an entry by which the network is not one of those that are read without a name, for the message.
    """
    stated = entries.options.get("model")
    if not isinstance(stated, str):
        raise ModelFileError(
            f"{entries.name} holds {entries.prefix}{foreign}, which is of neither a ConvNeXt nor a plain vision transformer; "
            "write its network's name in timm as `model: NAME`, such as swin_base_patch4_window7_224, into an opts.yaml beside "
            "the file."
        )
    name = timm_networks.base_name(stated)
    default = (384, 384)
    if {"pos_embed", "patch_embed.proj.weight"} <= entries.state.keys():
        default = transformers.trained_side(entries)
    elif timm_networks.has_fixed_size(name):
        default = timm_networks.trained_size(name)
    size = size_of(entries, default)
    branch = named_vector(name, entries, size)
    with torch.inference_mode():
        width = branch.eval()(torch.zeros(1, 3, *size)).shape[2]
    network = _Network(branch, name, width, size)
    if not isinstance(branch, MeanVector):
        return network._replace(level="one vector", held="")
    return network if branch.norm is not None else network._replace(level="exact", held="")


def _resnet_name(entries: Entries) -> str:
    return RESNETS.get(convnext.resnet_depths(entries)[2], "ResNet")


_BUILDERS: dict[Kind, Callable[[Entries], PublishedParts]] = {
    "fsra": _fsra,
    "mccg": _mccg,
    "sdpl": _sdpl,
    "denseuav": build_denseuav,
    "sues200": build_sues,
    "qdfl": build_qdfl,
    "mfrgn": build_mfrgn,
    "salad": build_salad,
    **{kind: partial(_one_vector, *of) for kind, of in _VECTORS.items()},
}
