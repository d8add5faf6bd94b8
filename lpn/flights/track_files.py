"""Tracks as GPX, KML, and KMZ, read as logs of moments; waypoints that are named as pictures are rows of those pictures.

gpxpy reads GPX. KML is read element by element: gx:Track, points with a time (TimeStamp, TimeSpan, or among their data), lines
with a time for each point, and points that are named as pictures. Other lines have no times, so they fit nothing. Heights count
as their altitudeMode says; without one they are altitudes, and 0 is none. A file with a DTD is refused before it is parsed, so
that no entity is expanded. Points before the place where a file is cut off are used, and a note says so.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flights import values
from lpn.flights.log_tables import picture_name
from lpn.flights.log_times import seconds_of
from lpn.flights.logs import Log, LogRow
from lpn.flights.telemetry import TelemetryEntry

if TYPE_CHECKING:
    from gpxpy.gpx import GPX

SUFFIXES = (".gpx", ".kml", ".kmz")
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
        time: str | datetime | None,
        name: str | None,
        height: float | None = None,
    ) -> None:
        """Add a point, if it is on the Earth and has a time or a picture's name."""
        # A comparison with NaN is false.
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            self.outside += 1
            return
        if latitude == longitude == 0:
            return
        clock, zoned = seconds_of(time) if isinstance(time, str) else _seconds(time)
        file = picture_name(name or "")
        if clock is None and file is None:
            self.untimed += 1
            return
        self.zoned |= zoned
        altitude = altitude if altitude is not None and math.isfinite(altitude) else None
        entry = TelemetryEntry(math.nan, clock, latitude, longitude, height, altitude=altitude)
        self.rows.append(LogRow(entry, file))


def read_track(file: Path) -> Log:
    """Read a track.

    Raises:
        DataError: if it is no such file, has a DTD, or has no point with a position.
    """
    name = printable(file.name)
    return parse_track(values.read_limited(file, _MOST_BYTES, "the track of one flight"), name)


def parse_track(data: bytes, name: str) -> Log:
    """Return the track in the contents of a GPX, KML, or KMZ file; see `read_track`.

    Args:
        name: the file's, for messages.
    """
    text = values.decoded(_unzipped(data, name), name)
    if _DTD.search(text):
        raise DataError(
            f"{name} has a DTD or entities, which no track needs, so it was not read; save it without them."
        )
    text = _without_prefix(text[max(text.find("<"), 0) :])
    text = _ZONE_NAME.sub(r"\1", _BARE_AMPERSAND.sub("&amp;", _DECLARATION.sub("", text)))
    if "<kml" in text:
        points = _kml_points(text, name)
    elif "<gpx" in text:
        points = _gpx_points(text, name)
    else:
        raise DataError(f"{name} is neither GPX nor KML; expected a track with <gpx> or <kml> in it.")
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


def _unzipped(data: bytes, name: str) -> bytes:
    """Return the KML in a KMZ archive, or the contents as they are."""
    if not data.startswith(b"PK"):
        return data
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            inside = next((entry for entry in archive.infolist() if entry.filename.lower().endswith(".kml")), None)
            if inside is None:
                raise DataError(f"{name} has no .kml in it; expected a KMZ archive.")
            if inside.file_size > _MOST_BYTES:
                raise DataError(
                    f"{name} holds more than {_MOST_BYTES // 1_000_000} MB; expected the track of one flight."
                )
            with archive.open(inside) as opened:
                return opened.read(_MOST_BYTES)
    except (
        zipfile.BadZipFile,
        OSError,
        ValueError,
        RuntimeError,
        NotImplementedError,
        EOFError,
        zlib.error,
    ) as error:
        raise DataError(f"{name} is a damaged archive; make it again.") from error


def _gpx_points(text: str, name: str) -> _Points:
    points = _Points()
    if _COMMA_DEGREES.search(text):
        text = _COMMA_DEGREES.sub(r"\1.\2", text)
        points.notes.append(f"The commas within numbers of {name} count as decimal commas: 47,301 is 47.301.")
    gpx = _parsed(text)
    if gpx is None:
        gpx = _without_rest(text, name)
        points.notes.append(_cut_note(name))
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


def _cut_note(name: str) -> str:
    return f"{name} is cut off or damaged; only its points before the damage were used."


