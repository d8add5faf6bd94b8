"""Vision transformers, and other networks of timm, whose tokens are pooled by name into parts."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.images import Triple
from lpn.core.views import VIEWS
from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import HeldNorm
from lpn.models.adapters.published import NORM_HELD, PublishedParts, published, size_of
from lpn.models.adapters.token_parts import CellsAndClass, TokenParts
from lpn.models.adapters.transformers import HEAD_WIDTH, NAMES
from lpn.models.adapters.vit_names import VitTensors, read_vit, vit_prefix
from lpn.models.token_pooling import TokenPooling
from lpn.models.transformers_files import (
    NETWORK,
    PICTURES,
    read_configuration,
    stated_normalisation,
    stated_number,
    stated_size,
)

log = logging.getLogger(__name__)

# transformers' names of activations as timm's, and the widths whose heads are not of 64 numbers.
_ACTIVATIONS = {
    "gelu": "gelu",
    "gelu_new": "gelu_tanh",
    "gelu_pytorch_tanh": "gelu_tanh",
    "quick_gelu": "quick_gelu",
    "relu": "relu",
    "silu": "silu",
}
_HEADS = {1152: 16, 1280: 16, 1408: 16, 1664: 16, 4096: 32}
# OpenAI's widest image encoder has 1,024 numbers, and OpenCLIP's ViT-H, ViT-g, and ViT-bigG have more.
_LAION_WIDTH = 1280
# The size of pictures of a network without positions.
_ROTARY_SIZE = (256, 256)


@dataclass(frozen=True)
class TokenNetwork:
    """A network with its weights, and what its file tells."""

    trunk: CellsAndClass
    title: str
    channels: int
    size: tuple[int, int]
    normalisation: tuple[Triple, Triple]
    norm: HeldNorm | None = None


def build_pooled(entries: Entries, folder: Path, pooling: TokenPooling, name: str | None = None) -> PublishedParts:
    """Build a network whose tokens are pooled by name; it describes all views alike.

    The size of pictures is `h` and `w` of the options, else that of a preprocessor_config.json, else that of the training.

    Args:
        folder: of the file, in which a config.json and a preprocessor_config.json of transformers are read.
        name: of the network in timm, with or without the tag of its weights; None for a vision transformer of known names.

    Raises:
        ModelFileError: if entries are missing, have wrong shapes, or contradict the configuration.
        InputError: if timm is needed and cannot be imported, has no such network, or the pooling does not fit the network.
    """
    network = network_of_entries(entries, folder) if name is None else _of_name(entries, name)
    if pooling.needs_class_token and not network.trunk.has_class:
        raise InputError(f"{network.title} has no class token for the pooling {pooling}; take mean, gem, or rings:N.")
    norm = network.norm if pooling.name == "mean" else None
    branch = TokenParts(network.trunk, pooling, norm)
    partition = pooling.partition
    made = published(
        dict.fromkeys(VIEWS, branch),
        f"{network.title}, {pooling}",
        "",
        network.size,
        pooling.level if norm is None else "exact, with held",
        pooling.held if norm is None else NORM_HELD,
        pooling.part_names,
        pooling.embedding(network.channels),
        mean=network.normalisation[0],
        std=network.normalisation[1],
        mirror="none",
        partitions={} if partition is None else dict.fromkeys(VIEWS, partition),
    )
    height, width = network.size
    return replace(made, contract=replace(made.contract, title=f"{network.title}, {pooling}, {height} x {width}"))


def dinov2(entries: Entries) -> Entries:
    """Return the entries of a network that is known to be torch.hub's DINOv2, with the one by which it is recognised.

    That entry, the token of masked patches, serves training alone, and a file may lack it.

    Raises:
        ModelFileError: if entries that every DINOv2 has are missing.
    """
    width = entries.shape("patch_embed.proj.weight", 4)[0]
    for key, sides in (("cls_token", 3), ("blocks.0.ls1.gamma", 1)):
        entries.shape(key, sides)
    state = {"mask_token": torch.zeros(1, width), **entries.state}
    return Entries(entries.name, state, entries.options, entries.prefix, entries.read)


def network_of_entries(
    entries: Entries, folder: Path | None, default_size: tuple[int, int] | None = None
) -> TokenNetwork:
    """Build a vision transformer from its entries and the configurations of transformers in a folder, None without them.

    Args:
        default_size: (height, width) of pictures where nothing says it; by default that of the training.

    Raises:
        ModelFileError, InputError: as for `build_pooled`.
    """
    vit = read_vit(entries)
    configuration: dict[str, Any] = {} if folder is None else read_configuration(folder, NETWORK)
    pictures: dict[str, Any] = {} if folder is None else read_configuration(folder, PICTURES)
    configuration = cast("dict[str, Any]", configuration.get("vision_config") or configuration)
    form, own = vit.format, vit.entries
    width, _, patch, _ = own.shape("patch_embed.proj.weight", 4)
    stated = configuration.get("hidden_act") or configuration.get("hidden_activation")
    activation = stated or form.activation
    if stated is None and form.title == "CLIP":
        activation = _activation_of_clip(entries, width)
    if activation not in _ACTIVATIONS:
        raise ModelFileError(
            f"The config.json beside {entries.name} says hidden_act: {printable(str(activation))[:40]}; expected one of "
            f"{', '.join(_ACTIVATIONS)}."
        )
    epsilon = stated_number(configuration, "layer_norm_eps", form.epsilon)
    size = _size(entries, vit, stated_size(pictures) or default_size, patch)
    grid = size[0] // patch, size[1] // patch
    depth, heads = own.count("blocks.{}.norm1.weight"), _heads(entries, configuration, width, form.rotary)
    registers = own.shape("reg_token", 3)[1] if "reg_token" in own.state else 0
    gated = "blocks.0.mlp.fc1_g.weight" in own.state
    hidden = own.shape(f"blocks.0.mlp.{'fc1_g' if gated else 'fc1'}.weight", 2)[0]
    shared: dict[str, Any] = {
        "registers": registers,
        "epsilon": epsilon,
        "qkv_bias": "blocks.0.attn.qkv.bias" in own.state,
    }
    prefix = registers + ("cls_token" in own.state)
    if form.rotary:
        base = stated_number(configuration, "rope_theta", 100.0)
        network = timm_networks.dinov3_transformer(
            width, depth, hidden, size, patch, heads, gated=gated, base=base, **shared
        )
    else:
        packed = own.shape("blocks.0.mlp.fc2.weight", 2)[1] * 2 == hidden
        network = timm_networks.vision_transformer(
            width,
            depth,
            hidden,
            size,
            patch,
            heads,
            class_token="cls_token" in own.state,
            cells_only=True,
            layer_scale="blocks.0.ls1.gamma" in own.state,
            last_norm="norm.weight" in own.state,
            norm_before=form.norm_before,
            activation="swiglu" if packed else _ACTIVATIONS[activation],
            attention_pool="attn_pool.latent" in own.state,
            **shared,
        )
    _fill(network, vit, grid)
    norm = _held_norm(own, ("fc_norm", epsilon) if "fc_norm.weight" in own.state else None, width)
    class_norm = None
    if form.class_norm_alone:
        class_norm, cast(Any, network).norm = cast(Any, network).norm, nn.Identity()
    normalisation = stated_normalisation(pictures, form.normalisation)
    if not pictures and form.title == "ViT":
        log.warning(
            "%s does not say which network it holds; pictures are normalised with the mean %s and the standard deviation %s. If "
            "its network takes others, name it: timm:NAME:FILE.",
            printable(entries.name),
            *normalisation,
        )
    trunk = CellsAndClass(network, grid, prefix, class_norm=class_norm)
    title = f"{form.title} {NAMES.get(width, 'ViT')}/{patch}".replace("ViT ViT", "ViT")
    return TokenNetwork(trunk, title, width, size, normalisation, norm)


def _activation_of_clip(entries: Entries, width: int) -> str:
    """Return the activation of a CLIP whose file does not tell it, by the width that OpenAI's networks do not have; log it."""
    own, other = ("quick_gelu", "gelu") if width < _LAION_WIDTH else ("gelu", "quick_gelu")
    log.warning(
        "%s does not say whether its CLIP is of OpenAI (QuickGELU) or of OpenCLIP (most have GELU), whose entries have the same "
        'names; %s is taken by its width of %d. If it is the other one, write {"hidden_act": "%s"} into a config.json beside it.',
        printable(entries.name),
        own,
        width,
        other,
    )
    return own


