"""A frozen backbone with adapters in its last blocks, so that a training learns the adapters and the heads alone.

The adapters are those of QDFL (Hu et al. 2025): in a block of a vision transformer one stands behind the attention, and one
beside the hidden layer. A residual block of a ResNet has one behind it, which is ours. Every adapter begins without effect.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError
from lpn.models.backbones import ResNet
from lpn.models.timm_networks import TimmMap

# The share of the adapter that QDFL adds beside a hidden layer.
_SHARE = 0.2
# An adapter's hidden layer has the channels divided by this, as QDFL's has.
_NARROWER = 2
# The entry of an adapter in the module that it belongs to.
_NAME = "adapter"


class ResidualAdapter(nn.Module):
    """Two linear layers over the channels of each cell, with a ReLU between them; the second begins at 0.

    Args:
        channels: C, the last axis of tokens (B, N, C), or the second of a map (B, C, h, w).
        of_maps: whether it adapts maps, by convolutions of one cell.
    """

    def __init__(self, channels: int, of_maps: bool) -> None:
        super().__init__()
        hidden = max(channels // _NARROWER, 1)
        self.down: nn.Conv2d | nn.Linear = nn.Conv2d(channels, hidden, 1) if of_maps else nn.Linear(channels, hidden)
        self.up: nn.Conv2d | nn.Linear = nn.Conv2d(hidden, channels, 1) if of_maps else nn.Linear(hidden, channels)
        nn.init.zeros_(self.up.weight)
        nn.init.zeros_(cast(Tensor, self.up.bias))

    def forward(self, values: Tensor) -> Tensor:
        return cast(Tensor, self.up(torch.relu(self.down(values))))


def adapt(backbone: nn.Module, name: str, count: int) -> None:
    """Freeze a backbone, and add adapters to its last blocks. Its entries keep their names.

    Args:
        name: of the backbone, for the message.
        count: of the blocks with adapters.

    Raises:
        InputError: if the backbone has no such blocks, or fewer of them.
    """
    blocks = blocks_of(backbone)
    if not blocks:
        raise InputError(
            f"{name} has no blocks that take adapters; leave --adapted-blocks out, or use a ResNet or a vision transformer of "
            "timm, such as timm:vit_small_patch14_dinov2."
        )
    if count > len(blocks):
        raise InputError(
            f"{name} has {len(blocks)} blocks, and {count} are to be adapted; give fewer --adapted-blocks."
        )
    backbone.requires_grad_(False)
    for block in blocks[-count:]:
        if isinstance(backbone, ResNet):
            _attach(block, ResidualAdapter(_channels(block), of_maps=True), _behind)
            continue
        width = cast(int, backbone.channels)
        _attach(cast(nn.Module, block.attn), ResidualAdapter(width, of_maps=False), _behind)
        _attach(cast(nn.Module, block.mlp), ResidualAdapter(width, of_maps=False), _beside)


def blocks_of(backbone: nn.Module) -> list[nn.Module]:
    """Return the blocks of a backbone that take adapters, in order; none if it is no ResNet and no vision transformer."""
    if isinstance(backbone, ResNet):
        return [block for stage in backbone.stages for block in cast(nn.Sequential, backbone.get_submodule(stage))]
    blocks = getattr(backbone.network, "blocks", ()) if isinstance(backbone, TimmMap) and backbone.patch else ()
    found = [block for block in blocks if isinstance(block, nn.Module)]
    return found if all(hasattr(block, "attn") and hasattr(block, "mlp") for block in found) else []


def is_adapters(name: str) -> bool:
    """Return whether an entry of a backbone belongs to an adapter."""
    return _NAME in name.split(".")


def frozen_output(backbone: nn.Module, images: Tensor, count: int) -> Tensor:
    """Return what enters the first adapted block: tokens (B, N, C) or a map (B, C, h, w), without a gradient.

    Args:
        images: (B, 3, H, W).
        count: of the blocks with adapters.
    """
    block = blocks_of(backbone)[-count]
    entered: list[Tensor] = []

    def stop(_: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        entered.append(inputs[0])
        raise _ReachedError

    hook = block.register_forward_pre_hook(stop)
    try:
        with torch.no_grad():
            backbone(images)
    except _ReachedError:
        pass
    finally:
        hook.remove()
    return entered[0]


def map_behind(backbone: nn.Module, values: Tensor, size: tuple[int, int], count: int) -> Tensor:
    """Return the last map (B, C, h, w) of what `frozen_output` returned, for a backbone that passes `check_divisible`.

    Args:
        size: (height, width) of the pictures in pixels.
        count: of the blocks with adapters.
    """
    for block in blocks_of(backbone)[-count:]:
        values = block(values)
    if isinstance(backbone, TimmMap):
        return backbone.on_grid(cast(Tensor, cast(Any, backbone.network).norm(values)), size)
    return values


def check_divisible(backbone: nn.Module, name: str, size: tuple[int, int], count: int) -> None:
    """Check on a random picture that `map_behind` of `frozen_output` is the map of the whole backbone.

    Args:
        backbone: in evaluation mode, on the CPU.
        name: of the backbone, for the message.
        size: (height, width) of the pictures in pixels.
        count: of the blocks with adapters.

    Raises:
        InputError: if it is not, as where the blocks take rotary positions beside the tokens (DINOv3).
    """
    picture = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        whole = backbone(picture)
        try:
            divided = map_behind(backbone, frozen_output(backbone, picture, count), size, count)
            same = torch.allclose(divided, whole, rtol=1e-3, atol=1e-3 * float(whole.abs().max()))
        except Exception:  # blocks that lack an argument, or a map of another shape, raise anything
            same = False
    # In an untrained network positions may have no effect yet.
    rotary = isinstance(backbone, TimmMap) and getattr(backbone.network, "rope", None) is not None
    if rotary or not same:
        raise InputError(
            f"The map of {name} does not follow from the tokens that enter its adapted blocks alone, which --variants stores; "
            "leave --variants out, or use a ResNet or a vision transformer such as timm:vit_small_patch14_dinov2."
        )


class _ReachedError(Exception):
    """The forward pass has reached the first adapted block."""


def _channels(block: nn.Module) -> int:
    """Return the channels of a residual block's output."""
    norms = [module for name, module in block.named_children() if name.startswith("bn")]
    return cast(nn.BatchNorm2d, norms[-1]).num_features


def _attach(module: nn.Module, adapter: ResidualAdapter, hook: Callable[..., Tensor]) -> None:
    # A hook leaves the names of the module's own entries as they are, so that every file of weights fits.
    module.add_module(_NAME, adapter)
    module.register_forward_hook(hook)


def _behind(module: nn.Module, _: tuple[Any, ...], output: Tensor) -> Tensor:
    """Add the adapter of a module's output."""
    return output + cast(Tensor, cast(ResidualAdapter, module.adapter)(output))


def _beside(module: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> Tensor:
    """Add a share of the adapter of a module's input."""
    return output + _SHARE * cast(Tensor, cast(ResidualAdapter, module.adapter)(inputs[0]))
