"""Vision transformers as transformers, torch.hub, and timm write them: DINOv2, DINOv3, CLIP, SigLIP, and plain ViT.

Each library writes other names for the same tensors. They are read here under timm's names, with positions apart.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.models.adapters.entries import Entries

# How a library resamples positions for a picture of another size: bicubically, without or with anti-aliasing, or as the
# code of DINOv2 without registers, with a scale for sides that are longer by 0.1 than they are; or bilinearly with
# anti-aliasing, as SigLIP 2 for pictures of any shape (NaFlex).
Resampling = Literal["plain", "antialiased", "longer", "bilinear"]
_LONGER = 0.1

_HALF: Triple = (0.5, 0.5, 0.5)
_CLIP: tuple[Triple, Triple] = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711))


@dataclass(frozen=True)
class VitFormat:
    """The facts about a network that its library knows and its tensors do not tell.

    Attributes:
        title: of the network, for headers.
        resampling: of positions.
        epsilon: of its LayerNorms.
        activation: as transformers names them.
        normalisation: mean and standard deviation of pictures.
        rotary: whether blocks have DINOv3's rotary positions.
        norm_before: whether tokens are normalised before the first block (CLIP).
        class_norm_alone: whether the last norm is of the class token alone, so that the tokens have none.
    """

    title: str
    resampling: Resampling = "plain"
    epsilon: float = 1e-6
    activation: str = "gelu"
    normalisation: tuple[Triple, Triple] = (MEAN, STD)
    rotary: bool = False
    norm_before: bool = False
    class_norm_alone: bool = False


@dataclass(frozen=True)
class VitTensors:
    """A vision transformer's tensors under timm's names.

    Attributes:
        entries: those of `VisionTransformer`, without `pos_embed`.
        positions: of the cells, (N, C); None for rotary ones.
        front: positions of the tokens in front of the cells, (k, C), of which there may be none.
        format: what the file does not say.
    """

    entries: Entries
    positions: Tensor | None
    front: Tensor
    format: VitFormat

    def resampled(self, grid: tuple[int, int]) -> Tensor:
        """Return the positions of the cells of a map (h, w), as the network's own library resamples them: (1, h w, C).

        Raises:
            ModelFileError: if they are not of a square map, and of another number of cells.
        """
        assert self.positions is not None
        count, width = self.positions.shape
        side = math.isqrt(count)
        if grid == (side, side) or (side * side != count and grid[0] * grid[1] == count):
            return self.positions[None]
        if side * side != count:
            raise ModelFileError(
                f"{self.entries.name} has positions for {count} cells, which are not of a square map, and the picture has "
                f"{grid[0]} x {grid[1]}; set h and w in an opts.yaml beside the file to the size that it was trained with."
            )
        square = self.positions.float().reshape(1, side, side, width).permute(0, 3, 1, 2)
        if self.format.resampling == "longer":
            scale = [(length + _LONGER) / side for length in grid]
            mapped = F.interpolate(square, scale_factor=scale, mode="bicubic", align_corners=False)
        else:
            bilinear = self.format.resampling == "bilinear"
            antialias = bilinear or self.format.resampling == "antialiased"
            mode = "bilinear" if bilinear else "bicubic"
            mapped = F.interpolate(square, size=grid, mode=mode, align_corners=False, antialias=antialias)
        return mapped.permute(0, 2, 3, 1).reshape(1, -1, width)


# Names of transformers' blocks, behind `encoder.layer.0.`, `encoder.layers.0.`, or `layer.0.`.
_BLOCK = (
    (r"(attention\.attention|attention|self_attn)\.(query|q_proj)\.", "attn.q."),
    (r"(attention\.attention|attention|self_attn)\.(key|k_proj)\.", "attn.k."),
    (r"(attention\.attention|attention|self_attn)\.(value|v_proj)\.", "attn.v."),
    (r"(attention\.output\.dense|attention\.o_proj|self_attn\.out_proj)\.", "attn.proj."),
    (r"(norm1|layernorm_before|layer_norm1)\.", "norm1."),
    (r"(norm2|layernorm_after|layer_norm2)\.", "norm2."),
    (r"layer_scale([12])\.lambda1$", r"ls\1.gamma"),
    (r"(mlp\.fc1|intermediate\.dense|mlp\.weights_in)\.", "mlp.fc1."),
    (r"(mlp\.fc2|output\.dense|mlp\.weights_out|mlp\.down_proj)\.", "mlp.fc2."),
    (r"mlp\.gate_proj\.", "mlp.fc1_g."),
    (r"mlp\.up_proj\.", "mlp.fc1_x."),
)
_OUTSIDE = (
    (r"embeddings\.cls_token$", "cls_token"),
    (r"embeddings\.class_embedding$", "cls_token"),
    (r"embeddings\.register_tokens$", "reg_token"),
    (r"embeddings\.(position_embeddings|position_embedding\.weight)$", "pos_embed"),
    (r"embeddings\.(patch_embeddings\.projection|patch_embeddings|patch_embedding)\.", "patch_embed.proj."),
    (r"pre_layrnorm\.", "norm_pre."),
    (r"(layernorm|post_layernorm|norm)\.", "norm."),
    (r"head\.probe$", "attn_pool.latent"),
    (r"head\.attention\.in_proj_", "attn_pool.qkv."),
    (r"head\.attention\.out_proj\.", "attn_pool.proj."),
    (r"head\.layernorm\.", "attn_pool.norm."),
    (r"head\.mlp\.", "attn_pool.mlp."),
)
_LAYER = re.compile(r"(?:encoder\.layers?|layers?|model\.layer)\.(\d+)\.(.*)")
# These are the names of OpenAI's and OpenCLIP's networks.
_OPENAI = (
    (r"conv1\.", "patch_embed.proj."),
    (r"class_embedding$", "cls_token"),
    (r"positional_embedding$", "pos_embed"),
    (r"ln_pre\.", "norm_pre."),
    (r"ln_post\.", "norm."),
    (r"transformer\.resblocks\.(\d+)\.attn\.in_proj_", r"blocks.\1.attn.qkv."),
    (r"transformer\.resblocks\.(\d+)\.attn\.out_proj\.", r"blocks.\1.attn.proj."),
    (r"transformer\.resblocks\.(\d+)\.ln_([12])\.", r"blocks.\1.norm\2."),
    (r"transformer\.resblocks\.(\d+)\.mlp\.c_fc\.", r"blocks.\1.mlp.fc1."),
    (r"transformer\.resblocks\.(\d+)\.mlp\.c_proj\.", r"blocks.\1.mlp.fc2."),
)
# These are the names of torch.hub's DINOv2 and DINOv3, and of timm's networks with rotary positions.
_HUB = (
    (r"(register_tokens|storage_tokens)$", "reg_token"),
    (r"blocks\.(\d+)\.gamma_([12])$", r"blocks.\1.ls\2.gamma"),
    (r"blocks\.(\d+)\.mlp\.w12\.", r"blocks.\1.mlp.fc1."),
    (r"blocks\.(\d+)\.mlp\.w1\.", r"blocks.\1.mlp.fc1_g."),
    (r"blocks\.(\d+)\.mlp\.w2\.", r"blocks.\1.mlp.fc1_x."),
    (r"blocks\.(\d+)\.mlp\.w3\.", r"blocks.\1.mlp.fc2."),
)
# The end of the name of the patches' weights, by the family of names.
_PATCHES = (
    ("patch_embed.proj.weight", "hub"),
    ("embeddings.patch_embeddings.projection.weight", "transformers"),
    ("embeddings.patch_embeddings.weight", "transformers"),
    ("embeddings.patch_embedding.weight", "transformers"),
    ("conv1.weight", "openai"),
)


def vit_prefix(entries: Entries) -> tuple[str, str] | None:
    """Return what stands before all names of a vision transformer, and their family; None if there is no such network.

    Raises:
        ModelFileError: if the file holds several.
    """
    places: list[tuple[str, str, str]] = []
    for ending, family in _PATCHES:
        begins = [key.removesuffix(ending) for key in entries.state if re.search(rf"(^|\.){re.escape(ending)}$", key)]
        if family == "openai":
            begins = [begin for begin in begins if f"{begin}class_embedding" in entries.state]
        places += [(begin, family, ending) for begin in begins]
    if len(places) > 1:
        named = ", ".join(printable(f"{begin}{ending}") for begin, _, ending in places[:3])
        raise ModelFileError(
            f"{entries.name} holds several vision transformers ({named}); give a file with one of them."
        )
    return places[0][:2] if places else None


def read_vit(entries: Entries) -> VitTensors:
    """Read a vision transformer under timm's names.

    Raises:
        ModelFileError: if there is none, or entries have wrong shapes.
    """
    if (place := vit_prefix(entries)) is None:
        shown = ", ".join(printable(key)[:60] for key in list(entries.state)[:3]) or "nothing"
        raise ModelFileError(
            f"{entries.name} holds {shown}, and no patches of a vision transformer; expected the names of timm, of transformers "
            "(DINOv2, DINOv3, CLIP, SigLIP, ViT), or of torch.hub (DINOv2, DINOv3)."
        )
    prefix, family = place
    own = entries.under(prefix)
    if "cls_norm.weight" in own.state:
        raise ModelFileError(
            f"{entries.name} has a last norm of the class token's own ({prefix}cls_norm), which is not read."
        )
    if family == "hub":
        state, form = _renamed(own.state, _HUB), _hub_format(own.state)
    elif family == "openai":
        state, form = (
            _renamed(own.state, _OPENAI),
            VitFormat("CLIP", "antialiased", 1e-5, "quick_gelu", _CLIP, norm_before=True),
        )
    else:
        state, form = _of_transformers(own.state), _transformers_format(own.state)
    state = _fused(state)
    for key in ("cls_token", "reg_token"):
        if key in state:
            state[key] = state[key].reshape(1, -1, state[key].shape[-1])
    if "reg_token" in state and not state["reg_token"].shape[1]:
        del state["reg_token"]
    named = Entries(entries.name, state, entries.options, entries.prefix + prefix, entries.read)
    width = named.shape("patch_embed.proj.weight", 4)[0]
    if "pos_embed" not in state:
        if not form.rotary:
            raise ModelFileError(
                f"{entries.name} has no positions (pos_embed), and is no DINOv3; give its network's name in timm as "
                "timm:NAME:FILE."
            )
        return VitTensors(named, None, torch.zeros(0, width), form)
    positions = state.pop("pos_embed").float().reshape(-1, width)
    front = _front(len(positions), "cls_token" in state, state["reg_token"].shape[1] if "reg_token" in state else 0)
    return VitTensors(named, positions[front:], positions[:front], form)


def _front(count: int, class_token: bool, registers: int) -> int:
    """Return how many of `count` positions are of the tokens in front of the cells: those whose rest is a square."""
    for front in dict.fromkeys((int(class_token), 0, int(class_token) + registers)):
        if count > front and math.isqrt(count - front) ** 2 == count - front:
            return front
    return int(class_token)


def _renamed(state: Mapping[str, Tensor], patterns: tuple[tuple[str, str], ...]) -> dict[str, Tensor]:
    renamed = {}
    for key, value in state.items():
        for pattern, replacement in patterns:
            changed, count = re.subn(f"^{pattern}", replacement, key)
            if count:
                key = changed
                break
        renamed[key] = value
    return renamed


def _of_transformers(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    renamed: dict[str, Tensor] = {}
    for key, value in state.items():
        if (match := _LAYER.fullmatch(key)) is None:
            renamed |= _renamed({key: value}, _OUTSIDE)
        else:
            renamed |= {f"blocks.{match[1]}.{name}": one for name, one in _renamed({match[2]: value}, _BLOCK).items()}
    patches = renamed.get("patch_embed.proj.weight")
    if (
        patches is not None
        and patches.ndim == 2
        and (side := math.isqrt(patches.shape[1] // 3)) ** 2 * 3 == patches.shape[1]
    ):
        # SigLIP 2 (NaFlex) multiplies patches whose colours come last.
        renamed["patch_embed.proj.weight"] = patches.reshape(-1, side, side, 3).permute(0, 3, 1, 2)
    # A plain MLP of DINOv3 has an "up_proj" without a gate.
    if "blocks.0.mlp.fc1_g.weight" not in renamed:
        renamed = {key.replace(".mlp.fc1_x.", ".mlp.fc1."): value for key, value in renamed.items()}
    return renamed


def _fused(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return queries, keys, and values of each block as one matrix, and those of a pooling by attention as timm's two."""
    fused = {
        key: value
        for key, value in state.items()
        if not re.search(r"\.attn\.([qkv]\.|[qkv]_bias$|qkv\.bias_mask$)", key)
    }
    for key, value in state.items():
        if key.endswith(".attn.q.weight"):
            block = key.removesuffix("q.weight")
            rest = [state[f"{block}{name}.weight"] for name in "kv" if f"{block}{name}.weight" in state]
            fused[f"{block}qkv.weight"] = torch.cat([value, *rest])
    for key, value in state.items():
        match = re.fullmatch(r"(blocks\.\d+\.attn\.)(?:q\.|k\.|v\.|q_)bias", key)
        if match is not None and f"{match[1]}qkv.bias" not in fused:
            found = (state.get(f"{match[1]}{name}.bias", state.get(f"{match[1]}{name}_bias")) for name in "qkv")
            fused[f"{match[1]}qkv.bias"] = torch.cat([torch.zeros_like(value) if one is None else one for one in found])
        if key.endswith(".qkv.bias_mask"):
            bias = state[key.removesuffix("_mask")]
            # The mask of a file that was never trained is not a number everywhere.
            fused[key.removesuffix("_mask")] = bias * torch.nan_to_num(value.to(bias.dtype))
    for kind in ("weight", "bias"):
        if (both := fused.pop(f"attn_pool.qkv.{kind}", None)) is not None:
            third = len(both) // 3
            fused |= {f"attn_pool.q.{kind}": both[:third], f"attn_pool.kv.{kind}": both[third:]}
    return fused


