"""Files written whole or not at all, what identifies a file, and how its name is shown."""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from contextlib import suppress
from pathlib import Path

from lpn.errors import OutputError


def fingerprint(*paths: Path, also: str = "") -> str:
    """SHA-256 of the contents of files, and of a text that decides how they are read: first 16 hexadecimal digits."""
    digest = hashlib.sha256(also.encode())
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]


def write_whole(path: Path, data: bytes) -> None:
    """Write beside `path`, then rename: a reader sees the old file or the new one, never half of it.

    Raises:
        OutputError: when it cannot be written; nothing is left behind.
    """
    beside = _beside(path)
    try:
        _prepare(path)
        beside.write_bytes(data)
        os.replace(beside, path)
    except OSError as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise _unwritable(path, error) from error


def check_writable(path: Path) -> None:
    """Find out before long work whether its result can be written to `path`; makes the folders it needs.

    Raises:
        OutputError: when it cannot.
    """
    beside = _beside(path)
    try:
        _prepare(path)
        beside.touch()
        beside.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error


def printable(name: str) -> str:
    """A file's name as text that can be shown and sent: bytes that are not UTF-8 and control characters become "?"."""
    return "".join(c if c.isprintable() else "?" for c in name.encode("utf-8", "replace").decode())


def _beside(path: Path) -> Path:
    """A name that no other process or thread writes to at the same time."""
    return path.parent / f"{path.name}.{os.getpid()}-{threading.get_ident()}.part"


def _prepare(path: Path) -> None:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    path.parent.mkdir(parents=True, exist_ok=True)


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path} cannot be written ({error.strerror}); free space or choose another place.")
