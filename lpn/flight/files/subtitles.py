"""Subtitles with telemetry of drones, in a `.SRT` file beside a video or inside the video.

    [latitude: 59.30] [longitude: 18.20] [rel_alt: 1.3 abs_alt: 132.8]      DJI, by name; also longtitude, altitude, gb_yaw
    GPS(149.0251,-20.2533,16) BAROMETER:1.9                                 DJI, longitude first, with the number of satellites
    GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M                                DJI Matrice and Avata, latitude first, with a height
    GPS (-58.85, -34.23, 15), D 698.70m, H 85.80m, G.PRY (-24.4°, 0.0°, 110.4°)    RTK in place of GPS with an RTK fix
    GPS(W: 70.5, S: 33.4, 812.5m) ReH:40.0                                  Autel: letters of hemispheres, with an altitude

rel_alt, BAROMETER, Hb, H, and ReH are heights above take-off; abs_alt and altitude are above the sea. (0, 0), written before the
first fix, is an unknown position. The gimbal's heading replaces the aircraft's. The time of day has no zone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files import cameras, values
from lpn.flight.files.telemetry import Log, entry_of

GpsOrder = Literal["lat-lon", "lon-lat"]

_MOST_BYTES = 500_000_000
_INDEX_LINE = re.compile(r"^[ \t]*[0-9]+[ \t]*$", re.MULTILINE)
_CODE = r"([0-9]{1,3}):([0-9]{2}):([0-9]{2}[,.][0-9]{2,3})"
_CODES = re.compile(rf"{_CODE} *--> *{_CODE}")
_TAG = re.compile(r"<[^<>\n]{0,200}>")
# Some firmware of Autel writes a second sign behind the point: -117.-9605.
_SECOND_SIGN = re.compile(r"(\d\.)-(?=\d)")
_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]+)?"
# [name: 1.0 name: 2.0, name: 3.0]; an unclosed bracket at the file's end does not count.
_BRACKET = re.compile(r"\[([^\[\]\n]{3,400})\]")
_NAMED = re.compile(rf"([A-Za-z_][A-Za-z_ ]{{0,40}}?) ?: ?({_NUMBER})(?=\s|,\s|,?$)")
_COLUMNS = {
    "latitude": "latitude", "longitude": "longitude", "altitude": "altitude",
    "longtitude": "longitude", "abs_alt": "altitude", "rel_alt": "height_above_takeoff",
    "gb_yaw": "gimbal_heading", "gb_pitch": "gimbal_pitch", "gb_roll": "gimbal_roll",
}  # fmt: skip
_POSITION = re.compile(r"\b(?:GPS|RTK) ?\(([^()\n]{3,100})\)")
_LETTER = re.compile("[NSEW]")
_HEIGHT = re.compile(
    rf"(?<![A-Za-z.])(?:BAROMETER|ReH|Hb|H) ?[:(]? ?({_NUMBER} ?(?:m|ft|feet)?)(?=[\s)]|,\s)", re.IGNORECASE
)
_ANGLES = re.compile(rf"\b([FG])\.PRY ?\(({_NUMBER})°?, ({_NUMBER})°?, ({_NUMBER})°?\)")
_SATELLITES = re.compile(r"[0-9]{1,2}")
_MOST_LETTERS = 120
# Zooms from 100 on are in ten-thousandths: [dzoom_ratio: 10000, delta:0].
_LEAST_SCALED, _ZOOM_SCALE = 100.0, 10_000.0


class SubtitleBlock(NamedTuple):
    """One subtitle: its text, and its start and end in seconds."""

    text: str
    start: float
    end: float


def read_subtitles(file: Path, gps_order: GpsOrder | None = None) -> Log:
    """Read a file of subtitles; see `parse_subtitles`.

    Raises:
        DataError: see `parse_subtitles`; also if the file cannot be read or is larger than 500 MB.
    """
    data = values.read_limited(file, _MOST_BYTES, "subtitles with telemetry")
    return parse_subtitles(blocks_of(data), printable(file.name), gps_order)


def blocks_of(data: bytes) -> list[SubtitleBlock]:
    """Split a file of subtitles at its time codes.

    Without time codes, it is split at lines with only an index, and clocks in the text give the times.
    """
    try:
        text = values.decoded(data, "").replace("\r\n", "\n").replace("\r", "\n")
    except DataError:  # without any text there is no subtitle
        return []
    codes = list(_CODES.finditer(text))
    begins = [match.start() for match in codes or _INDEX_LINE.finditer(text)]
    texts = [text[begin:end] for begin, end in zip(begins, [*begins[1:], len(text)], strict=False)]
    if codes:
        times = [(_seconds(*match.groups()[:3]), _seconds(*match.groups()[3:])) for match in codes]
        return [SubtitleBlock(one, *pair) for one, pair in zip(texts, times, strict=True)]
    clocked = [(one, moment.seconds) for one in texts if (moment := values.moment_in(one)) is not None]
    return [SubtitleBlock(one, clock - clocked[0][1], clock - clocked[0][1]) for one, clock in clocked]


def _seconds(hours: str, minutes: str, seconds: str) -> float:
    return 3600.0 * int(hours) + 60 * int(minutes) + float(seconds.replace(",", "."))


def parse_subtitles(blocks: Sequence[SubtitleBlock], name: str, gps_order: GpsOrder | None = None) -> Log:
    """Return the telemetry of subtitles in any known dialect; one file may mix them.

    Args:
        name: of the file, for messages.
        gps_order: order of the first two values in GPS(a, b, c); None infers it from letters, degrees beyond 90, or numbers
            of satellites, else takes latitude first with a note.

    Raises:
        DataError: if no subtitle holds telemetry; the message quotes a line.
    """
    texts = [_SECOND_SIGN.sub(r"\1", values.plain(_TAG.sub(" ", block.text))) for block in blocks]
    lists = [_listed(text) for text in texts]
    order, notes = _order([items for items in lists if items], gps_order, name)
    rows = [_told(text, items, order) for text, items in zip(texts, lists, strict=True)]
    if not any(rows):
        raise DataError(
            f"{name} holds no telemetry of DJI or Autel in a known dialect; expected subtitles such as [latitude: 59.30], "
            f"GPS(18.2,59.3,16), or GPS(E: 18.2, N: 59.3, 45.0m){_a_line(texts)}."
        )
    clocks = [None if (moment := values.moment_in(text)) is None else moment.seconds for text in texts]
    entries = [entry_of(block.start, clock, told) for block, clock, told in zip(blocks, clocks, rows, strict=True)]
    known = [abs(degrees) for e in entries for degrees in (e.latitude, e.longitude) if degrees is not None]
    if known and max(known) <= math.pi:
        notes.append(
            f"All positions of {name} lie within 3.14 degrees of 0, 0; if the camera wrote radians, they are wrong."
        )
    if missing := sum(entry.latitude is None for entry in entries):
        unread = "" if any("latitude" in told for told in rows) else _a_line(texts)
        notes.append(f"{missing} of {len(entries)} entries of {name} have no position{unread}.")
    return Log(name, tuple(entries), False, tuple(notes), max(block.end for block in blocks))


def _a_line(texts: Sequence[str]) -> str:
    """Return the end of a sentence that quotes the subtitles' line with the most digits."""
    lines = [line.strip() for text in texts for line in text.splitlines()]
    lines = [line for line in lines if not _CODES.search(line) and values.moment(line) is None]
    line = max(lines, key=lambda line: sum(map(str.isdigit, line)), default="")
    return f"; one of its lines is {printable(line)[:_MOST_LETTERS]!r}" if line else ""


