"""Networks of timm by their names, built without weights.

timm imports torchvision for augmentations and data sets, which are not needed here. Torchvision's compiled operators fit
only one build of torch; with another one, its import fails. Then timm is imported with empty stand-ins for torchvision's
modules. They are removed afterwards, so that no other package imports them.
"""

from __future__ import annotations

import copy
import difflib
import enum
import importlib
import sys
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any, cast

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
# Layers after the last map or tokens; they are not needed.
_BEHIND = ("head", "fc_norm", "pre_logits")


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
        with _stand_ins() if needed else nullcontext():
            return importlib.import_module("timm")
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "timm":
            raise InputError(
                "The model's network comes from timm, which is not installed; pip install 'lpn-explorer[models]'."
            ) from error
        raise InputError(broken_package(error)) from error


class _StandIn(types.ModuleType):
    """A module of torchvision in which every name is an empty class."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "InterpolationMode":
            # timm builds a table of these names at its import.
            return enum.Enum(name, "NEAREST BILINEAR BICUBIC BOX HAMMING LANCZOS")
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


def normalisation(name: str) -> tuple[Triple, Triple]:
    """Return the mean and the standard deviation of the pretraining pictures of a network of timm.

    Args:
        name: such as "vit_base_patch16_384.augreg_in21k_ft_in1k"; a prefix up to a slash is ignored.

    Raises:
        InputError: if timm has no such network.
    """
    timm = import_timm()
    own = name.rpartition("/")[2]
    try:
        configuration = timm.get_pretrained_cfg(own, allow_unregistered=False)
    except RuntimeError:  # timm lacks the tag in the name
        configuration = None
    if configuration is None:
        raise _unknown(own)
    return tuple(configuration.mean), tuple(configuration.std)


class TimmMap(nn.Module):
    """A network of timm up to its last map or tokens: (B, 3, H, W) -> (B, C, h, w).

    Tokens are put on the grid of their patches, without prefix tokens. Names of entries are `network.` and timm's name.

    Args:
        name: one of timm's, such as "convnext_tiny".
        size: (height, width) of the pictures. Networks with positions take no other size, unless timm resamples them.
        network: a built network with the layers after its map; None to build it without them.

    Raises:
        InputError: if timm is missing, has no network of that name, or that network gives no map of such pictures.
    """

    def __init__(self, name: str, size: tuple[int, int], network: nn.Module | None = None) -> None:
        super().__init__()
        self.network = named_network(name, size) if network is None else network
        if network is None:
            self.without_head()
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
        rows, columns = shape[1:3] if self.channels_last else shape[-2:]
        patch = self.patch
        self.grid = (rows, columns) if patch is None else (size[0] // patch[0], size[1] // patch[1])

    def without_head(self) -> TimmMap:
        """Return this network without the layers after its last map or tokens."""
        for behind in _BEHIND:
            if hasattr(self.network, behind):
                setattr(self.network, behind, nn.Identity())
        return self

    def forward(self, images: Tensor) -> Tensor:
        return self.as_map(cast(Tensor, self.network.forward_features(images)), images)  # type: ignore[operator]

    def as_map(self, features: Tensor, images: Tensor) -> Tensor:
        """Return the network's output for pictures as a map (B, C, h, w)."""
        if self.patch is None:
            return features.permute(0, 3, 1, 2) if self.channels_last else features
        cells = features[:, self.prefix :].transpose(1, 2)
        return cells.reshape(*cells.shape[:2], images.shape[2] // self.patch[0], images.shape[3] // self.patch[1])


def renamed(network: nn.Module, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a network's weights under timm's names, with positions resampled to its size.

    Files of other origin, such as torch.hub's, are renamed as far as timm can, and otherwise unchanged.
    """
    module = sys.modules[type(network).__module__]
    try:
        return dict(module.checkpoint_filter_fn(dict(state), network))
    except Exception:  # a filter of timm raises anything on names that it does not expect
        return dict(state)


def norm_behind(network: Any) -> nn.LayerNorm | None:
    """Return the LayerNorm after a network's mean over the cells, or None."""
    for norm in (getattr(network, "fc_norm", None), getattr(getattr(network, "head", None), "norm", None)):
        if isinstance(norm, nn.LayerNorm) and norm.weight is not None and norm.bias is not None:
            return norm
    return None


def _features_shape(network: nn.Module, name: str, size: tuple[int, int]) -> tuple[int, ...]:
    """Return the output shape of a network for one picture, without computing it."""
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
    """Return a network's name without a prefix up to a slash, and without the tag of its weights."""
    return name.rpartition("/")[2].partition(".")[0]


def has_fixed_size(name: str) -> bool:
    """Return whether a network of timm takes pictures of one size alone."""
    configuration = import_timm().get_pretrained_cfg(name, allow_unregistered=True)
    return configuration is not None and bool(configuration.fixed_input_size)


def trained_size(name: str) -> tuple[int, int]:
    """Return the size (height, width) of the pretraining pictures of a network of timm.

    Raises:
        InputError: if timm has no such network.
    """
    if not import_timm().is_model(name):
        raise _unknown(name)
    configuration = import_timm().get_pretrained_cfg(name, allow_unregistered=True)
    return (224, 224) if configuration is None else tuple(configuration.input_size[1:])


def named_network(name: str, size: tuple[int, int], own_size: bool = False) -> nn.Module:
    """Build a network of timm with its pooling and without a classifier; (B, 3, H, W) -> (B, C).

    Args:
        own_size: whether to build its positions for that size, instead of resampling them for each picture.

    Raises:
        InputError: if timm has no such network, or it takes no pictures of that size.
    """
    timm = import_timm()
    if "." in name or not timm.is_model(name):
        raise _unknown(name)
    # Networks with positions are made for a size; vision transformers resample their positions for another one.
    options: dict[str, Any] = {"img_size": size} if own_size or has_fixed_size(name) else {}
    attempts: list[dict[str, Any]] = [{**options, "dynamic_img_size": not own_size}, options, {}]
    for attempt in attempts:
        try:
            return cast(nn.Module, timm.create_model(name, pretrained=False, num_classes=0, **attempt))
        except TypeError:  # the network does not take an option
            continue
        except Exception as error:  # networks refuse sizes in many ways
            raise _refused(name, size, error) from error
    raise _refused(name, size, TypeError("it takes no options of a size"))
