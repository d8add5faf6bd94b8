"""Subtitles with telemetry of drones, in a `.SRT` beside a video or inside of it.

    [latitude: 59.30] [longitude: 18.20] [rel_alt: 1.3 abs_alt: 132.8]      by name; also longtitude, lat=, altitude, gb_yaw
    GPS(149.0251,-20.2533,16) BAROMETER:1.9                                 longitude first, with the number of satellites
    GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M                                latitude first, with a height
    GPS (-58.85, -34.23, 15), D 698.70m, H 85.80m, G.PRY (-24.4°, 0.0°, 110.4°)    RTK in place of GPS with an RTK fix
    GPS(W: 70.5, S: 33.4, 812.5m) ReH:40.0                                  Autel: letters of hemispheres, with an altitude
    N 47°18'04.4" E 8°30'04.4"                                              letters without a name

rel_alt, BAROMETER, Hb, H, and ReH are heights above take-off; abs_alt and altitude are above the sea. (0, 0) is a position
before the first fix, and unknown. A heading is that of the gimbal, else of the aircraft. The time of day has no zone. Numbers may
have units, and decimal commas, which are told from the file as a whole.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.flight.files import cameras, values
from lpn.flight.files.base import HeadingSource
from lpn.flight.files.telemetry import TelemetryEntry

GpsOrder = Literal["lat-lon", "lon-lat"]

_MOST_BYTES = 500_000_000
# A comma that digits follow is a decimal one here. Lists of numbers are split before.
_PLAIN_NUMBER = r"[0-9]+(?:\.[0-9]+|,[0-9]+(?![0-9]*[.,][0-9]))?(?![0-9]|[.,][0-9])"
_NUMBER = rf"([-+]?{_PLAIN_NUMBER})"
_DEGREES = rf"[-+]?{_PLAIN_NUMBER}(?:\s*(?:°|deg)(?:\s*{_PLAIN_NUMBER}\s*'(?:\s*{_PLAIN_NUMBER}\s*(?:\"|''))?)?)?"
_END = r"(?=\s*(?:°|deg\b|[mM]\b|ft\b|feet\b)?[\s\]),;|}])"
_INDEX_LINE = re.compile(r"^[ \t]*[0-9]+[ \t]*$", re.MULTILINE)
_CODE = r"([0-9]{1,3}):([0-9]{2}):([0-9]{2})[,.]([0-9]{2,3})"
_CODES = re.compile(rf"{_CODE} *--> *{_CODE}")
_CLOCK = re.compile(
    r"([0-9]{4})[-./]([0-9]{1,2})[-./]([0-9]{1,2})[ T]([0-9]{1,2}):([0-9]{2}):([0-9]{2})"
    r"(?:[.,]([0-9]{3}))?(?:,([0-9]{3}))?(?=[,\sZ]|$)"
)
_ONLY_CLOCK = re.compile(r"^[-0-9:., /T]+$")
_QUOTED_NAME = re.compile(r'"([A-Za-z_]{1,30})" ?:')
# A bracket that the file's end cuts off.
_OPEN = re.compile(r"\[[^\]\n]*$", re.MULTILINE)
_NAMED = re.compile(rf"([A-Za-z_]+) ?[:=(] ?{_NUMBER}\s*(ft\b|feet\b)?{_END}")
_COORDINATES = [
    re.compile(
        rf"\b(?:{names})\b\.? ?[:=]? ?((?:[{letters}] ?:? ?)?{_DEGREES}(?:\s*[{letters}]\b)?){_END}", re.IGNORECASE
    )
    for names, letters in (
        ("lat|latitude|latitud|breite|纬度|緯度", "NS"),
        ("lon|lng|long|longitude|longtitude|longitud|länge|经度|經度|経度", "EW"),
    )
]
# The position as a list, in brackets or not. RTK stands in place of GPS with an RTK fix.
_LABEL = r"\b(?:GPS|RTK|POS|POSITION|COORDINATES?|LOCATION)\b"
_LISTS = [
    re.compile(rf"{_LABEL} ?[:=]? ?[(\[]([^()\[\]\n]{{3,100}})[)\]]", re.IGNORECASE),
    re.compile(rf"{_LABEL} ?[:=]? ?([-+0-9][-+0-9.,;°'\" NSEW:m]{{4,80}})", re.IGNORECASE),
]
_LETTERED = {
    letters: rf"(?:(?<![A-Za-z.])[{letters}] ?:? ?{_DEGREES}|(?<![0-9.,]){_DEGREES} ?[{letters}](?![A-Za-z]))"
    for letters in ("NS", "EW")
}
_PAIR = re.compile(
    "|".join(rf"{_LETTERED[a]}[\s,;|\[\]]{{0,5}}{_LETTERED[b]}" for a, b in (("NS", "EW"), ("EW", "NS")))
)
# Behind a position by letters: the altitude, which has a unit.
_BEHIND = re.compile(rf"°?[\s,;]{{0,3}}{_NUMBER} ?(m|ft|feet)\b")
# Positions of others than the drone: in brackets, behind the other's name, or as a pair behind it.
_OTHER = (
    r"(?<![A-Za-z])(?:home|pilot|operator|rc|remote|controller|phone|mobile|take-?off|target|poi|base|gcs)(?![A-Za-z])"
)
_OTHERS = re.compile(
    rf"\[[^\[\]\n]{{0,30}}{_OTHER}[^\[\]\n]{{0,80}}\]"
    rf"|{_OTHER}[ _]?(?:point|position|location|pos|gps|coordinates?)? ?[:=]? ?"
    r"(?:\([^()\n]{0,100}\)|\[[^\[\]\n]{0,100}\])"
    rf"|{_OTHER}[^\n()\[\]0-9]{{0,16}}?\blat\w{{0,6}}[ .:=]{{0,3}}{_DEGREES}"
    rf"[^\n0-9]{{0,12}}?\b(?:lon|lng)\w{{0,6}}[ .:=]{{0,3}}{_DEGREES}"
    rf"|{_OTHER}[ :=_]{{0,4}}(?:{_PAIR.pattern})",
    re.IGNORECASE,
)
_HOME = re.compile(r"\bHOME ?\(([^()\n]{3,100})\)")
_DISTANCE, _HEIGHT = (
    re.compile(rf"(?<![A-Za-z.])(?:{letters}) ?[:=]? ?{_NUMBER} ?(m|ft|feet)\b") for letters in ("D", "ReH|H")
)
_ANGLES = re.compile(r"\b([FG])\.PRY ?\(([^()\n]{5,100})\)")
# The names of a value in lower case without signs, best first.
_NAMES: Mapping[str, tuple[str, ...]] = {
    "takeoff": ("relalt", "barometer", "hb", "reh", "relativealtitude", "relaltitude", "relheight", "altrel", "height"),
    "altitude": ("absalt", "altitude", "absolutealtitude", "gpsaltitude", "altamsl", "amsl", "alt"),
    "gimbal_yaw": ("gbyaw", "gimbalyaw", "gimbalheading", "camerayaw"),
    "gimbal_pitch": ("gbpitch", "gimbalpitch", "camerapitch"),
    "gimbal_roll": ("gbroll", "gimbalroll", "cameraroll"),
    "heading": ("droneyaw", "flightyaw", "heading", "hdg"),
    "zoom": ("dzoomratio",),
    "focal_length": ("focallen",),
}
_TELLING = re.compile(r"GPS|RTK|HOME|LAT|LON|\b[NS] ?:? ?[0-9]", re.IGNORECASE)
_MOST_LETTERS = 120
# Zooms from 100 on are in ten-thousandths: [dzoom_ratio: 10000, delta:0].
_LEAST_SCALED, _ZOOM_SCALE = 100.0, 10_000.0
# HOME and D decide the order of GPS(a, b, c) at this many metres from HOME or more, if the errors differ by this factor.
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


@dataclass(frozen=True)
class _Place:
    """The position in one subtitle: in degrees, or as a triple whose order is still open; `written` is its first number."""

    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    triple: _Triple | None = None
    written: str = ""


def read_subtitles(file: Path, gps_order: GpsOrder | None = None) -> Subtitles:
    """Read a file of subtitles; see `parse_subtitles`.

    Raises:
        DataError: also if the file cannot be read or is larger than 500 MB.
    """
    data = values.read_limited(file, _MOST_BYTES, "subtitles with telemetry")
    return parse_subtitles(blocks_of(data), printable(file.name), gps_order)


def blocks_of(data: bytes) -> list[SubtitleBlock]:
    """Split a file of subtitles at the lines that hold an index only, or, without any, at its time codes."""
    try:
        text = values.decoded(data, "").replace("\r\n", "\n").replace("\r", "\n")
    except DataError:  # without any text there is no subtitle
        return []
    parts = _INDEX_LINE.split(text)[1:]
    if not parts:
        starts = [match.start() for match in _CODES.finditer(text)]
        parts = [text[start:end] for start, end in zip(starts, [*starts[1:], len(text)], strict=False)]
    blocks = []
    for part in parts:
        codes = _CODES.search(part)
        start, end = (None, None) if codes is None else (_seconds(codes.groups()[:4]), _seconds(codes.groups()[4:]))
        blocks.append(SubtitleBlock(part, start, end))
    return blocks


def parse_subtitles(blocks: Iterable[SubtitleBlock], name: str, gps_order: GpsOrder | None = None) -> Subtitles:
    """Return the telemetry of subtitles in any dialect that is known; one file may mix them.

    Args:
        name: the file's, for messages.
        gps_order: order of the first two values in GPS(a, b, c); None finds it out, and a note says how if it was a guess.

    Raises:
        DataError: if no subtitle holds telemetry; the message has one line of what they hold.
    """
    texts: list[tuple[str, float, float | None]] = []
    end, first_clock = 0.0, None
    for block in blocks:
        text = _QUOTED_NAME.sub(r"\1:", values.plain(block.text))
        clock = _clock(text)
        first_clock = clock if first_clock is None else first_clock
        start = block.start
        if start is None and clock is not None and first_clock is not None:
            start = clock - first_clock
        if start is None:
            continue
        end = max(end, start if block.end is None else block.end)
        texts.append((_OPEN.sub("", text), start, clock))
    originals, texts = texts, [(_OTHERS.sub(" ", text), start, clock) for text, start, clock in texts]
    named = [_named(text) for text, _, _ in texts]
    lists = [None if all(pair) else _listed(text) for pair, (text, _, _) in zip(named, texts, strict=True)]
    verdicts = [_has_decimal_commas(raw) for raw in lists if raw is not None]
    commas = verdicts.count(True) > verdicts.count(False)
    places = [
        _of_names(*pair) if all(pair) else _place_of(text, raw, commas, original)
        for pair, (text, _, _), raw, (original, _, _) in zip(named, texts, lists, originals, strict=True)
    ]
    has_points = any("." in place.written for place in places)
    entries = [_entry(*known, place, commas or not has_points) for known, place in zip(texts, places, strict=True)]
    triples = {i: place.triple for i, place in enumerate(places) if place.triple is not None}
    if not any(_tells(entry) for entry in entries) and not any(place.written for place in places):
        raise DataError(
            f"{name} holds no telemetry of DJI or Autel in a known dialect; expected subtitles such as [latitude: 59.30], "
            f"GPS(18.2,59.3,16), or GPS(E: 18.2, N: 59.3, 45.0m){_a_line(originals)}."
        )
    notes = []
    if triples:
        order, note = _order(list(triples.values()), entries, gps_order, name)
        notes += [note] if note else []
        for at, triple in triples.items():
            entries[at] = _placed(entries[at], triple, order)
    entries, more = _in_degrees(entries, places, name)
    notes += more
    if any(verdicts) or any("," in place.written for place in places):
        notes.append(f"The commas within numbers of {name} count as decimal commas: 47,301 is 47.301.")
    if missing := sum(entry.latitude is None for entry in entries):
        unread = "" if any(place.written for place in places) else _a_line(originals)
        notes.append(f"{missing} of {len(entries)} entries of {name} have no position{unread}.")
    return Subtitles(tuple(entries), end, tuple(notes))


def _a_line(texts: Sequence[tuple[str, float, float | None]]) -> str:
    """Return the end of a sentence that quotes a line of the subtitles, the one that most likely has a position."""
    lines = [line.strip() for text, _, _ in texts for line in text.splitlines()]
    lines = [
        line
        for line in lines
        if line and not any(pattern.search(line) for pattern in (_CODES, _INDEX_LINE, _ONLY_CLOCK))
    ]
    if not lines:
        return ""
    line = next(
        (line for line in lines if _TELLING.search(line)), max(lines, key=lambda line: sum(map(str.isdigit, line)))
    )
    return f"; one of its lines is {printable(line)[:_MOST_LETTERS]!r}"


def _seconds(parts: Sequence[str]) -> float:
    hours, minutes, seconds = map(int, parts[:3])
    return 3600.0 * hours + 60 * minutes + seconds + float(f"0.{parts[3]}")


def _clock(text: str) -> float | None:
    match = _CLOCK.search(text)
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    fraction = int(match[7] or 0) / 1e3 + int(match[8] or 0) / 1e6
    try:
        return datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp() + fraction
    except (ValueError, OverflowError):
        return None


def _listed(text: str) -> str | None:
    """Return the list of numbers that GPS or RTK names; None without one."""
    return next((match[1].strip() for pattern in _LISTS if (match := pattern.search(text))), None)


def _has_decimal_commas(raw: str) -> bool | None:
    """Return whether the commas within a list's numbers are decimal ones; None if it has no sign of either."""
    if re.search(r"[0-9],[0-9]", raw) and (";" in raw or re.search(r",\s", raw)) and "." not in raw:
        return True
    if "." in raw:
        return False
    # Two whole numbers and a third are a position in whole degrees; more are numbers with decimals.
    return True if re.fullmatch(r"(?:[-+]?[0-9]+,){3,5}[-+]?[0-9]+[mM]?", raw) else None


