"""GPX tracks, read by gpxpy as logs of moments; waypoints named like pictures are rows of these pictures.

A file with a DTD is refused before it is parsed, so that no entity is expanded.
"""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.log_tables import picture_name
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.telemetry import TelemetryEntry

SUFFIXES = (".gpx",)
_MOST_BYTES = 100_000_000
_DTD = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")


def read_track(file: Path) -> Log:
    """Read a track.

    Raises:
        DataError: if it is no GPX file, is damaged, has a DTD, or has no point with a position.
    """
    name = printable(file.name)
    return parse_track(values.read_limited(file, _MOST_BYTES, "the track of one flight"), name)


def parse_track(data: bytes, name: str) -> Log:
    """Parse the contents of a GPX file; see `read_track`.

    Args:
        name: the file's, for messages.
    """
    text = values.decoded(data, name)
    if _DTD.search(text):
        raise DataError(
            f"{name} has a DTD or entities, which no track needs, so it was not read; save it without them."
        )
    if "<gpx" not in text:
        raise DataError(f"{name} is no GPX; expected a track with <gpx> in it.")
    points = _points(_DECLARATION.sub("", text), name)
    on_earth = [point for point in points if abs(point.latitude) <= 90 and abs(point.longitude) <= 180]
    if not on_earth:
        raise DataError(f"{name} has no point with a position on the Earth; expected a track.")
    rows, zoned = [], False
    for point in on_earth:
        time: datetime | None = point.time
        try:
            clock = None if time is None else time.replace(tzinfo=time.tzinfo or UTC).timestamp()
        except (ValueError, OverflowError):
            clock = None
        file = picture_name(point.name or "")
        zoned |= clock is not None and time is not None and time.tzinfo is not None
        if clock is None and file is None:
            continue
        altitude = None if point.elevation is None or not math.isfinite(point.elevation) else point.elevation
        rows.append(LogRow(TelemetryEntry(math.nan, clock, point.latitude, point.longitude, altitude=altitude), file))
    notes = []
    if outside := len(points) - len(on_earth):
        notes.append(f"{outside} points of {name} are outside of the Earth's degrees, and were left out.")
    if not rows:
        notes.append(
            f"{name} has {len(on_earth)} points without a time, so it fits no picture; export a track with times."
        )
    elif untimed := len(on_earth) - len(rows):
        notes.append(f"{untimed} points of {name} have no time, and were left out.")
    return Log(name, tuple(rows), zoned, tuple(notes))


def _points(text: str, name: str) -> list[Any]:
    """Return the points of tracks, waypoints, and routes, except at (0, 0), which means unknown."""
    import gpxpy  # its import takes a tenth of a second

    try:
        gpx = gpxpy.parse(text)
    except (gpxpy.gpx.GPXException, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(f"{name} is cut off or damaged, so it was not read; export the track again.") from error
    points: list[Any] = [point for track in gpx.tracks for segment in track.segments for point in segment.points]
    points += [*gpx.waypoints, *(point for route in gpx.routes for point in route.points)]
    return [point for point in points if point.latitude or point.longitude]
