"""Networks of `timm`, built without weights from the shapes of a checkpoint's entries.

timm imports torchvision for augmentations and data sets, of which nothing is needed here. Torchvision's compiled operators fit
one build of torch only, and beside another one it cannot be imported. Then timm is imported with empty stand-ins for the
modules of torchvision; they are removed again afterwards, so that no other package meets them.
"""

from __future__ import annotations

import enum
import importlib
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import nn

from lpn.core.errors import InputError
from lpn.core.requirements import broken_package

_STAND_INS = (
    "torchvision",
    "torchvision.ops",
    "torchvision.ops.misc",
    "torchvision.transforms",
    "torchvision.transforms.functional",
    "torchvision.datasets",
)
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
                "This model's network comes from timm, which is not installed; pip install 'lpn-explorer[models]'."
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


def convnext(depths: tuple[int, ...], widths: tuple[int, ...]) -> nn.Module:
    """Build a ConvNeXt without a classifier, on the meta device; `forward_features` gives the map (B, C, h, w)."""
    import_timm()
    from timm.models.convnext import ConvNeXt

    with torch.device("meta"):
        return cast(nn.Module, ConvNeXt(depths=depths, dims=widths, num_classes=0))


def vision_transformer(
    width: int, depth: int, hidden: int, size: tuple[int, int], patch: int, qkv_bias: bool, heads: int
) -> nn.Module:
    """Build a ViT with a class token and without a classifier, on the meta device.

    `forward_features` gives all tokens after the last norm, the class token first: (B, 1 + cells, width).

    Args:
        hidden: width of the hidden layer of each block.
        heads: of the attention.
    """
    import_timm()
    from timm.models.vision_transformer import VisionTransformer

    with torch.device("meta"):
        return cast(
            nn.Module,
            VisionTransformer(
                img_size=size,
                patch_size=patch,
                embed_dim=width,
                depth=depth,
                num_heads=heads,
                mlp_ratio=hidden / width,
                qkv_bias=qkv_bias,
                num_classes=0,
                global_pool="token",
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
