"""Photos with EXIF and XMP, read as frames.

position     XMP of the maker; else EXIF GPS, which some firmware truncates; else the EXIF in XMP. (0, 0) is unknown
height       above ground, above take-off, altitude: XMP of the maker; altitude also EXIF GPSAltitude
heading      the gimbal's, by XMP or DJI's maker note; the camera's, by XMP or EXIF GPSImgDirection; the aircraft's
pitch, roll  of the gimbal or the camera; of an aircraft without a gimbal, whose camera looks straight down in level flight
lens         XMP DewarpData of DJI
fov          the lens's; XMP CalibratedFocalLength; FocalPlaneXResolution and FocalLength; XMP Camera:PerspectiveFocalLength;
             FocalLengthIn35mmFilm
time         XMP UTCAtExposure, sensefly:UTCTime; EXIF DateTimeOriginal with OffsetTimeOriginal; GPSDateStamp and GPSTimeStamp.
             XMP CreateDate and EXIF DateTimeDigitized stand in for a missing DateTimeOriginal, before DateTime

`lpn.flight.files.makers` lists the properties of XMP. A tag or property that cannot be read is an oddity of the photo.

The frames of AerialVL tell time and position by their names, @<utc>@<longitude>@<latitude>@.png, and their top is east. Its
queries of place recognition, @<longitude>@<latitude>@.png, have no time.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any, get_args

from PIL import ExifTags, Image

from lpn.core.errors import PictureError
from lpn.core.files import first_few, printable
from lpn.core.numbers import wrap_degrees
from lpn.datasets.integrity import stream_error
from lpn.flight.files import cameras
from lpn.flight.files.base import Frame, HeadingSource
from lpn.flight.files.lenses import Lens, lens_of_dewarp_data
from lpn.flight.files.makers import ROWS, Convention, XmpValues, degrees_of
from lpn.flight.files.xmp import XmpProperty, read_xmp

_XMP_MARK = b"http://ns.adobe.com/xap/1.0/\x00"
_EXTENDED_MARK = b"http://ns.adobe.com/xmp/extension/\x00"
# The beginning of a packet in a segment without the mark.
_PACKET = re.compile(rb"<(?:\?xpacket|x:xmpmeta|rdf:RDF)")
_XMP_TAG = 700
_EXIF, _GPS = ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo
# Quarter turns clockwise that make a picture upright, by EXIF orientation. A mirrored one is taken at its word: flipped to the
# side it is a true picture, and is turned then.
_TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
_MIRRORED = (2, 4, 5, 7)
# Millimetres of EXIF's FocalPlaneResolutionUnit.
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Widths in millimetres that a sensor can have; others come from wrong tags.
_SENSOR_WIDTHS = (1.0, 60.0)
# Proportions and widths that differ by less are those of one picture.
_SAME = 0.01
# Positions in metres and angles in degrees that differ by more contradict each other. Some firmware truncates EXIF's position.
_OTHER_PLACE, _OTHER_ANGLE = 1000.0, 10.0
_METRES_PER_DEGREE = 111_195.0
# A camera looks back by less than this in degrees where 0 is straight down. A pitch below it counts from the horizon.
_MOST_BACK = -30.0
# A calibration's own width that differs by more is that of another size of the picture. The optical centre is off by less.
_OFF_CENTRE = 0.1
_SOURCES: Mapping[Convention, HeadingSource] = {
    "gimbal": "gimbal", "on platform": "gimbal", "nadir": "camera", "direction": "camera", "fixed": "aircraft",
    "aircraft": "aircraft",
}  # fmt: skip
# Namespaces and conventions of angles, best first.
_ANGLES = tuple(dict.fromkeys((row.namespace, row.convention) for row in ROWS if row.field == "heading"))
_PLACES = tuple(dict.fromkeys(row.namespace for row in ROWS if row.field == "latitude"))
# Tags of DJI's maker note: yaw, pitch, roll of the gimbal and of the aircraft (exiftool, lib/Image/ExifTool/DJI.pm).
_DJI_GIMBAL, _DJI_AIRCRAFT = (10, 9, 11), (7, 6, 8)
# Angles in the tags of text in which programs for phones write them.
_ANGLES_IN_TEXT = re.compile(r"(?:\b(?:yaw|pitch|roll)|heading)\b\W{0,4}[0-9]", re.IGNORECASE)
_TEXT_TAGS = (ExifTags.Base.UserComment, ExifTags.Base.ImageDescription)
_LENS_TAGS = ("FocalLength", "FocalPlaneXResolution", "FocalLengthIn35mmFilm")
_AERIALVL = re.compile(r"@(?:([0-9.]+)@)?([-+]?[0-9.]+)@([-+]?[0-9.]+)@\.\w+")
# Seconds from 1970 to the year 10000, which Python's dates do not reach.
_END_OF_TIME = 253402300800.0
# EXIF has colons between all numbers; programs write other marks, blanks for zeros, and zones.
_TIME = re.compile(
    r"(\d{4})[-:/.](\d\d)[-:/.](\d\d)[ T]+(\d\d?):([\d ]\d):([\d ]\d)(\.\d+)? *(Z|[-+]\d\d:?\d\d)?", re.ASCII
)
# Some phones write 24:08:19 for eight minutes after midnight of the day that they name.
_MIDNIGHT = re.compile(r"(?<=[ T])24(?=:)")
_TIME_TAGS = (ExifTags.Base.DateTimeOriginal, ExifTags.Base.DateTimeDigitized)
_FRACTION = re.compile(r"(\.\d{6})\d+")
_RANK: Mapping[HeadingSource, int] = {source: i for i, source in enumerate(get_args(HeadingSource))}
_NAMED = 12


@dataclass(frozen=True)
class Photo:
    """A photo's frame without a time, and what its flight needs to know.

    Attributes:
        utc, local: seconds since 1970-01-01 in UTC and on the camera's clock.
        turns: quarter turns clockwise of the EXIF orientation, which make the picture upright.
        oddities: predicates whose subject is the photo, such as "has no EXIF"; equal ones are counted in a note of the flight.
        heading_unread: its file has a value that looks like a heading, and that was not read.
        camera: maker and model by EXIF; "" if it does not tell them.
        named, time_named: the position, or the time, is that of the file's name, as in AerialVL.
    """

    frame: Frame
    utc: float | None = None
    local: float | None = None
    turns: int = 0
    oddities: tuple[str, ...] = ()
    heading_unread: bool = False
    camera: str = ""
    named: bool = False
    time_named: bool = False


@dataclass
class _Metadata:
    """The metadata of a picture file, and the oddities found in them."""

    main: dict[int, Any] = field(default_factory=dict)
    exif: dict[int, Any] = field(default_factory=dict)
    gps: dict[int, Any] = field(default_factory=dict)
    xmp: XmpValues = field(default_factory=XmpValues)
    oddities: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Angles:
    """Heading, pitch, and roll of a `Frame` by one source, in degrees, and the name of its heading."""

    heading: float | None
    pitch: float | None
    roll: float | None
    source: HeadingSource
    name: str


def read_photo(file: Path) -> Photo:
    """Read a photo's metadata; its pixels are not decoded, but the end of the file is checked.

    Raises:
        PictureError: if the file is no picture that can be read, or is cut short.
    """
    try:
        data = file.read_bytes()
    except OSError as error:
        raise PictureError(f"{printable(file.name)} cannot be read ({error.strerror or error}); check it.") from error
    if (error_found := stream_error(io.BytesIO(data))) is not None:
        raise PictureError(f"{printable(file.name)} {error_found}; replace it or leave it out.")
    return photo_of(data, file)


def photo_of(data: bytes, file: Path) -> Photo:
    """Return the photo of a picture file's bytes, which `lpn.core.images.header_error` accepts; `file` is not read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(io.BytesIO(data)) as picture:
            known = _metadata(picture)
            # Pillow turns a TIFF's size by its orientation, and no other's.
            width, height = picture.size
            if picture.format == "TIFF":
                width = known.main.get(ExifTags.Base.ImageWidth, width)
                height = known.main.get(ExifTags.Base.ImageLength, height)
    turns = _turns(known)
    frame = Frame(file.name, file, *((height, width) if turns % 2 else (width, height)))
    latitude, longitude = _position(known)
    frame = _with_heights(replace(frame, latitude=latitude, longitude=longitude), known)
    frame = _with_angles(frame, known, turns)
    lens = _lens(known, width, height, turns)
    if projection := known.xmp.text("projection").strip():
        known.oddities.append(
            f"is a panorama ({printable(projection)[:40]}), whose ground has not the map's shape; leave it out"
        )
    else:
        frame = replace(frame, lens=lens, fov=_fov(known, width, height, turns) if lens is None else lens.fov)
    utc, local = _times(known)
    told = utc
    if frame.latitude is None and (named := _AERIALVL.fullmatch(file.name)) is not None:
        frame, utc = _named_frame(frame, named, known, utc)
    by_name = latitude is None and frame.latitude is not None
    _name_the_rest(known)
    unread = known.xmp.heading_unread or bool(_text_with_angles(known))
    return Photo(
        frame, utc, local, turns, tuple(dict.fromkeys(known.oddities)), unread, _camera(known), by_name, utc != told
    )


