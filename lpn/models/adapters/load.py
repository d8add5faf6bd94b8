"""Open a published checkpoint of any known model."""

from __future__ import annotations

from pathlib import Path

import torch

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import fingerprint
from lpn.models.adapters.build import build
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.model import PublishedModel
from lpn.models.adapters.recognise import Kind, check_kind, title_of_other, unwrapped, unwrapped_as
from lpn.models.base import Model
from lpn.models.checkpoints import from_state, holds_safetensors, is_own, load_torch, read_state
from lpn.models.published_checkpoints import StateDict, read_options


def load_file(
    path: str | Path, device: torch.device | str = "cpu", compiled: bool = False, kind: Kind | None = None
) -> Model:
    """Open one of our `.safetensors`, or a published state dict in a PyTorch or `.safetensors` file.

    Args:
        compiled: run an LPN by torch.compile, see `TorchModel`.
        kind: see `load_published`.

    Raises:
        ModelFileError: as for `load_published`.
        InputError: as for `load_published`, and if a kind is given for a file of ours.
    """
    path = Path(path)
    if not holds_safetensors(path) or not is_own(path):
        return load_published(path, device, compiled, kind)
    if kind is not None:
        raise InputError(f"{path.name} contains its kind; leave --kind out.")
    return load_torch(path, device, compiled)


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
    if named is None:
        kind, state = unwrapped(state, path.name)
    else:
        kind, state = named, unwrapped_as(named, state)
    try:
        return _built(kind, state, path, device, compiled, named is None)
    except ModelFileError as error:
        own = None if named is None else title_of_other(named, state)
        if own is None:
            raise
        raise ModelFileError(
            f"{str(error).removesuffix('.')}; by its entries it is a checkpoint of {own}, so leave --kind out."
        ) from error


def _built(
    kind: Kind, state: StateDict, path: Path, device: torch.device | str, compiled: bool, recognised: bool
) -> Model:
    options = read_options(path.with_name("opts.yaml"))
    if kind == "lpn" and recognised and "dense_LPN" in options:
        # Baselines trained by SDPL's code have the same entries as an LPN of two branches; only this option distinguishes them.
        kind = "sdpl"
    if kind == "lpn":
        return from_state(state, options, path, device, compiled)
    if compiled:
        raise InputError(
            f"torch.compile is for LPN and SAFA, and {path.name} is of another kind ({kind}); leave --compile out."
        )
    published = build(kind, Entries(path.name, state, options))
    return PublishedModel(published, fingerprint(path, also=repr(published.contract)), device)
