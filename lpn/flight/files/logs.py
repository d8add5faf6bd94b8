"""Logs of a flight as tables and tracks: one row a picture, or one row a moment.

`lpn.flight.files.dialects` has the formats of tables; `lpn.flight.files.track_files` reads GPX. Positions must be degrees on the
Earth. Without a unit, values are metres, degrees, and seconds.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import cameras, values
from lpn.flight.files.log_tables import GRID, LogTable, table_of
from lpn.flight.files.telemetry import TelemetryEntry

SUFFIXES = (".csv", ".tsv", ".txt", ".pos", ".log")
_MOST_BYTES = 200_000_000
_HEIGHTS = ("height_above_ground", "height_above_takeoff", "altitude")
# The range of each angle in degrees. A gimbal's pitch that is always larger follows another convention.
_ANGLES = {
    **dict.fromkeys(("heading", "gimbal_heading", "direction"), (-360.0, 360.0)),
    **dict.fromkeys(("gimbal_pitch", "gimbal_roll", "nose", "bank"), (-180.0, 180.0)),
    "fov": cameras.FOV_RANGE,
}
_TILTS = ("gimbal_pitch", "gimbal_roll", "nose", "bank")
_LOOKS_UP = 30.0
# Share of positions, or of a column's angles, beyond their range above which all of them are in doubt.
_MOST_BEYOND = 0.1
# A recording shorter than this, in seconds, marks only the beginning of a video.
_LEAST_RECORDING = 1.5
# Range of epochs in seconds. Larger ones are in milli-, micro-, or nanoseconds; smaller numbers count from a start.
_EPOCHS = (1e9, 1e11)
# Positions from here on are eastings and northings of a map, or degrees times 1e7.
_LEAST_GRID, _LEAST_SCALED = 1e3, 2e7
_SWAPPED = " Check that latitude and longitude are not exchanged."
_SCALED = " Another unit is named behind a column, as in lat (degE7)."


@dataclass(frozen=True)
class LogRow:
    """A row of a log.

    Attributes:
        entry: its values; `time` is from its column, else NaN, and `clock` from its date.
        file: its picture; None in a log of moments.
        recording: whether the drone was recording a video; None if unknown.
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
        utc: True if the log names the entries' `clock` as UTC.
        notes: sentences about oddities.
    """

    name: str
    rows: tuple[LogRow, ...]
    utc: bool
    notes: tuple[str, ...]


def read_log(file: Path) -> Log:
    """Read a log that is a table.

    Raises:
        DataError: if it is of no known dialect, or a value is no number or no position; the message quotes the first line, or
            names the line of the value.
    """
    name = printable(file.name)
    data = values.read_limited(file, _MOST_BYTES, "a log of one flight")
    if file.suffix.lower() == ".txt" and b"\x00" in data[:1000] and data[:2] not in (b"\xff\xfe", b"\xfe\xff"):
        raise DataError(
            f"{name} is no text. A flight record of DJI's app is encrypted; convert it to .csv with Airdata or PhantomHelp."
        )
    table = table_of(values.decoded(data, name), name)
    notes = list(table.notes)
    places = _on_earth(table, notes)
    columns = {what: table.numbers(what) for what in (*_HEIGHTS, *_ANGLES) if what in table.columns.places}
    _clean_angles(table, columns, notes)
    clocks, zoned = _clocks(table, notes)
    times = (_numbers(table, table.texts("time")) * table.columns.factors.get("time", 1.0)).tolist()
    fixed = table.columns.dialect.fixed
    if unfixed := sum(text not in ("", fixed) for text in table.texts("quality")):
        column = printable(table.header[table.columns.places["quality"]])
        notes.append(
            f"{unfixed} of {len(places)} rows of {name} have no fixed RTK solution ({column} is not {fixed}), so they may be off "
            "by metres."
        )
    below = [text == "1" or text.casefold().startswith("below") for text in table.texts("below")]
    rows = []
    for i, (text, video, (line, _)) in enumerate(
        zip(table.texts("file"), table.texts("is_video"), table.rows, strict=True)
    ):
        row = {what: None if math.isnan(column[i]) else float(column[i]) for what, column in columns.items()}
        latitude, longitude = (None, None) if math.isnan(places[i, 0]) else places[i].tolist()
        above_ground, above_takeoff, altitude = (row.get(what) for what in _HEIGHTS)
        if below[i] and altitude is not None:
            altitude = -abs(altitude)
        entry = TelemetryEntry(
            times[i], clocks[i], latitude, longitude, above_ground, above_takeoff, altitude, fov=row.get("fov")
        )
        entry = _with_angles(entry, row)
        rows.append(LogRow(entry, text or None, video.casefold() in ("1", "true", "yes") if video else None, line))
    if missing := int(np.isnan(places[:, 0]).sum()):
        notes.append(f"{missing} of {len(rows)} rows of {name} have no position.")
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
    """Return the indices of the candidates that share the most folders with a path, from its end on.

    All are results of `path_parts`. Names of files are not compared, because one may lack its suffix.
    """
    pairs = [zip(path[-2::-1], candidate[-2::-1], strict=False) for candidate in candidates]
    shared = [sum(1 for _ in itertools.takewhile(lambda two: two[0] == two[1], folders)) for folders in pairs]
    return [i for i, count in enumerate(shared) if count == max(shared)]


def moments(log: Log) -> tuple[list[TelemetryEntry], str | None]:
    """Return the entries that have a clock, with it as their time, and a note about moments listed twice.

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
    """Return the first entry of each moment in the order of time, and a note if another of one moment is elsewhere."""
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
    """Return the entries of a log's recording with times from its start, and notes about them.

    Args:
        number: of the recording, from 0, in a log that marks recordings.
        began: the video's start in seconds since 1970-01-01 in UTC; None if its file lacks it.

    Raises:
        DataError: if the log has no times, or fewer recordings.
    """
    clocks = [row.entry.clock if math.isnan(row.entry.time) else row.entry.time for row in log.rows]
    timed = [(row, time) for row, time in zip(log.rows, clocks, strict=True) if time is not None]
    if not timed:
        raise DataError(f"{log.name} has no times, so it does not fit a video; expected a column time or datetime.")
    notes, start = [], None
    if all(row.recording is None for row, _ in timed):
        start, note = _start(log, began, timed)
        notes.append(note)
    else:
        starts = [i for i, (row, _) in enumerate(timed) if row.recording and not (i and timed[i - 1][0].recording)]
        if number >= len(starts):
            raise DataError(
                f"{log.name} has {len(starts)} recordings, and this is video {number + 1}; give the log of this flight."
            )
        following = timed[starts[number] : starts[number + 1] if number + 1 < len(starts) else None]
        timed = list(itertools.takewhile(lambda pair: pair[0].recording, following))
        if timed[-1][1] - timed[0][1] < _LEAST_RECORDING:
            timed = following
            notes.append(f"{log.name} has the start of the video but not its length; all rows from there on were used.")
    start = timed[0][1] if start is None else start
    entries, twice = _distinct([replace(row.entry, time=time - start) for row, time in timed], log.name)
    return entries, notes if twice is None else [*notes, twice]


