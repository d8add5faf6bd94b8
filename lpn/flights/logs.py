"""Logs of a flight as `.csv`: one row a picture, or one row a moment.

    Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,...     wildnav's photo_metadata.csv
    num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2                              UAV-VisLoc
    time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),...   Airdata

Columns are known by their names, whose case and spelling may vary, and may be in any order. Units stand behind a name, as in
height(feet) or speed_ms. Columns of other names are left out. Where nothing names a unit, metres, degrees, and seconds are meant.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import read_lines
from lpn.flights import cameras
from lpn.flights.telemetry import TelemetryEntry

# Names of a column without signs, in lower case, best first.
_NAMES: Mapping[str, tuple[str, ...]] = {
    "file": ("filename", "file", "imagename", "image", "photo", "picture", "sourcefile", "path", "name"),
    "latitude": ("latitude", "lat", "gpslatitude", "gpslat", "osdlatitude"),
    "longitude": ("longitude", "lon", "lng", "long", "gpslongitude", "gpslon", "osdlongitude"),
    "height_above_ground": ("heightaboveground", "heightabovegroundatdronelocation", "agl", "heightagl", "altitudeagl"),
    "height_above_takeoff": (
        "heightabovetakeoff", "relativealtitude", "relativeheight", "relalt", "heightabovehome", "osdheight", "height",
    ),
    "altitude": (
        "altitudeabovesealevel", "absolutealtitude", "absalt", "altitudeamsl", "gpsaltitude", "osdaltitude", "altitude", "alt",
    ),
    "gimbal_heading": ("gimbalheading", "gimbalyaw", "gimbalyawdegree", "gimballyaw", "cameraheading", "camerayaw"),
    "gimbal_pitch": ("gimbalpitch", "gimbalpitchdegree", "gimballpitch", "camerapitch"),
    "gimbal_roll": ("gimbalroll", "gimbalrolldegree", "gimballroll", "cameraroll"),
    "heading": ("heading", "compassheading", "flightyaw", "flightyawdegree", "yaw", "osdyaw", "phi1", "phi"),
    "nose": ("omega",),
    "bank": ("kappa",),
    "fov": ("fov", "hfov", "horizontalfov"),
    "time": ("time", "seconds", "elapsed", "elapsedtime", "flytime", "osdflytime", "timestamp", "epoch"),
    "date": ("datetime", "date", "utc", "timestamp", "time", "createdate", "datetimeoriginal"),
    "is_video": ("isvideo",),
}  # fmt: skip
_UNITS = {
    "feet": 0.3048, "foot": 0.3048, "ft": 0.3048, "meters": 1.0, "metres": 1.0, "meter": 1.0, "metre": 1.0, "m": 1.0, "cm": 0.01,
    "km": 1000.0, "degrees": 1.0, "degree": 1.0, "deg": 1.0, "°": 1.0, "rad": math.degrees(1), "radians": math.degrees(1),
    "millisecond": 0.001, "milliseconds": 0.001, "ms": 0.001, "s": 1.0, "sec": 1.0, "seconds": 1.0, "utc": 1.0, "wgs84": 1.0,
}  # fmt: skip
_BRACKETED = re.compile(r"^([^(\[]*)[(\[]([^)\]]*)[)\]]\s*$")
_DATES = (
    "%Y-%m-%d %H:%M:%S",
    "%Y:%m:%d %H:%M:%S",
    "%Y/%m/%d %H:%M:%S",
    "%Y.%m.%d %H:%M:%S",
    "%Y/%m/%d %H:%M",
    "%Y-%m-%d %H:%M",
)
_LATEST = 1e11  # epochs above it are in milliseconds
_EPOCH = 1e9


@dataclass(frozen=True)
class LogRow:
    """A row of a log.

    Attributes:
        entry: its values; `time` is that of its column, else NaN, and `clock` that of its date.
        file: the picture it tells about; None in a log of moments.
        recording: whether the drone recorded a video; None if the log does not say.
    """

    entry: TelemetryEntry
    file: str | None = None
    recording: bool | None = None


@dataclass(frozen=True)
class Log:
    """A log of a flight.

    Attributes:
        utc: the entries' `clock` is UTC.
        notes: sentences about what was odd.
    """

    name: str
    rows: tuple[LogRow, ...]
    utc: bool
    notes: tuple[str, ...]


def read_log(file: Path) -> Log:
    """Read a log.

    Raises:
        DataError: if it is no such file, has no latitude and longitude, or holds a value that is no number or no position; the
            message names the line of such a value.
    """
    name = printable(file.name)
    lines = [
        (number, line)
        for number, line in enumerate(read_lines(file, name), 1)
        if line.strip() and not line.startswith("sep=")
    ]
    if not lines:
        raise DataError(f"{name} is empty; expected a log with a line of column names.")
    reader = csv.reader((line for _, line in lines), delimiter=max(",;\t", key=lines[0][1].count))
    try:
        table = [(lines[reader.line_num - 1][0], cells) for cells in reader]
    except csv.Error as error:
        raise DataError(f"{name} is not comma-separated values ({error}); correct it.") from error
    header = [cell.strip() for cell in table[0][1]]
    columns, factors, notes = _columns(header, name)
    if not {"latitude", "longitude"} <= columns.keys():
        raise DataError(
            f"{name} has the columns {printable(', '.join(header))[:300]}; expected latitude and longitude among them."
        )
    utc = "date" in columns and "utc" in header[columns["date"]].casefold()
    rows, zoned = [], False
    for number, cells in table[1:]:
        named = {what: _cell(cells, at) for what, at in columns.items()}
        row, has_zone = _row(named, factors, f"Line {number} of {name}")
        zoned |= has_zone
        rows.append(row)
    if not rows:
        raise DataError(f"{name} has column names and no row; expected one row a picture or moment.")
    known = sum(row.entry.latitude is not None for row in rows)
    if known < len(rows):
        notes.append(f"{len(rows) - known} of {len(rows)} rows of {name} have no position.")
    return Log(name, tuple(rows), utc or zoned, tuple(notes))


def for_photos(log: Log) -> dict[str, TelemetryEntry]:
    """Return the entries of a log by the names of their pictures in lower case, without folders."""
    return {_key(row.file): row.entry for row in log.rows if row.file}


def for_video(log: Log, number: int) -> tuple[list[TelemetryEntry], str | None]:
    """Return the entries of a log's recording with times from its start, and a note where that start is a guess.

    Args:
        number: of the recording in a log that tells when the drone recorded, from 0.

    Raises:
        DataError: if the log has no times, or fewer recordings.
    """
    clocks = [row.entry.clock if math.isnan(row.entry.time) else row.entry.time for row in log.rows]
    timed = [(row, time) for row, time in zip(log.rows, clocks, strict=True) if time is not None]
    if not timed:
        raise DataError(f"{log.name} tells no times, so it does not fit a video; expected a column time or datetime.")
    runs: list[list[tuple[LogRow, float]]] = []
    before = False
    for row, time in timed:
        if row.recording and not before:
            runs.append([])
        if row.recording:
            runs[-1].append((row, time))
        before = bool(row.recording)
    note = None
    if not any(row.recording is not None for row, _ in timed):
        runs, number = [timed], 0
        note = f"{log.name} does not tell when the video began; its first row counts as the beginning."
    if number >= len(runs):
        raise DataError(
            f"{log.name} tells of {len(runs)} recordings, and this is video {number + 1}; give the log of this flight."
        )
    start = runs[number][0][1]
    return [replace(row.entry, time=time - start) for row, time in runs[number]], note


def _key(file: str) -> str:
    return file.replace("\\", "/").rpartition("/")[2].strip().casefold()


def _cell(cells: Sequence[str], at: int) -> str:
    return cells[at].strip() if at < len(cells) else ""


def _columns(header: Sequence[str], name: str) -> tuple[dict[str, int], dict[str, float], list[str]]:
    """Return the place of each known column, the factor of its unit, and notes."""
    plain, units = [], []
    for cell in header:
        found = _BRACKETED.match(cell)
        text, unit = (found[1], found[2].strip()) if found else (cell, "")
        head, _, tail = text.strip().rpartition("_")
        if not unit and head and tail.casefold() in _UNITS and tail.casefold() != "utc":
            text, unit = head, tail
        plain.append(re.sub(r"[^a-z0-9]", "", text.casefold()))
        units.append(unit.casefold())
    columns: dict[str, int] = {}
    factors: dict[str, float] = {}
    notes = []
    for what, names in _NAMES.items():
        at = next((plain.index(one) for one in names if one in plain), None)
        if at is None:
            continue
        if units[at] and units[at] not in _UNITS:
            notes.append(f"The column {printable(header[at])} of {name} is in an unknown unit and was left out.")
            continue
        columns[what], factors[what] = at, _UNITS.get(units[at], 1.0)
    if "gimballyaw" in plain and "altitude" in columns and "height_above_takeoff" not in columns:
        # wildnav copies its column Altitude from RelativeAltitude.
        columns["height_above_takeoff"], factors["height_above_takeoff"] = columns.pop("altitude"), factors["altitude"]
        notes.append(f"The column Altitude of {name} counts as height above take-off, as in wildnav's files.")
    elif "height_above_takeoff" in columns and plain[columns["height_above_takeoff"]] == "height":
        notes.append(f"The column height of {name} does not say above what; it counts as height above take-off.")
    return columns, factors, notes


def _row(cells: Mapping[str, str], factors: Mapping[str, float], where: str) -> tuple[LogRow, bool]:
    """Return a row, and whether its date has a zone."""

    def value(what: str) -> float | None:
        text = cells.get(what, "")
        if not text or text.casefold() in ("n/a", "na", "nan", "null", "none", "-"):
            return None
        try:
            found = float(text) * factors[what]
        except ValueError:
            found = math.nan
        if not math.isfinite(found):
            raise DataError(f"{where} has the {what.replace('_', ' ')} {printable(text)[:80]!r}; expected a number.")
        return found

    latitude, longitude = value("latitude"), value("longitude")
    if latitude is None or longitude is None or latitude == longitude == 0:
        latitude = longitude = None
    elif abs(latitude) > 90 or abs(longitude) > 180:
        raise DataError(
            f"{where} has the position {latitude:g}, {longitude:g}; expected degrees, latitude from -90 to 90."
        )
    time, clock, zoned = _time(cells, factors)
    entry = TelemetryEntry(
        time,
        clock,
        latitude,
        longitude,
        value("height_above_ground"),
        value("height_above_takeoff"),
        value("altitude"),
        fov=value("fov"),
    )
    return LogRow(_with_angles(entry, value), cells.get("file") or None, _flag(cells.get("is_video"))), zoned


def _with_angles(entry: TelemetryEntry, value: Callable[[str], float | None]) -> TelemetryEntry:
    """Return an entry with the gimbal's angles; those that are all 0 are unknown, and the aircraft's heading counts."""
    yaw, pitch, roll = value("gimbal_heading"), value("gimbal_pitch"), value("gimbal_roll")
    if yaw is not None and (yaw or pitch or roll):
        if pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        return replace(entry, heading=yaw % 360.0, heading_source="gimbal", pitch=pitch, roll=roll)
    flown, nose, bank = value("heading"), value("nose"), value("bank")
    if flown is None:
        return entry
    pitch = (pitch or None) if nose is None else nose - 90.0
    return replace(entry, heading=flown % 360.0, heading_source="aircraft", pitch=pitch, roll=bank)


def _time(cells: Mapping[str, str], factors: Mapping[str, float]) -> tuple[float, float | None, bool]:
    """Return seconds of the column of time, else NaN; seconds since 1970-01-01 of that of the date; whether it has a zone."""
    try:
        time = float(cells.get("time", "")) * factors["time"]
    except (ValueError, KeyError):
        time = math.nan
    text = cells.get("date", "")
    try:
        number = float(text)
    except ValueError:
        clock, zoned = _date(text)
    else:
        zoned = _EPOCH < number < math.inf
        clock = (number / 1000 if number > _LATEST else number) if zoned else None
    return time if math.isfinite(time) else math.nan, clock, zoned


def _date(text: str) -> tuple[float | None, bool]:
    text = text.strip()
    for pattern in _DATES:
        try:
            return datetime.strptime(text, pattern).replace(tzinfo=UTC).timestamp(), False
        except (ValueError, OverflowError):
            continue
    try:
        found = datetime.fromisoformat(text)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp(), found.tzinfo is not None
    except (ValueError, OverflowError):
        return None, False


def _flag(text: str | None) -> bool | None:
    return None if text is None or not text else text.casefold() in ("1", "true", "yes")
