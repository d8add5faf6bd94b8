"""Data sets in their published layouts, read as lists of pictures with places, tasks, and true matches.

It imports `core` only. `open_dataset` recognises University-1652 (and rendered worlds), CVUSA, CVACT, Oxford5k, Paris6k, your own
pairs with a `pairs.csv`, and a plain folder of pictures; docs/data.md shows each layout.
"""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import cvact, cvusa, landmarks, pairs
from lpn.datasets.base import Dataset, LeftOut, Picture, Size, Truth, files_below, hidden
from lpn.datasets.cvact import CVACT
from lpn.datasets.cvusa import CVUSA
from lpn.datasets.folder import Folder
from lpn.datasets.landmarks import Landmarks
from lpn.datasets.pairs import PairsCSV
from lpn.datasets.rendered import is_rendered
from lpn.datasets.university import University

__all__ = [
    "CVACT",
    "CVUSA",
    "Dataset",
    "Folder",
    "Landmarks",
    "LeftOut",
    "PairsCSV",
    "Picture",
    "Size",
    "Truth",
    "University",
    "files_below",
    "hidden",
    "open_dataset",
]

_LAYOUTS = (
    "train and test as in University-1652, splits/*-19zl.csv (CVUSA), ACT_data.mat (CVACT), *_query.txt (Oxford5k, Paris6k), "
    "pairs.csv, or pictures"
)


def open_dataset(root: str | Path) -> Dataset:
    """Recognise the layout of a data set's folder and open it.

    Raises:
        DataError: if the folder does not exist, its layout is unknown, or one of its lists is damaged.
    """
    root = Path(root)
    if not root.is_dir():
        raise DataError(f"There is no data set folder at {root}; check the path.")
    is_rendered(root)  # raises for an unfinished world
    if marked := _marked(root):
        return marked(root)
    inner = sorted(child.name for child in root.iterdir() if child.is_dir() and not hidden(child) and _marked(child))
    if inner:
        found = ", ".join(map(printable, inner[:5]))
        raise DataError(
            f"{root} holds data sets in folders of its own: {found}; give --data {root / printable(inner[0])}."
        )
    if queries := landmarks.query_files(root):
        return Landmarks(root, queries)
    if files := files_below(root):
        return Folder(root, files)
    inside = ", ".join(sorted(printable(child.name) for child in root.iterdir())[:5]) or "nothing"
    raise DataError(f"{root} holds {inside}; expected {_LAYOUTS}.")


def _marked(root: Path) -> type[PairsCSV | CVUSA | CVACT | University] | None:
    """Recognise the layout by a file or folder directly below the root."""
    if (root / pairs.NAME).is_file():
        return PairsCSV
    if cvusa.split_file(root, "train").is_file() or cvusa.split_file(root, "val").is_file():
        return CVUSA
    if (root / cvact.NAME).is_file():
        return CVACT
    if (root / "train").is_dir() or (root / "test").is_dir():
        return University
    return None
