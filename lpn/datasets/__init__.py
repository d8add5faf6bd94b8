"""Data sets in their published layouts, read as lists of pictures with places, tasks, and true matches.

This package imports `core` only. `open_dataset` recognises the layouts in `lpn.datasets.layouts`, those of other packages, and
a plain folder of pictures; docs/data.md shows each.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import iter_modules

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.datasets import layouts
from lpn.datasets.base import Dataset as Dataset
from lpn.datasets.base import Folder as Folder
from lpn.datasets.base import LeftOut as LeftOut
from lpn.datasets.base import Picture as Picture
from lpn.datasets.base import PictureRow as PictureRow
from lpn.datasets.base import Size as Size
from lpn.datasets.base import Truth as Truth
from lpn.datasets.base import files_below as files_below
from lpn.datasets.base import labels_of as labels_of
from lpn.datasets.base import unread_below as unread_below
from lpn.datasets.base import warn_left_out as warn_left_out
from lpn.datasets.layouts.university import University
from lpn.datasets.listed_paths import hidden_name

log = logging.getLogger(__name__)

# The group of the entry points for layouts of other packages.
GROUP = "lpn.datasets"
# The remedy for a file that is no picture, by its ending or its name.
_INSTEAD = {
    **dict.fromkeys(
        (".zip", ".tar", ".tgz", ".gz", ".xz", ".7z", ".rar"), "unpack it first, and give the folder that it makes"
    ),
    **dict.fromkeys((".mp4", ".mov", ".srt"), "make a flight of it with lpn flight, and give that with a --map"),
    **dict.fromkeys((".pth", ".safetensors", ".onnx"), "give it as --model, beside a data set's folder"),
}
# The deepest picture folders of a data set lie three levels below its root (Testing/150/query_drone).
_LEVELS = 3
# Maximum number of folders that a search for a data set looks into.
_MOST_FOLDERS = 2000


def open_dataset(root: str | Path) -> Dataset:
    """Recognise the layout of a data set's folder and open it.

    Args:
        root: its folder; with several test splits, also the path of one of them, such as ROOT/cross-area or ROOT/city.

    Raises:
        DataError: if the folder does not exist, its layout is unknown, or one of its lists is damaged.
    """
    given, split = Path(root), None
    root = given
    if not given.exists() and any(given.name in layout.splits for layout in known_layouts()):
        root, split = given.parent, given.name
    if not root.is_dir():
        shown, above = printable(str(root)), root.resolve().parent
        if root.exists():
            around = f"give {printable(str(above))}" if _marked(above) else "check the path"
            todo = _instead(root.name) or around
            raise DataError(f"{shown} is a file; expected a data set's folder, so {todo}.")
        raise DataError(f"There is no data set folder at {shown}; check the path.")
    layout = _marked(root)
    if split is not None and (layout is None or split not in layout.splits):
        shown, name = printable(str(given)), printable(str(root))
        raise DataError(f"There is no data set folder at {shown}; check the path, as {name} has no {split} split.")
    return _unmarked(root) if layout is None else layout(root, split)


def _instead(name: str) -> str | None:
    return _INSTEAD.get(name) or _INSTEAD.get(Path(name).suffix.lower())


@cache
def known_layouts() -> tuple[type[Dataset], ...]:
    """Return the layouts of this package and of others (entry points `lpn.datasets`), in the order of recognition.

    A layout that cannot be loaded is left out with a warning.
    """
    modules = [import_module(f"{layouts.__name__}.{module.name}") for module in iter_modules(layouts.__path__)]
    values = [(module.__name__, value) for module in modules for value in vars(module).values()]
    found = [of for name, of in values if isinstance(of, type) and issubclass(of, Dataset) and of.__module__ == name]
    for point in entry_points(group=GROUP):
        try:
            layout = point.load()
            if not (isinstance(layout, type) and issubclass(layout, Dataset) and hasattr(layout, "kind")):
                raise TypeError("it is no subclass of lpn.datasets.Dataset with a kind, such as kind = 'Plots'")
            found.append(layout)
        except Exception as error:  # another package's code may raise anything
            reason = printable(str(error).strip().partition("\n")[0]) or type(error).__name__
            log.warning("The layout %s is left out, as %s cannot be loaded (%s).", point.name, point.value, reason)
    return tuple(sorted(found, key=lambda layout: -layout.priority))


def _marked(root: Path) -> type[Dataset] | None:
    """Recognise the layout by files or folders near the root; None if there are none, or they are not readable."""
    with suppress(OSError):
        return next((layout for layout in known_layouts() if not layout.deep and layout.recognises(root)), None)
    return None


def _unmarked(root: Path) -> Dataset:
    """Open a folder without the marks of a layout, or raise an error that names the right folder."""
    if (root / "train").is_dir() or (root / "test").is_dir():
        return University(root)
    whole, shown = _above(root), printable(str(root))
    if whole is not None:
        inside = root.resolve().relative_to(whole.resolve()).as_posix()
        raise DataError(f"{shown} is the part {printable(inside)} of a data set; give {printable(str(whole))}.")
    if inner := _below(root):
        listed = first_few([printable(folder.relative_to(root).as_posix()) for folder in inner], 5)
        give = printable(str(inner[0]))
        raise DataError(f"{shown} holds folders of data sets: {listed}; give {give}.")
    for layout in known_layouts():
        if layout.deep and layout.recognises(root):
            return layout(root)
    folder = Folder(root)
    if folder.pictures("pictures"):
        return folder
    names = sorted(child.name for child in root.iterdir())
    holds = first_few(list(map(printable, names)), 5) or "nothing"
    if todo := next(filter(None, map(_instead, names)), None):
        raise DataError(f"{shown} holds {holds}; {todo}.")
    known = ", ".join(sorted(layout.kind for layout in known_layouts()))
    raise DataError(f"{shown} holds {holds}; expected a data set in a layout of docs/data.md ({known}), or pictures.")


def _above(root: Path) -> Path | None:
    """Return the outermost folder of a data set that contains a folder."""
    found = next((folder for folder in reversed(root.resolve().parents[: _LEVELS + 1]) if _marked(folder)), None)
    if found is None or root.is_absolute() or (near := os.path.relpath(found)).startswith(".."):
        return found
    return Path(near)


def _below(root: Path) -> list[Path]:
    """Return the folders of data sets at equal depth below a folder, at most three levels."""
    level, looked = [root], 0
    for _ in range(_LEVELS):
        level = [inner for folder in level for inner in _folders(folder)][: _MOST_FOLDERS - looked]
        looked += len(level)
        if found := [folder for folder in level if _marked(folder) is not None]:
            return found
    return []


def _folders(folder: Path) -> list[Path]:
    """Return the folders in a folder, sorted, without those of operating systems."""
    try:
        return sorted(inner for inner in folder.iterdir() if not hidden_name(inner.name) and inner.is_dir())
    except OSError:
        return []
