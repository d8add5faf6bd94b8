"""Networks of timm and of transformers, built by their own loaders, with tokens pooled into parts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError, MissingPackageError, ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.core.views import VIEWS
from lpn.models import timm_networks
from lpn.models.adapters.network import NORM_HELD, Account, HeldNorm, PartBranch, on_grid
from lpn.models.adapters.published import PublishedParts, size_of
from lpn.models.entries import Entries
from lpn.models.options import NETWORK, PICTURES, read_configuration, stated_normalisation, stated_size
from lpn.models.timm_networks import TimmMap
from lpn.models.token_pooling import TokenPooling, pooled


class TimmTokens(nn.Module):
    """A network of timm: (B, 3, H, W) to its map (B, C, h, w), and its class token (B, C), or None."""

    def __init__(self, network: TimmMap) -> None:
        super().__init__()
        self.network = network.network
        self.as_map, self.grid, self.channels = network.as_map, network.grid, network.channels
        self.pool = getattr(network.network, "attn_pool", None)
        of_class = network.patch is not None and getattr(network.network, "cls_token", None) is not None
        self.has_class = self.pool is not None or of_class

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor | None]:
        values = cast(Tensor, self.network.forward_features(images))  # type: ignore[operator]
        first = None
        if self.has_class:
            first = values[:, 0] if self.pool is None else cast(Tensor, self.pool(values))
        return self.as_map(values, images), first


class TransformersTokens(nn.Module):
    """A vision transformer of transformers: (B, 3, H, W) to its map (B, C, h, w), and its class token (B, C), or None."""

    def __init__(self, network: Any, size: tuple[int, int]) -> None:
        super().__init__()
        self.network = getattr(network, "vision_model", network)
        patch = int(self.network.config.patch_size)
        self.grid = size[0] // patch, size[1] // patch
        self.channels = int(self.network.config.hidden_size)
        with torch.inference_mode():
            count = self._tokens(torch.zeros(1, 3, *size)).shape[1]
        self.prefix = count - self.grid[0] * self.grid[1]
        self.has_class = self.prefix > 0

    def _tokens(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.network(pixel_values=images).last_hidden_state)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor | None]:
        values = self._tokens(images)
        return on_grid(values[:, self.prefix :].transpose(1, 2), self.grid), values[:, 0] if self.has_class else None


class TokenParts(PartBranch):
    """The parts of a map of tokens under a named pooling, without a head.

    Args:
        trunk: gives the map and the class token, and has `grid`.
        norm: a LayerNorm after the network's own mean; only with the pooling "mean".
    """

    def __init__(self, trunk: Any, pooling: TokenPooling, norm: HeldNorm | None = None) -> None:
        partition = pooling.partition
        super().__init__((1, 1) if partition is None else trunk.grid)
        self.trunk, self.pooling, self.norm = trunk, pooling, norm
        shares = None if partition is None else torch.from_numpy(partition.weights(*trunk.grid))
        self.register_buffer("shares", shares)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account."""
        features, first = self.trunk(images)
        if self.shares is None:
            return Account(cast(Tensor, first).unsqueeze(1))
        shares = cast(Tensor, self.shares)
        parts, features, constants = pooled(self.pooling, shares, features, first, torch.cat)
        if self.norm is not None:
            scale, offset = self.norm.affine(parts[:, 0])
            parts, constants = self.norm(parts), offset.unsqueeze(1)
            features = features * scale[:, :, None, None]
        return Account(parts, features, shares.expand(images.shape[0], -1, -1, -1), constants)


def of_timm(entries: Entries, pooling: TokenPooling, name: str) -> PublishedParts:
    """Build a network of timm by its name, with weights read by timm's own loader.

    The size of pictures is `h` and `w` of the options, else the training size.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes.
        InputError: if timm is missing, has no such network, or the network gives no map of such pictures.
    """
    base = timm_networks.base_name(name)
    normalisation = timm_networks.normalisation(name)
    size = size_of(entries, timm_networks.trained_size(name))
    network = timm_networks.named_network(base, size, own_size=True)
    mapped = TimmMap(base, size, network=network)
    try:
        Entries(entries.name, timm_networks.renamed(network, entries.state)).fill(network)
    except ModelFileError as error:
        raise ModelFileError(f"As timm's {base} for {size[0]} x {size[1]} pixels: {error}") from error
    behind = timm_networks.norm_behind(network)
    norm = None if behind is None else HeldNorm(behind)
    return _parts(TimmTokens(mapped.without_head()), pooling, base, size, normalisation, norm)


def is_of_transformers(folder: Path) -> bool:
    """Return whether a folder has the configuration that transformers writes beside a network's weights."""
    try:
        return "model_type" in read_configuration(folder, NETWORK)
    except ModelFileError:  # other programs write a config.json, too
        return False


def of_transformers(folder: Path, options: Mapping[str, Any], pooling: TokenPooling) -> PublishedParts:
    """Build a vision transformer from a folder that transformers saved; only transformers' own code runs.

    Raises:
        ModelFileError: if transformers cannot open it, or it gives no patch tokens.
        MissingPackageError: if transformers is missing.
    """
    try:
        import transformers
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"{printable(str(folder))} is a network of transformers, which is not installed; pip install transformers."
        ) from error
    configuration, pictures = read_configuration(folder, NETWORK), read_configuration(folder, PICTURES)
    own = configuration.get("vision_config") or configuration
    side = own.get("image_size", 224)
    stated = stated_size(pictures) or stated_size({"size": side}) or (224, 224)
    size = size_of(Entries(folder.name, {}, options), stated, int(own.get("patch_size", 1)))
    try:
        network = transformers.AutoModel.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
        trunk = TransformersTokens(network.eval(), size)
    except Exception as error:  # transformers and its networks raise anything
        reason = printable(str(error).strip().partition("\n")[0])[:200] or type(error).__name__
        raise ModelFileError(
            f"transformers {transformers.__version__} cannot open {printable(folder.name)} as a vision transformer for pictures "
            f"of {size[0]} x {size[1]} pixels ({reason})."
        ) from error
    title = printable(str(configuration["model_type"]))[:60]
    return _parts(trunk, pooling, title, size, stated_normalisation(pictures, (MEAN, STD)))


def _parts(
    trunk: TimmTokens | TransformersTokens,
    pooling: TokenPooling,
    title: str,
    size: tuple[int, int],
    normalisation: tuple[Triple, Triple],
    norm: HeldNorm | None = None,
) -> PublishedParts:
    """Return the model of a pooling of tokens; one branch describes all views."""
    if pooling.needs_class_token and not trunk.has_class:
        raise InputError(f"{title} has no class token for the pooling {pooling}; take mean, gem, or rings:N.")
    norm = norm if pooling.name == "mean" else None
    contract = pooling.contract(title, size, trunk.channels, normalisation, NORM_HELD if norm is not None else "")
    return PublishedParts(contract, dict.fromkeys(VIEWS, TokenParts(trunk, pooling, norm)))
