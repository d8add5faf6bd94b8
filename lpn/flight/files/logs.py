"""Logs of a flight as tables and tracks: one row a picture, or one row a moment.

`lpn.flight.files.dialects` has the formats of tables. Positions must be degrees on the Earth; without a unit, values are metres,
degrees, and seconds. Tracks are GPX. A waypoint that is named like a picture is the row of this picture.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import cameras, values
from lpn.flight.files.dialects import GRID, LogTable, picture_name, table_of
from lpn.flight.files.telemetry import Log, TelemetryEntry, entry_of

SUFFIXES = (".csv", ".tsv", ".txt", ".pos", ".log", ".gpx")
_MOST_BYTES = 200_000_000
_HEIGHTS = ("height_above_ground", "height_above_takeoff", "altitude")
# The range of each angle in degrees. A gimbal's pitch that is always larger follows another convention.
_ANGLES = {
    **dict.fromkeys(("heading", "gimbal_heading", "direction"), (-360.0, 360.0)),
    **dict.fromkeys(("gimbal_pitch", "gimbal_roll", "nose", "bank"), (-180.0, 180.0)),
}
_RANGES = {"latitude": (-90.0, 90.0), "longitude": (-180.0, 180.0), **_ANGLES, "fov": cameras.FOV_RANGE}
_LOOKS_UP = 30.0
# If a larger share of the positions, or of a column's angles, lies beyond its range, all of them are in doubt.
_MOST_BEYOND = 0.1
# A recording shorter than this, in seconds, marks only the beginning of a video.
_LEAST_RECORDING = 1.5
# Range of epochs in seconds. Larger ones are in milli-, micro-, or nanoseconds; smaller numbers count from a start.
_EPOCHS = (1e9, 1e11)
_DTD = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_UTC = re.compile("utc|gmt", re.IGNORECASE)
_DAY_OR_MONTH = re.compile(r"(\d{1,2})[-/](\d{1,2})")
# Positions from here on are eastings and northings of a map, or degrees times 1e7.
_LEAST_GRID, _LEAST_SCALED = 1e3, 2e7
_SWAPPED = " Check that latitude and longitude are not exchanged."
_SCALED = " Name another unit behind a column, as in lat (degE7)."


def read_log(file: Path) -> Log:
    """Read a table or a GPX track.

    Raises:
        DataError: if it is damaged or of no known dialect, or a value is no number or no position; the message quotes the first
            line, or names the line of the value.
    """
    name = printable(file.name)
    data = values.read_limited(file, _MOST_BYTES, "a log of one flight")
    if file.suffix.lower() == ".txt" and b"\x00" in data[:1000] and data[:2] not in (b"\xff\xfe", b"\xfe\xff"):
        raise DataError(
            f"{name} is no text. A flight record of DJI's app is encrypted; convert it to .csv with Airdata or PhantomHelp."
        )
    text = values.decoded(data, name)
    return parse_track(text, name) if file.suffix.lower() == ".gpx" else _log_of(table_of(text, name))


def _log_of(table: LogTable) -> Log:
    notes = list(table.notes)
    columns = {what: table.numbers(what) for what in (*_HEIGHTS, *_RANGES) if what in table.columns}
    notes += _unit_notes(table, columns)
    for what in [what for what in _RANGES if what in columns]:
        notes += _clean(table, columns, what)
    clocks, utc = _clocks(table, notes)
    count = len(table.lines)
    if unfixed := sum(text not in ("", table.dialect.fixed) for text in table.text("quality")):
        notes.append(
            f"{unfixed} of {count} rows of {table.name} have no fixed RTK solution ({table.columns['quality'].name} is not "
            f"{table.dialect.fixed}), so they may be off by metres."
        )
    if "altitude" in columns:
        below = [text == "1" or text.casefold().startswith("below") for text in table.text("below")]
        columns["altitude"] = np.where(below, -np.abs(columns["altitude"]), columns["altitude"])
    entries = []
    times, pictures = table.numbers("time").tolist(), table.text("file")
    for i, video in enumerate(table.text("is_video")):
        told = {what: float(column[i]) for what, column in columns.items()}
        recording = video.casefold() in ("1", "true", "yes") if video else None
        entries.append(entry_of(times[i], clocks[i], told, pictures[i] or None, recording, table.lines[i]))
    if missing := sum(entry.latitude is None for entry in entries):
        notes.append(f"{missing} of {count} rows of {table.name} have no position.")
    return Log(table.name, tuple(entries), utc, tuple(notes))


def _unit_notes(table: LogTable, columns: Mapping[str, Float64Array]) -> Iterator[str]:
    """Yield a note on positions, and one on angles, that may be radians."""
    for kinds, most in ((("latitude", "longitude"), math.pi), (_ANGLES, math.tau)):
        unsaid = [what for what in kinds if what in columns and not table.columns[what].has_unit]
        known = np.concatenate([np.zeros(1), *(columns[what] for what in unsaid)])
        if 0 < np.nanmax(np.abs(known)) <= most:
            names = [table.columns[what].name for what in unsaid]
            yield (
                f"All values of {', '.join(names)} in {table.name} lie within {most:.2f} of 0 and name no unit; they were read "
                f"as degrees. If they are radians, say so in the header, as in {names[0]} (rad)."
            )


def _clean(table: LogTable, columns: dict[str, Float64Array], what: str) -> Iterator[str]:
    """Remove angles beyond their range, or their whole column, and a gimbal's pitch that always looks up; yield notes.

    Raises:
        DataError: if more than a tenth of the positions are not on the Earth.
    """
    angles, (least, most) = columns[what], _RANGES[what]
    if what in _ANGLES and most == 180.0:
        turned = (np.abs(angles) > 180.0) & (np.abs(angles) <= 360.0)
        angles[turned] = wrap_degrees(angles[turned])
    beyond = np.flatnonzero((angles < least) | (angles > most))
    known = int((~np.isnan(angles)).sum())
    is_doubtful = len(beyond) > _MOST_BEYOND * known
    column = f"column {table.columns[what].name} of {table.name}"
    expected = f"from {least:g} to {most:g} degrees"
    if is_doubtful and what in ("latitude", "longitude"):
        first = beyond[0]
        latitude, longitude = columns["latitude"][first], columns["longitude"][first]
        largest = max(abs(latitude), abs(longitude))
        hint = _SCALED
        if largest < _LEAST_SCALED:
            hint = _SWAPPED if largest < _LEAST_GRID else f" {GRID}"
        raise DataError(
            f"Line {table.lines[first]} of {table.name} has the position {latitude:g}, {longitude:g}; expected degrees, latitude "
            f"from -90 to 90.{hint}"
        )
    if is_doubtful:
        del columns[what]
        worst = max(angles[beyond].tolist(), key=abs)
        hint = "" if what == "fov" else "; name another unit behind a column, as in (cdeg)"
        yield f"The {column} was left out: it holds {worst:g}; expected angles {expected}{hint}."
        return
    if len(beyond):
        line = table.lines[beyond[0]]
        yield f"{len(beyond)} of {known} values of the {column}, first in line {line}, were not used; expected {expected}."
        angles[beyond] = np.nan
    if what == "gimbal_pitch" and known and (lowest := np.nanmin(angles)) > _LOOKS_UP:
        del columns[what]
        yield (
            f"The {column} was left out: all its angles look up, by {lowest:g} degrees or more, and -90 should be straight "
            "down; give the pitch with --pitch."
        )


def _clocks(table: LogTable, notes: list[str]) -> tuple[list[float | None], bool]:
    """Return seconds since 1970-01-01 of the rows' dates, None where unknown, and whether they are in UTC."""
    late = table.dialect.before_utc
    utc = late is not None or ("date" in table.columns and bool(_UTC.search(table.columns["date"].name)))
    numbers = table.numbers("date")
    if not np.isnan(numbers).all():
        least, most = _EPOCHS
        while np.nanmax(np.abs(numbers)) > most:
            numbers /= 1000.0
        clocks = [float(number) if least < number < most else None for number in numbers]
        return clocks, utc or any(clock is not None for clock in clocks)
    pairs = zip(table.text("date"), table.text("clock"), strict=True)
    texts = [f"{date} {clock}" if date and clock and ":" not in date else date for date, clock in pairs]
    days = [(int(found[1]), int(found[2])) for text in texts if (found := _DAY_OR_MONTH.match(text))]
    day_first = any(one > 12 for one, _ in days)
    if days and not day_first and all(other <= 12 for _, other in days):
        first = next(text for text in texts if text)
        notes.append(f"The dates of {table.name}, such as {first}, count as month first; no date in it rules that out.")
    if late:
        notes.append(f"The times of {table.name} are GPS time; {late:g} s were subtracted for UTC.")
    parsed = [values.moment(text, day_first) for text in texts]
    clocks = [None if one is None else one.seconds - (late or 0.0) for one in parsed]
    return clocks, utc or any(one is not None and one.zoned for one in parsed)


