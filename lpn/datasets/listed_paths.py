"""Paths in lists and tables as users write them, and their files.

A list may come from another system: with backslashes, `./`, surrounding spaces, another case (`.JPG` for `.jpg`), and
composed or decomposed letters. `plain_path` normalises all of them. `FilesBelow` and `by_name` find their files, first by the
exact path, then in another case.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from lpn.core.errors import DataError
from lpn.core.files import printable

T = TypeVar("T")

# Lists hold hundreds of thousands of paths, and nearly all are already normalised.
_PLAIN = re.compile(r"\w[\w-]*(\.\w+)*(/\w[\w-]*(\.\w+)*)*", re.ASCII)
_DRIVE = re.compile(r"[A-Za-z]:/")
# Folders that macOS's archives, Windows, Synology's servers, and Linux create; their pictures are not the user's.
_ADDED_BY_SYSTEMS = frozenset(("__MACOSX", "$RECYCLE.BIN", "System Volume Information", "@eaDir", "lost+found"))
_INVISIBLE = "\ufeff\u200b\u200e\u200f\u2060"


def plain_path(text: str) -> str:
    """Return a listed path with forward slashes, without surrounding spaces, `./`, and doubled slashes."""
    if _PLAIN.fullmatch(text):
        return text
    path = text.strip().strip(_INVISIBLE).strip().replace("\\", "/")
    rooted = "/" if path.startswith("/") else ""
    return rooted + "/".join(part for part in path.split("/") if part not in ("", "."))


def is_absolute(path: str) -> bool:
    """Return whether a plain path begins at the root of a machine: /home/x, C:/data, or //server/share."""
    return path.startswith("/") or _DRIVE.match(path) is not None


def listed_path(text: str, where: str) -> str:
    """Check that a listed path stays below the data set's folder, and normalise it; see `plain_path`.

    Args:
        where: the file and line that contain the path, for the error.

    Raises:
        DataError: if the path is absolute or empty, or contains ".." or control characters.
    """
    path = plain_path(text)
    if _PLAIN.fullmatch(path):
        return path
    first, *rest = path.split("/")
    controls = any(ord(letter) < 32 for letter in path)
    if not path.strip("/") or ":" in first or path.startswith("/") or ".." in (first, *rest) or controls:
        raise _outside(where, text)
    return path


def name_of(path: str) -> str:
    """Return the file name of a listed path of any system, without folders."""
    return plain_path(path).rpartition("/")[2]


def fold(path: str) -> str:
    """Return a key that is equal for plain paths that differ only in case or in the composition of letters."""
    return (path if path.isascii() else unicodedata.normalize("NFC", path)).casefold()


def hidden_name(name: str) -> bool:
    """Return whether a name is hidden (.ipynb_checkpoints, ._a.jpg, .DS_Store), or created by a system (__MACOSX)."""
    return name.startswith(".") or name in _ADDED_BY_SYSTEMS


class FilesBelow:
    """The files and folders below a folder, listed once for quick look-ups."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._listed: dict[str, frozenset[str]] = {}
        self._folded: dict[str, dict[str, str | None]] = {}
        self._folders: dict[str, str | None] = {"": ""}

    def find(self, path: str) -> str | None:
        """Return a plain path if it exists, else the only existing path that differs in case alone, else None."""
        folder, _, name = path.rpartition("/")
        if is_absolute(path) or ".." in (name, *folder.split("/")):
            return None
        if name in self._names(folder):
            return path
        if folder not in self._folders:
            self._folders[folder] = self.find(folder)
        actual = self._folders[folder]
        if actual is None or not name:
            return None
        if name not in self._names(actual):
            if actual not in self._folded:
                self._folded[actual] = _by_fold(self._names(actual))
            name = self._folded[actual].get(fold(name)) or ""
        return f"{actual}/{name}".removeprefix("/") if name else None

    def names(self, folder: str) -> list[str]:
        """Return the sorted names in a folder, without hidden ones; none if it is missing."""
        return sorted(name for name in self._names(folder) if not hidden_name(name))

    def _names(self, folder: str) -> frozenset[str]:
        if folder not in self._listed:
            try:
                self._listed[folder] = frozenset(os.listdir(self._root / folder))  # noqa: PTH208 (names are enough)
            except (OSError, ValueError):
                self._listed[folder] = frozenset()
        return self._listed[folder]


def by_name(listed: Mapping[str, T], names: Collection[str], file: str) -> dict[str, T]:
    """Return a table's entries by the names of known pictures, for a table with paths of another system.

    Args:
        listed: entries by plain paths.
        names: paths of the pictures below the data set's folder.
        file: the table, for messages.

    Raises:
        DataError: if two paths name one picture, or paths are absolute and none names a picture.
    """
    known = {plain_path(name): name for name in names}
    folded = _by_fold(known)
    found: dict[str, T] = {}
    for path, entry in listed.items():
        name = known.get(path if path in known else folded.get(fold(path)) or "")
        if name is None:
            continue
        if name in found:
            raise DataError(f"{file} names {printable(name)} twice, also as {printable(path)}; keep one.")
        found[name] = entry
    if not found and (absolute := next(filter(is_absolute, listed), None)) is not None:
        raise _outside(file, absolute)
    return found


def _by_fold(names: Iterable[str]) -> dict[str, str | None]:
    """Return names by their folded keys; None for a key of two names."""
    names_by_fold: dict[str, str | None] = {}
    for name in names:
        key = fold(name)
        names_by_fold[key] = None if key in names_by_fold else name
    return names_by_fold


def _outside(where: str, text: str) -> DataError:
    return DataError(
        f"{where} names the file {printable(text)!r}; expected a path below the data set's folder, without '..'."
    )