def _held_norm(entries: Entries, named: tuple[str, float] | None, width: int) -> HeldNorm | None:
    """Return the LayerNorm behind a network's mean, see `TimmMap.norm_behind`."""
    if named is None:
        return None
    name, epsilon = named
    return HeldNorm(entries.tensor(f"{name}.weight", (width,)), entries.tensor(f"{name}.bias", (width,)), epsilon)


def _of_name(entries: Entries, name: str) -> TokenNetwork:
    """Build a network of timm by its name, with weights of timm's names, or of another library's for the same network."""
    base = timm_networks.base_name(name)
    normalisation = timm_networks.normalisation(name)
    size = size_of(entries, timm_networks.trained_size(name))
    mapped = timm_networks.TimmMap(base, size, resampling=False)
    network: Any = mapped.network
    if mapped.patch is not None and (size[0] % mapped.patch[0] or size[1] % mapped.patch[1]):
        raise _uneven(entries, size, mapped.patch[0])
    vit = read_vit(entries) if mapped.patch is not None and vit_prefix(entries) is not None else None
    own = entries if vit is None else vit.entries
    try:
        if vit is not None and (vit.positions is None or getattr(network, "pos_embed", None) is not None):
            _fill(network, vit, _grid_of(mapped, size))
        else:
            entries.fill(network)
        norm = _held_norm(own, mapped.norm_behind, mapped.channels)
    except ModelFileError as error:
        trained = timm_networks.trained_size(name)
        # Biases of attention, as BEiT's and MaxViT's, are of the size that the network was trained with.
        whole = (
            ""
            if size == trained
            else f" It was trained with {trained[0]} x {trained[1]} pixels, so set h and w to that."
        )
        raise ModelFileError(f"As timm's {base} for {size[0]} x {size[1]} pixels: {error}{whole}") from error
    with torch.inference_mode():
        height, width = mapped.eval()(torch.zeros(1, 3, *size)).shape[2:]
    trunk = CellsAndClass(network, (height, width), mapped.prefix, mapped.channels_last)
    return TokenNetwork(trunk, base, mapped.channels, size, normalisation, norm)


