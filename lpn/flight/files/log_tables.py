"""The table of a flight log in text: its header line, known columns, and the rows below as numbers.

The header is the first line, or one of the comments before it. Two formats have none: Pix4D's rows of pictures, and
OpenDroneMap's geo.txt. Any other file is refused, and the message quotes its first line.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.dialects import Columns, columns_of

_DELIMITERS = (",", ";", "\t", None)
# Most lines that are searched for the header, and most names in it.
_MOST_HEAD, _MOST_NAMES = 200, 1000
# The first line of OpenDroneMap's lists is a projection; only those of `_DEGREES` give degrees.
_PROJECTION = re.compile(r"EPSG:\s*\d+|\+proj=.*|WGS84 UTM \d+[NS]?", re.IGNORECASE)
_DEGREES = re.compile(r"EPSG:\s*(?:4326|4979)|\+proj=(?:longlat|latlong).*", re.IGNORECASE)
_GEO_TXT = ["image_name", "geo_x", "geo_y", "geo_z"]
_GEO_TXT_ANGLES = ["yaw", "pitch", "roll"]
_PIX4D = ["imagename", "latitude", "longitude", "altitude"]
_UNKNOWN = ("", "n/a", "na", "nan", "null", "none", "-", "--", "unknown")
_PICTURE = re.compile(r"\S.*\.(?:jpe?g|png|tiff?|webp|dng|heic|arw|cr2)", re.IGNORECASE)
# The end of a message about positions in a map's grid.
GRID = "Eastings and northings of a map are not read; export degrees of WGS 84."
_COORDINATES = ("latitude", "NS"), ("longitude", "EW")


@dataclass(frozen=True)
class LogTable:
    """The lines of a log below its header.

    Attributes:
        header: the names as they are written.
        rows: cells with the number of their line, from 1.
        name: of the file, for messages.
        commas: True if a comma may be the decimal sign, because it does not separate cells.
        notes: sentences about oddities.
    """

    columns: Columns
    header: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    name: str
    commas: bool
    notes: tuple[str, ...]

    def texts(self, what: str) -> list[str]:
        """Return the text of a value in each row, "" where it is unknown."""
        at = self.columns.places.get(what)
        # Some programs write an apostrophe before a minus sign, against formulas in spreadsheets.
        texts = [
            cells[at].strip().removeprefix("'") if at is not None and at < len(cells) else "" for _, cells in self.rows
        ]
        return ["" if text.casefold() in _UNKNOWN else text for text in texts]

    def numbers(self, what: str) -> Float64Array:
        """Return a value of each row in metres, degrees, or seconds, (N,); NaN where it is unknown.

        Raises:
            DataError: if a text is no number; the message names its line.
        """
        return self._read(what, lambda text: values.number(text, self.commas), "a number")

    def places(self) -> Float64Array:
        """Return latitude and longitude of each row in degrees, (N, 2); NaN where one is unknown, or both are 0.

        Raises:
            DataError: if a text is no angle, or more than a tenth of the positions are not on the Earth.
        """
        if "position" in self.columns.places:
            degrees = np.array([self._pair(i, text) for i, text in enumerate(self.texts("position"))], np.float64)
        else:
            axes = []
            for what, letters in _COORDINATES:
                axis = self._read(
                    what, partial(values.angle, letters=letters, comma=self.commas), "a number of degrees"
                )
                opposite = [text[:1].upper() == letters[1] for text in self.texts(f"{what}_letter")]
                axes.append(np.where(opposite, -np.abs(axis), axis))
            degrees = np.stack(axes, axis=1)
        degrees[np.isnan(degrees).any(axis=1) | (degrees == 0).all(axis=1)] = np.nan
        return degrees

    def _pair(self, row: int, text: str) -> tuple[float, float]:
        if not text:
            return math.nan, math.nan
        parts = re.split(r",\s+", text) if "," in text else text.split()
        pair = [values.angle(part, letters) for part, (_, letters) in zip(parts, _COORDINATES, strict=False)]
        if len(pair) != 2 or pair[0] is None or pair[1] is None:
            raise self._error(row, "position", text, "a latitude and a longitude")
        return pair[0], pair[1]

    def _read(self, what: str, read: Callable[[str], float | None], expected: str) -> Float64Array:
        factor = self.columns.factors.get(what, 1.0)
        numbers = np.full(len(self.rows), math.nan)
        for i, text in enumerate(self.texts(what)):
            if not text:
                continue
            number = read(text)
            if number is None:
                raise self._error(i, what, text, expected)
            # A unit in the cell counts in place of the column's.
            numbers[i] = number if text[-1].isalpha() or text[-1] == "°" else number * factor
        return numbers

    def _error(self, row: int, what: str, text: str, expected: str) -> DataError:
        line, shown = self.rows[row][0], printable(text)[:80]
        return DataError(f"Line {line} of {self.name} has the {what.replace('_', ' ')} {shown!r}; expected {expected}.")


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
    at, delimiter, header, notes = _header(lines, name)
    columns = columns_of(header, name)
    below = [(number, line) for number, line in lines[at + 1 :] if not _is_comment(line)]
    # Joined logs repeat the header.
    rows = [
        (line, cells) for line, cells in _cells(below, delimiter, name) if [cell.strip() for cell in cells] != header
    ]
    if not rows:
        raise DataError(f"{name} has column names and no row; expected one row a picture or moment.")
    longer = [(line, cells) for line, cells in rows if any(cells[len(header) :])]
    if len(longer) * 2 > len(rows) and columns.dialect.program != "OpenDroneMap geo.txt" and at >= 0:
        line, cells = longer[0]
        raise DataError(
            f"Line {line} of {name} has {len(cells)} values below {len(header)} names, as decimal commas between commas give; "
            "save it with decimal points, or with semicolons between the values."
        )
    return LogTable(columns, tuple(header), rows, name, delimiter != ",", (*columns.notes, *notes))


def picture_name(text: str) -> str | None:
    """Return the stripped text if it is the name of a picture, else None."""
    text = text.strip()
    return text if len(text) < 1000 and _PICTURE.fullmatch(text) else None


def _is_comment(line: str) -> bool:
    return line.startswith(("#", "%"))


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split() if not re.search("[,;\t]", line) else [line]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [""])]
    except csv.Error:
        return [line]


def _header(lines: Sequence[tuple[int, str]], name: str) -> tuple[int, str | None, list[str], list[str]]:
    """Return the header's line, or -1 if rows begin with the first one, the delimiter, the names, or the dialect's, and notes."""
    first = next((i for i, (_, line) in enumerate(lines) if not _is_comment(line)), len(lines) - 1)
    for at, (_, line) in enumerate(lines[: min(first + 1, _MOST_HEAD)]):
        for delimiter in _DELIMITERS:
            header = _split(line, delimiter)
            header = header[1:] if header[0] in ("#", "%") else header
            if len(header) > _MOST_NAMES or any(values.angle(cell) is not None for cell in header):
                continue
            if not columns_of(header, name).has_position:
                continue
            # RTKLIB has one name for two columns, date and time of day.
            if delimiter is None and header[0].lstrip("%") in ("GPST", "UTC"):
                header = [header[0], "time of day", *header[1:]]
            return at, delimiter, header, []
    line = lines[0][1].strip()
    for delimiter in _DELIMITERS:
        row, below = _split(line, delimiter), _split(lines[1][1], delimiter) if len(lines) > 1 else []
        if _is_picture_row(row):
            note = f"{name} has no line of column names; latitude before longitude was taken, as in Pix4D's files."
            more = " Further numbers in it were not read." if len(row) > len(_PIX4D) else ""
            return -1, delimiter, _PIX4D, [note + more]
        if not _PROJECTION.fullmatch(line):
            continue
        if len(below) > 5 and picture_name(below[5]):
            raise DataError(
                f"{name} is a list of ground control points, which tells where points on the ground are seen, and not where "
                "photos were taken; give a geo.txt, or a log with latitude and longitude."
            )
        if _is_picture_row(below):
            if not _DEGREES.fullmatch(line):
                raise DataError(f"{name} has positions in {printable(line)[:80]}. {GRID}")
            return 0, delimiter, _GEO_TXT + _GEO_TXT_ANGLES * (len(below) > 6), []
    raise _unknown(line, name)


def _is_picture_row(cells: Sequence[str]) -> bool:
    is_named = len(cells) > 2 and picture_name(cells[0]) is not None
    return is_named and all(values.angle(cell) is not None for cell in cells[1:3])


def _unknown(line: str, name: str) -> DataError:
    names = set(re.findall(r"[a-z]+", line.casefold()))
    grid = f" {GRID}" if {"x", "y"} <= names or names & {"easting", "northing", "utm"} else ""
    return DataError(
        f"{name} begins with {printable(line.strip())[:200]!r}; expected a line of column names with latitude and "
        f"longitude.{grid}"
    )


def _cells(lines: Sequence[tuple[int, str]], delimiter: str | None, name: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the cells of each row with the number of its last line."""
    if delimiter is None:
        yield from ((number, line.split()) for number, line in lines)
        return
    reader = csv.reader((line for _, line in lines), delimiter=delimiter)
    try:
        for cells in reader:
            yield lines[reader.line_num - 1][0], cells
    except csv.Error as error:
        number = lines[min(reader.line_num, len(lines)) - 1][0]
        raise DataError(f"Line {number} of {name} is not comma-separated values; correct it.") from error