def _items(raw: str, commas: bool) -> list[str]:
    """Split a list of numbers, and write each with a point; `commas` decides where the list itself does not."""
    own = _has_decimal_commas(raw)
    if not (commas if own is None else own):
        return re.split(r"\s*[,;]\s*", raw) if re.search(r"[,;]", raw) else raw.split()
    if ";" in raw or re.search(r",\s", raw):
        return [item.replace(",", ".") for item in re.split(r"\s*;\s*" if ";" in raw else r",\s+", raw)]
    whole = raw.split(",")
    return [".".join(whole[i : i + 2]) for i in range(0, len(whole), 2)]


def _named(text: str) -> tuple[str, str]:
    """Return the latitude and longitude that names tell, as they are written; "" without one."""
    latitude, longitude = (pattern.search(text) for pattern in _COORDINATES)
    return "" if latitude is None else latitude[1], "" if longitude is None else longitude[1]


def _of_names(latitude: str, longitude: str, altitude: float | None = None) -> _Place:
    """Return the position of a written latitude and longitude."""
    degrees = values.angle(latitude, "NS", True), values.angle(longitude, "EW", True)
    return _Place() if None in degrees else _Place(*_place(*degrees), altitude, written=latitude)


def _place_of(text: str, raw: str | None, commas: bool, original: str) -> _Place:
    """Return the position of a subtitle: by GPS or RTK and a list, or by letters of hemispheres alone.

    Args:
        original: the text with the positions of others, such as HOME.
    """
    if raw is not None:
        place = _of_list(_items(raw, commas), original, commas)
        if place is not None:
            return place
    if pair := _PAIR.search(text):
        # Letters tell which of the two is the latitude.
        columns = re.findall("|".join(f"({pattern})" for pattern in _LETTERED.values()), pair[0])
        if len(columns) == 2:
            latitude, longitude = ("".join(column) for column in zip(*columns, strict=True))
            behind = _BEHIND.match(text, pair.end())
            return _of_names(
                latitude, longitude, None if behind is None else values.number(behind[1] + behind[2], commas)
            )
    return _Place()