def _metadata(picture: Image.Image) -> _Metadata:
    """Read EXIF and XMP; what is damaged is an oddity, and what is readable beside it is used."""
    known = _Metadata()
    for directory in ("main", "exif", "gps"):
        try:
            tags = picture.getexif()
            setattr(
                known,
                directory,
                dict(tags if directory == "main" else tags.get_ifd({"exif": _EXIF, "gps": _GPS}[directory])),
            )
        # Pillow raises these on damaged EXIF.
        except (OSError, ValueError, SyntaxError, TypeError, LookupError, struct.error, OverflowError, RecursionError):
            known.oddities.append("has damaged EXIF, which was not used")
    properties: list[XmpProperty] = []
    flaws: dict[str, None] = {}
    for packet in _packets(picture, known):
        try:
            readable, some = read_xmp(packet)
        except ValueError as error:
            known.oddities.append(f"has XMP that was not used, because {error}")
            continue
        properties += readable
        flaws |= dict.fromkeys(some)
    if flaws:
        known.oddities.append(f"has damaged XMP ({'; '.join(flaws)}), of which the readable properties were used")
    known.xmp = XmpValues(properties)
    for row, value in known.xmp.values.items():
        if row.field.startswith("EXIF "):
            known.exif.setdefault(ExifTags.Base[row.field.removeprefix("EXIF ")].value, value)
    return known


