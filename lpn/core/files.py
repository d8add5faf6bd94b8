"""Atomic writes, locks, fingerprints, and printable names of files."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import re
import threading
import time
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING

from lpn.core.errors import InputError, OutputError, StoreError
from lpn.core.shutdown import uninterrupted
from lpn.core.texts import listed

if TYPE_CHECKING:
    from lpn.core.arrays import AnyArray

try:
    import fcntl
except ImportError:  # no POSIX system; two processes must not write into one folder there
    fcntl = None  # type: ignore[assignment]

try:
    import resource
except ImportError:  # not a POSIX system
    resource = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

# A partial file without a write for this many seconds belongs to a killed process, and is deleted.
_ABANDONED_SECONDS = 3600.0
# Limit of open files. An index of 7 * 10^8 tiles stays below it. With a limit of 2^30, a process can be slow to start.
_OPEN_FILES = 65_536
# macOS reports no limit, but refuses more than this.
_OPEN_FILES_MACOS = 10_240
# Maximum of folders in a displayed name.
_MAX_FOLDERS = 8
# Characters that turn the direction of writing (marks, embeddings, overrides, isolates), so that a text looks like another one,
# and the two further characters that XML excludes.
_MISLEADING = "\ufffe\uffff\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
# Categories of Unicode: control characters, bytes that are not UTF-8, separators of lines and of paragraphs.
_HIDDEN = "Cc", "Cs", "Zl", "Zp"
# Hidden characters that a note may hold: line breaks, tabs, and the direction marks of Arabic and Hebrew keyboards.
TYPED = "\n\t\u061c\u200e\u200f"
# Maximum of bytes of a folder's name.
_MAX_LINK = 255


def cache_folder() -> Path:
    """Return the folder of the user's cache.

    Raises:
        OutputError: if the user has no home folder, and neither LPN_CACHE nor XDG_CACHE_HOME is set.
    """
    if folder := os.environ.get("LPN_CACHE"):
        return Path(folder)
    return _user_folder("XDG_CACHE_HOME", ".cache", "a cache; set LPN_CACHE")


def data_folder() -> Path:
    """Return the folder of user files that belong in no data set's folder.

    Raises:
        OutputError: if the user has no home folder, and XDG_DATA_HOME is not set.
    """
    return _user_folder("XDG_DATA_HOME", ".local/share", "notes; set XDG_DATA_HOME")


def _user_folder(variable: str, below_home: str, use: str) -> Path:
    try:
        return Path(os.environ.get(variable) or Path.home() / below_home) / "lpn-explorer"
    except RuntimeError as error:
        raise OutputError(f"This user has no home folder for {use} to a folder that can be written.") from error


def fingerprint(*paths: Path, also: str = "") -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of files and of a text that affects how they are read."""
    digest = hashlib.sha256(also.encode())
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file atomically: a reader sees the old contents or the new ones, never a part.

    Raises:
        OutputError: if it cannot be written; nothing is left behind.
    """
    write_together({path: data})


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together, each as `write_atomic`; a full disk leaves all of them as they were.

    Raises:
        OutputError: if one cannot be written; nothing is left behind.
    """
    with uninterrupted():
        try:
            for path, data in contents.items():
                _prepare(path)
                _temporary(path).write_bytes(data)
            for path in contents:
                os.replace(_temporary(path), path)
        except OSError as error:
            for written in contents:
                with suppress(OSError):
                    _temporary(written).unlink(missing_ok=True)
            raise _unwritable(path, error) from error
        for path in contents:
            with suppress(OSError):
                _delete_abandoned(path)


def write_json(path: Path, value: object, *, ensure_ascii: bool = True) -> None:
    """Write a value as indented JSON with a line feed at its end, atomically; see `portable`.

    Raises:
        OutputError: if the file cannot be written; nothing is left behind.
    """
    write_atomic(path, json_bytes(value, ensure_ascii=ensure_ascii))


def json_bytes(value: object, *, ensure_ascii: bool = True) -> bytes:
    """Return the bytes that `write_json` writes."""
    return (json.dumps(portable(value), indent=1, ensure_ascii=ensure_ascii) + "\n").encode()


def portable(value: object) -> object:
    """Return a value that every JSON reader accepts: null for a number that is not finite, "?" for a byte that is not UTF-8."""
    match value:
        case str():
            return value.encode("utf-8", "replace").decode()
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {portable(key) if isinstance(key, str) else key: portable(entry) for key, entry in value.items()}
        case list() | tuple():
            return [portable(entry) for entry in value]
    return value


def linked_folder(path: Path) -> Path:
    """Return `path`; if it is a text file, return the folder beside it that the file names.

    Git writes such a file for a symbolic link on systems without links; Python packages know no links at all.
    """
    try:
        with path.open("rb") as file:
            name = file.read(_MAX_LINK).decode().strip()
    except (OSError, UnicodeDecodeError):  # a folder, or nothing
        return path
    return path.with_name(name) if re.fullmatch(r"[\w-]+", name) else path


