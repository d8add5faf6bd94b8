"""Your own pairs: pictures anywhere below a folder, paired by a `pairs.csv`.

    satellite,street,split,place
    tiles/a.jpg,photos/a1.jpg,train,
    tiles/b.jpg,photos/b1.jpg,test,7

The first line names two or three of satellite, street, drone, and optionally split (train or test; default test) and place
(a whole number). A cell may be empty if a line has no picture of a view. Without a place, lines with the same satellite
picture (without satellites: the same picture of the first view) show the same place. Positions stand in a `geo.csv` beside it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_text, table
from lpn.core.views import VIEWS
from lpn.datasets import geo
from lpn.datasets.base import Dataset, PictureRow
from lpn.datasets.listed_paths import listed_path

NAME = "pairs.csv"


class _PairLine(NamedTuple):
    where: str
    files: dict[str, str]
    split: str
    place: int | None


class PairsCSV(Dataset):
    """A folder with a pairs.csv."""

    kind = "pairs"
    title = f"pairs listed in {NAME}"
    marks = ((NAME,),)
    known_by = NAME
    priority = 1
    unusable = f"files named in {NAME}"
    expected = f"lines of {NAME} with the split test and such a picture"

    def rows(self) -> list[PictureRow]:
        self.none_whole = f"has none of the files that {NAME} names; expected paths relative to {self.root.name}"
        views, lines = self._read(read_text(self.root / NAME, NAME))
        by = "satellite" if "satellite" in views else views[0]
        places: dict[str | int, int] = {
            line.files[by]: line.place for line in lines if line.place is not None and by in line.files
        }
        # A new place differs from those that are given.
        fresh = max((line.place for line in lines if line.place is not None), default=-1) + 1
        rows: dict[tuple[str, str], PictureRow] = {}
        for new, line in enumerate(lines, fresh):
            place = places.setdefault(line.files.get(by, new), new) if line.place is None else line.place
            for view, file in line.files.items():
                row = PictureRow(f"{line.split}/{view}", file, place, Path(file).with_suffix("").as_posix())
                if (before := rows.setdefault((row.of, file), row).label) != place:
                    raise DataError(
                        f"{line.where} gives {printable(file)} the place {place}, after {before}; keep one."
                    )
        # The lists stand in the order of the columns, whichever view the first lines have.
        return sorted(rows.values(), key=lambda row: views.index(row.of.partition("/")[2]))

    def _read(self, text: str) -> tuple[list[str], list[_PairLine]]:
        expected = f"two or three of {', '.join(VIEWS)} and, if wanted, split and place"
        if re.match(r".*\b(lat|lon)", text):
            expected += f". Positions go into a {geo.NAME} beside it, with the columns path,latitude,longitude"
        header, rows = table(text, NAME, _fits, expected)
        views: list[str] = [name for name in header if name in VIEWS]
        lines = [self._line(views, where, row) for where, row in rows]
        if not lines:
            raise DataError(f"{NAME} has no line after the first; expected one for each pair.")
        return views, lines

    def _line(self, views: list[str], where: str, row: dict[str, str]) -> _PairLine:
        split, place = row.get("split") or "test", row.get("place") or None
        if split not in ("train", "test"):
            raise DataError(f"{where} has the split {printable(split)!r}; expected train or test.")
        if place is not None and not (place.isdecimal() and len(place) < 19):
            raise DataError(f"{where} has the place {printable(place)!r}; expected a whole number from 0.")
        files = {view: listed_path(row[view], where) for view in views if row[view]}
        if not files:
            raise DataError(f"{where} names no picture; expected one of {', '.join(views)}.")
        # One picture may be listed in two spellings, and is one place all the same.
        files = {view: self.files.find(file) or file for view, file in files.items()}
        return _PairLine(where, files, split, None if place is None else int(place))


def _fits(header: list[str]) -> bool:
    unknown = {*header} - {*VIEWS, "split", "place"}
    return len({*header}) == len(header) and len({*header} & {*VIEWS}) > 1 and not unknown
