"""Tables of telemetry: the dialects of programs, their marks, the meaning of their columns, and the rows as numbers.

The header is the first line, or one of the comments before it. Two formats have none: Pix4D's rows of pictures, and
OpenDroneMap's geo.txt. Any other file is refused, and the message quotes its first line.

Names of columns are compared without case and signs: "GPS.Lat [deg]" is gpslat in degrees. A unit follows the name in brackets,
or after an underscore, a space, or a slash. Without one the dialect's unit counts, else metres, degrees, or seconds.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.values import ANGLES, LENGTHS, TIMES

_DATES = TIMES | {"utc": 1.0, "gmt": 1.0, "local": 1.0}
# The values of a row, with the possible units of each. `direction` is the camera's heading, `heading` the aircraft's, `nose` a
# pitch with 0 for straight down, `bank` its roll, and `below` EXIF's GPSAltitudeRef.
UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("latitude", "longitude", "position"), ANGLES),
    **dict.fromkeys(("height_above_ground", "height_above_takeoff", "altitude"), LENGTHS),
    **dict.fromkeys(("gimbal_heading", "gimbal_pitch", "gimbal_roll", "heading", "direction", "nose", "bank", "fov"), ANGLES),
    "time": TIMES, **dict.fromkeys(("date", "clock"), _DATES),
    **{what: {} for what in ("file", "latitude_letter", "longitude_letter", "below", "is_video", "quality")},
}  # fmt: skip
_ALL_UNITS = LENGTHS | ANGLES | _DATES
_BRACKETED = re.compile(r"(.*?)\s*[\[(](.*)[\])]\s*", re.DOTALL)
# The group of tags that exiftool -G writes before a name.
_GROUP = re.compile(r"(?:EXIF|XMP|GPS|File|Composite|IFD0|ExifIFD)[\w-]*:(?=\w)")
_COMMENT = ("#", "%")
# Maximum number of comments that are searched for the header, and of names in it.
_MOST_COMMENTS, _MOST_NAMES = 200, 1000
# The first line of OpenDroneMap's lists is a projection; only projections of `_DEGREES` give degrees.
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
class Dialect:
    """A table of one program.

    Attributes:
        marks: the columns that all tables of the program have.
        columns: the program's names of each value, best first, separated by bars; with a unit where headers have none.
        source: page that documents it.
        note: a hint for users of such a table; {name} is the file's name.
        before_utc: seconds by which its clock is ahead of UTC; None if the header names the zone.
        fixed: the text of `quality` for a fixed RTK solution.
    """

    program: str
    marks: tuple[str, ...]
    columns: Mapping[str, str]
    source: str
    note: str = ""
    before_utc: float | None = None
    fixed: str = ""


# fmt: off
_AGISOFT = {"file": "Label | Camera", "direction": "Yaw", "nose": "Pitch", "bank": "Roll", "altitude": "Z/Altitude"}
_RTKLIB = {"altitude": "height", "quality": "Q"}
_ELLIPSOID = "The heights of {name} are above the ellipsoid, and not above the sea."
_METASHAPE = "https://www.agisoft.com/pdf/metashape-pro_2_1_en.pdf"
_RTKLIB_PAGE = "https://www.rtklib.com/prog/manual_2.4.2.pdf"
DIALECTS = (
    Dialect("Airdata", ("height_above_takeoff", "altitude_above_seaLevel"), {
        "height_above_ground": "height_above_ground_at_drone_location", "altitude": "altitude_above_seaLevel",
        "heading": "compass_heading", "time": "time [ms]",
    }, "https://app.airdata.com/wiki/Help/Downloadable+Flight+Data+CSV"),
    Dialect("PhantomHelp, Flight Reader", ("OSD.latitude", "OSD.longitude"), {
        "latitude": "OSD.latitude", "longitude": "OSD.longitude", "height_above_takeoff": "OSD.height",
        "altitude": "OSD.altitude", "heading": "OSD.yaw", "time": "OSD.flyTime", "date": "CUSTOM.date",
        "clock": "CUSTOM.updateTime", "is_video": "CAMERA.isVideo | CUSTOM.isVideo",
    }, "https://forum.phantomhelp.com/t/flight-reader-field-descriptions/10579"),
    # The column pitch(deg) beside pitchRaw shows the unit of raw angles.
    Dialect("Litchi", ("gimbalPitchRaw",), {
        "gimbal_heading": "gimbalYawRaw [ddeg]", "gimbal_pitch": "gimbalPitchRaw [ddeg]",
        "gimbal_roll": "gimbalRollRaw [ddeg]", "is_video": "isRecordingVideo",
    }, "https://flylitchi.com/help"),
    Dialect("exiftool -csv", ("SourceFile",), {
        "file": "SourceFile", "position": "GPSPosition", "altitude": "GPSAltitude | AbsoluteAltitude",
        "below": "GPSAltitudeRef", "height_above_takeoff": "RelativeAltitude",
        "date": "GPSDateTime | DateTimeOriginal | CreateDate", "gimbal_heading": "GimbalYawDegree",
        "gimbal_pitch": "GimbalPitchDegree", "gimbal_roll": "GimbalRollDegree", "heading": "FlightYawDegree",
        "direction": "GPSImgDirection", "quality": "RtkFlag",
    }, "https://exiftool.org/TagNames/DJI.html", fixed="50"),
    Dialect("Agisoft Metashape", ("X/Longitude", "Y/Latitude"),
        _AGISOFT | {"latitude": "Y/Latitude", "longitude": "X/Longitude"}, _METASHAPE),
    Dialect("Agisoft PhotoScan", ("X/East", "Y/North"),
        _AGISOFT | {"latitude": "Y/North", "longitude": "X/East"}, _METASHAPE),
    Dialect("PIX4Dmatic", ("imagename", "coordinate1", "coordinate2"), {
        "latitude": "coordinate1", "longitude": "coordinate2", "altitude": "z",
    }, "https://support.pix4d.com/hc/en-us/articles/360056389172"),
    Dialect("OpenDroneMap geo.txt", ("image_name", "geo_x", "geo_y"), {
        "file": "image_name", "longitude": "geo_x", "latitude": "geo_y", "altitude": "geo_z",
        "direction": "yaw", "nose": "pitch", "bank": "roll",
    }, "https://docs.opendronemap.org/geo/",
        "{name} has no line of column names; longitude was read before latitude, as in geo.txt of OpenDroneMap."),
    Dialect("UAV-VisLoc", ("Omega", "Kappa", "Phi1"), {
        "height_above_takeoff": "height", "heading": "Phi1", "nose": "Omega", "bank": "Kappa",
    }, "https://github.com/IntelliSensing/UAV-VisLoc"),
    Dialect("wildnav", ("Gimball_Yaw", "Gimball_Pitch"), {
        "gimbal_heading": "Gimball_Yaw", "gimbal_pitch": "Gimball_Pitch", "gimbal_roll": "Gimball_Roll",
        "heading": "Flight_Yaw", "height_above_takeoff": "Altitude",
    }, "https://github.com/TIERS/wildnav",
        "The column Altitude of {name} counts as height above take-off, as in wildnav's files."),
    Dialect("RTKLIB", ("GPST", "Q"), _RTKLIB | {"date": "GPST"}, _RTKLIB_PAGE, _ELLIPSOID, 18.0, "1"),
    Dialect("RTKLIB", ("UTC", "Q"), _RTKLIB | {"date": "UTC"}, _RTKLIB_PAGE, _ELLIPSOID, 0.0, "1"),
    Dialect("mavlogdump.py", ("time_boot_ms", "relative_alt", "hdg"), {
        "latitude": "lat [degE7]", "longitude": "lon [degE7]", "altitude": "alt [mm]", "heading": "hdg [cdeg]",
        "height_above_takeoff": "relative_alt [mm]", "date": "timestamp",
    }, "https://mavlink.io/en/messages/common.html#GLOBAL_POSITION_INT"),
)
# Clear names in other tables, and for values that a dialect does not name.
COMMON = Dialect("any", (), {
    "file": "filename | file | image filename | image name | image | photo | picture | name | label | path",
    "latitude": "latitude | lat | gps latitude | gps lat | latitude/Y",
    "longitude": "longitude | lon | lng | long | gps longitude | gps lon | gps lng | longitude/X",
    "latitude_letter": "gps latitude ref | latitude ref | lat ref",
    "longitude_letter": "gps longitude ref | longitude ref | lon ref",
    "height_above_ground": "height above ground | agl | height agl | altitude agl",
    "height_above_takeoff": "height above takeoff | relative altitude | altitude relative | relative height | relative alt"
    " | rel alt | height above home | ascent | height",
    "altitude": "altitude above sea level | absolute altitude | abs alt | altitude amsl | gps altitude | altitude | alt"
    " | ellipsoidal height | ellipsoid height",
    "gimbal_heading": "gimbal heading | gimbal yaw | camera heading | camera yaw",
    "gimbal_pitch": "gimbal pitch | camera pitch",
    "gimbal_roll": "gimbal roll | camera roll",
    "heading": "heading | yaw | hdg | compass heading",
    "fov": "fov | hfov | horizontal fov",
    "time": "time | seconds | elapsed | elapsed time | timestamp",
    "date": "datetime | date time | utc | timestamp | date | time",
    "clock": "time of day | time",
    "is_video": "isVideo | is recording",
}, "")
# fmt: on


class LogColumn(NamedTuple):
    """A column of known meaning.

    Attributes:
        place: its index in a row.
        name: its name in the file, printable.
        factor: from its unit to metres, degrees, or seconds; None if the unit is unknown.
        has_unit: whether the header or the program's dialect names its unit.
    """

    place: int
    name: str
    factor: float | None
    has_unit: bool


# The number of a line of the file, and its text.
_Line = tuple[int, str]


class _Header(NamedTuple):
    """The names of a table's columns with the lines below them; a delimiter of None is any whitespace."""

    below: Sequence[_Line]
    delimiter: str | None
    names: list[str]
    notes: list[str]


