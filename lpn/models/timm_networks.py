"""Networks of `timm`, built without weights: by name, or from the shapes of a checkpoint's entries.

timm imports torchvision for augmentations and data sets, of which nothing is needed here. Torchvision's compiled operators fit
one build of torch only, and beside another one it cannot be imported. Then timm is imported with empty stand-ins for the
modules of torchvision; they are removed again afterwards, so that no other package meets them.
"""

from __future__ import annotations

import copy
import difflib
import enum
import functools
import importlib
import sys
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.images import Triple
from lpn.core.requirements import broken_package

_STAND_INS = (
    "torchvision",
    "torchvision.ops",
    "torchvision.ops.misc",
    "torchvision.transforms",
    "torchvision.transforms.functional",
    "torchvision.datasets",
)
# Layers behind the last map or tokens; they are not needed.
_BEHIND = ("head", "fc_norm", "pre_logits")
# The rotary vision transformers of timm that Game4Loc is trained from, by width and depth.
_ROTARY = {
    (512, 12): "vit_medium_patch16_rope_reg1_gap_256",
    (512, 20): "vit_mediumd_patch16_rope_reg1_gap_256",
    (640, 12): "vit_betwixt_patch16_rope_reg4_gap_256",
    (768, 12): "vit_base_patch16_rope_reg1_gap_256",
}


def import_timm() -> Any:
    """Import timm, also where torchvision is missing or was built for another torch.

    Raises:
        InputError: if timm is not installed, or broken.
    """
    if (imported := sys.modules.get("timm")) is not None:
        return imported
    try:
        importlib.import_module("torchvision")
        needed = False
    except Exception:  # its operators may fail to register in any way
        needed = True
    try:
        if not needed:
            return importlib.import_module("timm")
        with _stand_ins():
            return importlib.import_module("timm")
    except ModuleNotFoundError as error:
        if error.name == "timm":
            raise InputError(
                "The model's network comes from timm, which is not installed; pip install 'lpn-explorer[models]'."
            ) from error
        raise InputError(broken_package(error)) from error
    except Exception as error:
        raise InputError(broken_package(error)) from error


class _InterpolationMode(enum.Enum):
    """The names of which timm makes a table when it is imported."""

    NEAREST = "nearest"
    BILINEAR = "bilinear"
    BICUBIC = "bicubic"
    BOX = "box"
    HAMMING = "hamming"
    LANCZOS = "lanczos"


