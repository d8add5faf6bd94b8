"""Your own pairs: pictures anywhere below a folder, paired by a `pairs.csv`.

    satellite,street,split,place
    tiles/a.jpg,photos/a1.jpg,train,
    tiles/b.jpg,photos/b1.jpg,test,7

The first line names two or three of satellite, street, drone, and optionally split (train or test; default test) and place
(a whole number). A cell may be empty if a line has no picture of a view. Without a place, lines with the same satellite
picture (without satellites: the same picture of the first view) show the same place. Positions stand in a `geo.csv` beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from lpn.core.csv_cells import mixed_separators
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.views import VIEWS
from lpn.datasets import geo
from lpn.datasets.base import LeftOut, ListedDataset, Picture, read_rows, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, listed_path

NAME = "pairs.csv"
_MOST = 2**62


@dataclass(frozen=True)
class _PairLine:
    line: int
    files: dict[str, str]
    split: str
    place: int | None


class PairsCSV(ListedDataset):
    """A folder with a pairs.csv. Missing pictures are left out and logged once.

    Raises:
        DataError: if pairs.csv is malformed; the message names the line.
    """

    kind = "pairs"

    def __init__(self, root: Path) -> None:
        views, rows = _read(root / NAME)
        there = FilesBelow(root).resolve(file for row in rows for file in row.files.values())
        # One picture may be listed in two spellings, and is one place all the same.
        rows = [replace(row, files={view: there.get(file, file) for view, file in row.files.items()}) for row in rows]
        files = set(there.values())
        places = _places(rows, "satellite" if "satellite" in views else views[0])
        left_out: dict[str, LeftOut] = {}
        pictures: dict[str, dict[str, dict[str, Picture]]] = {
            split: {view: {} for view in views} for split in ("train", "test")
        }
        for row, place in zip(rows, places, strict=True):
            for view, file in row.files.items():
                listed = pictures[row.split][view].get(file)
                if listed is not None and listed.label != place:
                    raise DataError(
                        f"Line {row.line} of {NAME} gives {printable(file)} the place {place}, after {listed.label}; keep one."
                    )
                if file in files:
                    name = Path(file).with_suffix("").as_posix()
                    pictures[row.split][view][file] = Picture(root / file, place, printable(name))
                else:
                    left_out[file] = LeftOut(file, "is not there")
        train, test = (
            {view: list(of_view.values()) for view, of_view in pictures[split].items()} for split in ("train", "test")
        )
        if not any([*train.values(), *test.values()]):
            raise DataError(
                f"{root.name} has none of the files that {NAME} names; expected paths relative to {root.name}."
            )
        super().__init__(root, train, test, test, f"lines of {NAME} with the split test and such a picture")
        self.left_out = list(left_out.values())
        warn_left_out(self.root.name, self.left_out, f"files named in {NAME} cannot be used", "they are left out")


def _read(path: Path) -> tuple[list[str], list[_PairLine]]:
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
    parsed = [_row(header, views, values, line) for line, values in rows]
    if not parsed:
        raise DataError(f"{NAME} has no line after the first; expected one for each pair.")
    return views, parsed


def _row(header: list[str], views: list[str], values: list[str], line: int) -> _PairLine:
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
    return _PairLine(line, files, split, place)


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