def _packets(picture: Image.Image, known: _Metadata) -> Iterator[bytes]:
    """Yield the XMP packets of a picture, the extended one of a JPEG last."""
    parts: dict[bytes, dict[int, bytes]] = {}
    standard: list[bytes] = []
    for marker, segment in getattr(picture, "applist", ()):
        if marker != "APP1" or segment.startswith(b"Exif"):
            continue
        if segment.startswith(_EXTENDED_MARK):
            header, content = segment[len(_EXTENDED_MARK) :][:40], segment[len(_EXTENDED_MARK) + 40 :]
            parts.setdefault(header[:32], {})[int.from_bytes(header[36:40], "big")] = content
        elif segment.startswith(_XMP_MARK):
            standard.append(segment[len(_XMP_MARK) :])
        elif (begin := _PACKET.search(segment[:256])) is not None:
            standard.append(segment[begin.start() :])
    if not standard:
        info = picture.info
        inside = (
            *(info.get(name) for name in ("xmp", "XML:com.adobe.xmp")),
            *(_raw_profile(info.get(f"Raw profile type {name}")) for name in ("xmp", "APP1")),
            *(tags.get(_XMP_TAG) for tags in (known.main, known.exif)),
        )
        packet = next((packet for packet in inside if packet), None)
        if isinstance(packet, tuple | list) and all(isinstance(value, int) and 0 <= value < 256 for value in packet):
            packet = bytes(packet)
        packet = packet.encode("utf-8", "replace") if isinstance(packet, str) else packet
        standard += [packet] if isinstance(packet, bytes) else []
    yield from standard
    for name, pieces in parts.items():
        if any(name in packet for packet in standard):
            yield b"".join(pieces[offset] for offset in sorted(pieces))
        else:
            known.oddities.append("has extended XMP that belongs to another packet, and was not used")


def _raw_profile(text: Any) -> bytes | None:
    """Return the XMP packet that ImageMagick writes into a PNG, as a name, a length, and hexadecimal digits."""
    digits = (
        re.sub(r"\s", "", text.lstrip().partition("\n")[2].lstrip().partition("\n")[2]) if isinstance(text, str) else ""
    )
    content = bytes.fromhex(digits) if re.fullmatch("(?:[0-9a-fA-F]{2})+", digits) else b""
    return content if _PACKET.search(content[:256]) else None


def _turns(known: _Metadata) -> int:
    """Return the quarter turns clockwise of the EXIF orientation."""
    orientation = known.main.get(ExifTags.Base.Orientation, 1)
    if not isinstance(orientation, int) or orientation not in _TURNS:
        known.oddities.append(
            f"has the EXIF orientation {printable(str(orientation))[:20]}, which does not exist; it counts as upright"
        )
        return 0
    if orientation in _MIRRORED:
        known.oddities.append(
            "is mirrored by its EXIF orientation; if its file is no mirror image, remove that tag, as a mirror image fits no map"
        )
    return _TURNS[orientation]


def _position(known: _Metadata) -> tuple[float | None, float | None]:
    """Return latitude and longitude in degrees, both None if unknown."""
    doubts: list[str] = []
    candidates = [(_in_xmp(known, "latitude", space), _in_xmp(known, "longitude", space), space) for space in _PLACES]
    inside = [
        _exif_degrees(known.gps, tag, signs, doubts)
        for tag, signs in ((ExifTags.GPS.GPSLatitude, "NS"), (ExifTags.GPS.GPSLongitude, "EW"))
    ]
    # The EXIF in XMP, the last of the table, is a copy of EXIF.
    candidates.insert(-1, (inside[0], inside[1], "EXIF GPS"))
    places: list[tuple[float, float, str]] = []
    for north, east, space in candidates:
        if (north is None) != (east is None) and not (space == "EXIF GPS" and doubts):
            known.oddities.append(f"has only one of latitude and longitude in {space}, which was not used")
        if north is None or east is None or north == east == 0:
            continue
        if abs(north) <= 90 and abs(east) <= 180:
            places.append((north, east, space))
        else:
            known.oddities.append("has a position outside of the Earth's degrees, which was not used")
    if not places or places[0][2] == "EXIF GPS":
        known.oddities += doubts
    if not places:
        return None, None
    (latitude, longitude, name), *others = places
    for north, east, space in others:
        aside = wrap_degrees(east - longitude) * math.cos(math.radians(latitude))
        if math.hypot(north - latitude, aside) * _METRES_PER_DEGREE > _OTHER_PLACE:
            known.oddities.append(f"has another position in {space} than in {name}, which was used")
    if name == "EXIF GPS":
        _doubt_fix(known)
    return latitude, longitude


