"""Corners of pictures by latitude and longitude: lists of published data sets, and names that tell them.

map.csv                             Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon       (wildnav)
satellite_coordinates_range.csv     mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region                 (UAV-VisLoc)
@name@LTlon@LTlat@RBlon@RBlat@.tif                                                                             (AerialVL)
"""

from __future__ import annotations

import re
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_rows
from lpn.flight.maps import _gdal

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
# Parts of a large map: row and column from 1.
_PART = re.compile(r"(.+)_([0-9]{1,3})-([0-9]{1,3})(\.[A-Za-z]+)")
_NAMED = re.compile(r"@[^@]*@([-+.0-9]+)@([-+.0-9]+)@([-+.0-9]+)@([-+.0-9]+)@")


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
    """Return the corners of a picture and where they were found: in its name, or in a list beside it or one folder up."""
    if match := _NAMED.search(path.name):
        try:
            left, top, right, bottom = map(float, match.groups())
            return (top, left, bottom, right), f"the name of {printable(path.name)}"
        except ValueError:
            return None
    for folder in (path.parent, path.parent / ".."):
        for name in LISTS:
            if (folder / name).is_file():
                listed = read_list(folder / name)
                corners = listed.get(path.name) or _of_part(path, listed)
                if corners is not None:
                    return corners, f"{printable(path.name)} in {name}"
    return None


def _of_part(path: Path, listed: dict[str, Corners]) -> Corners | None:
    """Return the corners of one of the parts name_RR-CC.tif into which the listed name.tif is cut; None if it is none."""
    match = _PART.fullmatch(path.name)
    whole = listed.get(f"{match[1]}{match[4]}") if match else None
    if match is None or whole is None:
        return None
    sizes = {}
    for part in path.parent.iterdir():
        part_match = _PART.fullmatch(part.name)
        if part_match and (part_match[1], part_match[4]) == (match[1], match[4]):
            with _gdal.opened(part) as file:
                sizes[int(part_match[2]), int(part_match[3])] = int(file.width), int(file.height)
    row, column = int(match[2]), int(match[3])
    widths = {c: width for (r, c), (width, _) in sizes.items() if r == row}
    heights = {r: height for (r, c), (_, height) in sizes.items() if c == column}
    if sorted(widths) != list(range(1, len(widths) + 1)) or sorted(heights) != list(range(1, len(heights) + 1)):
        raise DataError(
            f"Parts of {printable(match[1])} beside {printable(path.name)} are missing; expected all of them, because the list "
            "has the corners of the whole."
        )
    top, left, bottom, right = whole
    across = [
        sum(width for c, width in widths.items() if c < end) / sum(widths.values()) for end in (column, column + 1)
    ]
    down = [sum(height for r, height in heights.items() if r < end) / sum(heights.values()) for end in (row, row + 1)]
    return (
        top + down[0] * (bottom - top),
        left + across[0] * (right - left),
        top + down[1] * (bottom - top),
        left + across[1] * (right - left),
    )
