"""Logs of a flight as tables and tracks: one row a picture, or one row a moment.

    Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,...     wildnav's photo_metadata.csv
    num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2                              UAV-VisLoc
    time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),...   Airdata
    #Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll                             Agisoft
    SourceFile,GPSLatitude,GPSLongitude                                                 exiftool -csv: 47 deg 18' 4.44" N

Columns are known by their names (`lpn.flight.files.log_columns`), in any order, and their values must be what the name says:
degrees on the Earth. Lines of comment before the names, decimal commas, degrees and minutes, letters of hemispheres, degrees
times 1e7, radians, and a latitude and longitude whose names are swapped are told from the file as a whole, and a note says
so. Where nothing names a unit, metres, degrees, and seconds are meant. GPX is read by `lpn.flight.files.track_files`.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import cameras, values
from lpn.flight.files.base import HeadingSource
from lpn.flight.files.log_tables import LogTable, table_of
from lpn.flight.files.log_times import clocks_of, elapsed_of
from lpn.flight.files.telemetry import TelemetryEntry

SUFFIXES = (".csv", ".tsv", ".txt", ".pos", ".log")
_MOST_BYTES = 200_000_000
# The least and the largest angle in degrees. Headings may go on counting from turn to turn, but whole numbers that pass three
# turns are more likely hundredths of degrees.
_HEADINGS, _TILTS = ("heading", "gimbal_heading", "direction"), ("gimbal_pitch", "gimbal_roll", "nose", "bank")
_TURNS, _WHOLE_TURNS, _TURN = (-3600.0, 3600.0), (-1080.0, 1080.0), (-360.0, 360.0)
_RANGES = {**dict.fromkeys(_HEADINGS, _TURNS), **dict.fromkeys(_TILTS, _TURN), "fov": cameras.FOV_RANGE}
# MAVLink's heading if unknown, in hundredths of degrees or in degrees.
_NO_HEADING = (65535.0, 655.35)
# A gimbal whose least pitch in a log is larger was told by another convention.
_LOOKS_UP = 30.0
_SCALED = 1e7
# The name of MAVLink's heading, which is in hundredths of degrees, also as GLOBAL_POSITION_INT.hdg.
_MAVLINK_HEADING = re.compile(r"(?:.*[^a-z])?hdg", re.IGNORECASE | re.DOTALL)
# A recording shorter than this, in seconds, marks only the beginning of a video.
_LEAST_RECORDING = 1.5
# A log is refused if a larger share of its positions is beyond latitude 90 or longitude 180. A column of angles is left out if
# a larger share is beyond the limit, except for a single one of `_SEVERAL` or more.
_MOST_BEYOND, _SEVERAL = 0.1, 3
# Whole numbers below this are eastings and northings of a map, and no degrees times 1e7.
_LEAST_SCALED = 2e7


@dataclass(frozen=True)
class LogRow:
    """A row of a log.

    Attributes:
        entry: its values; `time` is that of its column, else NaN, and `clock` that of its date.
        file: the picture it tells about; None in a log of moments.
        recording: whether the drone recorded a video; None if the log does not say.
        line: its number in the file, from 1; 0 in a track.
    """

    entry: TelemetryEntry
    file: str | None = None
    recording: bool | None = None
    line: int = 0


@dataclass(frozen=True)
class Log:
    """A log of a flight.

    Attributes:
        utc: the entries' `clock` is UTC, as far as the log says.
        notes: sentences about what was odd.
    """

    name: str
    rows: tuple[LogRow, ...]
    utc: bool
    notes: tuple[str, ...]


def read_log(file: Path) -> Log:
    """Read a log that is a table.

    Raises:
        DataError: if it is no such file, has no latitude and longitude, or holds a value that is no number or no position; the
            message names the line of such a value.
    """
    name = printable(file.name)
    data = values.read_limited(file, _MOST_BYTES, "a log of one flight")
    if file.suffix.lower() == ".txt" and b"\x00" in data[:1000] and data[:2] not in (b"\xff\xfe", b"\xfe\xff"):
        raise DataError(
            f"{name} is no text. A flight record of DJI's app is encrypted; convert it to .csv with Airdata or PhantomHelp."
        )
    table = _with_hemispheres(table_of(values.decoded(data, name), name), name)
    places, notes, is_scaled = _positions(table, name)
    table = _with_possible_angles(_with_mavlink_units(table, name, is_scaled), name)
    clocks, zoned, clock_notes = clocks_of(table, name)
    times = elapsed_of(table)
    rows = []
    for i, (line, cells) in enumerate(table.rows):
        entry = TelemetryEntry(times[i], clocks[i], *places[i])
        rows.append(_row(entry, _Cells(table, cells, f"Line {line} of {name}"), line))
    known = sum(row.entry.latitude is not None for row in rows)
    missing = [] if known == len(rows) else [f"{len(rows) - known} of {len(rows)} rows of {name} have no position."]
    notes = [*table.columns.notes, *table.notes, *notes, *clock_notes, *missing]
    return Log(name, tuple(rows), table.columns.utc or zoned, tuple(notes))


def rows_by_name(log: Log) -> dict[str, list[LogRow]]:
    """Return the rows of a log by the names of their pictures in lower case, without folders."""
    by_name = defaultdict(list)
    for row in log.rows:
        if row.file:
            by_name[path_parts(row.file)[-1]].append(row)
    return dict(by_name)


def path_parts(path: str) -> tuple[str, ...]:
    """Return the folders and the name of a path of any system in lower case."""
    return tuple(part.strip().casefold() for part in path.replace("\\", "/").split("/") if part.strip()) or ("",)


def nearest_in_folders(path: Sequence[str], candidates: Sequence[Sequence[str]]) -> list[int]:
    """Return the numbers of the candidates that share most folders with a path, counted from its end; all are by `path_parts`.

    Names themselves are not compared, as one of them may lack its suffix.
    """
    shared = [_common_tail(path[:-1], candidate[:-1]) for candidate in candidates]
    return [i for i, count in enumerate(shared) if count == max(shared)]


def _common_tail(a: Sequence[str], b: Sequence[str]) -> int:
    count = 0
    while count < min(len(a), len(b)) and a[-1 - count] == b[-1 - count]:
        count += 1
    return count


def moments(log: Log) -> tuple[list[TelemetryEntry], str | None]:
    """Return the entries of a log that have a clock, with their clock as their time; and a note about moments listed twice.

    A clock in whole seconds gets its fraction from the column of elapsed time.
    """
    known = [row.entry for row in log.rows if row.entry.clock is not None]
    clocks = np.array([entry.clock for entry in known], np.float64)
    times = np.array([entry.time for entry in known], np.float64)
    if len(known) > 1 and np.isfinite(times).all() and (clocks == np.floor(clocks)).all():
        # Whole seconds are rounded down, so the largest difference is nearest to the clock's true lead over the elapsed time.
        lead = clocks - times
        if float(np.ptp(lead)) <= 1.0:
            clocks = times + lead.max()
    return _distinct([replace(entry, time=float(clock)) for entry, clock in zip(known, clocks, strict=True)], log.name)


def _distinct(entries: Sequence[TelemetryEntry], name: str) -> tuple[list[TelemetryEntry], str | None]:
    """Return the first entry of each moment, in the order of time, and a note if others of that moment are elsewhere."""
    first: dict[float, TelemetryEntry] = {}
    twice = set()
    for entry in entries:
        kept = first.setdefault(entry.time, entry)
        if (kept.latitude, kept.longitude) != (entry.latitude, entry.longitude):
            if kept.latitude is None:
                first[entry.time] = entry
            elif entry.latitude is not None:
                twice.add(entry.time)
    note = (
        f"{len(twice)} of {len(first)} moments of {name} are listed more than once with different positions; the first row of "
        "each was used."
    )
    return sorted(first.values(), key=lambda entry: entry.time), note if twice else None


def for_video(log: Log, number: int, began: float | None = None) -> tuple[list[TelemetryEntry], list[str]]:
    """Return the entries of a log's recording with times from its start, and notes such as that its start is a guess.

    Args:
        number: of the recording in a log that tells when the drone recorded, from 0.
        began: the video's start in seconds since 1970-01-01 in UTC, where its file says it.

    Raises:
        DataError: if the log has no times, or fewer recordings.
    """
    clocks = [row.entry.clock if math.isnan(row.entry.time) else row.entry.time for row in log.rows]
    timed = [(row, time) for row, time in zip(log.rows, clocks, strict=True) if time is not None]
    if not timed:
        raise DataError(f"{log.name} has no times, so it does not fit a video; expected a column time or datetime.")
    starts = [i for i, (row, _) in enumerate(timed) if row.recording and not (i and timed[i - 1][0].recording)]
    ends = [next((j for j in range(i, len(timed)) if not timed[j][0].recording), len(timed)) for i in starts]
    notes, start = [], None
    if not any(row.recording is not None for row, _ in timed):
        starts, ends, number = [0], [len(timed)], 0
        start, note = _start(log, began, timed)
        notes.append(note)
    if number >= len(starts):
        raise DataError(
            f"{log.name} has {len(starts)} recordings, and this is video {number + 1}; give the log of this flight."
        )
    first, end = starts[number], ends[number]
    if start is None and timed[end - 1][1] - timed[first][1] < _LEAST_RECORDING:
        end = starts[number + 1] if number + 1 < len(starts) else len(timed)
        notes.append(f"{log.name} has the start of the video but not its length; all rows from there on were used.")
    start = timed[first][1] if start is None else start
    entries, note_of_twice = _distinct(
        [replace(row.entry, time=time - start) for row, time in timed[first:end]], log.name
    )
    return entries, notes + ([] if note_of_twice is None else [note_of_twice])


def _start(log: Log, began: float | None, timed: Sequence[tuple[LogRow, float]]) -> tuple[float | None, str]:
    """Return the elapsed time in a log at which a video began, by the time in the video's file, or None; and a note."""
    known = [(row.entry.clock, time) for row, time in timed if row.entry.clock is not None]
    if began is not None and log.utc and known and known[0][0] <= began <= known[-1][0]:
        clock, time = min(known, key=lambda pair: abs(pair[0] - began))
        return (
            time + began - clock,
            f"The time in the video's file says where in {log.name} it began; that clock may be wrong.",
        )
    return None, f"{log.name} does not say when the video began; its first row counts as the beginning."