class _StandIn(types.ModuleType):
    """A module of torchvision in which every name is an empty class."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "InterpolationMode":
            return _InterpolationMode
        made = type(name, (nn.Module,), {})
        setattr(self, name, made)
        return made


@contextmanager
def _stand_ins() -> Iterator[None]:
    present = {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] == "torchvision"}
    modules = {name: _StandIn(name) for name in _STAND_INS}
    for name, module in modules.items():
        module.__path__ = []
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(modules[parent], child, module)
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in _STAND_INS:
            del sys.modules[name]
        sys.modules.update(present)


def convnext(
    depths: tuple[int, ...], widths: tuple[int, ...], second: bool = False, convolutional: bool = False
) -> nn.Module:
    """Build a ConvNeXt without a classifier, on the meta device; `forward_features` gives the map (B, C, h, w).

    Args:
        second: ConvNeXt V2, with a global response norm in each block in place of its scale.
        convolutional: whether the linear layers of blocks are convolutions of one pixel.
    """
    import_timm()
    from timm.models.convnext import ConvNeXt

    scale: dict[str, Any] = {"use_grn": True, "ls_init_value": None} if second else {}
    with torch.device("meta"):
        return cast(nn.Module, ConvNeXt(depths=depths, dims=widths, num_classes=0, conv_mlp=convolutional, **scale))


def vision_transformer(
    width: int,
    depth: int,
    hidden: int,
    size: tuple[int, int],
    patch: int,
    heads: int,
    *,
    qkv_bias: bool = True,
    class_token: bool = True,
    registers: int = 0,
    cells_only: bool = False,
    layer_scale: bool = False,
    last_norm: bool = True,
    norm_before: bool = False,
    epsilon: float = 1e-6,
    activation: str = "gelu",
    attention_pool: bool = False,
) -> nn.Module:
    """Build a ViT without a classifier, on the meta device.

    `forward_features` gives all tokens after the last norm, the class token and registers first: (B, prefix + cells, width).

    Args:
        hidden: width of the hidden layer of each block.
        heads: of the attention.
        cells_only: the class token and registers have no position.
        layer_scale: each half of a block has a scale by channel.
        last_norm: tokens are normalised at the end.
        norm_before: tokens are normalised before the first block, too (CLIP).
        epsilon: of the LayerNorms.
        activation: of the hidden layers by timm's name; "swiglu" for a gated hidden layer of packed weights.
        attention_pool: the network has a pooling by attention (SigLIP).
    """
    import_timm()
    from timm.layers.mlp import SwiGLUPacked
    from timm.layers.norm import LayerNorm
    from timm.models.vision_transformer import VisionTransformer

    hidden_layer: dict[str, Any] = {"act_layer": activation}
    if activation == "swiglu":
        hidden_layer = {"act_layer": nn.SiLU, "mlp_layer": SwiGLUPacked}
    pool: Literal["token", "avg", "map"] = "token" if class_token else "avg"
    with torch.device("meta"):
        return cast(
            nn.Module,
            VisionTransformer(
                img_size=size,
                patch_size=patch,
                embed_dim=width,
                depth=depth,
                num_heads=heads,
                # timm rounds the product of width and ratio down.
                mlp_ratio=(hidden + 0.5) / width,
                qkv_bias=qkv_bias,
                class_token=class_token,
                reg_tokens=registers,
                no_embed_class=cells_only,
                init_values=1.0 if layer_scale else None,
                fc_norm=not last_norm,
                pre_norm=norm_before,
                norm_layer=functools.partial(LayerNorm, eps=epsilon),
                num_classes=0,
                global_pool="map" if attention_pool else pool,
                **hidden_layer,
            ),
        )


def dinov3_transformer(
    width: int,
    depth: int,
    hidden: int,
    size: tuple[int, int],
    patch: int,
    heads: int,
    *,
    gated: bool = False,
    qkv_bias: bool = True,
    registers: int = 4,
    epsilon: float = 1e-5,
    base: float = 100.0,
) -> nn.Module:
    """Build a DINOv3 without a classifier; `forward_features` gives all tokens after the last norm, as `vision_transformer` does.

    Args:
        hidden: width of the hidden layer of each block.
        gated: whether the hidden layer has a gate (SwiGLU) with weights of its own.
        base: of the periods of its rotary positions.
    """
    import_timm()
    from timm.layers.norm import LayerNorm
    from timm.models.eva import Eva

    # Its periods and its biases of keys are in no file, so it is not built on the meta device.
    return cast(
        nn.Module,
        Eva(
            img_size=size,
            patch_size=patch,
            embed_dim=width,
            depth=depth,
            num_heads=heads,
            mlp_ratio=(hidden + 0.5) / width,
            qkv_bias=qkv_bias,
            swiglu_mlp=gated,
            swiglu_align_to=1 if gated else 0,
            init_values=1.0,
            rope_type="dinov3",
            rope_temperature=base,
            rope_rotate_half=True,
            use_rot_pos_emb=True,
            use_abs_pos_emb=False,
            num_reg_tokens=registers,
            use_fc_norm=False,
            norm_layer=functools.partial(LayerNorm, eps=epsilon),
            num_classes=0,
        ),
    )


def rotary_transformer(width: int, depth: int, size: tuple[int, int]) -> tuple[nn.Module, Any]:
    """Build a ViT with rotary positions and register tokens, and return it with timm's configuration of it.

    `forward_features` gives all tokens, the registers first, without a norm after the last block, for pictures of any size.

    Raises:
        InputError: if timm has no such network of this width and depth.
    """
    timm = import_timm()
    name = _ROTARY.get((width, depth))
    if name is None:
        raise InputError(
            f"A rotary vision transformer of width {width} and depth {depth} is not one of timm's: "
            f"{', '.join(sorted(_ROTARY.values()))}."
        )
    network = timm.create_model(name, pretrained=False, num_classes=0, img_size=size, dynamic_img_size=True)
    return cast(nn.Module, network), network.pretrained_cfg


def normalisation(name: str) -> tuple[Triple, Triple]:
    """Return the mean and the standard deviation of pictures that a network of timm was pretrained with.

    Args:
        name: such as "vit_base_patch16_384.augreg_in21k_ft_in1k"; what stands before a slash is left out.

    Raises:
        InputError: if timm has no such network.
    """
    timm = import_timm()
    own = name.rpartition("/")[2]
    try:
        configuration = timm.get_pretrained_cfg(own, allow_unregistered=False)
    except RuntimeError:  # of a tag that timm lacks
        configuration = None
    if configuration is None:
        raise _unknown(own)
    return tuple(configuration.mean), tuple(configuration.std)


class TimmMap(nn.Module):
    """A network of timm up to its last map or tokens: (B, 3, H, W) -> (B, C, h, w).

    Tokens are put on the grid of their patches, without class and register tokens in front of them. Entries have timm's names
    behind `network.`.

    Args:
        name: one of timm's, such as "convnext_tiny".
        size: (height, width) of the pictures. Networks with positions take no other size, unless timm resamples them.
        resampling: see `named_network`.

    Attributes:
        norm_behind: the LayerNorm that the whole network has behind its mean over the cells, as the name of its entries and its
            epsilon; None without one.

    Raises:
        InputError: if timm is missing, has no network of that name, or that network gives no map of such pictures.
    """

    def __init__(self, name: str, size: tuple[int, int], resampling: bool = True) -> None:
        super().__init__()
        self.network = named_network(name, size, resampling)
        self.norm_behind = _norm_behind(self.network)
        for behind in _BEHIND:
            if hasattr(self.network, behind):
                setattr(self.network, behind, nn.Identity())
        self.channels = int(cast(Any, self.network).num_features)
        self.prefix = int(getattr(self.network, "num_prefix_tokens", 0))
        self.channels_last = str(getattr(self.network, "output_fmt", "")).endswith("NHWC")
        shape = _features_shape(self.network, name, size)
        patch = getattr(getattr(self.network, "patch_embed", None), "patch_size", None)
        patch = (patch, patch) if isinstance(patch, int) else patch
        self.patch: tuple[int, int] | None = None if len(shape) != 3 or patch is None else (patch[0], patch[1])
        cells = shape[1] - self.prefix if self.patch is not None else 0
        tokens = self.patch is not None and cells == (size[0] // self.patch[0]) * (size[1] // self.patch[1])
        if not tokens and len(shape) != 4:
            raise InputError(
                f"timm's {name} gives an array of {' x '.join(map(str, shape[1:]))} for a picture of {size[0]} x {size[1]} "
                "pixels, which is no map of cells; choose another network, such as convnext_tiny."
            )

    def forward(self, images: Tensor) -> Tensor:
        features = cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]
        if self.patch is None:
            return features.permute(0, 3, 1, 2) if self.channels_last else features
        cells = features[:, self.prefix :].transpose(1, 2)
        return cells.reshape(*cells.shape[:2], images.shape[2] // self.patch[0], images.shape[3] // self.patch[1])

    def with_own_names(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return weights of timm under this network's names, with positions resampled to its size.

        Files of other origin are renamed as far as timm knows how; otherwise they are returned as they are.
        """
        module = sys.modules[type(self.network).__module__]
        try:
            renamed = module.checkpoint_filter_fn(dict(state), self.network)
        except Exception:  # a filter of timm raises anything on names that it does not expect
            renamed = state
        return {f"network.{key}": value for key, value in renamed.items()}


