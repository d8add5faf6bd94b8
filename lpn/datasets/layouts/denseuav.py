"""DenseUAV (Dai et al. 2023): University-1652's folders, tiles of three heights and two dates, and positions in a text file.

    Dense_GPS_ALL.txt                            <path> E<longitude> N<latitude> <height>, or Dense_GPS_{train,test}.txt
    train/drone/000001/{H80,H90,H100}.JPG
    train/satellite/000001/{H80,H90,H100}.tif and {H80,H90,H100}_old.tif
    test/{query,gallery}_{drone,satellite}/000001/*

Each line of the text file has the position of the place that is the last folder of <path>; later lines replace earlier ones.
The gallery also contains the training places.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import numbered_lines
from lpn.datasets import geo
from lpn.datasets.base import Picture, PictureRow, PositionProtocol, sizes
from lpn.datasets.layouts.university import University
from lpn.datasets.listed_paths import plain_path

LISTS = ("Dense_GPS_ALL.txt", "Dense_GPS_train.txt", "Dense_GPS_test.txt")
_HEIGHT = re.compile(r"H(\d+)(_old)?\.\w+", re.IGNORECASE)
_POINT = re.compile(r"([EW])(\d+(?:\.\d+)?)\s+([NS])(\d+(?:\.\d+)?)")


class DenseUAV(University):
    """A folder of DenseUAV; true matches are tiles in the folder of the same number.

    Queries are grouped by the height in their names.
    """

    kind = "DenseUAV"
    priority = 0
    group_name = "height"
    trained_distractors = True
    measured_by: PositionProtocol | None = "DenseUAV"
    published_sizes = sizes(
        train={"drone": (6_768, 2_256), "satellite": (13_536, 2_256)},
        query={"drone": (2_331, 777), "satellite": (4_662, 777)},
        gallery={"drone": (9_099, 3_033), "satellite": (18_198, 3_033)},
    )

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Return whether there is a list of positions, or a picture of the first place has a name such as H80.JPG."""
        if any((root / name).is_file() for name in LISTS):
            return True
        for folder in ("test/query_drone", "train/drone"):
            place = next((place for place in sorted((root / folder).glob("[0-9]*")) if place.is_dir()), None)
            if place is not None:
                return any(_HEIGHT.fullmatch(file.name) for file in place.iterdir())
        return False

    def rows(self) -> Iterator[PictureRow]:
        self.positions_from, self._places = _places(self.root)
        for row in super().rows():
            height = _HEIGHT.fullmatch(Path(row.file).name) if row.of.startswith("test/query") else None
            yield row if height is None else replace(row, group=height[1])

    def place(self, picture: Picture) -> geo.Position | None:
        return self._places.get(picture.path.parent.name)


def _places(root: Path) -> tuple[str, dict[str, geo.Position]]:
    """Return the names of the lists of positions, and the position of each place by its folder."""
    names = [name for name in LISTS[:1] if (root / name).is_file()]
    names = names or [name for name in LISTS[1:] if (root / name).is_file()]
    if not names:
        raise DataError(
            f"{printable(root.name)} has DenseUAV's folders and no {LISTS[0]}; put that file, or {' and '.join(LISTS[1:])}, "
            "beside train and test."
        )
    positions: dict[str, geo.Position] = {}
    for name in names:
        positions |= dict(_line(line, where) for where, line in numbered_lines(root / name, name))
    return " and ".join(names), positions


def _line(line: str, where: str) -> tuple[str, geo.Position]:
    point = _POINT.search(line)
    parts = plain_path(line[: point.start()]).split("/") if point is not None else []
    if point is None or len(parts) < 2:
        raise DataError(
            f"{where} is {printable(line[:100])!r}; expected a path, E<longitude>, N<latitude>, and a height."
        )
    longitude, latitude = (
        float(f"{'-' * (side in 'WS')}{value}") for side, value in (point.group(1, 2), point.group(3, 4))
    )
    return parts[-2], geo.Position(latitude, longitude)
