"""Methods of one vector: Sample4Geo and Game4Loc on a network of timm, and DAC, CAMP, MEAN, and DMNIL on a ConvNeXt."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any, NamedTuple, cast

from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.models import timm_networks
from lpn.models.adapters.convnext import STRIDE, Trunk, grid_of, hand_made_trunk
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.methods.mccg import MCCG
from lpn.models.adapters.named import named_vector
from lpn.models.adapters.network import Account, HeldNorm, MeanVector, PartBranch
from lpn.models.adapters.published import NORM_HELD, PublishedParts, by_role, distinct, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.vit import NAMES, TokenMap, Tokens, trained_side

log = logging.getLogger(__name__)

_HALF: Triple = (0.5, 0.5, 0.5)


class ClassToken(PartBranch):
    """One vector, a ViT's class token after the last norm, without a head and without cells."""

    def __init__(self, trunk: Tokens) -> None:
        super().__init__((1, 1))
        self.trunk = trunk

    def account(self, images: Tensor) -> Account:
        """Return the vector; it has no account."""
        return Account(self.trunk(images)[:, :1])


class _Network(NamedTuple):
    """A network of one vector, and the properties in its entries.

    Attributes:
        normalisation: mean and standard deviation; None if the entries lack them.
    """

    branch: PartBranch
    name: str
    width: int
    size: tuple[int, int]
    normalisation: tuple[Triple, Triple] = (MEAN, STD)
    told: bool = True


def _of_timm(entries: Entries) -> _Network:
    """Build a ConvNeXt, a rotary vision transformer, the network of the options, or else a plain vision transformer."""
    stated = entries.options.get("model")
    if "stages.0.blocks.0.conv_dw.weight" in entries.state:
        size = size_of(entries, (384, 384), STRIDE)
        trunk = Trunk(entries)
        network = _Network(MeanVector(trunk, trunk.norm(), grid_of(size), STRIDE), trunk.title, trunk.channels, size)
    elif "reg_token" in entries.state and "pos_embed" not in entries.state:
        network = _rotary(entries)
    elif isinstance(stated, str):
        name = timm_networks.base_name(stated)
        default = timm_networks.trained_size(name) if timm_networks.has_fixed_size(name) else (384, 384)
        if {"pos_embed", "patch_embed.proj.weight"} <= entries.state.keys():
            default = trained_side(entries)
        size = size_of(entries, default)
        branch, width = named_vector(name, entries, size)
        network = _Network(branch, name, width, size)
    else:
        network = _plain(entries)
    if isinstance(stated, str):
        return network._replace(normalisation=timm_networks.normalisation(stated), told=True)
    return network


def _plain(entries: Entries) -> _Network:
    """Build a plain vision transformer: its class token, or the mean of its cells."""
    if "pos_embed" not in entries.state or "patch_embed.proj.weight" not in entries.state:
        raise _foreign(entries, next((entries.file_name(key) for key in entries.state), "nothing"))
    patch = entries.shape("patch_embed.proj.weight", 4)[2]
    size = size_of(entries, trained_side(entries), patch)
    trunk = Tokens(entries, size)
    branch: PartBranch = ClassToken(trunk)
    if "cls_token" not in entries.state:
        norm = None if "norm.weight" in entries.state else _fc_norm(entries, trunk.channels)
        branch = MeanVector(TokenMap(trunk, trunk.prefix, patch), norm, trunk.grid, patch, fixed=True)
    if left := entries.left_over(_TIMM):
        raise _foreign(entries, left[0])
    # DINOv2 and DeiT III have a scale for each layer, and ImageNet's values; most other networks of timm have 0.5.
    scaled = "cls_token" in entries.state and "blocks.0.ls1.gamma" in entries.state
    name = f"{NAMES.get(trunk.channels, 'ViT')}/{patch}"
    return _Network(branch, name, trunk.channels, size, (MEAN, STD) if scaled else (_HALF, _HALF), told=False)


def _foreign(entries: Entries, entry: str) -> ModelFileError:
    return ModelFileError(
        f"{entries.name} holds {entry}, which is of neither a ConvNeXt nor a plain vision transformer; write its network's "
        "name in timm as `model: NAME`, such as swin_base_patch4_window7_224, into an opts.yaml beside the file."
    )


