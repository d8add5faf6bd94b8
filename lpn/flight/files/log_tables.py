"""The table of a flight log in text: its header line, known columns, and the rows below as numbers.

The header is the first line, or one of the comments before it. Two formats have none: Pix4D's rows of pictures, and
OpenDroneMap's geo.txt. Any other file is refused, and the message quotes its first line.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.dialects import Dialect, LogColumn, columns_of

# Most comments that are searched for the header.
_MOST_COMMENTS = 200
# The first line of OpenDroneMap's lists is a projection; only those of `_DEGREES` give degrees.
_PROJECTION = re.compile(r"EPSG:\s*\d+|\+proj=.*|WGS84 UTM \d+[NS]?", re.IGNORECASE)
_DEGREES = re.compile(r"EPSG:\s*(?:4326|4979)|\+proj=(?:longlat|latlong).*", re.IGNORECASE)
_GEO_TXT = ["image_name", "geo_x", "geo_y", "geo_z"]
_GEO_TXT_ANGLES = ["yaw", "pitch", "roll"]
_PIX4D = ["imagename", "latitude", "longitude", "altitude"]
_LETTERS = {"latitude": "NS", "longitude": "EW"}
_UNKNOWN = ("", "n/a", "na", "nan", "null", "none", "-", "--", "unknown")
_PICTURE = re.compile(r"\S.{0,1000}\.(?:jpe?g|png|tiff?|webp|dng|heic|arw|cr2)", re.IGNORECASE)
# The end of a message about positions in a map's grid.
GRID = "Eastings and northings of a map are not read; export degrees of WGS 84."


@dataclass(frozen=True)
class LogTable:
    """The known columns of a log.

    Attributes:
        columns: of the values that the table tells.
        texts: of each of these values, one a row; "" where it is unknown.
        lines: the number of each row's line, from 1.
        name: of the file, for messages.
        commas: True if a comma may be the decimal sign, because it does not separate cells.
        notes: sentences about oddities.
    """

    dialect: Dialect
    columns: Mapping[str, LogColumn]
    texts: Mapping[str, Sequence[str]]
    lines: Sequence[int]
    name: str
    commas: bool
    notes: tuple[str, ...]

    def text(self, what: str) -> Sequence[str]:
        """Return the texts of a value, "" where it is unknown."""
        return self.texts.get(what) or [""] * len(self.lines)

    def numbers(self, what: str) -> Float64Array:
        """Return a value of each row in metres, degrees, or seconds, (N,); NaN where it is unknown.

        Raises:
            DataError: if a text other than a time is no number; the message names its line.
        """
        letters = _LETTERS.get(what)
        numbers = np.full(len(self.lines), math.nan)
        for i, text in enumerate(self.text(what)):
            if not text:
                continue
            number = values.angle(text, letters, self.commas) if letters else values.number(text, self.commas)
            if number is not None:
                # A unit in the cell counts in place of the column's.
                is_converted = text[-1].isalpha() or text[-1] == "°"
                numbers[i] = number if is_converted else number * (self.columns[what].factor or 1.0)
            elif what not in ("time", "date"):
                shown, expected = printable(text)[:80], "a number of degrees" if letters else "a number"
                raise DataError(
                    f"Line {self.lines[i]} of {self.name} has the {what.replace('_', ' ')} {shown!r}; expected {expected}."
                )
        if letters and f"{what}_letter" in self.texts:
            opposite = [text[:1].upper() == letters[1] for text in self.texts[f"{what}_letter"]]
            numbers = np.where(opposite, -np.abs(numbers), numbers)
        return numbers


def table_of(text: str, name: str) -> LogTable:
    """Find the header in a log's text, and split the lines below it into cells.

    Args:
        name: the file's, for messages.

    Raises:
        DataError: if it is of no known dialect, or has no row; the message shows its first line, or names a damaged one.
    """
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith("sep=")
    ]
    if not lines:
        raise DataError(f"{name} is empty; expected a log with a line of column names.")
    first = next((i for i, (_, line) in enumerate(lines) if not _is_comment(line)), len(lines) - 1)
    notes: list[str] = []
    for i, row in enumerate(lines[: min(first + 1, _MOST_COMMENTS)]):
        delimiter = _delimiter(row[1])
        header = [cell.strip() for cell in _rows([row], delimiter, name)[0][1]]
        header = header[1:] if header[0] in ("#", "%") else header
        if {"latitude", "longitude"} <= (columns := columns_of(header, name)[1]).keys() or "position" in columns:
            below = lines[i + 1 :]
            break
    else:
        below, delimiter, header, notes = _without_header(lines, name)
    # RTKLIB has one name for two columns, date and time of day.
    if delimiter is None and header[0].lstrip("%") in ("GPST", "UTC"):
        header = [header[0], "time of day", *header[1:]]
    dialect, columns, more = columns_of(header, name)
    below = [(number, line) for number, line in below if not _is_comment(line)]
    rows = _rows(below, delimiter, name)
    if not rows:
        raise DataError(f"{name} has column names and no row; expected one row a picture or moment.")
    longer = [(line, cells) for line, cells in rows if any(cells[len(header) :])]
    if delimiter == "," and header is not _PIX4D and len(longer) * 2 > len(rows):
        line, cells = longer[0]
        raise DataError(
            f"Line {line} of {name} has {len(cells)} values below {len(header)} names, as decimal commas between commas give; "
            "save it with decimal points, or with semicolons between the values."
        )
    # Some programs write an apostrophe before a minus sign, against formulas in spreadsheets.
    texts = {
        what: ["" if len(cells) <= at else cells[at].strip().removeprefix("'") for _, cells in rows]
        for what, (at, *_) in columns.items()
    }
    if "position" in columns:
        pairs = [re.split(r",\s+" if "," in text else r"\s+", text, maxsplit=1) for text in texts.pop("position")]
        for i, what in enumerate(_LETTERS):
            columns[what] = columns["position"]
            texts[what] = [pair[min(i, len(pair) - 1)] for pair in pairs]
    texts = {what: ["" if text.casefold() in _UNKNOWN else text for text in told] for what, told in texts.items()}
    lines_of_rows = [line for line, _ in rows]
    return LogTable(dialect, columns, texts, lines_of_rows, name, delimiter != ",", (*more, *notes))


def picture_name(text: str) -> str | None:
    """Return the stripped text if it is the name of a picture, else None."""
    text = text.strip()
    return text if _PICTURE.fullmatch(text) else None


def _is_comment(line: str) -> bool:
    return line.startswith(("#", "%"))


def _delimiter(line: str) -> str | None:
    """Return the most frequent of comma, semicolon, and tab; None for whitespace."""
    delimiter = max(",;\t", key=line.count)
    return delimiter if delimiter in line else None


def _rows(lines: Sequence[tuple[int, str]], delimiter: str | None, name: str) -> list[tuple[int, list[str]]]:
    """Return the cells of each row with the number of its last line."""
    if delimiter is None:
        return [(number, line.split()) for number, line in lines]
    reader = csv.reader((line for _, line in lines), delimiter=delimiter)
    try:
        return [(lines[reader.line_num - 1][0], cells) for cells in reader]
    except csv.Error as error:
        number = lines[min(reader.line_num, len(lines)) - 1][0]
        raise DataError(f"Line {number} of {name} is not comma-separated values; correct it.") from error


def _without_header(
    lines: Sequence[tuple[int, str]], name: str
) -> tuple[list[tuple[int, str]], str | None, list[str], list[str]]:
    """Return the rows' lines, delimiter, names, and notes of a table of Pix4D or OpenDroneMap."""
    line = lines[0][1].strip()
    delimiter = _delimiter(line)
    if _is_picture_row(row := _rows(lines[:1], delimiter, name)[0][1]):
        note = f"{name} has no line of column names; latitude before longitude was taken, as in Pix4D's files."
        more = " Further numbers in it were not read." if len(row) > len(_PIX4D) else ""
        return list(lines), delimiter, _PIX4D, [note + more]
    second = lines[1][1].split() if len(lines) > 1 and _PROJECTION.fullmatch(line) else []
    if len(second) > 5 and picture_name(second[5]):
        raise DataError(
            f"{name} is a list of ground control points, which tells where points on the ground are seen, and not where photos "
            "were taken; give a geo.txt, or a log with latitude and longitude."
        )
    if _is_picture_row(second):
        if not _DEGREES.fullmatch(line):
            raise DataError(f"{name} has positions in {printable(line)[:80]}. {GRID}")
        return list(lines[1:]), None, _GEO_TXT + _GEO_TXT_ANGLES * (len(second) > 6), []
    names = set(re.findall(r"[a-z]+", line.casefold()))
    grid = f" {GRID}" if {"x", "y"} <= names or names & {"easting", "northing", "utm"} else ""
    raise DataError(
        f"{name} begins with {printable(line)[:200]!r}; expected a line of column names with latitude and longitude.{grid}"
    )


def _is_picture_row(cells: Sequence[str]) -> bool:
    is_named = len(cells) > 2 and picture_name(cells[0]) is not None
    return is_named and all(values.angle(cell) is not None for cell in cells[1:3])
