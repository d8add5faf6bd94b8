"""Dialects of telemetry as tables: the programs that write them, what marks each, and the meaning of its columns.

Names of columns are compared without case and signs: "GPS.Lat [deg]" is gpslat in degrees. A unit follows the name in brackets,
or after an underscore, a space, or a slash. Without one the dialect's unit counts, else metres, degrees, or seconds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files.values import FOOT

_LENGTHS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres", "amsl", "msl", "agl", "wgs84"), 1.0),
    **dict.fromkeys(("ft", "feet", "foot"), FOOT), "mm": 0.001, "cm": 0.01, "km": 1000.0,
}  # fmt: skip
_ANGLES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "decimal", "dd", "wgs84"), 1.0), "ddeg": 0.1, "cdeg": 0.01, "dege7": 1e-7,
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1)),
}  # fmt: skip
_TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0), **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "microseconds"), 1e-6),
}  # fmt: skip
_DATES = _TIMES | {"utc": 1.0, "gmt": 1.0, "local": 1.0}
# A column of time with another unit than these may hold another value of time.
_OF_TIME = (_TIMES, _DATES)
# The values of a row, with the possible units of each. `direction` is the camera's heading, `heading` the aircraft's, `nose` a
# pitch with 0 for straight down, `bank` its roll, and `below` EXIF's GPSAltitudeRef.
UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("latitude", "longitude", "position"), _ANGLES),
    **dict.fromkeys(("height_above_ground", "height_above_takeoff", "altitude"), _LENGTHS),
    **dict.fromkeys(("gimbal_heading", "gimbal_pitch", "gimbal_roll", "heading", "direction", "nose", "bank", "fov"), _ANGLES),
    "time": _TIMES, **dict.fromkeys(("date", "clock"), _DATES),
    **{what: {} for what in ("file", "latitude_letter", "longitude_letter", "below", "is_video", "quality")},
}  # fmt: skip
_ALL_UNITS = _LENGTHS | _ANGLES | _DATES
_BRACKETED = re.compile(r"(.*?)\s*[\[(](.*)[\])]\s*", re.DOTALL)
# No name of a column is longer.
_LONGEST = 200
# The group of tags that exiftool -G writes before a name.
_GROUP = re.compile(r"(?:EXIF|XMP|GPS|File|Composite|IFD0|ExifIFD)[\w-]*:(?=\w)")


@dataclass(frozen=True)
class Dialect:
    """A table of one program.

    Attributes:
        marks: the columns that all tables of the program have.
        columns: the program's names of each value, best first, separated by bars; with a unit where headers have none.
        source: page that documents it.
        note: a hint for users of such a table; {name} is the file's name.
        before_utc: seconds by which its clock is ahead of UTC; None if the header names the zone.
        fixed: the text of `quality` for a fixed RTK solution.
    """

    program: str
    marks: tuple[str, ...]
    columns: Mapping[str, str]
    source: str
    note: str = ""
    before_utc: float | None = None
    fixed: str = ""


# fmt: off
_AGISOFT = {"file": "Label | Camera", "direction": "Yaw", "nose": "Pitch", "bank": "Roll", "altitude": "Z/Altitude"}
_RTKLIB = {"altitude": "height", "quality": "Q"}
_ELLIPSOID = "The heights of {name} are above the ellipsoid, and not above the sea."
_METASHAPE = "https://www.agisoft.com/pdf/metashape-pro_2_1_en.pdf"
_RTKLIB_PAGE = "https://www.rtklib.com/prog/manual_2.4.2.pdf"
DIALECTS = (
    Dialect("Airdata", ("height_above_takeoff", "altitude_above_seaLevel"), {
        "height_above_ground": "height_above_ground_at_drone_location", "altitude": "altitude_above_seaLevel",
        "heading": "compass_heading", "time": "time [ms]",
    }, "https://app.airdata.com/wiki/Help/Downloadable+Flight+Data+CSV"),
    Dialect("PhantomHelp, Flight Reader", ("OSD.latitude", "OSD.longitude"), {
        "latitude": "OSD.latitude", "longitude": "OSD.longitude", "height_above_takeoff": "OSD.height",
        "altitude": "OSD.altitude", "heading": "OSD.yaw", "time": "OSD.flyTime", "date": "CUSTOM.date",
        "clock": "CUSTOM.updateTime", "is_video": "CAMERA.isVideo | CUSTOM.isVideo",
    }, "https://forum.phantomhelp.com/t/flight-reader-field-descriptions/10579"),
    # The column pitch(deg) beside pitchRaw shows the unit of raw angles.
    Dialect("Litchi", ("gimbalPitchRaw",), {
        "gimbal_heading": "gimbalYawRaw [ddeg]", "gimbal_pitch": "gimbalPitchRaw [ddeg]",
        "gimbal_roll": "gimbalRollRaw [ddeg]", "is_video": "isRecordingVideo",
    }, "https://flylitchi.com/help"),
    Dialect("exiftool -csv", ("SourceFile",), {
        "file": "SourceFile", "position": "GPSPosition", "altitude": "GPSAltitude | AbsoluteAltitude",
        "below": "GPSAltitudeRef", "height_above_takeoff": "RelativeAltitude",
        "date": "GPSDateTime | DateTimeOriginal | CreateDate", "gimbal_heading": "GimbalYawDegree",
        "gimbal_pitch": "GimbalPitchDegree", "gimbal_roll": "GimbalRollDegree", "heading": "FlightYawDegree",
        "direction": "GPSImgDirection", "quality": "RtkFlag",
    }, "https://exiftool.org/TagNames/DJI.html", fixed="50"),
    Dialect("Agisoft Metashape", ("X/Longitude", "Y/Latitude"),
        _AGISOFT | {"latitude": "Y/Latitude", "longitude": "X/Longitude"}, _METASHAPE),
    Dialect("Agisoft PhotoScan", ("X/East", "Y/North"),
        _AGISOFT | {"latitude": "Y/North", "longitude": "X/East"}, _METASHAPE),
    Dialect("PIX4Dmatic", ("imagename", "coordinate1", "coordinate2"), {
        "latitude": "coordinate1", "longitude": "coordinate2", "altitude": "z",
    }, "https://support.pix4d.com/hc/en-us/articles/360056389172"),
    Dialect("OpenDroneMap geo.txt", ("image_name", "geo_x", "geo_y"), {
        "file": "image_name", "longitude": "geo_x", "latitude": "geo_y", "altitude": "geo_z",
        "direction": "yaw", "nose": "pitch", "bank": "roll",
    }, "https://docs.opendronemap.org/geo/",
        "{name} has no line of column names; longitude before latitude was taken, as in geo.txt of OpenDroneMap."),
    Dialect("UAV-VisLoc", ("Omega", "Kappa", "Phi1"), {
        "height_above_takeoff": "height", "heading": "Phi1", "nose": "Omega", "bank": "Kappa",
    }, "https://github.com/IntelliSensing/UAV-VisLoc"),
    Dialect("wildnav", ("Gimball_Yaw", "Gimball_Pitch"), {
        "gimbal_heading": "Gimball_Yaw", "gimbal_pitch": "Gimball_Pitch", "gimbal_roll": "Gimball_Roll",
        "heading": "Flight_Yaw", "height_above_takeoff": "Altitude",
    }, "https://github.com/TIERS/wildnav",
        "The column Altitude of {name} counts as height above take-off, as in wildnav's files."),
    Dialect("RTKLIB", ("GPST", "Q"), _RTKLIB | {"date": "GPST"}, _RTKLIB_PAGE, _ELLIPSOID, 18.0, "1"),
    Dialect("RTKLIB", ("UTC", "Q"), _RTKLIB | {"date": "UTC"}, _RTKLIB_PAGE, _ELLIPSOID, 0.0, "1"),
    Dialect("mavlogdump.py", ("time_boot_ms", "relative_alt", "hdg"), {
        "latitude": "lat [degE7]", "longitude": "lon [degE7]", "altitude": "alt [mm]", "heading": "hdg [cdeg]",
        "height_above_takeoff": "relative_alt [mm]", "date": "timestamp",
    }, "https://mavlink.io/en/messages/common.html#GLOBAL_POSITION_INT"),
)
# Clear names in other tables, and for values that a dialect does not name.
COMMON = Dialect("any", (), {
    "file": "filename | file | image filename | image name | image | photo | picture | name | label | path",
    "latitude": "latitude | lat | gps latitude | gps lat | latitude/Y",
    "longitude": "longitude | lon | lng | long | gps longitude | gps lon | gps lng | longitude/X",
    "latitude_letter": "gps latitude ref | latitude ref | lat ref",
    "longitude_letter": "gps longitude ref | longitude ref | lon ref",
    "height_above_ground": "height above ground | agl | height agl | altitude agl",
    "height_above_takeoff": "height above takeoff | relative altitude | altitude relative | relative height | relative alt"
    " | rel alt | height above home | ascent | height",
    "altitude": "altitude above sea level | absolute altitude | abs alt | altitude amsl | gps altitude | altitude | alt"
    " | ellipsoidal height | ellipsoid height",
    "gimbal_heading": "gimbal heading | gimbal yaw | camera heading | camera yaw",
    "gimbal_pitch": "gimbal pitch | camera pitch",
    "gimbal_roll": "gimbal roll | camera roll",
    "heading": "heading | yaw | hdg | compass heading",
    "fov": "fov | hfov | horizontal fov",
    "time": "time | seconds | elapsed | elapsed time | timestamp",
    "date": "datetime | date time | utc | timestamp | date | time",
    "clock": "time of day | time",
    "is_video": "isVideo | is recording",
}, "")
# fmt: on


@dataclass(frozen=True)
class Columns:
    """The columns of known meaning in a table.

    Attributes:
        places: the index of each value in a row.
        factors: from each value's unit to metres, degrees, or seconds.
        unsaid: the values whose units neither the header nor the dialect names.
        utc: True if the header names the date as UTC.
        notes: sentences about columns that are left out or reinterpreted.
    """

    dialect: Dialect
    places: Mapping[str, int]
    factors: Mapping[str, float]
    unsaid: frozenset[str]
    utc: bool
    notes: tuple[str, ...]

    @property
    def has_position(self) -> bool:
        """True if a latitude and a longitude are among them."""
        return {"latitude", "longitude"} <= self.places.keys() or "position" in self.places


@dataclass(frozen=True)
class _Name:
    """A column's name without signs, and the words of its unit in lower case; a unit in brackets is surely one."""

    plain: str
    units: tuple[str, ...] = field(default=(), compare=False)
    bracketed: bool = field(default=False, compare=False)