def _norm_behind(network: Any) -> tuple[str, float] | None:
    named = {
        "fc_norm": getattr(network, "fc_norm", None),
        "head.norm": getattr(getattr(network, "head", None), "norm", None),
    }
    norms = ((name, norm) for name, norm in named.items() if isinstance(norm, nn.LayerNorm) and norm.weight is not None)
    return next(((name, norm.eps) for name, norm in norms), None)


def _features_shape(network: nn.Module, name: str, size: tuple[int, int]) -> tuple[int, ...]:
    """Return the shape of what a network gives for one picture, without computing it."""
    try:
        with torch.device("meta"), torch.inference_mode():
            shadow: Any = copy.deepcopy(network).to("meta").eval()
            return tuple(shadow.forward_features(torch.zeros(1, 3, *size)).shape)
    except Exception as error:
        raise _refused(name, size, error) from error


def _refused(name: str, size: tuple[int, int], error: Exception) -> InputError:
    reason = str(error).strip().partition("\n")[0] or type(error).__name__
    return InputError(
        f"timm's {name} takes no pictures of {size[0]} x {size[1]} pixels ({printable(reason[:200])}); choose another size or "
        "another network, such as convnext_tiny."
    )


def _unknown(name: str) -> InputError:
    timm = import_timm()
    near = difflib.get_close_matches(name.partition(".")[0], timm.list_models(), 3, 0.5)
    nearest = f"the nearest are {', '.join(near)}" if near else "timm.list_models() has them all"
    return InputError(f"timm {timm.__version__} has no network {printable(name[:80])!r}; {nearest}.")


def base_name(name: str) -> str:
    """Return a network's name without what stands before a slash and without the tag of its weights."""
    return name.rpartition("/")[2].partition(".")[0]


def has_fixed_size(name: str) -> bool:
    """Return whether a network of timm takes pictures of one size alone."""
    configuration = import_timm().get_pretrained_cfg(name, allow_unregistered=True)
    return configuration is not None and bool(configuration.fixed_input_size)


def trained_size(name: str) -> tuple[int, int]:
    """Return the size (height, width) of the pictures that a network of timm was pretrained with.

    Raises:
        InputError: if timm has no such network.
    """
    if not import_timm().is_model(name):
        raise _unknown(name)
    configuration = import_timm().get_pretrained_cfg(name, allow_unregistered=True)
    return (224, 224) if configuration is None else tuple(configuration.input_size[1:])


def named_network(name: str, size: tuple[int, int], resampling: bool = True) -> nn.Module:
    """Build a network of timm with its pooling and without a classifier; (B, 3, H, W) -> (B, C).

    Args:
        resampling: whether a vision transformer resamples its positions for a picture of another size.

    Raises:
        InputError: if timm has no such network, or it takes no pictures of that size.
    """
    timm = import_timm()
    if "." in name or not timm.is_model(name):
        raise _unknown(name)
    options: dict[str, Any] = {"num_classes": 0}
    # Networks with positions are made for a size; vision transformers resample their positions for another one.
    if has_fixed_size(name):
        options["img_size"] = size
    try:
        try:
            sizes = {"dynamic_img_size": resampling}
            return cast(nn.Module, timm.create_model(name, pretrained=False, **options, **sizes))
        except TypeError:
            return cast(nn.Module, timm.create_model(name, pretrained=False, **options))
    except Exception as error:  # networks refuse sizes in many ways
        raise _refused(name, size, error) from error