@dataclass(frozen=True)
class LogTable:
    """The known columns of a log.

    Attributes:
        columns: by their values, which are keys of `UNITS`.
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
                # A unit in the cell replaces the column's unit.
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
        name: of the file, for messages.

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
    below, delimiter, header, notes = _with_header(lines, name) or _without_header(lines, name)
    # RTKLIB has one name for two columns, date and time of day.
    if delimiter is None and header[0].lstrip("%") in ("GPST", "UTC"):
        header = [header[0], "time of day", *header[1:]]
    dialect, columns, more = columns_of(header, name)
    rows = _rows([row for row in below if not row[1].startswith(_COMMENT)], delimiter, name)
    # Joined logs repeat the header.
    rows = [row for row in rows if [cell.strip() for cell in row[1]] != header]
    if not rows:
        raise DataError(f"{name} has column names and no row; expected one row a picture or moment.")
    longer = [(line, cells) for line, cells in rows if any(cells[len(header) :])]
    if delimiter == "," and header is not _PIX4D and "geo_x" not in header and len(longer) * 2 > len(rows):
        line, cells = longer[0]
        raise DataError(
            f"Line {line} of {name} has {len(cells)} values below {len(header)} names, perhaps by decimal commas between commas; "
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
    return LogTable(dialect, columns, texts, [line for line, _ in rows], name, delimiter != ",", (*more, *notes))


def picture_name(text: str) -> str | None:
    """Return the stripped text if it is the name of a picture, else None."""
    text = text.strip()
    return text if _PICTURE.fullmatch(text) else None


def _delimiters(line: str) -> Sequence[str | None]:
    """Return the tab, semicolon, and comma outside of quotes, the most frequent first; for whitespace, None alone."""
    bare = re.sub('"[^"]*"', "", line)
    found: list[str] = sorted((mark for mark in "\t;," if mark in bare), key=bare.count, reverse=True)
    return found or [None]


def _rows(lines: Sequence[_Line], delimiter: str | None, name: str) -> list[tuple[int, list[str]]]:
    """Return the cells of each row with the number of its last line."""
    if delimiter is None:
        return [(number, line.split()) for number, line in lines]
    reader = csv.reader((line for _, line in lines), delimiter=delimiter)
    try:
        return [(lines[reader.line_num - 1][0], cells) for cells in reader]
    except csv.Error as error:
        number = lines[min(reader.line_num, len(lines)) - 1][0]
        raise DataError(f"Line {number} of {name} is not comma-separated values; correct it.") from error


def _with_header(lines: Sequence[_Line], name: str) -> _Header | None:
    """Return the header with names of a position: the first line, or one of the comments before it."""
    first = next((i for i, (_, line) in enumerate(lines) if not line.startswith(_COMMENT)), len(lines) - 1)
    for i, line in enumerate(lines[: min(first + 1, _MOST_COMMENTS)]):
        for delimiter in _delimiters(line[1]):
            header = [cell.strip() for cell in _rows([line], delimiter, name)[0][1]]
            header = header[1:] if header[0] in _COMMENT else header
            columns = {} if len(header) > _MOST_NAMES else columns_of(header, name)[1]
            if "position" in columns or {"latitude", "longitude"} <= columns.keys():
                return _Header(lines[i + 1 :], delimiter, header, [])
    return None


def _without_header(lines: Sequence[_Line], name: str) -> _Header:
    """Return the known header of a table of Pix4D or OpenDroneMap, which the file lacks."""
    line = lines[0][1].strip()
    delimiter = _delimiters(line)[0]
    if _is_picture_row(row := _rows(lines[:1], delimiter, name)[0][1]):
        note = f"{name} has no line of column names; latitude was read before longitude, as in Pix4D's files."
        more = " Further numbers in it were not read." if len(row) > len(_PIX4D) else ""
        return _Header(lines, delimiter, _PIX4D, [note + more])
    second: Sequence[str] = ()
    if len(lines) > 1 and _PROJECTION.fullmatch(line):
        delimiter = _delimiters(lines[1][1])[0]
        second = _rows(lines[1:2], delimiter, name)[0][1]
    if len(second) > 5 and picture_name(second[5]):
        raise DataError(
            f"{name} is a list of ground control points: it has positions of points in the photos, and none of the photos "
            "themselves; give a geo.txt, or a log with latitude and longitude."
        )
    if _is_picture_row(second):
        if not _DEGREES.fullmatch(line):
            raise DataError(f"{name} has positions in {printable(line)[:80]}. {GRID}")
        return _Header(lines[1:], delimiter, _GEO_TXT + _GEO_TXT_ANGLES * (len(second) > 6), [])
    names = set(re.findall(r"[a-z]+", line.casefold()))
    grid = f" {GRID}" if {"x", "y"} <= names or names & {"easting", "northing", "utm"} else ""
    raise DataError(
        f"{name} begins with {printable(line)[:200]!r}; expected a line of column names with latitude and longitude.{grid}"
    )


def _is_picture_row(cells: Sequence[str]) -> bool:
    is_named = len(cells) > 2 and picture_name(cells[0]) is not None
    return is_named and all(values.angle(cell) is not None for cell in cells[1:3])


def columns_of(header: Sequence[str], name: str) -> tuple[Dialect, dict[str, LogColumn], list[str]]:
    """Return the dialect of a header, the column of each known value, and notes about columns that are not read or in doubt.

    Args:
        name: of the log, for notes.

    Raises:
        DataError: if the column of a latitude or longitude has an unknown unit.
    """
    readings = [(plain, units, place) for place, text in enumerate(header) for plain, units in _readings(text)]
    names = {plain for plain, _, _ in readings}
    dialect = next((one for one in DIALECTS if {_plain(mark) for mark in one.marks} <= names), COMMON)
    columns: dict[str, LogColumn] = {}
    notes = []
    for table in (dialect, COMMON) if dialect is not COMMON else (COMMON,):
        taken = {column.place for column in columns.values()}
        free = [reading for reading in readings if reading[2] not in taken]
        found = {what: _best(free, what, names) for what, names in table.columns.items() if what not in columns}
        for what, column in found.items():
            if column is None:
                continue
            written = printable(header[column.place])
            if column.factor is not None:
                columns[what] = column._replace(name=written, has_unit=column.has_unit or table is not COMMON)
                continue
            notes.append(f"The column {written} of {name} is in an unknown unit and was left out.")
            if what in ("latitude", "longitude"):
                raise DataError(f"{notes[-1]} Expected degrees, as in {what} (deg).")
    if {"latitude", "longitude"} <= columns.keys():
        columns.pop("position", None)
    read = {what: header[column.place] for what, column in columns.items()}
    if _plain(read.get("height_above_takeoff", "")) == "height":
        notes.append(f"The column height of {name} does not state its reference; it counts as height above take-off.")
    if {"omega", "phi", "kappa"} <= names:
        notes.append(f"The columns omega, phi, and kappa of {name} are angles of photogrammetry, and were not read.")
    if "ellips" in read.get("altitude", "").casefold():
        notes.append(_ELLIPSOID.format(name=name))
    tilts = [text for text in header if _readings(text)[0][0] in ("pitch", "roll") and text not in read.values()]
    if tilts and "gimbal_pitch" not in columns:
        notes.append(
            f"The columns {' and '.join(map(printable, tilts))} of {name} do not say whether they are the camera's, and were not "
            "read; call them gimbal_pitch and gimbal_roll if they are."
        )
    if dialect.note:
        notes.append(dialect.note.format(name=name))
    return dialect, columns, notes


def _plain(text: str) -> str:
    return "".join(letter for letter in text.casefold() if letter.isalnum())


def _readings(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """Return the readings of a column's name: the plain name, and the words of its unit in lower case."""
    text = _GROUP.sub("", text.lstrip("#% ").strip()[:200])
    if match := _BRACKETED.fullmatch(text):
        return [(_plain(match[1]), tuple(re.split(r"[\s,;]+", match[2].casefold().strip())))]
    readings: list[tuple[str, tuple[str, ...]]] = [(_plain(text), ())]
    parts = re.split(r"[\s_/]+", text)
    for count in range(1, min(len(parts), 3)):
        units = tuple(part.casefold() for part in parts[-count:])
        if set(units) <= _ALL_UNITS.keys():
            readings.append((_plain("".join(parts[:-count])), units))
    return readings


def _best(readings: Sequence[tuple[str, tuple[str, ...], int]], what: str, names: str) -> LogColumn | None:
    """Return a value's best column without its name.

    Columns are ranked by the order of names, then by the unit: known, missing, unknown or local time.
    """
    ranked = []
    units = UNITS[what]
    for rank, written in enumerate(names.split("|")):
        wanted, wanted_units = _readings(written)[0]
        own = units[wanted_units[0]] if wanted_units else 1.0
        for plain, words, place in readings:
            if plain != wanted:
                continue
            unit = next((word for word in words if word in units), "")
            is_unknown = bool(units and words and not unit)
            # A column of time in another unit may hold another value of time.
            if is_unknown and what in ("time", "date", "clock"):
                continue
            factor = None if is_unknown else units.get(unit, own)
            doubt = 2 if is_unknown or unit == "local" else int(not unit)
            ranked.append((rank, doubt, place, LogColumn(place, "", factor, bool(unit or wanted_units))))
    return min(ranked, key=lambda found: found[:3])[3] if ranked else None