@dataclass(frozen=True)
class _Cells:
    """The cells of one row, with the place of the row for messages."""

    table: LogTable
    cells: Sequence[str]
    where: str

    def text(self, what: str) -> str:
        """Return the text of a value, "" for one that is unknown."""
        return self.table.text(self.cells, what)

    def value(self, what: str) -> float | None:
        """Return a value in metres or degrees, pitch and roll from -180 to 180; None if it is unknown."""
        text = self.text(what)
        if not text:
            return None
        value = values.number(text if text.isascii() else values.plain(text), self.table.commas)
        if value is None or not math.isfinite(value):
            raise DataError(
                f"{self.where} has the {what.replace('_', ' ')} {printable(text)[:80]!r}; expected a number."
            )
        if what == "heading" and value in _NO_HEADING:
            return None
        # A unit in the cell counts in place of the column's.
        value = value if text[-1].isalpha() or text[-1] == "°" else value * self.table.columns.factors[what]
        return wrap_degrees(value) if what in _TILTS and 180 < abs(value) <= _TURN[1] else value

    def value_or_nan(self, what: str) -> float:
        """Return a value as `value` does; NaN if it is unknown or no number."""
        try:
            value = self.value(what)
        except DataError:
            return math.nan
        return math.nan if value is None else value

    def angle(self, what: str, letters: str) -> float | None:
        """Return degrees of a coordinate, with the letter of its own column if it has one; None if it is unknown."""
        text = self.text(what)
        if not text:
            return None
        angle = values.angle(text, letters, self.table.commas)
        if angle is None and "e" in text.casefold():
            angle = values.number(text, self.table.commas)
        if angle is None or not math.isfinite(angle):
            raise DataError(f"{self.where} has the {what} {printable(text)[:80]!r}; expected a number of degrees.")
        angle *= self.table.columns.factors.get(what, 1.0)
        if what in self.table.columns.negative and not values.letter_of(text):
            angle = -angle
        letter = self.text(f"{what}_letter")[:1].upper()
        return -abs(angle) if letter and letter == letters[1] else angle

    def coordinates(self) -> tuple[float | None, float | None]:
        """Return latitude and longitude; both None if either is unknown."""
        if "position" not in self.table.columns.places:
            latitude, longitude = self.angle("latitude", "NS"), self.angle("longitude", "EW")
            return (None, None) if latitude is None or longitude is None else (latitude, longitude)
        text = self.text("position")
        if not text:
            return None, None
        parts = re.split(r"\s*;\s*|\s*,\s+|\s*,(?=\s*[-+]?\d)|(?<=[NS])\s+", text, maxsplit=1)
        parts = parts if len(parts) == 2 else text.split()
        angles = [values.angle(part, letters) for part, letters in zip(parts, ("NS", "EW"), strict=False)]
        if len(parts) != 2 or angles[0] is None or angles[1] is None:
            raise DataError(
                f"{self.where} has the position {printable(text)[:80]!r}; expected a latitude and a longitude."
            )
        return angles[0], angles[1]


