"""Your own pairs: pictures anywhere below a folder, paired by a `pairs.csv`.

    satellite,street,split,place
    tiles/a.jpg,photos/a1.jpg,train,
    tiles/b.jpg,photos/b1.jpg,test,7

The first line names two or three of satellite, street, drone, and optionally split (train or test; default test) and place
(a whole number). A cell may be empty if a line has no picture of a view. Without a place, lines with the same satellite
picture (without satellites: the same picture of the first view) show the same place. Positions stand in a `geo.csv` beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lpn.core.csv_cells import mixed_separators
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.views import VIEWS
from lpn.datasets import geo
from lpn.datasets.base import Dataset, PictureRow, read_rows
from lpn.datasets.listed_paths import FilesBelow, listed_path

NAME = "pairs.csv"
_MOST = 2**62


@dataclass(frozen=True)
class _PairLine:
    line: int
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
        views, lines = _read(self.root / NAME, self.files)
        rows: dict[tuple[str, str], PictureRow] = {}
        for line, place in zip(lines, _places(lines, "satellite" if "satellite" in views else views[0]), strict=True):
            for view, file in line.files.items():
                row = PictureRow(f"{line.split}/{view}", file, place, Path(file).with_suffix("").as_posix())
                if (before := rows.setdefault((row.of, file), row).label) != place:
                    raise DataError(
                        f"Line {line.line} of {NAME} gives {printable(file)} the place {place}, after {before}; keep one."
                    )
        # The lists stand in the order of the columns, whichever view the first lines have.
        return sorted(rows.values(), key=lambda row: views.index(row.of.partition("/")[2]))


def _read(path: Path, files: FilesBelow) -> tuple[list[str], list[_PairLine]]:
    rows = read_rows(path, NAME)
    _, first = next(rows, (0, []))
    header = [name.strip().lower() for name in first]
    views: list[str] = [name for name in header if name in VIEWS]
    unknown = set(header) - {*VIEWS, "split", "place"}
    if len(views) < 2 or unknown or len(set(header)) < len(header):
        found = printable(",".join(header)) or "empty"
        more = mixed_separators(found)
        if {"latitude", "longitude", "lat", "lon"} & unknown:
            more = f" Positions go into a {geo.NAME} beside it, with the columns path,latitude,longitude."
        raise DataError(
            f"The first line of {NAME} is {found}; expected two or three of {', '.join(VIEWS)} and, if wanted, split and "
            f"place.{more}"
        )
    parsed = [_row(header, views, values, line, files) for line, values in rows]
    if not parsed:
        raise DataError(f"{NAME} has no line after the first; expected one for each pair.")
    return views, parsed


def _row(header: list[str], views: list[str], values: list[str], line: int, there: FilesBelow) -> _PairLine:
    if len(values) != len(header):
        raise DataError(f"Line {line} of {NAME} has {len(values)} values; expected {len(header)}: {','.join(header)}.")
    row = {name: value.strip() for name, value in zip(header, values, strict=True)}
    split = row.get("split") or "test"
    if split not in ("train", "test"):
        raise DataError(f"Line {line} of {NAME} has the split {printable(split)!r}; expected train or test.")
    place = None
    if text := row.get("place"):
        place = int(text) if text.isdecimal() and len(text) < 20 else _MOST
        if place >= _MOST:
            raise DataError(f"Line {line} of {NAME} has the place {printable(text)!r}; expected a whole number from 0.")
    files = {view: listed_path(row[view], f"Line {line} of {NAME}") for view in views if row[view]}
    if not files:
        raise DataError(f"Line {line} of {NAME} names no picture; expected one of {', '.join(views)}.")
    # One picture may be listed in two spellings, and is one place all the same.
    return _PairLine(line, {view: there.find(file) or file for view, file in files.items()}, split, place)


def _places(rows: list[_PairLine], view: str) -> list[int]:
    """Return each line's place: as given, else that of the first line with the same picture of `view`, else a new one."""
    numbered = [row.place for row in rows if row.place is not None]
    # New places must differ from the given ones.
    fresh = max(numbered, default=-1) + 1
    known = {row.files[view]: row.place for row in rows if row.place is not None and view in row.files}
    places: list[int] = []
    for row in rows:
        place = row.place
        if place is None:
            place = known.setdefault(row.files[view], fresh + row.line) if view in row.files else fresh + row.line
        places.append(place)
    return places
