"""Compare written files with their checksums: stores, models, and trainings, read in full."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lpn.core.checksums import check_entries, check_seal
from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.descriptors import open_store
from lpn.descriptors.store import MANIFEST, UNFINISHED, parts_of

_MODELS = (".onnx", ".safetensors", ".pth", ".pt")
_AGAIN = "copy it again from its source, or make it again"


@dataclass(frozen=True)
class VerifiedFile:
    """The result for one file or folder.

    Attributes:
        path: the file or folder.
        message: the end of a sentence about it.
        healthy: False if it is damaged, unfinished, or empty.
        flaw: the word for its defect.
    """

    path: Path
    message: str
    healthy: bool
    flaw: str = "DAMAGED"

    @property
    def line(self) -> str:
        """The result as one line of text."""
        name = printable(str(self.path))
        return f"{name} {self.message}." if self.healthy else f"{self.flaw}: {name}: {self.message}"


def verify(path: Path) -> Iterator[VerifiedFile]:
    """Compare a model file or a store, or all of these below a folder, with their checksums.

    Raises:
        InputError: if there is no model file and no store.
    """
    if not path.exists():
        raise InputError(f"There is nothing at {path}; check the path.")
    files = [path] if path.is_file() else sorted(_find(path))
    if not files:
        raise InputError(f"{path} holds no store and no model; give one of these, or a folder of them.")
    for file in files:
        try:
            yield _verify_store(file) if file.is_dir() else VerifiedFile(file, _verify(file), True)
        except (LPNError, OSError) as error:
            yield VerifiedFile(file, printable(str(error)), False)


def _verify_store(folder: Path) -> VerifiedFile:
    if not (folder / MANIFEST).exists():
        return VerifiedFile(folder, f"{UNFINISHED}.", False, "UNFINISHED")
    store = open_store(folder)
    unfinished = store.check()
    left = "an unfinished run has left parts beside it, so give its command again" if unfinished else ""
    if len(store):
        return VerifiedFile(folder, f"matches its checksums{f'; {left}' if left else ''}", True)
    again = "check that the disk has space, and add tiles again with lpn index"
    return VerifiedFile(folder, f"is empty: {left or 'no tile was added'}; {again}.", False)


def _find(folder: Path) -> Iterator[Path]:
    for path in (folder, *folder.rglob("*")):
        is_store = path.is_dir() and ((path / MANIFEST).is_file() or parts_of(path))
        if is_store or (path.suffix in _MODELS and path.is_file()):
            yield path


def _verify(path: Path) -> str:
    if path.suffix in (".onnx", ".safetensors") and check_seal(path, _AGAIN):
        return "matches its checksum"
    if path.suffix in (".pth", ".pt") and check_entries(path, _AGAIN):
        return "matches the checksums of its entries"
    # A truncated file has lost its checksum, so it must be opened.
    if path.suffix == ".onnx":
        from lpn.models.onnx_engine import open_session

        open_session(path)
    else:
        from lpn.models.checkpoints import check_opens

        check_opens(path)
    return "can be read, and has no checksum: an earlier version or another program wrote it"