def _with_hemispheres(table: LogTable, name: str) -> LogTable:
    """Leave out of `negative` each column in which a number has a sign, or all have letters; a note names the others."""
    negative = []
    for what in sorted(table.columns.negative):
        texts = [text for _, cells in table.rows if (text := table.text(cells, what))]
        is_signed = any(values.plain(text).strip().startswith(("-", "+")) for text in texts)
        if not is_signed and not all(map(values.letter_of, texts)):
            negative.append(what)
    notes = [
        f"The numbers in the column {printable(table.header[table.columns.places[what]])} of {name} have no signs, and count as "
        "negative, as its name says."
        for what in negative
    ]
    columns = replace(table.columns, negative=frozenset(negative))
    return replace(table, columns=columns, notes=[*table.notes, *notes])


def _positions(table: LogTable, name: str) -> tuple[list[tuple[float | None, float | None]], list[str], bool]:
    """Return the rows' positions in degrees, None where unknown, notes on how they were read, and whether they were scaled."""
    rows = [_Cells(table, cells, f"Line {line} of {name}") for line, cells in table.rows]
    degrees = np.array([row.coordinates() for row in rows], np.float64)
    degrees[(degrees == 0).all(axis=1)] = np.nan
    known = ~np.isnan(degrees[:, 0])
    notes, is_scaled = [], False
    latitudes, longitudes = degrees[known].T
    size = np.abs(degrees[known]).max(axis=0) if known.any() else np.zeros(2)
    whole = bool(known.any() and (degrees[known] == np.floor(degrees[known])).all())
    texts = [row.text("latitude") for row, is_known in zip(rows, known, strict=True) if is_known]
    if whole and size.max() > _LEAST_SCALED and size[0] <= 90 * _SCALED and size[1] <= 180 * _SCALED:
        degrees, is_scaled = degrees / _SCALED, True
        notes.append(f"The positions of {name} are whole numbers and count as degrees times 1e7, as in MAVLink.")
    elif not whole and _are_minutes(latitudes, 90) and _are_minutes(longitudes, 180):
        degrees = np.sign(degrees) * (np.abs(degrees) // 100 + np.abs(degrees) % 100 / 60)
        notes.append(f"The positions of {name} count as degrees and minutes, ddmm.mmmm, as in NMEA.")
    elif size[0] > 90 and size[1] <= 90 and size[0] <= 180 and len(latitudes) > 1 and (np.abs(latitudes) > 90).all():
        degrees = degrees[:, ::-1]
        notes.append(f"Latitude and longitude of {name} are swapped: its latitudes are beyond 90 degrees.")
    elif values.seem_radians(latitudes, longitudes, texts):
        degrees = np.degrees(degrees)
        notes.append(f"The positions of {name} count as radians: as degrees they would be at sea, near 0, 0.")
    beyond = np.flatnonzero((np.abs(degrees) > (90, 180)).any(axis=1))
    if len(beyond) > _MOST_BEYOND * known.sum():
        row, (latitude, longitude) = rows[beyond[0]], degrees[beyond[0]]
        grid = " Eastings and northings of a map are not read; export degrees of WGS 84." if size.min() > 1000 else ""
        raise DataError(
            f"{row.where} has the position {latitude:g}, {longitude:g}; expected degrees, latitude from -90 to 90.{grid}"
        )
    if len(beyond):
        degrees[beyond] = np.nan
        first = table.rows[beyond[0]][0]
        notes.append(
            f"{len(beyond)} positions of {name} are none on the Earth and were not used, first in line {first}."
        )
    places = [
        (None, None) if math.isnan(latitude) else (latitude, longitude) for latitude, longitude in degrees.tolist()
    ]
    return places, notes, is_scaled


def _with_mavlink_units(table: LogTable, name: str, is_scaled: bool) -> LogTable:
    """Read columns of whole numbers in MAVLink's units: heights in millimetres, headings in hundredths of degrees.

    Where positions are not scaled, only a column `hdg` is read so, if half of its numbers exceed a turn; a note says so.
    """
    factors, notes = dict(table.columns.factors), list(table.notes)
    header = table.header[table.columns.places["heading"]] if "heading" in table.columns.places else ""
    is_hdg = _MAVLINK_HEADING.fullmatch(header) is not None
    if is_scaled:
        units = (
            ("altitude", 1000.0, 0.001),
            ("height_above_takeoff", 1000.0, 0.001),
            ("heading", 0.0 if is_hdg else 360.0, 0.01),
        )
        factors |= {what: factor for what, most, factor in units if _share_of_large(table, what, most) > 0}
    elif is_hdg and _share_of_large(table, "heading", 360.0) >= 0.5:
        factors["heading"] = 0.01
        notes.append(f"The column {printable(header)} of {name} counts as hundredths of degrees, as in MAVLink.")
    return replace(table, columns=replace(table.columns, factors=factors), notes=notes)


def _share_of_large(table: LogTable, what: str, most: float) -> float:
    """Return the share of a column's numbers that are larger than `most`; 0 unless all are whole, and the column has no unit."""
    if what not in table.columns.places or what in table.columns.with_unit:
        return 0.0
    numbers = _column(table, what)
    known = numbers[~np.isnan(numbers)]
    return float((np.abs(known) > most).mean()) if len(known) and (known == np.floor(known)).all() else 0.0


def _column(table: LogTable, what: str) -> Float64Array:
    """Return a column's values, (N,), as `_Cells.value` does; NaN for those that are unknown or no numbers."""
    return np.array([_Cells(table, cells, "").value_or_nan(what) for _, cells in table.rows], np.float64)


def _with_possible_angles(table: LogTable, name: str) -> LogTable:
    """Leave out angles out of their range, or their column, and a gimbal's pitch that looks up throughout; notes name them."""
    columns = dict(table.columns.places)
    notes, rows = list(table.notes), list(table.rows)
    for what in [what for what in _RANGES if what in columns]:
        angles = _column(table, what)
        known = angles[~np.isnan(angles)]
        whole = what in _HEADINGS and bool((known == np.floor(known)).all())
        least, most = _WHOLE_TURNS if whole else _RANGES[what]
        beyond, possible = np.flatnonzero((angles < least) | (angles > most)), known[(known >= least) & (known <= most)]
        is_fov = what == "fov"
        noun = f"field{{}} of view from {least:g} to {most:g} degrees" if is_fov else "angle{} in degrees"
        column = f"column {printable(table.header[columns[what]])} of {name}"
        if len(beyond) > max(_MOST_BEYOND * len(known), 1 if len(known) >= _SEVERAL else 0):
            hint = "" if is_fov else "; another unit is named behind a column, as in [cdeg]"
            why = f"holds {max(angles[beyond].tolist(), key=abs):g}, which is no {noun.format('')}{hint}"
        elif what == "gimbal_pitch" and len(possible) and possible.min() > _LOOKS_UP:
            why = (
                f"looks up by {possible.min():g} degrees and more, where -90 should be straight down; --pitch tells it"
            )
        else:
            if len(beyond):
                notes.append(
                    f"{len(beyond)} of {len(known)} values of the {column} are no {noun.format('s')} and were not used, first "
                    f"in line {table.rows[beyond[0]][0]}."
                )
            for i in beyond:
                line, cells = rows[i]
                rows[i] = line, [*cells[: columns[what]], "", *cells[columns[what] + 1 :]]
            continue
        notes.append(f"The {column} was left out: it {why}.")
        del columns[what]
    return replace(table, columns=replace(table.columns, places=columns), rows=rows, notes=notes)


def _are_minutes(degrees: Float64Array, most: int) -> bool:
    """Return whether angles are degrees and minutes as ddmm.mmmm: beyond the degrees of the Earth, with minutes below 60."""
    size = np.abs(degrees)
    return bool(len(size) and size.max() > 180 and size.max() < 100 * most + 60 and (size % 100 < 60).all())


def _row(entry: TelemetryEntry, cells: _Cells, line: int) -> LogRow:
    entry = replace(
        entry,
        height_above_ground=cells.value("height_above_ground"),
        height_above_takeoff=cells.value("height_above_takeoff"),
        altitude=_signed(cells.value("altitude"), cells.text("below")),
        fov=cells.value("fov"),
    )
    entry = _with_angles(entry, cells.value, cells.table.columns.nadir_zero)
    return LogRow(entry, cells.text("file") or None, _flag(cells.text("is_video")), line)


def _with_angles(entry: TelemetryEntry, value: Callable[[str], float | None], nadir_zero: bool) -> TelemetryEntry:
    """Return an entry with the gimbal's angles; those that are all 0 are unknown, and the aircraft's heading counts."""
    yaw, pitch, roll = value("gimbal_heading"), value("gimbal_pitch"), value("gimbal_roll")
    if yaw is not None and (yaw or pitch or roll):
        if pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        return replace(entry, heading=yaw % 360.0, heading_source="gimbal", pitch=pitch, roll=roll)
    flown, nose, bank = value("heading"), value("nose"), value("bank")
    if (looked := value("direction")) is not None:
        return replace(entry, heading=looked % 360.0, heading_source="camera", pitch=pitch or None)
    if flown is None:
        return replace(entry, pitch=pitch or None)
    pitch = (pitch or None) if nose is None else nose - 90.0
    source: HeadingSource = "camera" if nadir_zero else "aircraft"
    return replace(entry, heading=flown % 360.0, heading_source=source, pitch=pitch, roll=bank)


def _signed(altitude: float | None, reference: str) -> float | None:
    """Return an altitude with the sign that EXIF's GPSAltitudeRef gives it: 1, or "Below Sea Level"."""
    below = reference.strip() == "1" or reference.strip().casefold().startswith("below")
    return -abs(altitude) if altitude is not None and below else altitude


def _flag(text: str) -> bool | None:
    return None if not text else text.casefold() in ("1", "true", "yes")