def _in_xmp(known: _Metadata, axis: str, space: str) -> float | None:
    """Return latitude or longitude of a namespace in degrees; a reference of EXIF gives its sign to one without a sign."""
    degrees = known.xmp.first(axis, "", space)
    opposite = space == "exif" and known.xmp.text(f"{axis} reference").strip().upper()[:1] in ("S", "W")
    return -abs(degrees) if degrees is not None and opposite else degrees


def _doubt_fix(known: _Metadata) -> None:
    """Note what EXIF says against its own position."""
    datum = _text(known.gps.get(ExifTags.GPS.GPSMapDatum))
    if datum and re.sub("[^a-z0-9]", "", datum.casefold()) not in ("wgs84", "wgs1984", "egm96"):
        known.oddities.append(f"has its position in {printable(datum)[:40]}, which was taken for WGS 84")
    if _text(known.gps.get(ExifTags.GPS.GPSStatus)).upper() == "V":
        known.oddities.append("has a position that its GPSStatus calls void; it was used")


def _named_frame(frame: Frame, named: re.Match[str], known: _Metadata, utc: float | None) -> tuple[Frame, float | None]:
    """Return a frame of AerialVL with position and heading, and its time in seconds, if it has one, by its name."""
    try:
        time, longitude, latitude = (utc if value is None else float(value) for value in named.groups())
    except ValueError:
        return frame, utc
    if longitude is None or latitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return frame, utc
    time = utc if time is not None and time >= _END_OF_TIME else time
    known.oddities.append("has its position in its name, as in AerialVL; its top is taken for east")
    return replace(frame, latitude=latitude, longitude=longitude, heading=90.0, heading_source="camera"), time


def _exif_degrees(gps: dict[int, Any], tag: int, signs: str, doubts: list[str]) -> float | None:
    """Return an angle of EXIF in degrees, negative for the second of the two `signs`; what is odd is added to `doubts`."""
    name = ExifTags.GPS(tag).name
    if (raw := gps.get(tag)) is None:
        return None
    reference = _text(gps.get(tag - 1)).upper()
    if text := _text(raw):
        total = degrees_of(text)
        # Its own letter is a reference.
        reference = reference or ("" if total is None or text[-1:].isdigit() else signs[total < 0])
    else:
        total = _summed(raw if isinstance(raw, tuple | list) else (raw,), name, doubts)
    if total is None or total == 0:
        if total is None and not any(name in doubt for doubt in doubts):
            doubts.append(f"has a {name} that cannot be read")
        return total
    if reference[:1] in tuple(signs):
        if total < 0 and reference[0] == signs[0]:
            doubts.append(f"has a negative {name} with the reference {signs[0]}; its sign was used")
        return -abs(total) if total < 0 or reference[0] == signs[1] else total
    if total < 0:
        doubts.append(f"has no readable {name}Ref; the sign of its {name} was used")
        return total
    doubts.append(f"has no readable {name}Ref; its hemisphere, and so its position, is unknown")
    return None


def _summed(values: Sequence[Any], name: str, doubts: list[str]) -> float | None:
    """Return the sum of degrees, minutes, and seconds, negative if one is; None if a part that matters cannot be read.

    Decimal degrees leave nothing to minutes, and decimal minutes nothing to seconds: such parts may be 0/0.
    """
    parts = [_number(value) for value in values]
    if not 1 <= len(parts) <= 3 or parts[0] is None or any(part is not None and abs(part) > 60 for part in parts[1:]):
        return None
    total, whole = 0.0, True
    for i, (part, noun) in enumerate(zip(parts, ("degrees", "minutes", "seconds"), strict=False)):
        before = ("", "degrees", "minutes")[i]
        if part is None and whole:
            doubts.append(f"has {noun} of {name} that cannot be read; its position is unknown")
            return None
        if part is None:
            doubts.append(f"has {noun} of {name} that cannot be read; its decimal {before} were used")
            break
        # Some programs repeat in seconds what decimal minutes tell.
        if not whole and part:
            repeated = abs(abs(total) * 60**i % 60 - abs(part)) < 0.5
            return (-total if min(p for p in parts if p is not None) < 0 else total) if repeated else None
        total += abs(part) / 60**i
        whole = abs(part - round(part)) < 1e-9
    return -total if any(part is not None and part < 0 for part in parts) else total


def _with_heights(frame: Frame, known: _Metadata) -> Frame:
    altitude = known.xmp.first("altitude")
    if altitude is None:
        altitude = _exif_number(known, known.gps, ExifTags.GPS.GPSAltitude)
        below: Any = known.gps.get(ExifTags.GPS.GPSAltitudeRef)
        if altitude is None:
            altitude, below = known.xmp.first("exif altitude"), known.xmp.text("exif altitude reference")
        # 3 is below the ellipsoid in EXIF 3.0.
        if altitude is not None and below in (1, 3, b"\x01", b"\x03", "1", "3"):
            altitude = -abs(altitude)
    return replace(
        frame,
        height_above_ground=known.xmp.first("height_above_ground"),
        height_above_takeoff=known.xmp.first("height_above_takeoff"),
        altitude=altitude,
    )