def _grid_of(mapped: timm_networks.TimmMap, size: tuple[int, int]) -> tuple[int, int]:
    patch = mapped.patch or (1, 1)
    return size[0] // patch[0], size[1] // patch[1]


def _fill(network: nn.Module, vit: VitTensors, grid: tuple[int, int]) -> None:
    """Put a file's tensors into a network of timm, with positions where that network has them."""
    wanted, state = network.state_dict(), dict(vit.entries.state)
    width = vit.front.shape[1]
    if vit.positions is not None and "pos_embed" in wanted:
        cells = vit.resampled(grid)
        if wanted["pos_embed"].shape[1] == cells.shape[1]:
            _add_front(state, vit.front)
        else:
            cells = torch.cat([vit.front[None], cells], 1)
        state["pos_embed"] = cells.reshape(1, -1, width)
    if "blocks.0.gamma_1" in wanted:
        state = {
            key.replace(".ls1.gamma", ".gamma_1").replace(".ls2.gamma", ".gamma_2"): one for key, one in state.items()
        }
    if "blocks.0.attn.q_bias" in wanted or not any(key.endswith("qkv.bias") for key in wanted):
        _split_biases(state, vit.entries.name)
    Entries(vit.entries.name, state, vit.entries.options, vit.entries.prefix, vit.entries.read).fill(network)


def _add_front(state: dict[str, Tensor], front: Tensor) -> None:
    """Add the positions of the tokens in front of the cells to these tokens."""
    for key in ("cls_token", "reg_token"):
        if key in state and len(front):
            count = state[key].shape[1]
            state[key] = state[key].float() + front[None, :count]
            front = front[count:]


def _split_biases(state: dict[str, Tensor], name: str) -> None:
    """Replace biases of queries, keys, and values by those of timm's rotary networks, which have none of keys."""
    for key in [key for key in state if key.endswith(".attn.qkv.bias")]:
        bias = state.pop(key)
        third = len(bias) // 3
        if bool(bias[third : 2 * third].any()):
            raise ModelFileError(f"In {name}, keys have biases ({printable(key)}); expected a DINOv3 without them.")
        state[key.replace("qkv.bias", "q_bias")] = bias[:third]
        state[key.replace("qkv.bias", "v_bias")] = bias[2 * third :]


def _size(entries: Entries, vit: VitTensors, stated: tuple[int, int] | None, patch: int) -> tuple[int, int]:
    if stated is not None and (stated[0] % patch or stated[1] % patch):
        stated = None
    trained = _ROTARY_SIZE
    if vit.positions is not None:
        side = patch * round(len(vit.positions) ** 0.5)
        trained = (side, side)
    size = size_of(entries, stated or trained)
    if size[0] % patch or size[1] % patch:
        raise _uneven(entries, size, patch)
    return size


def _uneven(entries: Entries, size: tuple[int, int], patch: int) -> ModelFileError:
    return ModelFileError(
        f"{entries.name} has patches of {patch} pixels, and pictures of {size[0]} x {size[1]}; set h and w in an opts.yaml "
        f"beside the file to multiples of {patch}."
    )


def _heads(entries: Entries, configuration: Mapping[str, Any], width: int, rotary: bool) -> int:
    heads = configuration.get("num_attention_heads") or entries.options.get("heads")
    if heads is None:
        usual = width // HEAD_WIDTH if width % HEAD_WIDTH == 0 else 0
        heads = usual if rotary and usual else _HEADS.get(width, usual)
    if not isinstance(heads, int) or isinstance(heads, bool) or heads < 1 or width % heads:
        raise ModelFileError(
            f"{entries.name} does not say how many heads its attention of the width {width} has; put its config.json beside "
            "it, or write `heads: NUMBER` into an opts.yaml there."
        )
    return heads
