"""Compare written files with their checksums: stores, indexes, parts, models, and trainings, read in full."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpn.core.checksums import check_entries, check_seal
from lpn.core.errors import InputError, LPNError, StoreError
from lpn.core.files import printable
from lpn.descriptors import Store, open_store
from lpn.descriptors.partial_store import LOG
from lpn.index.folder import is_manifest
from lpn.index.folder import verify as verify_index

_CHUNK = 4096
_MODELS = (".onnx", ".safetensors", ".pth", ".pt")
_AGAIN = "copy it again from where it came, or make it again"
_DESCRIBE = "delete the folder and describe the pictures again"


@dataclass(frozen=True)
class VerifiedFile:
    """The result for one file or folder.

    Attributes:
        path: the file or folder.
        message: the end of a sentence about it.
        whole: False if it is damaged, or holds nothing.
    """

    path: Path
    message: str
    whole: bool


def verify(path: Path) -> Iterator[VerifiedFile]:
    """Compare a model file, store, index, or folder of parts, or all of these below a folder, with their checksums.

    Raises:
        InputError: if none of them is there.
    """
    if not path.exists():
        raise InputError(f"There is nothing at {path}; check the path.")
    files = [path] if path.is_file() else sorted({*_find(path)})
    if not files:
        raise InputError(
            f"{path} holds no store, no index, no parts, and no model; give one of these, or a folder of them."
        )
    for file in files:
        try:
            of_index = file.is_dir() and any(is_manifest(one.name) for one in file.iterdir())
            yield _verify_index(file) if of_index else VerifiedFile(file, _verify(file), True)
        except (LPNError, OSError) as error:
            yield VerifiedFile(file, printable(str(error)), False)


def _verify_index(folder: Path) -> VerifiedFile:
    tiles, unfinished = verify_index(folder)
    left = "an add was interrupted or is still running, and its tiles are missing" if unfinished else ""
    if tiles:
        more = f"; {left}, so add them again with lpn index" if left else ""
        return VerifiedFile(folder, f"is what was written{more}", True)
    again = "see that the disk has space, and add them again with lpn index"
    return VerifiedFile(folder, f"is empty: {left or 'no tile was added'}; {again}.", False)


def _find(folder: Path) -> Iterator[Path]:
    for file in folder.rglob("*"):
        name = file.name
        parts = name == "plan.json" and any(file.parent.glob("part-*.zip"))
        # The log belongs to an interrupted store.
        if parts or name in ("manifest.json", LOG) or is_manifest(name):
            yield file.parent
        elif file.suffix in _MODELS and file.is_file():
            yield file


def _verify(path: Path) -> str:
    if path.is_dir():
        return _verify_parts(path) if (path / "plan.json").exists() else _verify_store(open_store(path), path)
    if path.suffix in (".onnx", ".safetensors") and check_seal(path, _AGAIN):
        return "is what was written"
    if path.suffix in (".pth", ".pt") and check_entries(path, _AGAIN):
        return "is what was written, as far as its entries have checksums"
    # A truncated file has lost its checksum, so it must be opened.
    if path.suffix == ".onnx":
        from lpn.models.onnx_engine import open_session

        open_session(path)
    else:
        from lpn.models.checkpoints import check_opens

        check_opens(path)
    return "can be read, and has no checksum: an earlier version or another program wrote it"


def _verify_store(store: Store, folder: Path) -> str:
    for start in range(0, len(store.descriptors), _CHUNK):
        finite = np.isfinite(store.descriptors[start : start + _CHUNK]).all(axis=(1, 2))
        if not finite.all():
            first = store.manifest.rows[start + int(np.argmin(finite))].file
            raise StoreError(
                f"{folder} holds values that are not finite, the first of {printable(first)}; {_DESCRIBE}."
            )
    if store.manifest.damaged:
        raise StoreError(f"manifest.json in {folder} does not match its checksum; {_DESCRIBE}.")
    if damaged := int(store.damaged().sum()):
        of = f"in up to {damaged} of {len(store.descriptors)} rows"
        raise StoreError(f"descriptors.npy in {folder} does not match its checksums {of}; {_DESCRIBE}.")
    return "is what was written" if store.manifest.checksums else "has no checksums: an earlier version wrote it"


def _verify_parts(folder: Path) -> str:
    from lpn.cluster.parts import open_parts

    opened = open_parts(folder)
    if not all(np.isfinite(opened.vectors(part)).all() for part in opened.parts):
        raise StoreError(f"{folder} holds values that are not finite; {_DESCRIBE}.")
    return "is what was written"
