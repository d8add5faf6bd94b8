"""The folder to give as a data set: one above or one below."""

from __future__ import annotations

import os
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.datasets.base import Dataset
from lpn.datasets.listed_paths import hidden_name

# The deepest list of a split is three folders below (Testing/150/query_drone).
_LEVELS = 3
# A search for a data set below looks into so many folders at most.
_MOST_FOLDERS = 2000

Marked = Callable[[Path], type[Dataset] | None]


def below(root: Path, marked: Marked) -> DataError | None:
    """Return the error about a folder around data sets, at any of three levels; it names the folder to give.

    Args:
        marked: recognises the layout of a folder, else returns None.
    """
    level, looked = [root], 0
    for _ in range(_LEVELS):
        level = [folder / name for folder in level for name in _folders(folder)][: _MOST_FOLDERS - looked]
        looked += len(level)
        if inner := [folder for folder in level if _layout(folder, marked) is not None]:
            listed = first_few([printable(folder.relative_to(root).as_posix()) for folder in inner], 5)
            return DataError(
                f"{printable(str(root))} holds data sets in folders of its own: {listed}; give "
                f"{printable(str(inner[0]))}."
            )
    return None


def above(root: Path, marked: Marked) -> Path | None:
    """Return the folder of the data set that a folder is a part of, the outermost one."""
    whole, found = root.resolve(), None
    for depth, folder in enumerate(whole.parents[: _LEVELS + 1], 1):
        layout = _layout(folder, marked)
        if layout is not None and any(fnmatchcase(whole.parts[-depth].lower(), part) for part in layout.parts):
            found = folder
    if found is None or root.is_absolute() or (near := os.path.relpath(found)).startswith(".."):
        return found
    return Path(near)


def _layout(folder: Path, marked: Marked) -> type[Dataset] | None:
    try:
        return marked(folder)
    except OSError:  # a folder that this user may not read
        return None


def _folders(folder: Path) -> list[str]:
    """Return the names of the folders in a folder, sorted, without those that systems add."""
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries if not hidden_name(entry.name) and entry.is_dir())
    except OSError:
        return []