def _start(log: Log, began: float | None, timed: Sequence[tuple[LogRow, float]]) -> tuple[float | None, str]:
    known = [(row.entry.clock, time) for row, time in timed if row.entry.clock is not None]
    if began is not None and log.utc and known and known[0][0] <= began <= known[-1][0]:
        clock, time = min(known, key=lambda pair: abs(pair[0] - began))
        return (
            time + began - clock,
            f"The time in the video's file says where in {log.name} it began; that clock may be wrong.",
        )
    return None, f"{log.name} does not say when the video began; its first row counts as the beginning."


def _on_earth(table: LogTable, notes: list[str]) -> Float64Array:
    """Return the rows' positions in degrees, (N, 2); positions off the Earth become NaN, with a note."""
    degrees = table.places()
    known = ~np.isnan(degrees[:, 0])
    beyond = np.flatnonzero((np.abs(degrees) > (90, 180)).any(axis=1))
    if len(beyond) > _MOST_BEYOND * known.sum():
        line, (latitude, longitude) = table.rows[beyond[0]][0], degrees[beyond[0]]
        largest = np.abs(degrees[beyond[0]]).max()
        hint = _SWAPPED if largest < _LEAST_GRID else f" {GRID}" if largest < _LEAST_SCALED else _SCALED
        raise DataError(
            f"Line {line} of {table.name} has the position {latitude:g}, {longitude:g}; expected degrees, latitude from -90 to "
            f"90.{hint}"
        )
    if len(beyond):
        degrees[beyond] = np.nan
        first = table.rows[beyond[0]][0]
        notes.append(
            f"{len(beyond)} positions of {table.name} are none on the Earth and were not used, first in line {first}."
        )
    notes += _radians_note(table, {"latitude": degrees[:, 0], "longitude": degrees[:, 1]}, math.pi)
    return degrees


def _radians_note(table: LogTable, columns: Mapping[str, Float64Array], most: float) -> list[str]:
    """Return a note, if any, about columns without a unit that may be radians, because all values are at most `most`."""
    unsaid = [what for what in columns if what in table.columns.unsaid and what != "fov"]
    known = np.concatenate([columns[what] for what in unsaid]) if unsaid else np.zeros(0)
    if np.isnan(known).all() or not 0 < np.nanmax(np.abs(known)) <= most:
        return []
    names = [printable(table.header[table.columns.places[what]]) for what in unsaid]
    return [
        f"All values of {', '.join(names)} in {table.name} lie within {most:.2f} of 0 and name no unit; they were read as "
        f"degrees. If they are radians, say so in the header, as in {names[0]} (rad)."
    ]


