"""Open a published checkpoint of any known model."""

from __future__ import annotations

from pathlib import Path

import torch

from lpn.core.errors import InputError
from lpn.core.files import fingerprint
from lpn.models.adapters.build import build
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.model import PublishedModel
from lpn.models.adapters.recognise import Kind, check_kind, recognise
from lpn.models.base import Model
from lpn.models.checkpoints import from_state, read_state
from lpn.models.published_checkpoints import read_options


def load_published(
    path: str | Path, device: torch.device | str = "cpu", compiled: bool = False, kind: Kind | None = None
) -> Model:
    """Open a published state dict, with the `opts.yaml` beside it. Only tensors are unpickled.

    Args:
        compiled: run an LPN by torch.compile, see `TorchModel`.
        kind: whose checkpoint it is; by default recognised by the names of its entries.

    Raises:
        ModelFileError: if the file is missing, truncated, of no known model, incomplete, or has entries of wrong shapes.
        InputError: if there is no such kind, a package is missing, or `compiled` with another model than an LPN.
    """
    path = Path(path)
    named = None if kind is None else check_kind(kind)
    state = read_state(path)
    kind = recognise(state, path.name) if named is None else named
    options = read_options(path.with_name("opts.yaml"))
    if kind == "lpn":
        return from_state(state, options, path, device, compiled)
    if compiled:
        raise InputError(
            f"torch.compile is for LPN and SAFA, and {path.name} is of another kind ({kind}); leave --compile out."
        )
    published = build(kind, Entries(path.name, state, options))
    return PublishedModel(published, fingerprint(path, also=repr(published.contract)), device)