def _of_list(items: Sequence[str], text: str, commas: bool) -> _Place | None:
    """Return the position in a list of two or three values; None if they are none, such as N/A."""
    if not 2 <= len(items) <= 4:
        return None
    third = items[2] if len(items) > 2 else ""
    letters = [values.letter_of(item) for item in items[:2]]
    if any(letters):
        if {"NS" if letter in ("N", "S") else "EW" for letter in letters if letter} != {"NS", "EW"}:
            return None
        north_first = letters[0] in ("N", "S") or letters[1] in ("E", "W")
        north, east = items[:2] if north_first else items[1::-1]
        degrees = values.angle(north, "NS"), values.angle(east, "EW")
        return None if None in degrees else _Place(*_place(*degrees), values.number(third), written=north)
    a, b = values.angle(items[0]), values.angle(items[1])
    if a is None or b is None:
        return None
    return _Place(
        triple=_Triple(a, b, third, _home(text, commas), _metres_of(_DISTANCE, text, commas)), written=items[0]
    )


def _home(text: str, commas: bool) -> tuple[float, float] | None:
    if (match := _HOME.search(text)) is None:
        return None
    items = _items(match[1].strip(), commas)
    a, b = (values.angle(item) if not values.letter_of(item) else None for item in (*items, "", "")[:2])
    return None if a is None or b is None else (a, b)