def _with_angles(frame: Frame, known: _Metadata, turns: int) -> Frame:
    """Return a frame with heading, pitch, and roll of the upright picture."""
    all_angles = list(_told_angles(known))
    headings = sorted(
        (angles for angles in all_angles if angles.heading is not None), key=lambda angles: _RANK[angles.source]
    )
    best = headings[0] if headings else None
    tilts = [angles for angles in all_angles if angles.pitch is not None]
    tilt = best if best is not None and best.pitch is not None else tilts[0] if tilts else None
    pitch, roll = (None, None) if tilt is None else (tilt.pitch, tilt.roll)
    for other in headings[1:]:
        if best is not None and "aircraft" not in (best.source, other.source) and _differ(best, other):
            known.oddities.append(
                f"has other angles of the camera in {other.name} than in {best.name}, which were used"
            )
    if best is not None and best.name.endswith("GPSImgDirection"):
        reference = _text(known.gps.get(ExifTags.GPS.GPSImgDirectionRef)) or known.xmp.text("direction reference")
        if reference.upper().startswith("M"):
            known.oddities.append("has a direction from magnetic north, which was not corrected")
    if best is not None and turns:
        known.oddities.append(turned_oddity(turns))
    heading, pitch, roll = upright_angles(0.0 if best is None else best.heading or 0.0, pitch, roll, turns)
    if best is None:
        return replace(frame, pitch=pitch, roll=roll)
    return replace(frame, heading=heading, heading_source=best.source, pitch=pitch, roll=roll)


def _told_angles(known: _Metadata) -> Iterator[_Angles]:
    """Yield the angles by each source that tells any; those that are all 0 are unknown."""
    sets: list[tuple[list[float | None], Convention, str]] = []
    for space, convention in _ANGLES:
        names = [known.xmp.names[row] for row in known.xmp.all_of("heading", convention) if row.namespace == space]
        sets.append((_of_axes(known, convention, space), convention, names[0] if names else space))
    note = _dji_maker_note(known.exif.get(ExifTags.Base.MakerNote))
    sets.append(([note.get(tag) for tag in _DJI_GIMBAL], "gimbal", "DJI's maker note"))
    looked = _exif_number(known, known.gps, ExifTags.GPS.GPSImgDirection)
    sets.append(([looked, None, None], "direction", "GPSImgDirection"))
    sets.append(([note.get(tag) for tag in _DJI_AIRCRAFT], "aircraft", "DJI's maker note"))
    platform = _of_axes(known, "aircraft", "exif")
    for values, convention, name in sets:
        yaw, pitch, roll = values
        if all(value is None for value in values):
            continue
        if yaw == pitch == 0 and roll in (0, None):
            if convention != "aircraft":
                noun = "gimbal" if _SOURCES[convention] == "gimbal" else "camera"
                known.oddities.append(f"has {noun} angles that are all 0, which some cameras write for unknown ones")
            continue
        if convention == "on platform":
            if None in platform or None in values:
                known.oddities.append(f"has {name} against an aircraft whose angles are unknown; it was not used")
                continue
            yaw, pitch, roll = (a + b for a, b in zip(values, platform, strict=True) if a is not None and b is not None)
        elif convention == "nadir" and pitch is not None and pitch < _MOST_BACK:
            known.oddities.append(
                f"has a pitch below {_MOST_BACK:.0f} beside {name}, which was taken to count from the horizon"
            )
            convention = "gimbal"
        elif convention in ("nadir", "fixed") and pitch is not None:
            pitch -= 90.0
        elif convention == "aircraft":
            pitch = roll = None
        if convention in ("gimbal", "on platform") and yaw is not None and pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        roll = roll if roll is None or abs(roll) <= 180 else wrap_degrees(roll)
        yield _Angles(None if yaw is None else yaw % 360.0, pitch, roll, _SOURCES[convention], name)


def _of_axes(known: _Metadata, convention: Convention, space: str) -> list[float | None]:
    """Return yaw, pitch, and roll of a namespace in one convention."""
    return [known.xmp.first(axis, convention, space) for axis in ("heading", "pitch", "roll")]


def _differ(one: _Angles, other: _Angles) -> bool:
    """Return whether two sources contradict each other about the camera's heading or pitch."""
    pairs = ((one.heading, other.heading), (one.pitch, other.pitch))
    return any(a is not None and b is not None and abs(wrap_degrees(a - b)) > _OTHER_ANGLE for a, b in pairs)


def _dji_maker_note(note: Any) -> dict[int, float]:
    """Return the finite numbers of DJI's maker note by tag: a directory of EXIF with values inside."""
    if (
        not isinstance(note, bytes)
        or note[2:6] not in (b"\x01\x00\x02\x00", b"\x00\x01\x00\x02")
        or b"DJI" not in note[:20]
    ):
        return {}
    order = "<" if note[2] else ">"
    tags = {}
    for at in range(2, min(len(note) - 11, 2 + 12 * struct.unpack(order + "H", note[:2])[0]), 12):
        tag, kind, count = struct.unpack(order + "HHI", note[at : at + 8])
        if (kind, count) == (11, 1) and abs(value := struct.unpack(order + "f", note[at + 8 : at + 12])[0]) <= 720:
            tags[tag] = float(value)
    return tags


