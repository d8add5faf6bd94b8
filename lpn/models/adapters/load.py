"""Open a published checkpoint of any known model."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from pathlib import Path

import torch

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import fingerprint, first_few, printable
from lpn.models.adapters.build import build
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.model import PublishedModel
from lpn.models.adapters.recognise import (
    Kind,
    Recognised,
    check_kind,
    check_named,
    title_of_other,
    unwrapped,
    unwrapped_as,
)
from lpn.models.adapters.vit import build_pooled
from lpn.models.adapters.vit_names import vit_prefix
from lpn.models.base import Model
from lpn.models.checkpoints import from_state, holds_safetensors, is_own, load_torch, read_state
from lpn.models.published_checkpoints import StateDict, infer_backbone, name_unknown, read_options
from lpn.models.token_pooling import TokenPooling

log = logging.getLogger(__name__)

# Methods whose checkpoint is a network of timm and no parts, so that its tokens may be pooled otherwise.
_PLAIN = ("Sample4Geo", "Game4Loc")
_SHOWN = 3
# Entries that the released code of the methods has for training alone, or that are read in another form.
# The buffers of Swin are in files of timm before 0.8 alone.
_KNOWN = re.compile(
    r"num_batches_tracked$|classifier|\.(relative_position_index|relative_coords_table|attn_mask)$|(^|\.)(logit_scale\w*|w_blocks\d|mask_token|cls_token|reg_token|pos_embed|pos_scale|gem\d*\.p)$|"
    r"(^|\.)(head|fc|bn|tri_layer|proj|DEG|MSE|MSF|feature_scaling|slot_moe|mix_fusion)\."
)


def load_file(
    path: str | Path,
    device: torch.device | str = "cpu",
    kind: Kind | None = None,
    pooling: TokenPooling | None = None,
    network: str | None = None,
) -> Model:
    """Open one of our `.safetensors`, or a published state dict in a PyTorch or `.safetensors` file.

    Args:
        kind, pooling, network: see `load_published`.

    Raises:
        ModelFileError: as for `load_published`.
        InputError: as for `load_published`, and if a kind, a pooling, or a network is given for a file of ours.
    """
    path = Path(path)
    if not holds_safetensors(path) or not is_own(path):
        return load_published(path, device, kind, pooling, network)
    for option, given in (("--kind", kind), ("--pooling", pooling), ("timm:", network)):
        if given is not None:
            raise InputError(f"{path.name} contains its network and its parts; leave {option} out.")
    return load_torch(path, device)


def load_published(
    path: str | Path,
    device: torch.device | str = "cpu",
    kind: Kind | None = None,
    pooling: TokenPooling | None = None,
    network: str | None = None,
) -> Model:
    """Open a published state dict, with the `opts.yaml` beside it. Only tensors are unpickled.

    Args:
        kind: whose checkpoint it is; by default recognised by the names of its entries.
        pooling: of the tokens of a vision transformer, or of any network of timm that is named; the mean by default.
        network: the name of the network in timm; None to recognise it.

    Raises:
        ModelFileError: if the file is missing, truncated, of no known model or of another than the kind that is named,
            incomplete, or has entries of wrong shapes.
        InputError: if there is no such kind, a package is missing, or the pooling does not fit the model.
    """
    path = Path(path)
    named = None if kind is None else check_kind(kind)
    state = read_state(path)
    if pooling is not None or network is not None:
        if named is not None:
            raise InputError(f"A pooling is for tokens, and --kind {named} has its own parts; leave one of both out.")
        return _pooled(state, path, device, pooling, network)
    found: Recognised
    if named is None:
        try:
            found, state = unwrapped(state, path.name)
        except ModelFileError as error:
            raise _backbone_alone(state, path.name) or error from None
    else:
        found, state = named, unwrapped_as(named, state)
        check_named(named, state, path.name)
    return _built(found, state, path, device, named is None)


# First words of the names that a backbone alone has: torchvision's, and those of timm's networks.
_OF_BACKBONE = re.compile(r"(conv1|bn1|layer[1-4]|fc|features|classifier)\.")
_OF_TIMM = re.compile(
    r"(conv1|bn1|layer[1-4]|fc|stem|stages|layers|blocks|patch_embed|norm|norm_pre|fc_norm|head|conv_stem|conv_head|bn2|classifier)"
    r"\.|(cls_token|reg_token|pos_embed)$"
)


def _backbone_alone(state: StateDict, name: str) -> ModelFileError | None:
    """Return the error about a backbone without heads, such as `lpn train --init` takes; None for other files."""
    own = {re.sub(r"^model_\d\.model\.", "", key): tensor for key, tensor in state.items()}
    if own and all(map(_OF_BACKBONE.match, own)):
        with suppress(ModelFileError):
            backbone, last = infer_backbone(own, name)
            held = f"{backbone} up to layer3" if last == "layer3" and backbone.startswith("resnet") else backbone
            return ModelFileError(
                f"{printable(name)} is a backbone alone ({held}), without the heads of a model; train a model "
                "that starts from it by giving the file to lpn train --init."
            )
    if own and all(map(_OF_TIMM.match, own)):
        return ModelFileError(
            f"{printable(name)} is a backbone alone, by its names one of timm, without the heads of a model; read it as it is by "
            "--model timm:NAME:FILE with its name in timm, or train a model that starts from it by lpn train --backbone "
            "timm:NAME --init FILE."
        )
    return None


# The files that transformers writes beside the weights.
_BESIDE = ("config.json", "preprocessor_config.json")


def _pooled(
    state: StateDict,
    path: Path,
    device: torch.device | str,
    pooling: TokenPooling | None,
    network: str | None,
) -> Model:
    """Open a network whose tokens are pooled by name."""
    options = read_options(path.with_name("opts.yaml"))
    if network is None and isinstance(options.get("model"), str):
        network = str(options["model"])
    entries = Entries(path.name, state, options)
    own = title_of_other("vit", state)
    if own is not None and own not in _PLAIN:
        raise InputError(
            f"By its entries {path.name} is a checkpoint of {own}, which has its own parts; leave --pooling out."
        )
    if pooling is None:
        pooling = TokenPooling()
        log.warning(
            "%s has no parts of its own; its tokens are pooled by their mean (--pooling).", printable(path.name)
        )
    published = build_pooled(entries, path.parent, pooling, network)
    # Heads and activations change the network, and are in no tensor.
    beside = [file.read_bytes() for name in _BESIDE if (file := path.with_name(name)).is_file()]
    return PublishedModel(published, fingerprint(path, also=repr((published.contract, options, beside))), device)


def _check_alone(entries: Entries) -> None:
    """Refuse a vision transformer that may be the trunk of a method: other entries stand beside it under names of their own."""
    place = vit_prefix(entries)
    others = [printable(key)[:80] for key in entries.state if place is not None and not key.startswith(place[0])]
    if others and place is not None and place[1] == "hub":
        raise ModelFileError(
            f"{entries.name} holds a vision transformer under {place[0]} and other entries ({first_few(others, _SHOWN)}), so it "
            "may be of a method that is not known here; --pooling mean reads the transformer alone."
        )


def _tell_unknown(method: str, entries: Entries) -> None:
    """Name the entries that nothing read and the released code does not have: the file may be of a method built on it."""
    unread = entries.left_over()
    first = {re.sub(r"^model_\d\.", "model_1.", key) for key in entries.state.keys() - set(unread)}
    unknown = [key for key in unread if not _KNOWN.search(key) and re.sub(r"^model_\d\.", "model_1.", key) not in first]
    name_unknown(entries.name, method, unknown)


def _built(kind: Recognised, state: StateDict, path: Path, device: torch.device | str, recognised: bool) -> Model:
    options = read_options(path.with_name("opts.yaml"))
    if kind == "lpn" and recognised and "dense_LPN" in options:
        # Baselines trained by SDPL's code have the same entries as an LPN of two branches; only this option distinguishes them.
        kind = "sdpl"
    if kind == "lpn":
        return from_state(state, options, path, device)
    if kind == "vit":
        _check_alone(Entries(path.name, state))
        return _pooled(state, path, device, None, None)
    entries = Entries(path.name, state, options)
    published = build(kind, entries)
    _tell_unknown(published.contract.method, entries)
    # The stride of SUES-200's networks is in no tensor.
    also = repr((published.contract, options) if kind == "sues200" else published.contract)
    return PublishedModel(published, fingerprint(path, also=also), device)