def columns_of(header: Sequence[str], name: str) -> Columns:
    """Return the known columns of a header.

    Args:
        name: the log's, for notes.

    Raises:
        DataError: if the column of a latitude or longitude has an unknown unit.
    """
    cells = [list(_names(text)) for text in header]
    plain = {cell.plain for names in cells for cell in names}
    dialect = next((one for one in DIALECTS if all(_plain(mark) in plain for mark in one.marks)), COMMON)
    places: dict[str, int] = {}
    factors: dict[str, float] = {}
    unsaid, notes, taken = set(), [], set[int]()
    for table in (dialect, COMMON) if dialect is not COMMON else (COMMON,):
        found = {}
        for what, names in table.columns.items():
            known = None if what in places else _best(cells, what, names, taken)
            if known is None:
                continue
            at, factor, said = known
            if factor is None:
                notes.append(f"The column {printable(header[at])} of {name} is in an unknown unit and was left out.")
                if what in ("latitude", "longitude"):
                    raise DataError(f"{notes[-1]} Expected degrees, as in {what} (deg).")
                continue
            found[what], factors[what] = at, factor
            unsaid |= {what} if table is COMMON and not said else set()
        places |= found
        taken |= set(found.values())
    if {"latitude", "longitude"} <= places.keys():
        places.pop("position", None)
    if "height_above_takeoff" in places and _plain(header[places["height_above_takeoff"]]) == "height":
        notes.append(f"The column height of {name} does not say above what; it counts as height above take-off.")
    if {"omega", "phi", "kappa"} <= plain:
        notes.append(f"The columns omega, phi, and kappa of {name} are angles of photogrammetry, and were not read.")
    if "ellips" in (header[places["altitude"]].casefold() if "altitude" in places else ""):
        notes.append(_ELLIPSOID.format(name=name))
    tilts = [
        printable(header[at])
        for at, names in enumerate(cells)
        if names[0].plain in ("pitch", "roll") and at not in taken
    ]
    if tilts and "gimbal_pitch" not in places:
        notes.append(
            f"The columns {' and '.join(tilts)} of {name} do not say whether they are the camera's, and were not read; call them "
            "gimbal_pitch and gimbal_roll if they are."
        )
    if dialect.note:
        notes.append(dialect.note.format(name=name))
    utc = dialect.before_utc is not None or (
        "date" in places and re.search("utc|gmt", header[places["date"]], re.I) is not None
    )
    return Columns(dialect, places, factors, frozenset(unsaid), utc, tuple(notes))


