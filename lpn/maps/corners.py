"""Corners of pictures by latitude and longitude: lists of published data sets, and names that tell them.

map.csv                             Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon       (wildnav)
satellite_coordinates_range.csv     mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region                 (UAV-VisLoc)
@name@LTlon@LTlat@RBlon@RBlat@.tif                                                                             (AerialVL)
"""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

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
_NAMED = re.compile(r"@[^@]*@([-+.0-9]+)@([-+.0-9]+)@([-+.0-9]+)@([-+.0-9]+)@")


def read_list(path: Path) -> dict[str, Corners]:
    """Read a list of pictures with their corners: latitude and longitude of the top left, then of the bottom right.

    Raises:
        DataError: if it is no such list; the message names the line.
    """
    shown = printable(str(path))
    try:
        lines = csv.reader(io.StringIO(path.read_bytes().decode("utf-8-sig"), newline=""), skipinitialspace=True)
        header = [re.sub("[^a-z]", "", name.lower()) for name in next(lines, [])]
        places = [next((i for i, name in enumerate(header) if name in names), None) for names in _COLUMNS]
        if None in places:
            raise DataError(
                f"The first line of {shown} is {printable(','.join(header))[:200] or 'empty'}; expected "
                "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon."
            )
        found = {}
        for values in lines:
            if values:
                try:
                    name, top, left, bottom, right = (values[place].strip() for place in places if place is not None)
                    found[name] = (float(top), float(left), float(bottom), float(right))
                except (IndexError, ValueError):
                    raise DataError(
                        f"Line {lines.line_num} of {shown} is {printable(','.join(values))[:200]}; expected a file "
                        "and four numbers."
                    ) from None
    except OSError as error:
        raise DataError(
            f"{shown} cannot be read ({error.strerror or error}); check that it is there and readable."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{shown} is not a text file of comma-separated values in UTF-8; save it as such.") from error
    if not found:
        raise DataError(f"{shown} names no picture; expected a line for each.")
    return found


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
            if (folder / name).is_file() and (corners := read_list(folder / name).get(path.name)) is not None:
                return corners, f"{printable(path.name)} in {name}"
    return None
