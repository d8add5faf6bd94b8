"""Text as the table of a flight log: the line of names is looked for, and the lines below it are split into cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lpn.core.errors import DataError, OtherKindError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.log_columns import LogColumns, columns_of

# The line of names is looked for among so many lines. DroneDeploy's has some thirty lines before it.
_MOST_HEAD = 200
_DELIMITERS = (",", ";", "\t", "|", None)
# A second line with units, as in FlySight's files.
_UNIT_CELL = re.compile(r"[(\[]?(?:deg|degrees|°|rad|dd|decimal degrees)[)\]]?", re.IGNORECASE)
_COMMA_DECIMAL = re.compile(r"[^\d,.]*\d{1,3},\d+[^\d,.]*")
# Names of WGS 84 in the first line of a geo.txt, whose positions are in degrees then.
_GEOGRAPHIC = re.compile(r"EPSG:4326|longlat|WGS ?84", re.IGNORECASE)
_UNKNOWN = ("", "n/a", "na", "nan", "null", "none", "-", "--", "unknown")
_PICTURE = re.compile(r"\S.*\.(?:jpe?g|png|tiff?|webp|dng|heic|arw|cr2)", re.IGNORECASE)


@dataclass(frozen=True)
class LogTable:
    """The lines of a log below its names.

    Attributes:
        header: the names as they are written.
        rows: cells with the number of their line, from 1.
        commas: a comma within a number is the decimal sign.
        notes: sentences about what was odd.
    """

    columns: LogColumns
    header: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    commas: bool
    notes: list[str]

    def text(self, cells: Sequence[str], what: str) -> str:
        """Return the text of a value in a row, "" for one that is unknown."""
        at = self.columns.places.get(what)
        # Programs that fear formulas write an apostrophe before a minus sign.
        text = "" if at is None else cell_at(cells, at).removeprefix("'")
        return "" if text.casefold() in _UNKNOWN else text


def table_of(text: str, name: str) -> LogTable:
    """Find the line of names in a log's text, and split the lines below it into cells.

    Args:
        name: the file's, for messages.

    Raises:
        DataError: if there is no latitude and longitude, or no row; the message names a damaged line.
    """
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith("sep=")
    ]
    if not lines:
        raise OtherKindError(f"{name} is empty; expected a log with a line of column names.")
    at, delimiter, header, notes = _header(lines, name)
    lines = lines[at + 1 :]
    columns = columns_of(header, name)
    lines = [(number, line) for number, line in lines if not line.startswith(("#", "%"))]
    # Logs that were joined have the line of names again.
    rows = [
        (line, cells) for line, cells in _cells(lines, delimiter, name) if [cell.strip() for cell in cells] != header
    ]
    if (
        rows
        and columns.places.keys() >= {"latitude"}
        and _UNIT_CELL.fullmatch(cell_at(rows[0][1], columns.places["latitude"]))
    ):
        rows = rows[1:]
    if not rows:
        raise DataError(f"{name} has column names and no row; expected one row a picture or moment.")
    if delimiter == ",":
        rows = _with_whole_positions(rows, len(header), columns.places.get("position"))
        rows = _rejoined(rows, header, columns, name, notes)
    commas = any(
        _COMMA_DECIMAL.fullmatch(cell_at(cells, columns.places[what]))
        for _, cells in rows for what in ("latitude", "longitude") if what in columns.places
    )  # fmt: skip
    if commas:
        notes.append(f"The commas within numbers of {name} count as decimal commas: 47,301 is 47.301.")
    return LogTable(columns, tuple(header), rows, commas, notes)


def cell_at(cells: Sequence[str], at: int) -> str:
    """Return the text of a cell, "" beyond the end of a short row."""
    return cells[at].strip() if at < len(cells) else ""


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [""])]
    except csv.Error:
        return [line]


def _header(lines: Sequence[tuple[int, str]], name: str) -> tuple[int, str | None, list[str], list[str]]:
    """Return the index of the line of names, the delimiter, the names, and notes.

    Files of Pix4D and OpenDroneMap's geo.txt have none: the names are known, and the index is that of the line before the rows.
    """
    for at, (_, line) in enumerate(lines[:_MOST_HEAD]):
        for delimiter in _DELIMITERS:
            header = _split(line, delimiter)
            if len(header) < 2 or any(values.angle(cell) is not None for cell in header):
                continue
            header = header[1:] if header[0] in ("#", "%") else header
            if not columns_of(header, name).has_position:
                continue
            # RTKLIB writes a date and a time below one name.
            if delimiter is None and header[0].lstrip("%") in ("GPST", "UTC"):
                header = [re.sub(r"^height\b", "ellipsoidal height", cell) for cell in header[1:]]
                header = ["GPST" if "GPST" in line else "UTC", "time of day", *header]
            return at, delimiter, header, []
    first = next((i for i, (_, line) in enumerate(lines[:_MOST_HEAD]) if not line.startswith("#")), 0)
    for delimiter in _DELIMITERS:
        if _is_picture_row(lines[first][1], delimiter):
            if first and _names(lines[first - 1][1], delimiter) == len(_split(lines[first][1], delimiter)):
                raise _no_position(lines[first - 1 :], name)
            note = "latitude before longitude was taken, as in Pix4D's files"
            return first - 1, delimiter, ["file", "lat", "lon", "alt"], [_without_names(name, note)]
        if (
            len(lines) > first + 1
            and _is_picture_row(lines[first + 1][1], delimiter)
            and _GEOGRAPHIC.search(lines[first][1])
        ):
            note = "longitude before latitude was taken, as in geo.txt of OpenDroneMap"
            return first, delimiter, ["file", "lon", "lat", "alt"], [_without_names(name, note)]
    raise _no_position(lines, name)


def _names(line: str, delimiter: str | None) -> int:
    """Return the number of names in a line; 0 if one of its cells is a number or empty."""
    cells = _split(line.lstrip("#% "), delimiter)
    return len(cells) if all(cell and values.angle(cell) is None for cell in cells) else 0


def _without_names(name: str, note: str) -> str:
    return f"{name} has no line of column names; {note}. Angles in it were not read."


def _is_picture_row(line: str, delimiter: str | None) -> bool:
    """Return whether a line has a picture's name and two numbers."""
    cells = _split(line, delimiter)
    return (
        len(cells) > 2
        and bool(_PICTURE.fullmatch(cells[0]))
        and all(values.angle(cell) is not None for cell in cells[1:3])
    )


