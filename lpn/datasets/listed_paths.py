"""Paths in lists and tables as people have them, and the files that they name.

A list may come from another system: with backslashes, `./`, spaces around, another case (`.JPG` for `.jpg`), composed or
decomposed letters, or the folders of another machine (`C:\\University-Release\\test\\...`, `/home/x/...`). `plain_path` gives
all of them one form. `FilesBelow` and `NamesBelow` find what they name: the path as it is, else in another case, else the longest
part of its end that fits.
"""

from __future__ import annotations

import logging
import os
import re
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from lpn.core.errors import DataError
from lpn.core.files import printable

log = logging.getLogger(__name__)

T = TypeVar("T")

# Lists hold hundreds of thousands of paths, nearly all of which are in this form already.
_PLAIN = re.compile(r"\w[\w-]*(\.\w+)*(/\w[\w-]*(\.\w+)*)*", re.ASCII)
_DRIVE = re.compile(r"[A-Za-z]:/")
_INVISIBLE = "\ufeff\u200b\u200e\u200f\u2060"


def plain_path(text: str) -> str:
    """Return a listed path with forward slashes, without spaces around, and without `./` and doubled slashes in it."""
    if _PLAIN.fullmatch(text):
        return text
    path = text.strip().strip(_INVISIBLE).strip().replace("\\", "/")
    rooted = "/" if path.startswith("/") else ""
    return rooted + "/".join(part for part in path.split("/") if part not in ("", "."))


def is_absolute(path: str) -> bool:
    """Return whether a plain path begins at the root of a machine: /home/x, C:/data, or //server/share."""
    return path.startswith("/") or _DRIVE.match(path) is not None


def listed_path(text: str, where: str) -> str:
    """Check a path of a list that is looked up, never opened, and return it in one form; see `plain_path`.

    An absolute path passes, as it may be one of another machine whose end names a file here.

    Args:
        where: the file and line that contain the path, for the error.

    Raises:
        DataError: if the path is empty, contains "..", or has control characters.
    """
    path = plain_path(text)
    if _PLAIN.fullmatch(path):
        return path
    first, *rest = path.split("/")
    drive = ":" in first and not is_absolute(path)
    if not path.strip("/") or drive or ".." in (first, *rest) or any(ord(letter) < 32 for letter in path):
        raise _outside(where, text)
    return path


def checked_path(text: str, where: str) -> str:
    """Check that a listed path stays below the data set's folder, and return it in one form.

    Args:
        where: the file and line that contain the path, for the error.

    Raises:
        DataError: if the path is absolute, is empty, contains "..", or has control characters.
    """
    path = listed_path(text, where)
    if is_absolute(path):
        raise _outside(where, text)
    return path


def name_of(path: str) -> str:
    """Return the file name of a listed path of any system, without folders."""
    return plain_path(path).rpartition("/")[2]


def fold(path: str) -> str:
    """Return the key of a plain path: equal for two paths that differ only in case or in how letters are composed."""
    return (path if path.isascii() else unicodedata.normalize("NFC", path)).casefold()