def _listed(text: str) -> list[str]:
    """Return the three values of GPS or RTK, the last one "" if missing; an empty list without numbers."""
    for match in _POSITION.finditer(text):
        items = [item.strip() for item in match[1].split(",")]
        if 2 <= len(items) <= 3 and None not in map(values.angle, items[:2]):
            return [*items, ""][:3]
    return []


def _order(lists: Sequence[list[str]], chosen: GpsOrder | None, name: str) -> tuple[GpsOrder, list[str]]:
    """Return the order of GPS(a, b, c) without letters, and a note if it is a guess."""
    plain = [items for items in lists if not _LETTER.search(items[0])]
    if chosen is not None or not plain:
        return chosen or "lat-lon", []
    first, second = (max(abs(values.angle(items[i]) or 0.0) for items in plain) for i in (0, 1))
    if max(first, second) > 90:
        return "lon-lat" if first > 90 else "lat-lon", []
    if sum(_SATELLITES.fullmatch(third) is not None for _, _, third in plain) * 2 > len(plain):
        return "lon-lat", []
    return "lat-lon", [
        f"The order of latitude and longitude in GPS(a, b, c) of {name} is ambiguous; latitude first was taken, as the third "
        "value is no number of satellites. If that is wrong, give --gps-order lon-lat."
    ]


def _told(text: str, items: Sequence[str], order: GpsOrder) -> dict[str, float | None]:
    """Return the values of one subtitle, named as in `lpn.flight.files.dialects.UNITS`; `items` are its GPS values."""
    named = {key.strip(): number for inside in _BRACKET.findall(text) for key, number in _NAMED.findall(inside)}
    told = _listed_values(items, order) if items else {}
    if height := _HEIGHT.search(text):
        told["height_above_takeoff"] = values.number(height[1])
    for letter, *angles in _ANGLES.findall(text):
        pitch, roll, yaw = map(float, angles)
        if letter == "G":
            told |= {"gimbal_heading": yaw, "gimbal_pitch": pitch, "gimbal_roll": roll}
        elif pitch or roll or yaw:
            told["heading"] = yaw
    told |= {_COLUMNS[key]: float(number) for key, number in named.items() if key in _COLUMNS}
    if "focal_len" in named:
        fov = _fov(named["focal_len"], float(named.get("dzoom_ratio", 1.0)))
        told |= {} if fov is None else {"fov": fov}
    return told


def _listed_values(items: Sequence[str], order: GpsOrder) -> dict[str, float | None]:
    letter = _LETTER.search(items[0])
    if letter:
        order = "lat-lon" if letter[0] in "NS" else "lon-lat"
    latitude, longitude = items[:2] if order == "lat-lon" else items[1::-1]
    told = {"latitude": values.angle(latitude, "NS"), "longitude": values.angle(longitude, "EW")}
    if letter or not _SATELLITES.fullmatch(items[2]):
        told["altitude"] = values.number(items[2]) or None
    return told


def _fov(focal_length: str, zoom: float) -> float | None:
    """Return the field of view of a 35 mm equivalent focal length, "24.00" or, in tenths, "240"; None if it is impossible."""
    is_in_tenths = focal_length.isdecimal() and len(focal_length) > 2
    equivalent = float(focal_length) / (10.0 if is_in_tenths else 1.0)
    if zoom >= _LEAST_SCALED:
        zoom /= _ZOOM_SCALE
    equivalent *= max(zoom, 1.0)
    return cameras.fov_of_equivalent(equivalent) if 5 <= equivalent <= 1000 else None