def _no_position(lines: Sequence[tuple[int, str]], name: str) -> DataError:
    """Return the error about a file without a position; columns that may be one are named."""
    delimiter = max(",;\t", key=lines[0][1].count)
    header = _split(lines[0][1].lstrip("#% "), delimiter)
    message = (
        f"{name} has the columns {printable(', '.join(header))[:300]}; expected latitude and longitude among them."
    )
    if any(word in lines[0][1].casefold() for word in ("easting", "northing", "utm", "epsg")):
        return DataError(f"{message} Eastings and northings of a map are not read; export degrees of WGS 84.")
    second = _split(lines[1][1], delimiter) if len(lines) > 1 else []
    likely = [
        header[i]
        for i, cell in enumerate(second[: len(header)])
        if re.fullmatch(r"-?\d{1,3}\.\d{4,}", cell) and abs(float(cell)) <= 180
    ]
    if len(likely) < 2:
        return OtherKindError(message)
    return DataError(
        f"{message} {printable(likely[0])} and {printable(likely[1])} look like degrees; if they are, name them so."
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
        raise DataError(
            f"Line {lines[min(reader.line_num, len(lines)) - 1][0]} of {name} is not comma-separated values; correct it."
        ) from error


def _with_whole_positions(
    rows: list[tuple[int, list[str]]], columns: int, at: int | None
) -> list[tuple[int, list[str]]]:
    """Join a latitude and a longitude in one column that the comma between them splits, as FrSky's Ethos writes them."""
    if at is None or any(
        len(cells) != columns + 1 or values.angle(cell_at(cells, at + 1)) is None for _, cells in rows
    ):
        return rows
    return [(line, [*cells[:at], f"{cells[at]}, {cells[at + 1]}", *cells[at + 2 :]]) for line, cells in rows]


def _rejoined(
    rows: list[tuple[int, list[str]]], header: Sequence[str], columns: LogColumns, name: str, notes: list[str]
) -> list[tuple[int, list[str]]]:
    """Join numbers whose decimal commas also separate the cells: 47,301,8,501 under lat,lon."""
    places = [columns.places[what] for what in ("latitude", "longitude") if what in columns.places]
    longer = [
        (line, cells)
        for line, cells in rows
        if len(cells) > len(header)
        and any(cells[len(header) :])
        and all(re.fullmatch(r"[-+]?\d{1,3}", cell_at(cells, at)) for at in places[:1])
    ]
    if len(longer) * 2 <= len(rows) or not places:
        return rows
    joined = []
    for line, cells in rows:
        ways = _ways([cell.strip() for cell in cells], len(header))
        if len(ways) != 1:
            raise DataError(
                f"Line {line} of {name} has {len(cells)} values below {len(header)} names, as decimal commas between commas "
                "give; save it with decimal points, or with semicolons between the values."
            )
        joined.append((line, ways[0]))
    notes.append(f"{name} has commas both within and between numbers; they were joined to one number a column.")
    return joined


def _ways(cells: Sequence[str], columns: int) -> list[list[str]]:
    """Return the ways to join neighbouring whole numbers to decimals so that a row has a number of columns; two at most."""
    ways: list[list[str]] = []
    todo: list[tuple[int, list[str]]] = [(0, [])] if len(cells) <= 2 * columns else []
    while todo and len(ways) < 2:
        at, row = todo.pop()
        left, wanted = len(cells) - at, columns - len(row)
        if not left and not wanted:
            ways.append(row)
        elif left and wanted and wanted <= left <= 2 * wanted:
            todo.append((at + 1, [*row, cells[at]]))
            if left > 1 and re.fullmatch(r"[-+]?\d+", cells[at]) and cells[at + 1].isdecimal():
                todo.append((at + 2, [*row, f"{cells[at]}.{cells[at + 1]}"]))
    return ways


def picture_name(text: str) -> str | None:
    """Return a text without spaces about it if it is the name of a picture, else None."""
    text = text.strip()
    return text if len(text) < 1000 and _PICTURE.fullmatch(text) else None
