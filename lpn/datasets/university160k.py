"""University160k: University-1652's test split with 167,486 further tiles, whose true matches its server keeps.

[test/]gallery_satellite_160k/<name>.jpg         tiles, all in one folder
[test/]query_drone_160k/<name>.jpeg              or query_drone160k_wx/query_drone_160k_wx_24/*, with weather
query_drone_name.txt                             the queries' file names in the order of the answer, here or in test
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.images import SUFFIXES
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Truth, hidden_name, read_lines, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, listed_path, name_of

_GALLERY = "gallery_satellite_160k"
_QUERIES = ("query_drone_160k", "query_drone160k_wx/query_drone_160k_wx_24", "query_drone_160k_wx_24")
_NAMES = "query_drone_name.txt"


class University160k(ListedDataset):
    """A folder of University160k; its only task is "drone-to-satellite", and no query's true match is known.

    Raises:
        DataError: if a part of the layout is missing; the message names it.
    """

    kind = "University160k"
    truth_keeper = "its evaluation server (codalab.lisn.upsaclay.fr/competitions/12672)"

    def __init__(self, root: Path) -> None:
        top = _top(root)
        assert top is not None
        below = top.relative_to(root).as_posix().removeprefix(".")
        folder = next((name for name in _QUERIES if (top / name).is_dir()), None)
        listing = next((file for file in (root / _NAMES, top / _NAMES) if file.is_file()), None)
        gallery_there = (top / _GALLERY).is_dir()
        has = _GALLERY if gallery_there else folder
        missing = _GALLERY if not gallery_there else _QUERIES[0] if folder is None else _NAMES
        if not gallery_there or folder is None or listing is None:
            raise DataError(
                f"{printable(root.name)} has University160k's {has} and no {missing}; expected {_GALLERY}, {_QUERIES[0]} (or "
                f"{_QUERIES[1]}) beside it, and {_NAMES}, which lists the queries in the order of the answer."
            )
        files = sorted(
            file.name
            for file in (top / _GALLERY).iterdir()
            if file.name.lower().endswith(SUFFIXES) and not hidden_name(file.name)
        )
        gallery = [Picture(top / _GALLERY / file, i, printable(Path(file).stem)) for i, file in enumerate(files)]
        queries: list[Picture] = []
        left_out: list[LeftOut] = []
        there = FilesBelow(top / folder)
        for number, line in enumerate(read_lines(listing, _NAMES), 1):
            if not line.strip():
                continue
            name = name_of(listed_path(line, f"Line {number} of {_NAMES}"))
            if (actual := there.find(name)) is None:
                left_out.append(LeftOut("/".join(filter(None, (below, folder, name))), "is not there"))
            else:
                label = len(gallery) + len(queries)
                queries.append(Picture(top / folder / actual, label, printable(Path(actual).stem)))
        if not queries and not left_out:
            raise DataError(f"{_NAMES} of {printable(root.name)} names no query; expected the name of one a line.")
        super().__init__(
            root,
            {},
            {"drone": queries},
            {"satellite": gallery},
            f"{_GALLERY}/*, {folder}/*, and their names in {_NAMES}",
        )
        self.left_out = left_out
        warn_left_out(self.root.name, left_out, f"queries of {_NAMES} cannot be used", "they are left out")

    def truth(self, task: str) -> list[Truth]:
        del task
        none = np.zeros(0, np.int64)
        return [Truth(none, none, known=False)] * len(self._queries["drone"])


def is_university160k(root: Path) -> bool:
    """Return whether a folder, or its test, holds University160k's gallery or queries."""
    return _top(root) is not None


def _top(root: Path) -> Path | None:
    names = (_GALLERY, *_QUERIES)
    return next((folder for name in names for folder in (root, root / "test") if (folder / name).is_dir()), None)