def _metres_of(pattern: re.Pattern[str], text: str, commas: bool) -> float | None:
    match = pattern.search(text)
    return None if match is None else values.number(match[1] + match[2], commas)


def _entry(text: str, start: float, clock: float | None, place: _Place, commas: bool) -> TelemetryEntry:
    """Parse one subtitle with its position."""
    written = {name.casefold().replace("_", ""): (number, unit) for name, number, unit in _NAMED.findall(text)}

    def value(what: str) -> float | None:
        return next((values.number("".join(written[name]), commas) for name in _NAMES[what] if name in written), None)

    takeoff = value("takeoff")
    takeoff = _metres_of(_HEIGHT, text, commas) if takeoff is None else takeoff
    altitude = value("altitude")
    focal_length = next((written[name][0] for name in _NAMES["focal_length"] if name in written), None)
    return TelemetryEntry(
        start, clock, place.latitude, place.longitude, None, takeoff, place.altitude if altitude is None else altitude,
        *_angles(text, value), _fov(focal_length, value("zoom")),
    )  # fmt: skip


def _angles(
    text: str, value: Callable[[str], float | None]
) -> tuple[float | None, HeadingSource | None, float | None, float | None]:
    """Return heading, its source, pitch, and roll; angles of a gimbal that are all 0 are unknown."""
    turns = {letter: turn for letter, raw in _ANGLES.findall(text) if (turn := _turn(raw)) is not None}
    yaw, pitch = value("gimbal_yaw"), value("gimbal_pitch")
    gimbal = turns.get("G") or (None if yaw is None or pitch is None else (yaw, pitch, value("gimbal_roll") or 0.0))
    if gimbal is not None and any(gimbal):
        heading, pitch, roll = cameras.from_gimbal(*gimbal)
        return heading, "gimbal", pitch, roll
    if "F" in turns and any(turns["F"]):
        return turns["F"][0] % 360.0, "aircraft", None, None
    if (flown := value("heading")) is not None:
        return flown % 360.0, "aircraft", None, None
    return None, None, None, None


