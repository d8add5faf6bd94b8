"""Your own pairs: pictures anywhere below a folder, paired by a `pairs.csv`.

    satellite,street,split,place
    tiles/a.jpg,photos/a1.jpg,train,
    tiles/b.jpg,photos/b1.jpg,test,7

The first line names two or three of satellite, street, drone, and optionally split (train or test; default test) and place
(a whole number). A cell may be empty if a line has no picture of a view. Without a place, lines that share a satellite picture
(without satellites, a picture of the first view) show the same place. Positions stand in a `geo.csv` beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_text, table
from lpn.core.views import VIEWS
from lpn.datasets.base import Dataset, PictureRow
from lpn.datasets.listed_paths import listed_path

NAME = "pairs.csv"


class PairsCSV(Dataset):
    """A folder with a pairs.csv."""

    kind = "pairs"
    title = f"pairs listed in {NAME}"
    marks = ((NAME,),)
    priority = 1
    expected = f"lines of {NAME} with the split test and paths of pictures relative to its folder"

    def rows(self) -> list[PictureRow]:
        expected = f"two or three of {', '.join(VIEWS)} and, if wanted, split and place"
        header, listed = table(read_text(self.root / NAME, NAME), NAME, _fits, expected)
        views: list[str] = [name for name in header if name in VIEWS]
        lines = [(where, *self._line(views, where, row)) for where, row in listed]
        if not lines:
            raise DataError(f"{NAME} has no line after the first; expected one for each pair.")
        by = "satellite" if "satellite" in views else views[0]
        places: dict[str | int, int] = {
            files[by]: place for _, files, _, place in lines if place is not None and by in files
        }
        # New places get numbers above the listed ones.
        fresh = max((place for *_, place in lines if place is not None), default=-1) + 1
        rows: dict[tuple[str, str], PictureRow] = {}
        for new, (where, files, split, given) in enumerate(lines, fresh):
            place = places.setdefault(files.get(by, new), new) if given is None else given
            for view, file in files.items():
                row = PictureRow(f"{split}/{view}", file, place, Path(file).with_suffix("").as_posix())
                if (before := rows.setdefault((row.of, file), row).label) != place:
                    raise DataError(f"{where} has {printable(file)} at place {place}, earlier at {before}; keep one.")
        # The lists follow the order of the columns, even if the first lines lack a view.
        return sorted(rows.values(), key=lambda row: views.index(row.of.partition("/")[2]))

    def _line(self, views: Sequence[str], where: str, row: dict[str, str]) -> tuple[dict[str, str], str, int | None]:
        """Return the file of each view, the split, and the place."""
        split, place = row.get("split") or "test", row.get("place") or None
        if split not in ("train", "test"):
            raise DataError(f"{where} has the split {printable(split)!r}; expected train or test.")
        if place is not None and not (place.isdecimal() and len(place) < 19):
            raise DataError(f"{where} has the place {printable(place)!r}; expected a whole number from 0.")
        files = {view: listed_path(row[view], where) for view in views if row[view]}
        if not files:
            raise DataError(f"{where} names no picture; expected one of {', '.join(views)}.")
        # A picture in two spellings is still one picture.
        found = {view: self.files.find(file) or file for view, file in files.items()}
        return found, split, None if place is None else int(place)


def _fits(header: list[str]) -> bool:
    unknown = {*header} - {*VIEWS, "split", "place"}
    return len({*header}) == len(header) and len({*header} & {*VIEWS}) > 1 and not unknown