def open_memmap(path: Path) -> AnyArray:
    """Open the array of a `.npy` file, memory-mapped and read-only.

    Raises:
        FileNotFoundError: if there is no file.
        OSError: if the system refuses to read it; see `unreadable_error`.
        ValueError: if it is damaged, or holds Python objects.
    """
    import numpy as np

    try:
        array: AnyArray = np.lib.format.open_memmap(path, mode="r")
    # NumPy raises these for damaged headers.
    except (EOFError, SyntaxError, TokenError, TypeError, OverflowError, MemoryError) as error:
        raise ValueError("the file does not hold a valid array") from error
    return array


def unreadable_error(path: Path, error: OSError) -> StoreError:
    """Return the error for an existing file that the system refuses to read; its contents may be intact."""
    too_many = error.errno in (errno.EMFILE, errno.ENFILE)
    remedy = "let more files be open at once (ulimit -n)" if too_many else "check its permissions and its disk"
    return StoreError(f"{path} cannot be read ({error.strerror or error}); {remedy}.")


def space_remedy(error: OSError) -> str:
    """Return "free space or " for an error of a full disk, and "" for others, such as a read-only folder."""
    return "free space or " if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""


def raise_open_file_limit() -> None:
    """Raise this process's limit of open files if possible; every mapped array counts as one."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unbounded = hard == resource.RLIM_INFINITY
    for most in (_OPEN_FILES, _OPEN_FILES_MACOS):
        most = most if unbounded else min(most, hard)
        if most <= soft or soft == resource.RLIM_INFINITY:
            return
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            return


def check_ending(path: Path, *endings: str) -> None:
    """Check that the ending of a file's name fits its contents.

    Args:
        endings: the possible endings, such as ".png"; case is ignored.

    Raises:
        InputError: if the name ends in none of them.
    """
    if path.suffix.lower() not in endings:
        expected = listed(endings, "or")
        raise InputError(f"The file to write is named {printable(path.name)}; expected a name that ends in {expected}.")


def check_outputs(*outputs: tuple[Path | None, *tuple[str, ...]]) -> None:
    """Check the names of output files, and then, before long work, that each can be written.

    Args:
        outputs: file and its possible endings; None if there is no output.

    Raises:
        InputError: if a name has another ending, see `check_ending`; then no folder is created.
        OutputError: if a file cannot be written.
    """
    files = [(path, endings) for path, *endings in outputs if path is not None]
    for path, endings in files:
        if not path.is_dir():
            check_ending(path, *endings)
    for path, _ in files:
        check_writable(path)


def check_writable(path: Path) -> None:
    """Check before long work that `path` can be written; creates missing folders.

    Raises:
        OutputError: if it cannot.
    """
    temporary = _temporary(path)
    try:
        _prepare(path)
        temporary.touch()
        temporary.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error


@contextmanager
def exclusive_lock(folder: Path, wait: bool) -> Iterator[None]:
    """Lock a folder against other processes; the system releases the lock of a killed one.

    Args:
        wait: wait for the other process instead of raising.

    Raises:
        OutputError: if another process holds the lock and `wait` is False.
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


def distinct_names(files: Sequence[Path]) -> list[str]:
    """Return the files' printable names, with enough of their folders to distinguish different files."""
    names: list[str] = []
    for depth in range(1, _MAX_FOLDERS + 2):
        names = ["/".join(file.absolute().parts[-depth:]) for file in files]
        if len(set(names)) == len(set(files)):
            break
    return [printable(name) for name in names]


def printable(text: str, keep: str = "", instead: str = "?") -> str:
    """Return a text, such as a file's name, with "?" for each control character and others that could mislead a reader.

    Replaced are control characters, separators of lines, changes of the writing direction, and bytes that are not UTF-8. All
    other characters stay, also those without width, for private use, or newer than this Python.

    Args:
        keep: characters that stay nevertheless, such as line breaks in our own layout.
        instead: the replacement; may be empty.
    """
    if text.isprintable():
        return text
    misleading = {c for c in set(text) if c in _MISLEADING or unicodedata.category(c) in _HIDDEN}
    return text.translate({ord(c): instead for c in misleading if c not in keep})


def first_few(texts: Sequence[str], most: int) -> str:
    """Join the first texts by commas, with the number of further ones."""
    more = f", and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def _temporary(path: Path) -> Path:
    """Return a temporary name that is unique to this process and thread."""
    return path.parent / f"{path.name}.{os.getpid()}-{threading.get_ident()}.part"


def _delete_abandoned(path: Path) -> None:
    """Delete temporary files of processes that were killed while they wrote the same file."""
    left = re.compile(re.escape(path.name) + r"\.[0-9]+-[0-9]+\.part")
    for file in [file for file in path.parent.iterdir() if left.fullmatch(file.name)]:
        if time.time() - file.stat().st_mtime > _ABANDONED_SECONDS:
            file.unlink()


def _prepare(path: Path) -> None:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    path.parent.mkdir(parents=True, exist_ok=True)


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path} cannot be written ({error.strerror or error}); {space_remedy(error)}choose another place."
    )
