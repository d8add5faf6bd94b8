"""Files written whole or not at all, what identifies a file, and how its name is shown."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING

from lpn.core.errors import OutputError, StoreError
from lpn.core.shutdown import uninterrupted

if TYPE_CHECKING:
    from lpn.core.arrays import AnyArray

try:
    import fcntl
except ImportError:  # not a POSIX system: there, two processes must not write into one folder at once
    fcntl = None  # type: ignore[assignment]

try:
    import resource
except ImportError:  # the same
    resource = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

_ABANDONED = 60.0
"""Seconds in which nobody wrote to what a killed process left, before it is deleted: it may be another machine's."""
_MANY = 65_536
"""Open files that are enough for 7 * 10^8 tiles; a process that may have 2^30 of them can be slow to start another."""
_FILES = 10_240
"""What macOS lets a process open, which says that there is no bound."""


def fingerprint(*paths: Path, also: str = "") -> str:
    """SHA-256 of the contents of files, and of a text that decides how they are read: first 16 hexadecimal digits."""
    digest = hashlib.sha256(also.encode())
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]


def write_atomic(path: Path, data: bytes) -> None:
    """Write beside `path`, then rename: a reader sees the old file or the new one, never half of it.

    Raises:
        OutputError: when it cannot be written; nothing is left behind.
    """
    beside = _beside(path)
    with uninterrupted():
        try:
            _prepare(path)
            beside.write_bytes(data)
            os.replace(beside, path)
        except OSError as error:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            raise _unwritable(path, error) from error
        with suppress(OSError):
            _clear(path)


def open_memmap(path: Path) -> AnyArray:
    """The array of a `.npy` file, memory-mapped, read-only.

    Raises:
        FileNotFoundError: when there is none.
        OSError: when it cannot be read, whatever it holds; see `unreadable`.
        ValueError: when it is damaged, or holds Python objects.
    """
    import numpy as np

    try:
        found: AnyArray = np.lib.format.open_memmap(path, mode="r")
    # What NumPy raises where a header is neither of today nor of Python 2.
    except (EOFError, SyntaxError, TokenError, TypeError, OverflowError, MemoryError) as error:
        raise ValueError("no array") from error
    return found


def unreadable_error(path: Path, error: OSError) -> StoreError:
    """The sentence about a file that is there and that the system does not let us read, which says nothing of what it holds."""
    too_many = error.errno in (errno.EMFILE, errno.ENFILE)
    remedy = "let more files be open at once (ulimit -n)" if too_many else "check its permissions and its disk"
    return StoreError(f"{path} cannot be read ({error.strerror or error}); {remedy}.")


def raise_open_file_limit() -> None:
    """Raise this process's limit of open files, where the system lets it: every mapped array counts as one."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unbounded = hard == resource.RLIM_INFINITY
    for most in (_MANY, _FILES):
        most = most if unbounded else min(most, hard)
        if most <= soft or soft == resource.RLIM_INFINITY:
            return
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            return


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


@contextmanager
def exclusive_lock(folder: Path, wait: bool) -> Iterator[None]:
    """Two processes that write into one folder take turns; the system lets go of a killed one's lock.

    Args:
        wait: for the other process, rather than refuse to work beside it.

    Raises:
        OutputError: when another process is at work there and `wait` is False.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if not wait:
                raise OutputError(
                    f"Another process is writing to {folder}; wait for it, or choose another folder."
                ) from error
            log.warning("Another process is writing to %s; waiting for it.", folder)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def printable(name: str) -> str:
    """A file's name as text that can be shown and sent: bytes that are not UTF-8 and control characters become "?"."""
    if name.isascii() and name.isprintable():
        return name
    return "".join(c if c.isprintable() else "?" for c in name.encode("utf-8", "replace").decode())


def _beside(path: Path) -> Path:
    """A name that no other process or thread writes to at the same time."""
    return path.parent / f"{path.name}.{os.getpid()}-{threading.get_ident()}.part"


def _clear(path: Path) -> None:
    """Delete what processes left that were killed while they wrote the same file."""
    left = re.compile(re.escape(path.name) + r"\.([0-9]+)-[0-9]+\.part")
    with os.scandir(path.parent) as entries:
        found = [(entry, match) for entry in entries if (match := left.fullmatch(entry.name))]
    for entry, match in found:
        if time.time() - entry.stat().st_mtime > _ABANDONED and not _alive(int(match[1])):
            Path(entry.path).unlink()


def _alive(process: int) -> bool:
    """Whether a process of that number runs on this machine; True where that cannot be known."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _prepare(path: Path) -> None:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    path.parent.mkdir(parents=True, exist_ok=True)


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path} cannot be written ({error.strerror or error}); free space or choose another place.")
