"""Open a published checkpoint of any known model, or a network whose tokens are pooled."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from lpn.core.errors import InputError
from lpn.core.files import fingerprint, printable
from lpn.models.adapters import Kind, tokens
from lpn.models.adapters.published import PublishedModel, PublishedParts
from lpn.models.adapters.registry import choose
from lpn.models.base import Model
from lpn.models.checkpoints import from_state, holds_safetensors, is_own, load_torch, read_state
from lpn.models.entries import Entries
from lpn.models.options import read_options
from lpn.models.published_checkpoints import name_unknown
from lpn.models.token_pooling import TokenPooling

log = logging.getLogger(__name__)


def load_file(
    path: str | Path,
    device: torch.device | str = "cpu",
    kind: Kind | None = None,
    pooling: TokenPooling | None = None,
    network: str | None = None,
) -> Model:
    """Open one of our `.safetensors`, or a published state dict in a PyTorch or `.safetensors` file.

    Only tensors are unpickled. An `opts.yaml` beside the file has the options of its training.

    Args:
        kind: the checkpoint's method; by default recognised by its entries.
        pooling: of the tokens of a network of timm or transformers; the mean by default.
        network: the name of the network in timm; None for a method, or a folder of transformers.

    Raises:
        ModelFileError: if the file is missing, truncated, of no known model, incomplete, or has entries of wrong shapes.
        InputError: if there is no such kind, a package is missing, or an option does not fit the model.
    """
    path = Path(path)
    if holds_safetensors(path) and is_own(path):
        for option, given in (("--kind", kind), ("--pooling", pooling), ("timm:", network)):
            if given is not None:
                raise InputError(f"{path.name} contains its network and its parts; leave {option} out.")
        return load_torch(path, device)
    options = read_options(path.with_name("opts.yaml"))
    if network is None and kind is None and tokens.is_of_transformers(path.parent):
        made = tokens.of_transformers(path.parent, options, _told(pooling, path))
        beside = [file.read_bytes() for file in sorted(path.parent.glob("*config.json"))]
        return _model(made, path, device, [options, *beside])
    state = read_state(path)
    if network is not None:
        if kind is not None:
            raise InputError(f"A network of timm defines no parts; leave --kind {kind} out.")
        made = tokens.of_timm(Entries(path.name, state, options), _told(pooling, path), network)
        return _model(made, path, device, options)
    if pooling is not None:
        raise InputError(
            f"{path.name} is no network by itself; name its network, as timm:NAME:{path.name}, or leave --pooling out."
        )
    adapter, state = choose(kind, state, options, path.name)
    if adapter.build is None:
        return from_state(state, options, path, device)
    entries = Entries(path.name, state, options)
    made = adapter.build(entries)
    name_unknown(path.name, made.contract.method, entries.left_over(adapter.unused))
    return _model(made, path, device, options)


def _told(pooling: TokenPooling | None, path: Path) -> TokenPooling:
    """Return the pooling of a network without parts; the default, the mean, is logged."""
    if pooling is None:
        log.warning("%s defines no parts; its tokens are pooled by their mean (--pooling).", printable(path.name))
    return pooling or TokenPooling()


def _model(made: PublishedParts, path: Path, device: torch.device | str, beside: object) -> PublishedModel:
    # Options and configurations change a network, but are in no tensor.
    return PublishedModel(made, fingerprint(path, also=repr((made.contract, beside))), device)