def _hub_format(state: Mapping[str, Tensor]) -> VitFormat:
    rotary = "pos_embed" not in state and ("blocks.0.gamma_1" in state or "blocks.0.ls1.gamma" in state)
    if rotary:
        return VitFormat("DINOv3", epsilon=1e-5, rotary=True)
    if "mask_token" in state and "blocks.0.ls1.gamma" in state:
        registers = "register_tokens" in state
        return VitFormat("DINOv2 with registers", "antialiased") if registers else VitFormat("DINOv2", "longer")
    # timm's own names, of which DINOv2 and DeiT III have scales and ImageNet's values, and most others 0.5.
    scaled = "cls_token" in state and "blocks.0.ls1.gamma" in state
    return VitFormat("ViT", "antialiased", normalisation=(MEAN, STD) if scaled else (_HALF, _HALF))


def _transformers_format(state: Mapping[str, Tensor]) -> VitFormat:
    if "embeddings.class_embedding" in state:
        return VitFormat(
            "CLIP",
            epsilon=1e-5,
            activation="quick_gelu",
            normalisation=_CLIP,
            norm_before=True,
            class_norm_alone=True,
        )
    if (patches := state.get("embeddings.patch_embedding.weight")) is not None:
        if patches.ndim == 2:
            return VitFormat("SigLIP 2", "bilinear", activation="gelu_pytorch_tanh", normalisation=(_HALF, _HALF))
        return VitFormat("SigLIP", activation="gelu_pytorch_tanh", normalisation=(_HALF, _HALF))
    if "embeddings.patch_embeddings.weight" in state:
        return VitFormat("DINOv3", epsilon=1e-5, rotary=True)
    if "embeddings.register_tokens" in state:
        return VitFormat("DINOv2 with registers", "antialiased")
    if any(".layer_scale1." in key for key in state):
        return VitFormat("DINOv2")
    return VitFormat("ViT", epsilon=1e-12, normalisation=(_HALF, _HALF))
