"""The columns of flight logs: their names by dialect, with a public source of each, and their units.

A column's name counts without case and signs, so that "GPS.Lat [deg]" is gpslat in degrees. A part behind a colon, point, or
slash counts alone where the whole name is unknown, and so does a word: "IMU_ATTI(0):Latitude" and "GPS Lat Exif" are latitudes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lpn.core.files import printable

# The names of a column, in lower case without signs, by where they are documented; best first for each value.
DIALECTS: Mapping[str, Mapping[str, str]] = {
    "common spellings": {
        "file": "filename file imagefilename imagename image photo picture path name",
        "latitude": "latitude lat",
        "longitude": "longitude lon lng long",
        "height_above_ground": "heightaboveground agl heightagl altitudeagl",
        "height_above_takeoff": "heightabovetakeoff relativealtitude relativeheight relalt heightabovehome",
        "altitude": "altitudeabovesealevel absolutealtitude absalt altitudeamsl altitude alt",
        "gimbal_heading": "gimbalheading gimbalyaw cameraheading camerayaw",
        "gimbal_pitch": "gimbalpitch camerapitch",
        "gimbal_roll": "gimbalroll cameraroll",
        "heading": "heading yaw",
        "fov": "fov hfov horizontalfov",
        "time": "time seconds elapsed elapsedtime timestamp epoch",
        "date": "datetime utc timestamp date time",
        "clock": "timeofday time",
        "position": "position coordinates latlon latlong latlng gps",
        "is_video": "isvideo",
    },
    # wildnav's photo_metadata.csv and UAV-VisLoc, whose Omega and Kappa are the aircraft's pitch and roll
    "https://github.com/TIERS/wildnav": {
        "gimbal_heading": "gimballyaw", "gimbal_pitch": "gimballpitch", "gimbal_roll": "gimballroll", "heading": "flightyaw",
    },
    "https://github.com/IntelliSensing/UAV-VisLoc": {
        "height_above_takeoff": "height", "heading": "phi1", "nose": "omega", "bank": "kappa",
    },
    "https://app.airdata.com/wiki/Help/Downloadable+Flight+Data+CSV": {
        "height_above_ground": "heightabovegroundatdronelocation", "heading": "compassheading",
    },
    "https://forum.phantomhelp.com/t/flight-reader-field-descriptions/10579": {
        "latitude": "osdlatitude", "longitude": "osdlongitude", "height_above_takeoff": "osdheight", "altitude": "osdaltitude",
        "heading": "osdyaw", "time": "osdflytime flytime", "date": "customdate", "clock": "customupdatetime updatetime",
        "is_video": "cameraisvideo customisvideo",
    },
    "https://datfile.net/DatCon/fieldsV3.html": {
        "height_above_takeoff": "relativeheight", "altitude": "heightmsl", "time": "offsettime", "date": "datetimestamp",
    },
    "https://exiftool.org/TagNames/GPS.html": {
        "file": "sourcefile", "latitude": "gpslatitude", "longitude": "gpslongitude", "altitude": "gpsaltitude",
        "latitude_letter": "gpslatituderef latituderef latref ns", "longitude_letter": "gpslongituderef longituderef lonref ew",
        "position": "gpsposition gpscoordinates", "date": "gpsdatetime datetimeoriginal createdate",
        "gimbal_heading": "gimbalyawdegree", "gimbal_pitch": "gimbalpitchdegree", "gimbal_roll": "gimbalrolldegree",
        "heading": "flightyawdegree", "direction": "gpsimgdirection", "below": "gpsaltituderef",
    },
    "https://photogrammetrycommunity.github.io/metashape-expert-manual/": {
        "file": "label camera", "longitude": "xlongitude xeast", "latitude": "ylatitude ynorth", "altitude": "zaltitude",
    },
    "https://support.pix4d.com/hc/en-us/articles/360056389172": {
        "latitude": "coordinate1", "longitude": "coordinate2", "altitude": "z",
    },
    "https://developer.dronedeploy.com/docs/flightlogs/sample-flight-log.html": {
        "latitude": "aircraftlatitude", "longitude": "aircraftlongitude", "height_above_takeoff": "aircraftbarometricaltitude",
        "heading": "aircraftheading",
    },
    # MAVLink's messages and logs of ArduPilot, PX4, QGroundControl, and Mission Planner
    "https://mavlink.io/en/messages/common.html": {
        "latitude": "gpslat", "longitude": "gpslon gpslng", "height_above_takeoff": "altituderelative relativealt",
        "altitude": "heightz",
        "heading": "hdg", "time": "timeus timeboot", "date": "timeutcusec",
    },
    "https://github.com/koen-aerts/potdroneflightparser": {  # Potensic
        "latitude": "dronelat", "longitude": "dronelon", "height_above_takeoff": "altitude2metric",
    },
    "https://github.com/h-elsner/Q500log2kml": {"date": "unnamedtime"},
    "https://github.com/aleiby/kml2g1000": {"date": "lcldate localdate", "clock": "lcltime localtime"},  # Garmin G1000
    "https://github.com/mikeemoo/dji-log-parser/issues/7": {"height_above_takeoff": "ascent"},  # Flytrex
    "https://github.com/sco1/pyflysight/blob/main/doc/data_format.md": {"altitude": "hmsl"},
    "https://github.com/tomojitakasu/RTKLIB": {"altitude": "ellipsoidalheight", "date": "gpst"},
    # The same words in other languages
    "translated": {
        "file": "dateiname datei bild fichier nomfichier archivo imagen nomearquivo immagine файл 文件名 照片 ファイル名",
        "latitude": "breitengrad breite latitud latitudine breddegrad breedtegraad szerokość широта 纬度 緯度",
        "longitude": "längengrad länge longitud longitudine lengdegrad lengtegraad długość долгота 经度 経度",
        "height_above_takeoff": "relativehöhe höheüberstart 相对高度",
        "altitude": "höhe altitud altura altitudine quota hoogte wysokość высота 高度 海拔 海拔高度 標高",
        "heading": "kurs gierwinkel cap rumbo azimut 航向 偏航角",
        "date": "zeitstempel datumuhrzeit datum uhrzeit horodatage fecha fechahora data dataora дата время 时间 日時",
        "clock": "uhrzeit heure hora ora время",
    },
}  # fmt: skip
UNITS = {
    "feet": 0.3048, "foot": 0.3048, "ft": 0.3048, "meters": 1.0, "metres": 1.0, "meter": 1.0, "metre": 1.0, "m": 1.0, "cm": 0.01,
    "mm": 0.001, "km": 1000.0, "degrees": 1.0, "degree": 1.0, "deg": 1.0, "°": 1.0, "cdeg": 0.01, "dege7": 1e-7,
    "rad": math.degrees(1), "radians": math.degrees(1), "millisecond": 0.001, "milliseconds": 0.001, "ms": 0.001, "us": 1e-6,
    "µs": 1e-6, "s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "wgs84": 1.0, "dd": 1.0, "dms": 1.0,
    "amsl": 1.0, "msl": 1.0, "utc": 1.0, "gmt": 1.0, "local": 1.0,
}  # fmt: skip
_NEGATIVE = {"latitude": {"s", "south"}, "longitude": {"w", "west"}}
_SIDES = {"n", "s", "e", "w", "north", "south", "east", "west"}
# Signs and words that explain which side is negative, as in "Longitude (W negative)": such numbers have their signs.
_EXPLAINED = re.compile(r"[+<>=±−]|(?<!\w)[-/]|[-/](?!\w)|\bneg|\bpositive|minus|plus|sign")
# Words that stand in the place of a unit, and are none.
_NO_UNITS = ("", "wgs84", "amsl", "msl")
# Names that hold their unit.
_OWN_UNITS = {"timeus": 1e-6, "timeutcusec": 1e-6}
_BRACKETED = re.compile(r"(.*?)\s*(?:\[(.*)\]|\(([^()]*)\))\s*", re.DOTALL)
# If no column has a full name of one of these values, one word of a name is enough, as in "GPS Lat Exif".
_BY_WORD = ("file", "latitude", "longitude")
# Positions of these are not the aircraft's.
_OTHERS = (
    "home", "device", "phone", "mobile", "app", "rc", "remote", "operator", "pilot", "base", "target", "controller", "gcs", "poi",
    "takeoff", "landing", "user", "goto", "waypoint", "next", "accuracy", "error", "std", "dev", "est",
)  # fmt: skip
_NAMES: Mapping[str, tuple[str, ...]] = {
    what: tuple(dict.fromkeys(name for dialect in DIALECTS.values() for name in dialect.get(what, "").split()))
    for what in dict.fromkeys(what for dialect in DIALECTS.values() for what in dialect)
}


@dataclass(frozen=True)
class LogColumns:
    """The columns of a log that are known.

    Attributes:
        places: of each value in a row.
        factors: of its unit, to metres, degrees, or seconds.
        with_unit: the values whose columns name their unit.
        utc: the header says that the date is UTC.
        nadir_zero: a pitch of 0 looks straight down, as in Agisoft's files.
        negative: latitude where its name says south, longitude where it says west, as in "Longitude W"; for a column in which
            no number has a sign, and for numbers without a letter. One beside a column of letters is not among them.
        notes: sentences about columns that count as something, or are left out.
    """

    places: Mapping[str, int]
    factors: Mapping[str, float]
    with_unit: frozenset[str]
    utc: bool
    nadir_zero: bool
    negative: frozenset[str]
    notes: tuple[str, ...]

    @property
    def has_position(self) -> bool:
        """True if a latitude and a longitude are among them."""
        return {"latitude", "longitude"} <= self.places.keys() or "position" in self.places


@dataclass(frozen=True)
class _Cell:
    """A name in the header: as it is written, without signs, its last part alone, its words, and its unit in lower case."""

    text: str
    plain: str
    tail: str
    words: tuple[str, ...]
    unit: str


def columns_of(header: Sequence[str], name: str) -> LogColumns:
    """Return the known columns of a header; `name` is the log's, for notes."""
    cells = [_cell(text.strip(), i) for i, text in enumerate(header)]
    places: dict[str, int] = {}
    factors: dict[str, float] = {}
    notes: list[str] = []
    for what, names in _NAMES.items():
        at = _best(cells, what, names)
        if at is None:
            continue
        unit = cells[at].unit
        if unit and unit not in UNITS:
            notes.append(f"The column {printable(header[at])} of {name} is in an unknown unit and was left out.")
            continue
        places[what] = at
        factors[what] = _OWN_UNITS.get(cells[at].plain, UNITS.get(unit, 1.0))
    if {"latitude", "longitude"} <= places.keys():
        places.pop("position", None)
        by_part = [cells[places[what]] for what in ("latitude", "longitude")]
        if any(cell.plain not in _NAMES["latitude"] + _NAMES["longitude"] for cell in by_part):
            notes.append(
                f"The columns {' and '.join(printable(cell.text) for cell in by_part)} of {name} count as the position."
            )
    negative = frozenset(
        what
        for what in _NEGATIVE
        if what in places and f"{what}_letter" not in places and _is_negative(what, cells[places[what]].text.casefold())
    )
    plain = [cell.plain for cell in cells]
    if "altitude" in places and plain[places["altitude"]] == "z" and "coordinate1" not in plain:
        del places["altitude"]  # elsewhere z may be of a local grid
    if "gimballyaw" in plain and "altitude" in places and "height_above_takeoff" not in places:
        # wildnav copies its column Altitude from RelativeAltitude.
        places["height_above_takeoff"], factors["height_above_takeoff"] = places.pop("altitude"), factors["altitude"]
        notes.append(f"The column Altitude of {name} counts as height above take-off, as in wildnav's files.")
    elif places.get("height_above_takeoff") == places.get("altitude", -1):
        del places["height_above_takeoff"]
    elif "height_above_takeoff" in places and plain[places["height_above_takeoff"]] == "height":
        notes.append(f"The column height of {name} does not say above what; it counts as height above take-off.")
    if "phi1" not in plain and any(places.pop(what, None) is not None for what in ("nose", "bank")):
        for what in ("nose", "bank"):
            places.pop(what, None)
        notes.append(f"The columns omega, phi, and kappa of {name} are angles of photogrammetry, and were not read.")
    nadir_zero = "xlongitude" in plain or "xeast" in plain
    if nadir_zero:
        places |= {what: plain.index(angle) for what, angle in (("nose", "pitch"), ("bank", "roll")) if angle in plain}
        factors |= {"nose": 1.0, "bank": 1.0}
    utc = "date" in places and any(word in header[places["date"]].casefold() for word in ("utc", "gmt", "gpst"))
    with_unit = frozenset(what for what, at in places.items() if cells[at].unit not in _NO_UNITS)
    return LogColumns(places, factors, with_unit, utc, nadir_zero, negative, tuple(notes))


