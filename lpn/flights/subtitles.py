"""DJI's subtitles with telemetry, in a `.SRT` beside a video or inside of it.

    [latitude: 59.30] [longitude: 18.20] [rel_alt: 1.3 abs_alt: 132.8]      bracketed; also longtitude, altitude, gb_yaw
    GPS(149.0251,-20.2533,16) BAROMETER:1.9                                 longitude first, with the number of satellites
    GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M                                latitude first, with a height
    GPS (-58.85, -34.23, 15), D 698.70m, H 85.80m, G.PRY (-24.4°, 0.0°, 110.4°)

rel_alt, BAROMETER, Hb, and H are heights above take-off; abs_alt and altitude are above the sea. (0, 0) is a position before
the first fix, and unknown. A heading is that of the gimbal, else of the aircraft. The time of day has no zone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.flights import cameras
from lpn.flights.base import HeadingSource
from lpn.flights.telemetry import TelemetryEntry

GpsOrder = Literal["lat-lon", "lon-lat"]

_MOST_BYTES = 500_000_000
_NUMBER = r"(-?[0-9]+(?:\.[0-9]+)?)"
_INDEX_LINE = re.compile(r"^[ \t]*[0-9]+[ \t]*$", re.MULTILINE)
_CODES = re.compile(
    r"([0-9]{2,}):([0-9]{2}):([0-9]{2})[,.]([0-9]{3}) *--> *([0-9]{2,}):([0-9]{2}):([0-9]{2})[,.]([0-9]{3})"
)
_CLOCK = re.compile(
    r"([0-9]{4})[-.]([0-9]{1,2})[-.]([0-9]{1,2})[ T]([0-9]{1,2}):([0-9]{2}):([0-9]{2})"
    r"(?:[.,]([0-9]{3}))?(?:,([0-9]{3}))?(?=[,\s]|$)"
)
# A bracket that the file's end cuts off.
_OPEN = re.compile(r"\[[^\]\n]*$", re.MULTILINE)
_NAMED = re.compile(rf"([A-Za-z_]+) ?[:(] ?{_NUMBER}(?=[\s\]),]|M\b)")
_GPS = re.compile(rf"GPS ?\({_NUMBER}, ?{_NUMBER}, ?([^,)]*)\)")
_HOME = re.compile(rf"HOME ?\({_NUMBER}, ?{_NUMBER}[,)]")
_DISTANCE, _HEIGHT = (re.compile(rf"\b{letter} {_NUMBER}(m|ft)\b") for letter in "DH")
_ANGLES = re.compile(rf"\b([FG])\.PRY \({_NUMBER}[^0-9,]*, ?{_NUMBER}[^0-9,]*, ?{_NUMBER}[^0-9,]*\)")
_FOOT = 0.3048
# Zooms from 100 on are in ten-thousandths: [dzoom_ratio: 10000, delta:0].
_LEAST_SCALED, _ZOOM_SCALE = 100.0, 10_000.0
# HOME and D decide the order of GPS(a, b, c) from this many metres on, by this factor of the error.
_FAR, _CLEAR = 50.0, 3.0


@dataclass(frozen=True)
class Subtitles:
    """The telemetry of a subtitle file.

    Attributes:
        end: of the last entry in seconds.
        notes: sentences about what was odd.
    """

    entries: tuple[TelemetryEntry, ...]
    end: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class SubtitleBlock:
    """One subtitle: its text, and its seconds, None in a file without time codes."""

    text: str
    start: float | None
    end: float | None


@dataclass(frozen=True)
class _Triple:
    """GPS(a, b, c) of an entry, with HOME(a, b) and the distance to it in metres, None where there is none."""

    a: float
    b: float
    third: str
    home: tuple[float, float] | None
    distance: float | None


def read_subtitles(file: Path, gps_order: GpsOrder | None = None) -> Subtitles:
    """Read a `.SRT` file; see `parse_subtitles`.

    Raises:
        DataError: also if the file cannot be read or is larger than 500 MB.
    """
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise DataError(f"{printable(file.name)} has more than 500 MB; expected DJI's subtitles.")
        data = file.read_bytes()
    except OSError as error:
        raise DataError(f"{printable(file.name)} cannot be read ({error.strerror or error}); check it.") from error
    return parse_subtitles(blocks_of(data), printable(file.name), gps_order)


def blocks_of(data: bytes) -> list[SubtitleBlock]:
    """Split the contents of a `.SRT` file at the lines that hold an index only."""
    text = data.decode("utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n")
    blocks = []
    for part in _INDEX_LINE.split(text)[1:]:
        codes = _CODES.search(part)
        start, end = (None, None) if codes is None else (_seconds(codes.groups()[:4]), _seconds(codes.groups()[4:]))
        blocks.append(SubtitleBlock(part, start, end))
    return blocks


def parse_subtitles(blocks: Iterable[SubtitleBlock], name: str, gps_order: GpsOrder | None = None) -> Subtitles:
    """Return the telemetry of subtitles in any of DJI's dialects; one file may mix them.

    Args:
        name: the file's, for messages.
        gps_order: order of the first two values in GPS(a, b, c); None finds it out, and a note says how if it was a guess.

    Raises:
        DataError: if no subtitle holds telemetry.
    """
    entries: list[TelemetryEntry] = []
    triples: dict[int, _Triple] = {}
    end, first_clock = 0.0, None
    for block in blocks:
        clock = _clock(block.text)
        first_clock = clock if first_clock is None else first_clock
        start = block.start
        if start is None and clock is not None and first_clock is not None:
            start = clock - first_clock
        if start is None:
            continue
        end = max(end, start if block.end is None else block.end)
        entry, triple = _entry(block.text, start, clock)
        if triple is not None:
            triples[len(entries)] = triple
        entries.append(entry)
    if not any(_tells(entry) for entry in entries) and not triples:
        raise DataError(
            f"{name} holds no telemetry of DJI; expected subtitles such as [latitude: 59.30] or GPS(18.2,59.3,16)."
        )
    notes = []
    if triples:
        order, note = _order(list(triples.values()), entries, gps_order, name)
        notes += [note] if note else []
        for at, triple in triples.items():
            entries[at] = _placed(entries[at], triple, order)
    if missing := sum(entry.latitude is None for entry in entries):
        notes.append(f"{missing} of {len(entries)} entries of {name} have no position.")
    return Subtitles(tuple(entries), end, tuple(notes))


def _seconds(parts: Sequence[str]) -> float:
    hours, minutes, seconds, thousandths = map(int, parts)
    return 3600.0 * hours + 60 * minutes + seconds + thousandths / 1000


def _clock(text: str) -> float | None:
    found = _CLOCK.search(text)
    if found is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
    fraction = int(found[7] or 0) / 1e3 + int(found[8] or 0) / 1e6
    try:
        return datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp() + fraction
    except (ValueError, OverflowError):
        return None


def _entry(text: str, start: float, clock: float | None) -> tuple[TelemetryEntry, _Triple | None]:
    """Parse one subtitle; a position whose order is still open is returned beside it."""
    named: dict[str, str] = dict(_NAMED.findall(_OPEN.sub("", text)))
    latitude, longitude = _place(_value(named, "latitude"), _value(named, "longitude", "longtitude"))
    takeoff = _value(named, "rel_alt", "BAROMETER", "Hb")
    if takeoff is None and (high := _HEIGHT.search(text)):
        takeoff = float(high[1]) * (_FOOT if high[2] == "ft" else 1.0)
    heading, source, pitch, roll = _angles(text, named)
    entry = TelemetryEntry(
        start, clock, latitude, longitude, None, takeoff, _value(named, "abs_alt", "altitude"), heading, source, pitch, roll,
        _fov(named.get("focal_len"), _value(named, "dzoom_ratio")),
    )  # fmt: skip
    return entry, _triple(text)


def _value(named: dict[str, str], *names: str) -> float | None:
    found = next((float(named[name]) for name in names if name in named), math.nan)
    return found if math.isfinite(found) else None


def _triple(text: str) -> _Triple | None:
    found = _GPS.search(text)
    if found is None:
        return None
    home, distance = _HOME.search(text), _DISTANCE.search(text)
    metres = None if distance is None else float(distance[1]) * (_FOOT if distance[2] == "ft" else 1.0)
    return _Triple(
        float(found[1]), float(found[2]), found[3].strip(), (float(home[1]), float(home[2])) if home else None, metres
    )


def _angles(text: str, named: dict[str, str]) -> tuple[float | None, HeadingSource | None, float | None, float | None]:
    """Return heading, its source, pitch, and roll; angles of a gimbal that are all 0 are unknown."""
    turns = {letter: (float(yaw), float(pitch), float(roll)) for letter, pitch, roll, yaw in _ANGLES.findall(text)}
    yaw, pitch = _value(named, "gb_yaw"), _value(named, "gb_pitch")
    gimbal = turns.get("G") or (None if yaw is None or pitch is None else (yaw, pitch, _value(named, "gb_roll") or 0.0))
    if gimbal is not None and any(gimbal):
        heading, pitch, roll = cameras.from_gimbal(*gimbal)
        return heading, "gimbal", pitch, roll
    if "F" in turns and any(turns["F"]):
        return turns["F"][0] % 360.0, "aircraft", None, None
    return None, None, None, None


def _fov(focal_length: str | None, zoom: float | None) -> float | None:
    """Return the field of view of a focal length that is equivalent to one on 35 mm film: "24.00" or, in tenths, "240"."""
    if focal_length is None:
        return None
    equivalent = float(focal_length) / (1.0 if "." in focal_length or len(focal_length) < 3 else 10.0)
    zoom = zoom or 1.0
    equivalent *= max(zoom / _ZOOM_SCALE if zoom >= _LEAST_SCALED else zoom, 1.0)
    return cameras.fov_of_equivalent(equivalent) if 5 <= equivalent <= 1000 else None


def _tells(entry: TelemetryEntry) -> bool:
    return any(
        value is not None
        for value in (entry.latitude, entry.height_above_takeoff, entry.altitude, entry.heading, entry.fov)
    )


def _place(latitude: float | None, longitude: float | None) -> tuple[float | None, float | None]:
    """Return a position, or (None, None) if it is unknown, (0, 0), or none on the Earth."""
    if latitude is None or longitude is None or latitude == longitude == 0:
        return None, None
    return (latitude, longitude) if abs(latitude) <= 90 and abs(longitude) <= 180 else (None, None)


def _placed(entry: TelemetryEntry, triple: _Triple, order: GpsOrder) -> TelemetryEntry:
    """Return an entry with the position of its GPS(a, b, c), and its altitude, if the third value is one."""
    if entry.latitude is not None:
        return entry
    latitude, longitude = _place(*((triple.a, triple.b) if order == "lat-lon" else (triple.b, triple.a)))
    height = re.fullmatch(rf"{_NUMBER}M?", triple.third)
    altitude = entry.altitude
    if altitude is None and height is not None and not _counts_satellites(triple) and float(height[1]):
        altitude = float(height[1])
    return replace(entry, latitude=latitude, longitude=longitude, altitude=altitude)


def _counts_satellites(triple: _Triple) -> bool:
    return triple.third.isascii() and triple.third.isdecimal() and len(triple.third) <= 2


def _order(
    triples: list[_Triple], entries: Sequence[TelemetryEntry], given: GpsOrder | None, name: str
) -> tuple[GpsOrder, str]:
    """Return the order of GPS(a, b, c), and a note if it is a guess.

    Degrees beyond 90 are longitudes. Otherwise positions of the same file in brackets decide, then the distance to HOME. The
    third value is a guess: where it counts satellites, the known cameras write the longitude first.
    """
    if given is not None:
        return given, ""
    a, b = (np.array(values) for values in zip(*((t.a, t.b) for t in triples), strict=True))
    if (np.abs(a) > 90).any() != (np.abs(b) > 90).any():
        return ("lon-lat" if (np.abs(a) > 90).any() else "lat-lon"), ""
    placed = [(entry.latitude, entry.longitude) for entry in entries if entry.latitude is not None]
    if placed:
        latitude, longitude = np.median(np.array(placed, np.float64), axis=0)
        off = abs(np.median(a) - latitude) + abs(np.median(b) - longitude)
        off_swapped = abs(np.median(b) - latitude) + abs(np.median(a) - longitude)
        if max(off, off_swapped) > _CLEAR * min(off, off_swapped):
            return ("lat-lon" if off < off_swapped else "lon-lat"), ""
    if (by_home := _order_by_home(triples)) is not None:
        return by_home, ""
    satellites = sum(map(_counts_satellites, triples)) * 2 > len(triples)
    order: GpsOrder = "lon-lat" if satellites else "lat-lon"
    first, why = ("longitude", "counts satellites") if satellites else ("latitude", "is a height")
    return order, (
        f"The order of latitude and longitude in GPS(a, b, c) of {name} is ambiguous; {first} first was taken, because the third "
        f"value {why}. If that is wrong, give --gps-order {'lat-lon' if satellites else 'lon-lat'}."
    )


def _order_by_home(triples: Sequence[_Triple]) -> GpsOrder | None:
    """Return the order under which positions are as far from HOME as the file says; None if that is unknown or unclear."""
    errors: list[tuple[float, float]] = []
    for triple in triples:
        if triple.home is None or triple.distance is None or triple.distance < _FAR:
            continue
        da, db = triple.a - triple.home[0], triple.b - triple.home[1]
        latitude_first = math.hypot(*_metres(da, db, triple.a))
        longitude_first = math.hypot(*_metres(db, da, triple.b))
        errors.append((abs(latitude_first - triple.distance), abs(longitude_first - triple.distance)))
    if not errors:
        return None
    off, off_swapped = np.median(np.array(errors), axis=0)
    if max(off, off_swapped) <= _CLEAR * min(off, off_swapped):
        return None
    return "lat-lon" if off < off_swapped else "lon-lat"


def _metres(latitudes: float, longitudes: float, latitude: float) -> tuple[float, float]:
    """Return the metres north and east of differences in degrees at a latitude."""
    north, east = geo.metres_per_degree(max(-89.0, min(89.0, latitude)))
    return latitudes * north, longitudes * east
