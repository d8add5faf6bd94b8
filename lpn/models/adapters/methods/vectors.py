"""Methods of one vector: Sample4Geo and Game4Loc on a network of timm, and DAC, CAMP, MEAN, and DMNIL on a ConvNeXt."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

from lpn.core.errors import ModelFileError
from lpn.core.images import MEAN, STD, Triple
from lpn.models import timm_networks
from lpn.models.adapters.methods.mccg import MCCG
from lpn.models.adapters.named import named_vector
from lpn.models.adapters.network import MeanVector, PartBranch
from lpn.models.adapters.published import PublishedParts, by_role, distinct, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.trunks import STRIDE, ConvNeXt, ResNetMap, hand_made_trunk, trained_side
from lpn.models.entries import Entries

# timm's rotary vision transformers that Game4Loc starts from, by width and depth.
_ROTARY = {
    (512, 12): "vit_medium_patch16_rope_reg1_gap_256",
    (512, 20): "vit_mediumd_patch16_rope_reg1_gap_256",
    (640, 12): "vit_betwixt_patch16_rope_reg4_gap_256",
    (768, 12): "vit_base_patch16_rope_reg1_gap_256",
}


class _Network(NamedTuple):
    """A network of one vector: its branch, its name, the length of the vector, its input size, and mean and deviation."""

    branch: PartBranch
    name: str
    width: int
    size: tuple[int, int]
    normalisation: tuple[Triple, Triple] = (MEAN, STD)


def _on_map(entries: Entries, trunk: ConvNeXt | ResNetMap) -> _Network:
    size = size_of(entries, (384, 384), STRIDE)
    grid = size[0] // STRIDE, size[1] // STRIDE
    return _Network(MeanVector(trunk, trunk.norm, grid), trunk.title, trunk.channels, size)


def _of_timm(entries: Entries) -> _Network:
    """Build a ConvNeXt or a rotary vision transformer from the shapes of its entries, or the network that the options name."""
    stated = entries.options.get("model")
    if "stages.0.blocks.0.conv_dw.weight" in entries.state:
        made = _on_map(entries, ConvNeXt(entries))
        return made._replace(normalisation=timm_networks.normalisation(stated)) if isinstance(stated, str) else made
    if "reg_token" in entries.state and "pos_embed" not in entries.state:
        width, depth = entries.shape("patch_embed.proj.weight", 4)[0], entries.count("blocks.{}.norm1.weight")
        stated = stated or _ROTARY.get((width, depth))
    if not isinstance(stated, str):
        raise ModelFileError(
            f"{entries.name} holds {next((entries.file_name(key) for key in entries.state), 'nothing')}, which names no network; "
            "write its network's name in timm as `model: NAME`, such as swin_base_patch4_window7_224, into an opts.yaml beside "
            "the file."
        )
    name = timm_networks.base_name(stated)
    default = timm_networks.trained_size(name) if timm_networks.has_fixed_size(name) else (384, 384)
    if {"pos_embed", "patch_embed.proj.weight"} <= entries.state.keys():
        default = trained_side(entries)
    size = size_of(entries, default)
    branch, width = named_vector(name, entries, size)
    return _Network(branch, name, width, size, timm_networks.normalisation(stated))


def build(method: str, entries: Entries) -> PublishedParts:
    """Build a model with one network for both views, or with one for queries and one for the gallery."""
    if method in ("Sample4Geo", "Game4Loc"):
        two = entries.has("model1.") and entries.has("model2.")
        prefixes = ("model1.", "model2.") if two else ("model." if entries.has("model.") else "",)
        made = [_of_timm(own) for own in distinct(entries, *prefixes)]
    else:
        own = entries.under("model_1.")
        made = [_on_map(own, hand_made_trunk(own))]
    first = made[0]
    mean, std = first.normalisation
    further: dict[str, Any] = {"resize": "linear", "mean": mean, "std": std, "mirror": "none"}
    branches = by_role([network.branch for network in made])
    return published(branches, method, first.name, first.size, embedding=first.width, **further)


# Entries of training, and buffers of Swin that only files of timm before 0.8 contain.
_TIMM = r"^logit_scale|\.(relative_position_index|relative_coords_table|attn_mask)$|^(model\d?\.)?(head|norm|fc|classifier)\."
_TRAINED = (
    r"^logit_scale\w*$|^w_blocks\d$|^model_\d\.(classifier1|classifier_mcb\d+)\.|\.convnext\.(head|model\.fc)\."
    r"|\.(relative_position_index|relative_coords_table|attn_mask)$|^model_1\.tri_layer\."
)
_MEAN = (r"model_1\.convnext\.", r"model_1\.(DEG|MSE)\.FC11\.", r"model_1\.MSF\.", r"model_1\.classifier_mcb1\.")
_ROTARY_ENTRIES = (r"model[12]?\.reg_token$", r"model[12]?\.blocks\.0\.attn\.q_bias$", r"model[12]?\.fc_norm\.")
# Each method with the entries that it needs, and further entries of its training.
_METHODS = (
    ("Sample4Geo", (r"model\.stem\.0\.weight$", r"model\.head\.norm\."), _TIMM),
    ("Sample4Geo", (r"model\.", r"logit_scale$"), _TIMM),
    ("Game4Loc", _ROTARY_ENTRIES, _TIMM),
    ("Game4Loc", (r"model1\.", r"model2\.", r"logit_scale$"), _TIMM),
    ("DAC", (*MCCG, r"model_1\.proj\.mlp\.0\.weight$"), rf"{_TRAINED}|^model_1\.(proj\.mlp|proj_obj\.mlp)\."),
    ("CAMP", (*MCCG, r"model_1\.pos_embed$"), rf"{_TRAINED}|^model_1\.pos_(embed|scale)$"),
    ("MEAN", _MEAN, rf"{_TRAINED}|^model_1\.(DEG|MSE|MSF|proj\.layers|feature_scaling)\."),
    ("DMNIL", (r"model_1\.convnext\.", r"w_blocks1$"), rf"{_TRAINED}|^(slot_moe|mix_fusion)\."),
)
ADAPTERS = tuple(Adapter(method.lower(), needs, partial(build, method), unused) for method, needs, unused in _METHODS)
