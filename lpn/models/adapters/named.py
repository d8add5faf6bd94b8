"""Networks of timm by name: as a map, or as the network's own pooled vector."""

from __future__ import annotations

import torch
from torch import nn

from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.network import FirstToken, HeldNorm, MeanVector, PartBranch
from lpn.models.entries import Entries
from lpn.models.timm_networks import TimmMap

# The largest difference, relative to the largest value, between a network's vector and the mean of its cells.
_SAME = 1e-4
_SEED = 21


def filled_map(name: str, entries: Entries, size: tuple[int, int]) -> TimmMap:
    """Return a network of timm up to its last map or tokens, with the weights of a file.

    Raises:
        InputError: if timm has no such network, or it gives no map of pictures of that size.
        ModelFileError: if the entries are of another network.
    """
    network = TimmMap(name, size)
    _fill(network.network, name, entries)
    return network


def named_vector(name: str, entries: Entries, size: tuple[int, int]) -> tuple[PartBranch, int]:
    """Return a network of timm with its own pooling and without a classifier, and the length of its vector.

    The network's vector for a picture of noise is compared with the mean of its cells, with and without the LayerNorm after
    the pooling. If one of the two equals the vector, the branch has cells; otherwise it has none.

    Raises:
        InputError: if timm has no such network, or it takes no pictures of that size.
        ModelFileError: if the entries are of another network.
    """
    whole = timm_networks.named_network(name, size)
    _fill(whole, name, entries)
    noise = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(_SEED))
    with torch.inference_mode():
        vector = whole.eval()(noise)
        try:
            mapped = TimmMap(name, size, network=whole)
        except InputError:
            return FirstToken(whole), vector.shape[1]
        pooled = mapped(noise).mean((2, 3))
        behind = timm_networks.norm_behind(whole)
        for norm in (None, *([] if behind is None else [HeldNorm(behind)])):
            found = pooled if norm is None else norm(pooled)
            if found.shape == vector.shape and bool((found - vector).abs().max() < _SAME * vector.abs().max()):
                return MeanVector(mapped.without_head(), norm, mapped.grid), vector.shape[1]
    return FirstToken(whole), vector.shape[1]


def _fill(network: nn.Module, name: str, entries: Entries) -> None:
    try:
        entries.fill(network)
    except ModelFileError as error:
        raise ModelFileError(f"As timm's {name}: {error}") from error