def _rotary(entries: Entries) -> _Network:
    """Build the rotary vision transformer that Game4Loc starts from."""
    width, _, patch, _ = entries.shape("patch_embed.proj.weight", 4)
    size = size_of(entries, (384, 384), patch)
    network, configuration = timm_networks.rotary_transformer(width, entries.count("blocks.{}.norm1.weight"), size)
    entries.fill(network)
    trunk = TokenMap(_Features(network), entries.shape("reg_token", 3)[1], patch)
    branch = MeanVector(trunk, _fc_norm(entries, width), (size[0] // patch, size[1] // patch), patch)
    name = {512: "ViT-M", 640: "ViT-Betwixt", 768: "ViT-B"}[width] + " with rotary positions"
    mean, std = (cast(Triple, tuple(configuration[key])) for key in ("mean", "std"))
    return _Network(branch, name, width, size, (mean, std))


class _Features(nn.Module):
    """The tokens of a network of timm."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]


def _fc_norm(entries: Entries, width: int) -> HeldNorm:
    return HeldNorm(entries.tensor("fc_norm.weight", (width,)), entries.tensor("fc_norm.bias", (width,)))


def _hand_made(entries: Entries) -> _Network:
    size = size_of(entries, (384, 384), STRIDE)
    trunk = hand_made_trunk(entries)
    return _Network(MeanVector(trunk, trunk.norm(), grid_of(size), STRIDE), trunk.title, trunk.channels, size)


def build(method: str, entries: Entries) -> PublishedParts:
    """Build a model with one network for both views, or with one for queries and one for the gallery."""
    if method in ("Sample4Geo", "Game4Loc"):
        two = entries.has("model1.") and entries.has("model2.")
        prefixes = ("model1.", "model2.") if two else ("model." if entries.has("model.") else "",)
        made = [_of_timm(own) for own in distinct(entries, *prefixes)]
    else:
        made = [_hand_made(entries.under("model_1."))]
    own = made[0]
    if not own.told:
        log.warning(
            "%s does not say which network of timm it holds; pictures are normalised with the mean %s and the standard "
            "deviation %s. If its network takes others, write its name as `model: NAME` into an opts.yaml beside the file.",
            printable(entries.name),
            *own.normalisation,
        )
    level: dict[str, Any] = {"level": "one vector"}
    if isinstance(own.branch, MeanVector):
        level = {"level": "exact"} if own.branch.norm is None else {"level": "exact, with held", "held": NORM_HELD}
    mean, std = own.normalisation
    further: dict[str, Any] = {"resize": "linear", "mean": mean, "std": std, "mirror": "none"}
    branches = by_role([network.branch for network in made])
    return published(branches, method, own.name, own.size, embedding=own.width, **level, **further)


# Entries of training, and buffers of Swin that only files of timm before 0.8 contain.
_TIMM = r"^logit_scale|\.(relative_position_index|relative_coords_table|attn_mask)$|^(model\d?\.)?(head|norm|fc|classifier)\."
_TRAINED = (
    r"^logit_scale\w*$|^w_blocks\d$|^model_\d\.(classifier1|classifier_mcb\d+)\.|\.convnext\.(head|model\.fc)\."
    r"|\.(relative_position_index|relative_coords_table|attn_mask)$"
)
ADAPTERS = (
    Adapter("sample4geo", (r"model\.stem\.0\.weight$", r"model\.head\.norm\."), partial(build, "Sample4Geo"), _TIMM),
    Adapter("sample4geo", (r"model\.", r"logit_scale$"), partial(build, "Sample4Geo"), _TIMM),
    Adapter(
        "game4loc",
        (r"model[12]?\.reg_token$", r"model[12]?\.blocks\.0\.attn\.q_bias$", r"model[12]?\.fc_norm\."),
        partial(build, "Game4Loc"),
        _TIMM,
    ),
    Adapter("game4loc", (r"model1\.", r"model2\.", r"logit_scale$"), partial(build, "Game4Loc"), _TIMM),
    Adapter(
        "dac",
        (*MCCG, r"model_1\.proj\.mlp\.0\.weight$"),
        partial(build, "DAC"),
        rf"{_TRAINED}|^model_1\.(tri_layer|proj\.mlp|proj_obj\.mlp)\.",
    ),
    Adapter(
        "camp",
        (*MCCG, r"model_1\.pos_embed$"),
        partial(build, "CAMP"),
        rf"{_TRAINED}|^model_1\.(tri_layer\.|pos_embed$|pos_scale$)",
    ),
    Adapter(
        "mean",
        (
            r"model_1\.convnext\.",
            r"model_1\.(DEG|MSE)\.FC11\.weight$",
            r"model_1\.MSF\.",
            r"model_1\.classifier_mcb1\.",
        ),
        partial(build, "MEAN"),
        rf"{_TRAINED}|^model_1\.(DEG|MSE|MSF|proj\.layers|feature_scaling)\.",
    ),
    Adapter(
        "dmnil",
        (r"model_1\.convnext\.", r"w_blocks1$"),
        partial(build, "DMNIL"),
        rf"{_TRAINED}|^(slot_moe|mix_fusion)\.",
    ),
)