def turned_oddity(turns: int) -> str:
    """Return the oddity of a photo whose EXIF orientation turns picture and heading."""
    return f"is turned by {90 * turns}° by its EXIF orientation, and its heading with it"


def upright_angles(
    heading: float, pitch: float | None, roll: float | None, turns: int
) -> tuple[float, float | None, float | None]:
    """Return heading, pitch, and roll in degrees after quarter turns clockwise; see `lpn.flight.files.cameras.turned`."""
    if not turns or pitch is None:
        return (heading - 90.0 * turns) % 360.0, pitch, roll
    return cameras.turned(heading, pitch, roll or 0.0, turns)


def upright_values(
    values: Mapping[str, Any], turns: int, frame: Frame, across_longer_side: bool = False
) -> dict[str, Any]:
    """Return telemetry of a frame with its angles turned as the picture is, and with the field of view across its width.

    A frame whose lens is known keeps that one's field of view, with which its distortion is removed.

    Args:
        values: named as in `Frame`; None where unknown.
        turns: quarter turns clockwise from the picture as it was taken to the frame.
        across_longer_side: the field of view lies across the longer side, as subtitles tell it; else across the width of the
            picture as it was taken.
    """
    upright = dict(values)
    if turns and (heading := values.get("heading")) is not None:
        angles = upright_angles(heading, values.get("pitch"), values.get("roll"), turns)
        upright |= {
            name: angle for name, angle in zip(("heading", "pitch", "roll"), angles, strict=True) if angle is not None
        }
    is_across_height = frame.height > frame.width if across_longer_side else turns % 2 == 1
    if frame.lens is not None:
        upright.pop("fov", None)
    elif is_across_height and (fov := values.get("fov")) is not None:
        upright["fov"] = cameras.fov_across(fov, frame.width / frame.height)
    return upright


def _lens(known: _Metadata, width: int, height: int, turns: int) -> Lens | None:
    """Return the lens of DJI's DewarpData; None where the camera took its distortion out already, or the picture is not whole."""
    if not (text := known.xmp.text("lens").strip()) or known.xmp.text("undistorted").strip() == "1":
        return None
    original, original_height = _original(known, width, height)
    if turns or abs(original / original_height * height / width - 1) > _SAME:
        known.oddities.append("was turned or cropped, so the lens of its DewarpData was not used")
        return None
    try:
        return lens_of_dewarp_data(text, original)
    except ValueError as error:
        known.oddities.append(f"has a DewarpData that was not used, because it has {printable(str(error))[:80]}")
        return None


def _original(known: _Metadata, width: int, height: int) -> tuple[float, float]:
    """Return the width and height in pixels of the picture as it was taken."""
    original = _number(known.exif.get(ExifTags.Base.ExifImageWidth)) or float(width)
    original_height = _number(known.exif.get(ExifTags.Base.ExifImageHeight)) or float(height)
    if (
        abs(original_height / original * height / width - 1) <= _SAME
    ):  # a program turned the picture, or swapped the sizes
        return original_height, original
    return original, original_height


def _fov(known: _Metadata, width: int, height: int, turns: int) -> float | None:
    """Return the horizontal field of view of the upright picture in degrees."""
    original, original_height = _original(known, width, height)
    across = _fov_across(known, original, original_height)
    if across is None:
        tags = [
            name
            for name in _LENS_TAGS
            if (raw := known.exif.get(ExifTags.Base[name].value)) is not None and _number(raw) is None
        ]
        known.oddities += [f"has no field of view, because its {' and '.join(tags)} cannot be read"] if tags else []
        return None
    if abs(original / width - 1) > _SAME:
        whole = abs(original / original_height * height / width - 1) <= _SAME
        known.oddities.append(
            f"is {width} x {height} pixels where its EXIF says {original:.0f} x {original_height:.0f}; "
            + ("its field of view is right if it was reduced, and too wide if it was cropped" if whole
               else "it was cropped, and its field of view may be too wide")
        )  # fmt: skip
    if turns % 2:
        across = cameras.fov_across(across, height / width)
    return across