def _cell(text: str, at: int) -> _Cell:
    text = text.lstrip("#% ").strip()
    match = _BRACKETED.fullmatch(text)
    body, unit = (match[1], (match[2] or match[3] or "").strip()) if match else (text, "")
    if _SIDES & set(_words(unit)) and {*_words(body)} & {*_NAMES["latitude"], *_NAMES["longitude"]}:
        unit = next((word for word in _words(unit) if word in UNITS and word not in _SIDES), "")
    unit = re.split(r"[\s,;(\[]", unit)[0]
    if not unit:
        for sign in "_/ ":
            head, _, last = body.rpartition(sign)
            is_unit = last.casefold() in UNITS and last.casefold() not in ("utc", "local", "gmt")
            if head and is_unit and _plain(head) not in (*_NAMES["file"], "gps"):
                body, unit = head, last
                break
    parts = [part for part in re.split(r"[:./]", body) if len(part) > 1] or [body]
    # Yuneec's time has no name, and is the first column.
    plain = _plain(body) or ("unnamedtime" if at == 0 else "")
    tail = parts[-1] if parts != [body] and not _is_other(parts[:-1]) else ""
    words = tuple(_plain(word) for word in re.split(r"[\s_-]+", body))
    return _Cell(text, plain, _plain(tail), () if _is_other(words) else words, unit.casefold())