def _plain(text: str) -> str:
    return "".join(letter for letter in text.casefold() if letter.isalnum())


def _names(text: str) -> Iterator[_Name]:
    """Yield the readings of a column's name: the whole without a unit in brackets, and the part before a unit."""
    text = _GROUP.sub("", text.lstrip("#% ").strip()[:_LONGEST])
    if match := _BRACKETED.fullmatch(text):
        yield _Name(_plain(match[1]), tuple(re.split(r"[\s,;]+", match[2].casefold().strip())), True)
        return
    yield _Name(_plain(text))
    parts = re.split(r"[\s_/]+", text)
    for count in (1, 2):
        units = tuple(part.casefold() for part in parts[-count:])
        if len(parts) > count and set(units) <= _ALL_UNITS.keys():
            yield _Name(_plain("".join(parts[:-count])), units)


def _best(
    cells: Sequence[Sequence[_Name]], what: str, names: str, taken: set[int]
) -> tuple[int, float | None, bool] | None:
    """Return the index of a value's best column, its unit's factor (None if unknown), and whether the unit is named.

    Columns are ranked by the order of names, then by the unit: known, missing, unknown or local time.
    """
    ranked = []
    units = UNITS[what]
    for rank, written in enumerate(names.split("|")):
        wanted = next(_names(written))
        own = next((units[unit] for unit in wanted.units), 1.0)
        for at, known in ((at, name) for at, names_of in enumerate(cells) for name in names_of if name == wanted):
            unit = next((unit for unit in known.units if unit in units), None)
            if at in taken or (known.units and unit is None and (units in _OF_TIME or not known.bracketed)):
                continue
            is_unknown = bool(units and known.units and unit is None)
            factor = None if is_unknown else own if unit is None else units[unit]
            certainty = 2 if is_unknown or unit == "local" else 1 if unit is None else 0
            ranked.append((rank, certainty, at, factor, unit is not None or bool(wanted.units)))
    if not ranked:
        return None
    return min(ranked, key=lambda column: column[:3])[2:]
