"""Corners of pictures by latitude and longitude, in lists of published data sets.

map.csv                             Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon       (wildnav)
satellite_coordinates_range.csv     mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region                 (UAV-VisLoc)
"""

from __future__ import annotations

import re
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_rows

Corners = tuple[float, float, float, float]

LISTS = ("map.csv", "satellite_coordinates_range.csv", "satellite_ coordinates_range.csv")
# The columns, without signs and in lower case: the picture, then top, left, bottom, right.
_COLUMNS = (
    {"filename", "mapname", "name", "file"},
    {"topleftlat", "topleftlatitude", "ltlatmap"},
    {"topleftlon", "topleftlong", "topleftlng", "topleftlongitude", "ltlonmap"},
    {"bottomrightlat", "bottomrightlatitude", "rblatmap"},
    {"bottomrightlon", "bottomrightlong", "bottomrightlng", "bottomrightlongitude", "rblonmap"},
)


def read_list(path: Path) -> dict[str, Corners]:
    """Read a list of pictures with their corners: latitude and longitude of the top left, then of the bottom right.

    Raises:
        DataError: if it is no such list; the message names the line.
    """
    file_name = printable(str(path))
    rows = read_rows(path, file_name)
    header = [re.sub("[^a-z]", "", name.lower()) for name in next(rows, (0, []))[1]]
    places = [next((i for i, name in enumerate(header) if name in names), None) for names in _COLUMNS]
    if None in places:
        raise DataError(
            f"The first line of {file_name} is {printable(','.join(header))[:200] or 'empty'}; expected "
            "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon."
        )
    corners = {}
    for line, values in rows:
        try:
            name, top, left, bottom, right = (values[place].strip() for place in places if place is not None)
            corners[name] = (float(top), float(left), float(bottom), float(right))
        except (IndexError, ValueError):
            raise DataError(
                f"Line {line} of {file_name} is {printable(','.join(values))[:200]}; expected a file and four numbers."
            ) from None
    if not corners:
        raise DataError(f"{file_name} names no picture; expected a line for each.")
    return corners


def corners_of(path: Path) -> tuple[Corners, str] | None:
    """Return the corners of a picture, and the list that has them, beside it or one folder up; None without a list."""
    for folder in (path.parent, path.parent / ".."):
        for name in LISTS:
            if (folder / name).is_file() and (corners := read_list(folder / name).get(path.name)):
                return corners, f"{printable(path.name)} in {name}"
    return None