def _clean_angles(table: LogTable, columns: dict[str, Float64Array], notes: list[str]) -> None:
    """Remove angles beyond their range, or their whole column, and a gimbal's pitch that always looks up, with notes."""
    notes += _radians_note(table, {what: columns[what] for what in columns if what in _ANGLES}, math.tau)
    for what in [what for what in _ANGLES if what in columns]:
        angles = columns[what]
        if what in _TILTS:
            turned = (np.abs(angles) > 180.0) & (np.abs(angles) <= 360.0)
            angles[turned] = wrap_degrees(angles[turned])
        least, most = _ANGLES[what]
        beyond = (angles < least) | (angles > most)
        known, within = int((~np.isnan(angles)).sum()), angles[(angles >= least) & (angles <= most)]
        column = f"column {printable(table.header[table.columns.places[what]])} of {table.name}"
        expected = f"from {least:g} to {most:g} degrees"
        if beyond.sum() > _MOST_BEYOND * known:
            hint = "" if what == "fov" else "; another unit is named behind a column, as in (cdeg)"
            why = f"holds {max(angles[beyond].tolist(), key=abs):g}, and expected are angles {expected}{hint}"
        elif what == "gimbal_pitch" and len(within) and within.min() > _LOOKS_UP:
            why = f"looks up by {within.min():g} degrees and more, where -90 should be straight down; --pitch tells it"
        else:
            if beyond.any():
                first = table.rows[int(beyond.argmax())][0]
                notes.append(
                    f"{beyond.sum()} of {known} values of the {column} are not {expected} and were not used, first in line "
                    f"{first}."
                )
                angles[beyond] = np.nan
            continue
        notes.append(f"The {column} was left out: it {why}.")
        del columns[what]


def _with_angles(entry: TelemetryEntry, row: Mapping[str, float | None]) -> TelemetryEntry:
    """Return an entry with the angles of the gimbal, camera, or aircraft, in this order; three zeros are unknown."""
    yaw, pitch, roll = (row.get(what) for what in ("gimbal_heading", "gimbal_pitch", "gimbal_roll"))
    if yaw is not None and (yaw or pitch or roll):
        if pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        return replace(entry, heading=yaw % 360.0, heading_source="gimbal", pitch=pitch, roll=roll)
    looked, flown, nose, bank = (row.get(what) for what in ("direction", "heading", "nose", "bank"))
    if nose is not None and looked is not None and not any((looked, nose, bank)):
        looked = nose = bank = None
    entry = replace(entry, pitch=(pitch or None) if nose is None else nose - 90.0, roll=bank)
    if looked is not None:
        return replace(entry, heading=looked % 360.0, heading_source="camera")
    return entry if flown is None else replace(entry, heading=flown % 360.0, heading_source="aircraft")


def _clocks(table: LogTable, notes: list[str]) -> tuple[list[float | None], bool]:
    """Return seconds since 1970-01-01 of the rows' dates, None where unknown, and whether they have a zone."""
    pairs = zip(table.texts("date"), table.texts("clock"), strict=True)
    texts = [f"{date} {clock}" if date and clock and ":" not in date else date for date, clock in pairs]
    numbers = _numbers(table, texts) * table.columns.factors.get("date", 1.0)
    if not np.isnan(numbers).all():
        least, most = _EPOCHS
        while np.nanmax(np.abs(numbers)) > most:
            numbers /= 1000.0
        clocks = [float(number) if least < number < most else None for number in numbers]
        return clocks, any(clock is not None for clock in clocks)
    day_first = any(int(found[1]) > 12 for text in texts if (found := re.match(r"(\d{1,2})[-/]", text)))
    parsed = [values.moment(text, day_first) for text in texts]
    known = [moment for moment in parsed if moment is not None]
    if known and all(moment.ambiguous for moment in known):
        first = next(text for text in texts if text)
        notes.append(f"The dates of {table.name}, such as {first}, count as month first; nothing in it rules that out.")
    late = table.columns.dialect.before_utc or 0.0
    if late:
        notes.append(f"The times of {table.name} are GPS time; {late:g} s were taken off for UTC.")
    return [None if one is None else one.seconds - late for one in parsed], any(moment.zoned for moment in known)


def _numbers(table: LogTable, texts: Sequence[str]) -> Float64Array:
    return np.array([values.number(text, table.commas) for text in texts], np.float64)