def _words(text: str) -> list[str]:
    return re.findall(r"[^\W_]+", text.casefold())


def _is_negative(what: str, text: str) -> bool:
    """Return whether a latitude's or longitude's name in lower case names south or west alone, and explains no signs."""
    sides = [word for word in _words(text) if word in _SIDES]
    return len(sides) == 1 and sides[0] in _NEGATIVE[what] and not _EXPLAINED.search(text)


def _plain(text: str) -> str:
    return "".join(letter for letter in text.casefold() if letter.isalnum())


def _is_other(parts: Sequence[str]) -> bool:
    return any(_plain(part).startswith(_OTHERS) for part in parts)


def _best(cells: Sequence[_Cell], what: str, names: Sequence[str]) -> int | None:
    """Return the place of the best column of a value: by whole names first; for dates, UTC before all else."""
    ranked = []
    for at, cell in enumerate(cells):
        words = cell.words if what in _BY_WORD else ()
        for by_part, name in enumerate((cell.plain, cell.tail, *words)):
            if name and name in names:
                unit = 0 if cell.unit in UNITS else 1 if not cell.unit else 2
                zone = {"utc": 0, "gmt": 0, "local": 2}.get(cell.unit, 0 if "utc" in name else 1)
                order = (zone if what == "date" else 0, by_part, names.index(name), unit, at)
                ranked.append((order, at))
    return min(ranked)[1] if ranked else None