def _turn(raw: str) -> tuple[float, float, float] | None:
    """Return yaw, pitch, and roll of a list of pitch, roll, and yaw."""
    angles = [values.number(re.sub(r"[^0-9]+$", "", item)) for item in _items(raw.strip(), False)]
    if len(angles) != 3:
        return None
    pitch, roll, yaw = angles
    return None if pitch is None or roll is None or yaw is None else (yaw, pitch, roll)


def _fov(focal_length: str | None, zoom: float | None) -> float | None:
    """Return the field of view of a focal length that is equivalent to one on 35 mm film: "24.00" or, in tenths, "240"."""
    if focal_length is None:
        return None
    equivalent = float(focal_length.replace(",", ".")) / (
        1.0 if not focal_length.isdecimal() or len(focal_length) < 3 else 10.0
    )
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
    latitude, longitude = _place(*((triple.a, triple.b) if order == "lat-lon" else (triple.b, triple.a)))
    height = None if _counts_satellites(triple) else values.number(triple.third)
    altitude = entry.altitude if entry.altitude is not None else height or None
    return replace(entry, latitude=latitude, longitude=longitude, altitude=altitude)


def _in_degrees(
    entries: Sequence[TelemetryEntry], places: Sequence[_Place], name: str
) -> tuple[list[TelemetryEntry], list[str]]:
    """Return the entries with positions in degrees, and a note if a camera wrote radians, as a Mavic Air 2 may."""
    known = [(entry, place) for entry, place in zip(entries, places, strict=True) if entry.latitude is not None]
    latitudes, longitudes = np.array([(e.latitude, e.longitude) for e, _ in known], np.float64).reshape(-1, 2).T
    if not values.seem_radians(latitudes, longitudes, [place.written.replace(",", ".") for _, place in known]):
        return list(entries), []
    note = f"The positions of {name} count as radians: as degrees they would be at sea, near 0, 0."
    return [
        entry
        if entry.latitude is None or entry.longitude is None
        else replace(entry, latitude=math.degrees(entry.latitude), longitude=math.degrees(entry.longitude))
        for entry in entries
    ], [note]


def _counts_satellites(triple: _Triple) -> bool:
    return triple.third.isascii() and triple.third.isdecimal() and len(triple.third) <= 2


def _order(
    triples: list[_Triple], entries: Sequence[TelemetryEntry], chosen: GpsOrder | None, name: str
) -> tuple[GpsOrder, str]:
    """Return the order of GPS(a, b, c), and a note if it is a guess.

    Degrees beyond 90 are longitudes. Otherwise positions of the same file in brackets decide, then the distance to HOME. The
    third value is a guess: where it counts satellites, the known cameras write the longitude first.
    """
    if chosen is not None:
        return chosen, ""
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
    first, why = (
        ("longitude", ", because the third value counts satellites") if satellites
        else ("latitude", ", because the third value is a height") if any(triple.third for triple in triples)
        else ("latitude", "")
    )  # fmt: skip
    return order, (
        f"The order of latitude and longitude in GPS(a, b, c) of {name} is ambiguous; {first} first was taken{why}. If that is "
        f"wrong, give --gps-order {'lat-lon' if satellites else 'lon-lat'}."
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