def parse_track(text: str, name: str) -> Log:
    """Parse a GPX file's text; a DTD is refused before entities are expanded.

    Args:
        name: of the file, for messages.

    Raises:
        DataError: if it is no GPX file, is damaged, has a DTD, or has no point with a position.
    """
    import gpxpy  # its import takes a tenth of a second

    if _DTD.search(text):
        raise DataError(
            f"{name} has a DTD or entities, which no track needs, so it was not read; save it without them."
        )
    if "<gpx" not in text:
        raise DataError(f"{name} is no GPX; expected a track with <gpx> in it.")
    try:
        gpx = gpxpy.parse(_DECLARATION.sub("", text))
    except (gpxpy.gpx.GPXException, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(f"{name} is cut off or damaged, so it was not read; export the track again.") from error
    points: list[Any] = [point for track in gpx.tracks for segment in track.segments for point in segment.points]
    points += gpx.waypoints
    points += [point for route in gpx.routes for point in route.points]
    entries, utc = [], False
    for point in points:
        clock: float | None = None
        if point.time is not None:
            with contextlib.suppress(ValueError, OverflowError):
                clock = point.time.replace(tzinfo=point.time.tzinfo or UTC).timestamp()
                utc |= point.time.tzinfo is not None
        told = {"latitude": point.latitude, "longitude": point.longitude, "altitude": point.elevation}
        entries.append(entry_of(math.nan, clock, told, picture_name(point.name or "")))
    placed = [entry for entry in entries if entry.latitude is not None]
    if not placed:
        raise DataError(f"{name} has no point with a position on the Earth; expected a track.")
    used = [entry for entry in placed if entry.clock is not None or entry.file is not None]
    notes: tuple[str, ...] = ()
    if not used:
        notes = (f"{name} has no point with a time, so it fits no picture; export a track with times.",)
    elif left := len(entries) - len(used):
        notes = (
            f"{left} of {len(entries)} points of {name} have no time, or no position on the Earth, and were left out.",
        )
    return Log(name, tuple(used), utc, notes)


def entries_by_name(log: Log) -> dict[str, list[TelemetryEntry]]:
    """Return the entries of a log by the names of their pictures in lower case, without folders."""
    by_name = defaultdict(list)
    for entry in log.entries:
        if entry.file:
            by_name[path_parts(entry.file)[-1]].append(entry)
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
    most = max(shared, default=0)
    return [i for i, count in enumerate(shared) if count == most]


def moments(log: Log) -> tuple[list[TelemetryEntry], list[str]]:
    """Return the entries with a clock, timed by it, and notes; of equal moments, the first with a position counts.

    A clock in whole seconds gets its fraction from the column of elapsed time.
    """
    known = [entry for entry in log.entries if entry.clock is not None]
    clocks = np.array([entry.clock for entry in known], np.float64)
    times = np.array([entry.time for entry in known], np.float64)
    if len(known) > 1 and np.isfinite(times).all() and (clocks == np.floor(clocks)).all():
        # Whole seconds are rounded down, so the largest difference is nearest to the clock's true lead over the elapsed time.
        lead = clocks - times
        if float(np.ptp(lead)) <= 1.0:
            clocks = times + lead.max()
    return _distinct([replace(entry, time=float(clock)) for entry, clock in zip(known, clocks, strict=True)], log.name)


def _distinct(entries: Sequence[TelemetryEntry], name: str) -> tuple[list[TelemetryEntry], list[str]]:
    first: dict[float, TelemetryEntry] = {}
    twice = set()
    for entry in sorted(entries, key=lambda entry: (entry.time, entry.latitude is None)):
        kept = first.setdefault(entry.time, entry)
        if entry.latitude is not None and (kept.latitude, kept.longitude) != (entry.latitude, entry.longitude):
            twice.add(entry.time)
    note = (
        f"{len(twice)} of {len(first)} moments of {name} are listed more than once with different positions; the first row of "
        "each was used."
    )
    return list(first.values()), [note] if twice else []


def for_video(log: Log, number: int, began: float | None = None) -> tuple[list[TelemetryEntry], list[str]]:
    """Return the entries of a log's recording, timed from its start, and notes; entries of subtitles stay unchanged.

    Args:
        number: of the recording, from 0, in a log that marks recordings.
        began: the video's start in seconds since 1970-01-01 in UTC; None if its file lacks it.

    Raises:
        DataError: if the log has no times, or fewer recordings.
    """
    if log.end is not None:
        return list(log.entries), []
    timed = [
        replace(entry, time=entry.clock) if math.isnan(entry.time) and entry.clock is not None else entry
        for entry in log.entries
    ]
    timed = [entry for entry in timed if not math.isnan(entry.time)]
    if not timed:
        raise DataError(f"{log.name} has no times, so it does not fit a video; expected a column time or datetime.")
    notes = []
    start = timed[0].time
    known = [(entry.clock, entry.time) for entry in timed if entry.clock is not None]
    if any(entry.recording is not None for entry in timed):
        starts = [i for i, entry in enumerate(timed) if entry.recording and not (i and timed[i - 1].recording)]
        if number >= len(starts):
            raise DataError(
                f"{log.name} has {len(starts)} recordings, and this is video {number + 1}; give the log of this flight."
            )
        ends = [*starts[1:], len(timed)]
        following = timed[starts[number] : ends[number]]
        timed = list(itertools.takewhile(lambda entry: entry.recording, following))
        start = timed[0].time
        if timed[-1].time - start < _LEAST_RECORDING:
            timed = following
            notes.append(f"{log.name} has the start of the video but not its length; all rows from there on were used.")
    elif began is not None and log.utc and known and known[0][0] <= began <= known[-1][0]:
        clock, time = min(known, key=lambda pair: abs(pair[0] - began))
        start = time + began - clock
        notes.append(f"The video's start in {log.name} follows from the video file's time; that clock may be wrong.")
    else:
        notes.append(f"{log.name} does not say when the video began; its first row counts as the beginning.")
    entries, twice = _distinct([replace(entry, time=entry.time - start) for entry in timed], log.name)
    return entries, notes + twice