def _kml_points(text: str, name: str) -> _Points:
    points = _Points()
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    parents: list[ElementTree.Element] = []
    angles = False
    try:
        parser.feed(text)
        parser.close()
    except ElementTree.ParseError:
        points.notes.append(_cut_note(name))
    try:
        for event, element in parser.read_events():
            if event == "start":
                parents.append(element)
                continue
            parents.pop()
            angles |= _tag(element) == "angles" and any(map(values.number, (element.text or "").split()))
            _add_element(element, parents[-1] if parents else None, points)
    except ElementTree.ParseError:
        pass  # the note is there already
    if angles:
        points.notes.append(
            f"The gx:angles of {name} turn the model that moves along its track, not a camera, and were not read."
        )
    return points


def _add_element(element: ElementTree.Element, parent: ElementTree.Element | None, points: _Points) -> None:
    """Add the points of a KML element that is complete, and forget what is in it."""
    tag = _tag(element)
    if tag == "Track":
        # A gx:MultiTrack has one mode for its tracks.
        mode = _mode(element) or ("" if parent is None else _mode(parent))
        parts = [(child.text or "", _tag(child)) for child in element if _tag(child) in ("when", "coord")]
        times, places = ([text for text, kind in parts if kind == wanted] for wanted in ("when", "coord"))
        pairs = list(zip(times, places, strict=False))
        if len(times) != len(places):
            # A place belongs to the time right before it; no other pairs are certain.
            steps = zip([("", ""), *parts], parts, strict=False)
            pairs = [
                (before if kind == "when" else "", text)
                for (before, kind), (text, wanted) in steps
                if wanted == "coord"
            ]
        for time, place in pairs:
            _add(points, place.split(), time, None, mode)
        element.clear()
    elif tag == "Placemark":
        inside = list(element.iter())
        name = next((child.text for child in inside if _tag(child) == "name"), None)
        located = list(_coordinates(element))
        moments = [child.text for child in inside if _tag(child) == "when"] or [
            next((child.text for child in inside if _tag(child) == "begin"), None) or _time_in_data(inside)
        ]
        # One time is that of a point; a line has one for each of its points, or none that can be told.
        moments = moments if len(moments) == len(located) else [None] * len(located)
        for (place, mode), moment in zip(located, moments, strict=True):
            _add(points, place.split(","), moment, name, mode)
        element.clear()


def _coordinates(element: ElementTree.Element, mode: str = "") -> Iterator[tuple[str, str]]:
    """Yield each place below a KML element with its altitudeMode: that of its own geometry, else of the one around it."""
    waiting = [(element, mode)]
    while waiting:
        here, mode = waiting.pop()
        if _tag(here) == "coordinates":
            yield from ((place, mode) for place in _after_comma(here.text).split())
        mode = _mode(here) or mode
        waiting += [(child, mode) for child in reversed(here)]


def _after_comma(text: str | None) -> str:
    """Return coordinates without the spaces behind their commas, which some programs write."""
    return re.sub(r",\s+", ",", text or "")


def _time_in_data(inside: list[ElementTree.Element]) -> str | None:
    """Return the time among a placemark's own data, such as <Data name="time"><value>...</value></Data>."""
    for child in inside:
        if _tag(child) in ("Data", "SimpleData") and re.search(r"time|date|when", child.get("name", ""), re.IGNORECASE):
            return next((value.text for value in child.iter() if value.text and value.text.strip()), None)
    return None


def _mode(element: ElementTree.Element) -> str:
    """Return what the heights of a KML element are measured from: "absolute", "relativeToGround", or other words."""
    return next(((child.text or "").strip() for child in element if _tag(child) == "altitudeMode"), "")


def _add(points: _Points, numbers: list[str], time: str | None, name: str | None, mode: str) -> None:
    """Add a point of longitude, latitude, and height; one that is no number is left out and counted."""
    if len(numbers) > 3:
        raise DataError(
            f"A track has the coordinates {printable(','.join(numbers))[:60]}; expected longitude, latitude, and height "
            "with points as decimal signs, so export it again."
        )
    coordinates = [values.number(number) for number in numbers[:3]]
    if len(coordinates) < 2 or coordinates[0] is None or coordinates[1] is None:
        points.untimed += 1
        return
    height = coordinates[2] if len(coordinates) > 2 else None
    altitude = height if mode == "absolute" or (not mode and height) else None
    above_ground = height if mode == "relativeToGround" else None
    points.add(coordinates[1], coordinates[0], altitude, time, name, above_ground)


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _seconds(time: datetime | None) -> tuple[float | None, bool]:
    if time is None:
        return None, False
    try:
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp(), time.tzinfo is not None
    except (ValueError, OverflowError):
        return None, False