class _Below(ABC):
    """Files and folders below a folder, looked up by listed paths."""

    # A file that is found is opened later, so a path outside of the folder is an error even among others.
    _opens = True

    @abstractmethod
    def find(self, path: str) -> str | None:
        """Return what a plain path names as it is, or in another case if only one differs from it so; None for nothing."""

    def resolve(self, paths: Iterable[str], where: str) -> dict[str, str]:
        """Return what each of the plain paths of a list names; those that name nothing are absent.

        The folders that stand before them on another machine are left out of absolute paths. If no path of the list names
        anything as it is, they are left out of relative paths, too. They are the same for the whole list: those by which most
        paths name something, and of several the shortest. A warning says so.

        Args:
            where: the list, for messages.
        """
        paths = list(dict.fromkeys(paths))
        exact = {path: name for path in paths if not is_absolute(path) and (name := self.find(path)) is not None}
        rest = [path for path in paths if path not in exact and (is_absolute(path) or not exact)]
        folders, ends = self._ends(rest, where)
        names = _unique(exact, ends, where)
        if ends:
            first, name = next(iter(ends.items()))
            log.warning(
                "%s names %d files by paths of another folder, such as %s; without %s they are below this one (%s).",
                where,
                len(ends),
                printable(first),
                printable(folders),
                printable(name),
            )
        absolute = next((path for path in rest if is_absolute(path)), None)
        if absolute is not None and not ends and (self._opens or not names):
            raise _outside(where, absolute)
        return names

    def _ends(self, paths: Iterable[str], where: str) -> tuple[str, dict[str, str]]:
        """Return the folders without which most paths name something, and what those paths name."""
        by_folders: dict[str, dict[str, str]] = {}
        for path in paths:
            begin = path.find("/") + 1
            while begin:
                if (name := self.find(path[begin:])) is not None:
                    by_folders.setdefault(fold(path[:begin]), {})[path] = name
                begin = path.find("/", begin) + 1
        if not by_folders:
            return "", {}
        best = min(by_folders, key=lambda folders: (-len(by_folders[folders]), len(folders)))
        for other, ends in by_folders.items():
            if len(ends) == len(by_folders[best]) and not other.startswith(best):
                raise DataError(
                    f"{where} names as many files without {printable(best)} as without {printable(other)}, and only one of them "
                    "can be this folder; give paths below the data set's folder."
                )
        first = next(iter(by_folders[best]))
        return first[: len(best)], by_folders[best]


class FilesBelow(_Below):
    """The files and folders below a folder, which is listed once, so that many look-ups are quick."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._listed: dict[str, frozenset[str]] = {}
        self._folded: dict[str, dict[str, str | None]] = {}
        self._folders: dict[str, str | None] = {"": ""}

    def find(self, path: str) -> str | None:
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

    def _names(self, folder: str) -> frozenset[str]:
        if folder not in self._listed:
            try:
                self._listed[folder] = frozenset(os.listdir(self._root / folder))  # noqa: PTH208 (names are enough)
            except (OSError, ValueError):
                self._listed[folder] = frozenset()
        return self._listed[folder]


class NamesBelow(_Below):
    """Known pictures below a folder, by their paths."""

    _opens = False

    def __init__(self, names: Collection[str]) -> None:
        self._names = {plain_path(name): name for name in names}
        self._folded = _by_fold(self._names)

    def find(self, path: str) -> str | None:
        if path in self._names:
            return self._names[path]
        folded = self._folded.get(fold(path))
        return None if folded is None else self._names[folded]


def by_name(listed: Mapping[str, T], names: Collection[str], file: str) -> dict[str, T]:
    """Return the entries of a table by the names of known pictures, for a table with paths of another system.

    Args:
        listed: entries by plain paths.
        names: paths of the pictures below the data set's folder.
        file: the table, for messages.

    Raises:
        DataError: if two paths name one picture.
    """
    named = NamesBelow(names).resolve(listed, file)
    by_end: dict[str, T] = {}
    for path, name in named.items():
        if name in by_end:
            raise DataError(f"{file} names {printable(name)} twice, also as {printable(path)}; keep one.")
        by_end[name] = listed[path]
    return by_end


def _by_fold(names: Iterable[str]) -> dict[str, str | None]:
    """Return names by their keys; None where two names have one."""
    names_by_fold: dict[str, str | None] = {}
    for name in names:
        key = fold(name)
        names_by_fold[key] = None if key in names_by_fold else name
    return names_by_fold


def _unique(exact: Mapping[str, str], by_end: Mapping[str, str], where: str) -> dict[str, str]:
    """Return both together; DataError if a name is found by the ends of two paths."""
    paths = {name: path for path, name in exact.items()}
    for path, name in by_end.items():
        if fold(other := paths.setdefault(name, path)) != fold(path):
            raise DataError(
                f"{where} names both {printable(other)} and {printable(path)}, and only {printable(name)} fits both here; give "
                "paths below the data set's folder."
            )
    return {**exact, **by_end}


def _outside(where: str, text: str) -> DataError:
    return DataError(
        f"{where} names the file {printable(text)!r}; expected a path below the data set's folder, without '..'."
    )