def _fov_across(known: _Metadata, original: float, original_height: float) -> float | None:
    """Return the field of view in degrees across the width of the picture as it was taken, of `original` pixels.

    An equivalent focal length tells that across the longer side.
    """
    zoom = _positive(known.exif.get(ExifTags.Base.DigitalZoomRatio)) or 1.0
    for row in known.xmp.all_of("focal length"):
        if (calibrated := known.xmp.number(row)) is None or calibrated <= 0:
            continue
        centre, low = (
            known.xmp.first(name, "", row.namespace) for name in ("optical centre", "optical centre's height")
        )
        own = original
        # A picture of another size than the calibration's was reduced, or is another camera's if it is less wide.
        if centre is not None and abs(2 * centre / original - 1) > _OFF_CENTRE:
            own = 2 * centre
            if low and original / original_height < (1 - _OFF_CENTRE / 2) * centre / low:
                known.oddities.append("has a focal length calibrated for other proportions, which was not used")
                continue
        # Skydio calibrates the sensor, of which a zoomed picture is the middle (its X10's metadata overview).
        return _possible(cameras.fov_of_sensor(own, calibrated * (zoom if row.namespace == "drone-skydio" else 1.0)))
    if (fov := known.xmp.first("fov")) is not None:
        return _possible(fov)
    focal_length = _positive(known.exif.get(ExifTags.Base.FocalLength))
    density = _positive(known.exif.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _UNITS.get(known.exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal_length is not None and density is not None and unit is not None:
        sensor = original * unit / density
        if _SENSOR_WIDTHS[0] <= sensor <= _SENSOR_WIDTHS[1]:
            return _possible(cameras.fov_of_sensor(sensor / zoom, focal_length))
    if (perspective := known.xmp.first("perspective focal length")) and known.xmp.text("perspective unit") in (
        "",
        "mm",
    ):
        # The principal point is the middle of the sensor, but for some hundredths of its width.
        middle = _number(known.xmp.text("principal point").split(",")[0])
        if middle is not None and _SENSOR_WIDTHS[0] <= 2 * middle <= _SENSOR_WIDTHS[1] and perspective > 0:
            return _possible(cameras.fov_of_sensor(2 * middle, perspective))
    equivalent = _positive(known.exif.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent is None:
        return None
    longer = cameras.fov_of_equivalent(equivalent, focal_length)
    return _possible(cameras.fov_across(longer, min(original / original_height, 1.0)))


def _possible(fov: float) -> float | None:
    least, most = cameras.FOV_RANGE
    return fov if least <= fov <= most else None


def _times(known: _Metadata) -> tuple[float | None, float | None]:
    """Return the time of exposure in UTC and on the camera's clock, in seconds since 1970-01-01."""
    # A program that edits a photo sets DateTime to its own time.
    taken = next((text for tag in _TIME_TAGS if (text := _text(known.exif.get(tag)))), "")
    stamp = taken or _text(known.main.get(ExifTags.Base.DateTime))
    fraction = _text(known.exif.get(ExifTags.Base.SubsecTimeOriginal)).strip()
    local, zone = _local_time(stamp)
    if local is None and re.search("[1-9]", stamp):
        known.oddities.append("has a DateTimeOriginal that cannot be read")
    if local is not None and _MIDNIGHT.search(stamp):
        known.oddities.append("has a time with the hour 24, which was taken for the hour 0 of the same day")
    if local is not None and fraction.isascii() and fraction.isdecimal():
        local += float(f"0.{fraction}")
    for row in known.xmp.all_of("utc"):
        text = str(known.xmp.values[row]).removesuffix("Z").replace(" ", "T")
        if "T" in text and (utc := _iso_seconds(_FRACTION.sub(r"\1", text))) is not None:
            return utc, local
        known.oddities.append(f"has a time that cannot be read in {known.xmp.names[row]}")
    offset = _text(known.exif.get(ExifTags.Base.OffsetTimeOriginal))
    zone = _zone(offset) if zone is None else zone
    if zone is None and re.search(r"\w", offset):
        known.oddities.append("has an OffsetTimeOriginal that cannot be read")
    if local is not None and zone is not None:
        return local - zone, local
    return _gps_time(known), local


def _gps_time(known: _Metadata) -> float | None:
    day = _seconds(_text(known.gps.get(ExifTags.GPS.GPSDateStamp)), "%Y:%m:%d")
    raw = known.gps.get(ExifTags.GPS.GPSTimeStamp)
    if raw is None:
        return None
    parts = [_number(part) for part in raw] if isinstance(raw, tuple | list) else []
    clock = [part for part in parts if part is not None and 0 <= part <= 60]
    if not len(parts) == len(clock) == 3 or clock[0] >= 24:
        known.oddities.append("has a GPSTimeStamp that cannot be read")
        return None
    return None if day is None else day + 3600 * clock[0] + 60 * clock[1] + clock[2]


def _local_time(stamp: str) -> tuple[float | None, float | None]:
    """Return the seconds of a time as EXIF or ISO 8601 write it, and those of its zone, if it has one."""
    match = _TIME.fullmatch(_MIDNIGHT.sub("00", stamp.strip()))
    if match is None:
        return None, None
    day, clock = ":".join(match.group(1, 2, 3)), ":".join(match.group(4, 5, 6))
    seconds = _seconds(f"{day} {clock}".replace(": ", ":0"), "%Y:%m:%d %H:%M:%S")
    if seconds is not None and match[7]:
        seconds += float(match[7])
    zone = match[8] or ""
    return seconds, 0.0 if zone == "Z" else _zone(zone)


def _name_the_rest(known: _Metadata) -> None:
    """Note properties that were not read, cannot be read, or contradict themselves."""
    xmp = known.xmp
    unread = [*xmp.unread, *_text_with_angles(known)]
    for names, predicate in (
        (unread, "has values that look like a position, height, or angle and were not read"),
        (xmp.unreadable, "has values that cannot be read"),
        (xmp.contradictory, "has some properties twice with different values, and the first value was used"),
    ):
        if names:
            known.oddities.append(f"{predicate}: {first_few([printable(name)[:60] for name in names], _NAMED)}")


def _camera(known: _Metadata) -> str:
    maker, model = (_text(known.main.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    return model if model.startswith(maker) else f"{maker} {model}".strip()


def _text_with_angles(known: _Metadata) -> list[str]:
    """Return the names of EXIF's texts in which a program wrote the camera's angles."""
    names = []
    for tag in _TEXT_TAGS:
        raw = known.exif.get(tag, known.main.get(tag))
        text = (
            raw[:400].decode("ascii", "ignore").replace("\x00", "") if isinstance(raw, bytes) else str(raw or "")[:400]
        )
        names += [f"EXIF {tag.name}"] if _ANGLES_IN_TEXT.search(text) else []
    return names


def _exif_number(known: _Metadata, tags: Mapping[int, Any], tag: ExifTags.GPS) -> float | None:
    """Return a number of EXIF; one that is there and cannot be read is an oddity."""
    if (raw := tags.get(tag)) is None:
        return None
    value = _number(raw[0] if isinstance(raw, tuple | list) and len(raw) == 1 else _text(raw) or raw)
    if value is None or abs(value) > 1e5:
        known.oddities.append(f"has a {tag.name} that cannot be read")
        return None
    return value


def _seconds(text: str, pattern: str) -> float | None:
    try:
        return datetime.strptime(text.strip(), pattern).replace(tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        return None


def _iso_seconds(text: str) -> float | None:
    try:
        moment = datetime.fromisoformat(text)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def _zone(text: str) -> float | None:
    """Return the seconds of a zone such as "+02:00", "-5:00", or "+0200"."""
    match = re.fullmatch(r"([+-])(\d\d?):?(\d\d)", text.strip(), re.ASCII)
    if match is None or int(match[2]) > 14 or int(match[3]) > 59:
        return None
    offset = timezone(timedelta(hours=int(match[2]), minutes=int(match[3]))).utcoffset(None)
    return offset.total_seconds() * (1 if match[1] == "+" else -1)


def _number(value: Any) -> float | None:
    """Return an EXIF value as a finite float, else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _text(value: Any) -> str:
    """Return an EXIF value as text without trailing NULs; "" for other types."""
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return value.strip("\x00 ") if isinstance(value, str) else ""


def set_times(photos: Sequence[Photo]) -> tuple[list[Frame], bool, list[str]]:
    """Put the photos of a flight on one clock, and order them by time, then by name.

    Returns:
        frames; whether their times are UTC, else since the first; notes about the clocks.
    """
    pairs = [photo.utc - photo.local for photo in photos if photo.utc is not None and photo.local is not None]
    notes = _clock_notes(pairs)
    is_utc = any(photo.utc is not None for photo in photos)
    offset = sorted(pairs)[len(pairs) // 2] if pairs else None
    timed = []
    for photo in photos:
        time = photo.local if not is_utc else photo.utc
        if is_utc and time is None and photo.local is not None and offset is not None:
            time = photo.local + offset
        timed.append(replace(photo.frame, time=time))
    known = [frame.time for frame in timed if frame.time is not None]
    if not is_utc and known:
        start = min(known)
        timed = [frame if frame.time is None else replace(frame, time=frame.time - start) for frame in timed]
        notes.append("No photo has its time in UTC: times are seconds since the first photo.")
    if len(known) < len(timed):
        notes.append(
            f"{len(timed) - len(known)} of {len(timed)} photos have no time: the photos are in the order of their names."
        )
        return sorted(timed, key=lambda frame: natural(frame.name)), is_utc, notes
    return sorted(timed, key=lambda frame: (frame.time, natural(frame.name))), is_utc, notes


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that counts numbers in a name: "9.jpg" comes before "10.jpg"."""
    return [(int(digits or 0), letters.casefold()) for digits, letters in re.findall(r"([0-9]*)([^0-9]*)", name)]


def _clock_notes(pairs: Sequence[float]) -> list[str]:
    """Compare the camera's clock with UTC; `pairs` are their differences in seconds, positive where the camera's is behind."""
    if not pairs:
        return []
    quarter = 900.0
    middle = sorted(pairs)[len(pairs) // 2]
    zone = -round(middle / quarter) * quarter
    late, spread = middle + zone, max(pairs) - min(pairs)
    notes = []
    if abs(late) > 2:
        hours = f"UTC{zone / 3600:+g}" if zone else "UTC"
        notes.append(f"The camera's clock is {abs(late):.0f} s {'behind' if late > 0 else 'ahead of'} {hours}.")
    if spread > 2:
        notes.append(f"The camera's clock and UTC move apart by {spread:.0f} s during the flight.")
    return notes
