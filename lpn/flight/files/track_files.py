"""GPX tracks, read as logs of moments; waypoints that are named as pictures are rows of those pictures.

gpxpy reads them. A file with a DTD is refused before it is parsed, so that no entity is expanded. Points before the place where a
file is cut off are used, and a note says so.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import values
from lpn.flight.files.log_tables import picture_name
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.telemetry import TelemetryEntry

if TYPE_CHECKING:
    from gpxpy.gpx import GPX

SUFFIXES = (".gpx",)
_MOST_BYTES = 100_000_000
# A damaged track is tried again so often with less of it, point by point below so many letters.
_MOST_TRIES, _SHORT = 20, 4000
_DTD = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_BARE_AMPERSAND = re.compile(r"&(?!#?\w{1,10};)")
# Java writes the name of a zone behind its offset: 2022-03-27T15:32:37+02:00[Europe/Brussels].
_ZONE_NAME = re.compile(r"((?:Z|[-+]\d\d:\d\d))\[[A-Za-z_/+-]{1,40}\](?=\s*<)")
_COMMA_DEGREES = re.compile(r"""((?:(?:lat|lon)=["']|<ele>\s*)[-+]?\d{1,5}),(\d+\s*["'<])""")


@dataclass
class _Points:
    """The points of a track: rows, whether a time has a zone, points without a time or a name, and notes."""

    rows: list[LogRow] = field(default_factory=list)
    zoned: bool = False
    untimed: int = 0
    outside: int = 0
    notes: list[str] = field(default_factory=list)

    def add(
        self,
        latitude: float,
        longitude: float,
        altitude: float | None,
        time: datetime | None,
        name: str | None,
    ) -> None:
        """Add a point, if it is on the Earth and has a time or a picture's name."""
        # A comparison with NaN is false.
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            self.outside += 1
            return
        if latitude == longitude == 0:
            return
        clock, zoned = _seconds(time)
        file = picture_name(name or "")
        if clock is None and file is None:
            self.untimed += 1
            return
        self.zoned |= zoned
        altitude = altitude if altitude is not None and math.isfinite(altitude) else None
        entry = TelemetryEntry(math.nan, clock, latitude, longitude, altitude=altitude)
        self.rows.append(LogRow(entry, file))


def read_track(file: Path) -> Log:
    """Read a track.

    Raises:
        DataError: if it is no such file, has a DTD, or has no point with a position.
    """
    name = printable(file.name)
    return parse_track(values.read_limited(file, _MOST_BYTES, "the track of one flight"), name)


def parse_track(data: bytes, name: str) -> Log:
    """Return the track in the contents of a GPX file; see `read_track`.

    Args:
        name: the file's, for messages.
    """
    text = values.decoded(data, name)
    if _DTD.search(text):
        raise DataError(
            f"{name} has a DTD or entities, which no track needs, so it was not read; save it without them."
        )
    text = _without_prefix(text[max(text.find("<"), 0) :])
    text = _ZONE_NAME.sub(r"\1", _BARE_AMPERSAND.sub("&amp;", _DECLARATION.sub("", text)))
    if "<gpx" not in text:
        raise DataError(f"{name} is no GPX; expected a track with <gpx> in it.")
    points = _gpx_points(text, name)
    if points.untimed:
        points.notes.append(
            f"{points.untimed} points of {name} have no time, and were left out."
            if points.rows
            else f"{name} has {points.untimed} points without a time, so it fits no picture; export a track with times."
        )
    elif not points.rows:
        beyond = f" Its {points.outside} positions are outside of the Earth's degrees." if points.outside else ""
        raise DataError(f"{name} has no point with a position; expected a track.{beyond}")
    if points.outside:
        points.notes.append(f"{points.outside} points of {name} are outside of the Earth's degrees, and were left out.")
    return Log(name, tuple(points.rows), points.zoned, tuple(points.notes))


def _without_prefix(text: str) -> str:
    """Return GPX whose elements have no prefix, which gpxpy does not find: <ns2:trkpt> is <trkpt>."""
    root = re.search(r"<(\w{1,40}):gpx\b", text)
    return text if root is None else re.sub(rf"(</?){root[1]}:(?=\w)", r"\1", text)


def _gpx_points(text: str, name: str) -> _Points:
    points = _Points()
    if _COMMA_DEGREES.search(text):
        text = _COMMA_DEGREES.sub(r"\1.\2", text)
        points.notes.append(f"The commas within numbers of {name} count as decimal commas: 47,301 is 47.301.")
    gpx = _parsed(text)
    if gpx is None:
        gpx = _without_rest(text, name)
        points.notes.append(f"{name} is cut off or damaged; only its points before the damage were used.")
    for track in gpx.tracks:
        for segment in track.segments:
            for point in segment.points:
                points.add(point.latitude, point.longitude, point.elevation, point.time, point.name)
    places: list[Any] = [*gpx.waypoints, *(point for route in gpx.routes for point in route.points)]
    for place in places:
        points.add(place.latitude, place.longitude, place.elevation, place.time, place.name)
    return points


def _parsed(text: str) -> GPX | None:
    """Return a GPX document, None if it is damaged."""
    import gpxpy  # its import takes a tenth of a second

    try:
        return gpxpy.parse(text)
    except (gpxpy.gpx.GPXException, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None


def _without_rest(text: str, name: str) -> GPX:
    """Return the track before the damage of a file: up to its last whole point that leaves it readable."""
    closing = "</trkpt>"
    end = text.rfind(closing)
    for _ in range(_MOST_TRIES):
        if end < 0:
            break
        if (gpx := _parsed(text[: end + len(closing)] + "</trkseg></trk></gpx>")) is not None:
            return gpx
        # Damage in the middle: half of what is before it is tried.
        end = text.rfind(closing, 0, end // 2 if end > _SHORT else end)
    raise DataError(f"{name} is damaged, and no point of it can be read; export the track again.")


def _seconds(time: datetime | None) -> tuple[float | None, bool]:
    if time is None:
        return None, False
    try:
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp(), time.tzinfo is not None
    except (ValueError, OverflowError):
        return None, False
