"""Photos with EXIF and XMP, read as frames.

position     XMP GpsLatitude, GpsLongitude; else EXIF GPS, which some firmware truncates. (0, 0) is unknown
height       above ground: XMP sensefly:Height; above take-off: RelativeAltitude; altitude: AbsoluteAltitude, EXIF GPSAltitude
heading      GimbalYawDegree; else FlightYawDegree or sensefly:Heading; else EXIF GPSImgDirection
pitch, roll  of the gimbal; of an aircraft without a gimbal, whose camera looks straight down in level flight
fov          XMP CalibratedFocalLength; else FocalPlaneXResolution and FocalLength; else FocalLengthIn35mmFilm
time         XMP UTCAtExposure, sensefly:UTCTime; EXIF DateTimeOriginal with OffsetTimeOriginal; GPSDateStamp and GPSTimeStamp

The frames of AerialVL tell time and position by their names, @<utc>@<longitude>@<latitude>@.png, and their top is east. Its
queries of place recognition, @<longitude>@<latitude>@.png, have no time.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from lpn.core.errors import PictureError
from lpn.core.files import printable
from lpn.datasets.integrity import stream_error
from lpn.flights import cameras
from lpn.flights.base import Frame
from lpn.flights.xmp import number, read_xmp

_XMP_MARK = b"http://ns.adobe.com/xap/1.0/\x00"
_EXIF, _GPS = ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo
# Quarter turns clockwise that make a picture upright, by EXIF orientation. The others are mirrored.
_TURNS = {1: 0, 3: 2, 6: 1, 8: 3}
# Millimetres of EXIF's FocalPlaneResolutionUnit.
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Widths in millimetres that a sensor can have; others come from wrong tags.
_SENSOR_WIDTHS = (1.0, 60.0)
# Proportions and widths that differ by less are those of one picture.
_SAME = 0.01
_AERIALVL = re.compile(r"@(?:([0-9.]+)@)?([-+]?[0-9.]+)@([-+]?[0-9.]+)@\.\w+")
_FRACTION = re.compile(r"(\.\d{6})\d+")


@dataclass(frozen=True)
class Photo:
    """A photo's frame without a time, and what its flight needs to know.

    Attributes:
        utc, local: seconds since 1970-01-01 in UTC and on the camera's clock.
        turns: quarter turns clockwise of the EXIF orientation, which make the picture upright.
        oddities: predicates whose subject is the photo, such as "has no EXIF"; equal ones are counted in a note of the flight.
    """

    frame: Frame
    utc: float | None = None
    local: float | None = None
    turns: int = 0
    oddities: tuple[str, ...] = ()


@dataclass
class _Metadata:
    """The metadata of a picture file, and the oddities found in them."""

    main: dict[int, Any]
    exif: dict[int, Any]
    gps: dict[int, Any]
    xmp: dict[str, str]
    oddities: list[str] = field(default_factory=list)


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
    orientation = known.main.get(ExifTags.Base.Orientation, 1)
    turns = _TURNS.get(orientation, 0) if isinstance(orientation, int) else 0
    frame = Frame(file.name, file, *((height, width) if turns % 2 else (width, height)))
    latitude, longitude = _position(known)
    frame = _with_heights(replace(frame, latitude=latitude, longitude=longitude), known)
    frame = _with_angles(frame, known, turns)
    frame = replace(frame, fov=_fov(known, width, height, turns))
    utc, local = _times(known)
    if frame.latitude is None and (named := _AERIALVL.fullmatch(file.name)) is not None:
        frame, utc = _named_frame(frame, named, known, utc)
    return Photo(frame, utc, local, turns, tuple(known.oddities))


def _metadata(picture: Image.Image) -> _Metadata:
    """Read EXIF and XMP; a damaged one counts as none, and is an oddity."""
    found = _Metadata({}, {}, {}, {})
    try:
        exif = picture.getexif()
        found.main, found.exif, found.gps = dict(exif), dict(exif.get_ifd(_EXIF)), dict(exif.get_ifd(_GPS))
    # Pillow raises these on damaged EXIF.
    except (OSError, ValueError, SyntaxError, TypeError, LookupError, struct.error, OverflowError, RecursionError):
        found.oddities.append("has damaged EXIF, which was not used")
    if (packet := _packet(picture)) is not None:
        try:
            found.xmp = read_xmp(packet)
        except ValueError as error:
            found.oddities.append(f"has XMP that was not used, because {error}")
    return found


def _packet(picture: Image.Image) -> bytes | None:
    """Return the first XMP packet of a picture; None without one."""
    for marker, segment in getattr(picture, "applist", ()):
        if marker == "APP1" and segment.startswith(_XMP_MARK):
            return bytes(segment[len(_XMP_MARK) :])
    packet = picture.info.get("xmp", picture.info.get("XML:com.adobe.xmp"))
    return (
        packet.encode("utf-8", "replace") if isinstance(packet, str) else packet if isinstance(packet, bytes) else None
    )


def _position(known: _Metadata) -> tuple[float | None, float | None]:
    """Return latitude and longitude in degrees, both None if unknown."""
    found = [
        (number(known.xmp, "GpsLatitude", "sensefly:Latitude"),
         number(known.xmp, "GpsLongitude", "GpsLongtitude", "sensefly:Longitude")),
        (_degrees(known.gps, ExifTags.GPS.GPSLatitude, "NS"), _degrees(known.gps, ExifTags.GPS.GPSLongitude, "EW")),
    ]  # fmt: skip
    for latitude, longitude in found:
        if latitude is None or longitude is None or latitude == longitude == 0:
            continue
        if abs(latitude) <= 90 and abs(longitude) <= 180:
            return latitude, longitude
        known.oddities.append("has a position outside of the Earth's degrees, which was not used")
    return None, None


def _named_frame(frame: Frame, named: re.Match[str], known: _Metadata, utc: float | None) -> tuple[Frame, float | None]:
    """Return a frame of AerialVL with position and heading, and its time in seconds, if it has one, by its name."""
    try:
        time, longitude, latitude = (utc if value is None else float(value) for value in named.groups())
    except ValueError:
        return frame, utc
    if longitude is None or latitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return frame, utc
    known.oddities.append("has its position in its name, as in AerialVL; its top is taken for east")
    return replace(frame, latitude=latitude, longitude=longitude, heading=90.0, heading_source="camera"), time


def _degrees(gps: dict[int, Any], tag: int, signs: str) -> float | None:
    """Return an angle of EXIF in degrees, negative for the second of the two `signs`."""
    reference = _text(gps.get(tag - 1)).upper()
    values = gps.get(tag)
    if reference[:1] not in tuple(signs) or not isinstance(values, tuple | list) or not 1 <= len(values) <= 3:
        return None
    parts = [_number(value) for value in values]
    total = sum(math.nan if part is None else part / 60**i for i, part in enumerate(parts))
    return None if math.isnan(total) else -total if reference[0] == signs[1] else total


def _with_heights(frame: Frame, known: _Metadata) -> Frame:
    altitude = number(known.xmp, "AbsoluteAltitude", "sensefly:AltitudeAMSL")
    if altitude is None and (altitude := _number(known.gps.get(ExifTags.GPS.GPSAltitude))) is not None:
        below = known.gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
        altitude = -altitude if below else altitude
    return replace(
        frame,
        height_above_ground=number(known.xmp, "sensefly:Height"),
        height_above_takeoff=number(known.xmp, "RelativeAltitude"),
        altitude=altitude,
    )


def _with_angles(frame: Frame, known: _Metadata, turns: int) -> Frame:
    """Return a frame with heading, pitch, and roll of the upright picture."""
    yaw, pitch, roll = (number(known.xmp, f"Gimbal{axis}Degree") for axis in ("Yaw", "Pitch", "Roll"))
    if yaw == pitch == 0 and roll in (0, None):
        known.oddities.append("has gimbal angles that are all 0, which some cameras write for unknown ones")
        yaw = pitch = roll = None
    if yaw is not None:
        if pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        frame = replace(frame, heading=yaw, heading_source="gimbal", pitch=pitch, roll=roll)
    elif (flown := number(known.xmp, "sensefly:Heading")) is not None:
        nose, bank = (number(known.xmp, f"sensefly:{axis}Angle") for axis in ("Pitch", "Roll"))
        frame = replace(frame, heading=flown, heading_source="aircraft", roll=bank)
        frame = replace(frame, pitch=None if nose is None else nose - 90.0)
    elif (flown := number(known.xmp, "FlightYawDegree", "FlightYaw")) is not None:
        frame = replace(frame, heading=flown, heading_source="aircraft", pitch=pitch, roll=roll)
    elif (looked := _number(known.gps.get(ExifTags.GPS.GPSImgDirection))) is not None:
        frame = replace(frame, heading=looked, heading_source="camera", pitch=pitch, roll=roll)
        if _text(known.gps.get(ExifTags.GPS.GPSImgDirectionRef)).upper().startswith("M"):
            known.oddities.append("has a direction from magnetic north, which was not corrected")
    if frame.heading is None:
        return frame
    if turns:
        known.oddities.append(turned_oddity(turns))
    heading, pitch, roll = upright_angles(frame.heading, frame.pitch, frame.roll, turns)
    return replace(frame, heading=heading, pitch=pitch, roll=roll)


def turned_oddity(turns: int) -> str:
    """Return the oddity of a photo whose EXIF orientation turns picture and heading."""
    return f"is turned by {90 * turns}° by its EXIF orientation, and its heading with it"


def upright_angles(
    heading: float, pitch: float | None, roll: float | None, turns: int
) -> tuple[float, float | None, float | None]:
    """Return heading, pitch, and roll in degrees after quarter turns clockwise; see `lpn.flights.cameras.turned`."""
    if not turns or pitch is None:
        return (heading - 90.0 * turns) % 360.0, pitch, roll
    return cameras.turned(heading, pitch, roll or 0.0, turns)


def _fov(known: _Metadata, width: int, height: int, turns: int) -> float | None:
    """Return the horizontal field of view of the upright picture in degrees."""
    original = _number(known.exif.get(ExifTags.Base.ExifImageWidth)) or float(width)
    original_height = _number(known.exif.get(ExifTags.Base.ExifImageHeight)) or float(height)
    if (
        abs(original_height / original * height / width - 1) <= _SAME
    ):  # a program turned the picture, or swapped the sizes
        original, original_height = original_height, original
    across = _fov_across(known, original, original_height)
    if across is None:
        return None
    if abs(original / width - 1) > _SAME:
        whole = abs(original / original_height * height / width - 1) <= _SAME
        known.oddities.append(
            f"is {width} x {height} pixels where its EXIF says {original:.0f} x {original_height:.0f}; "
            + ("its field of view is right if it was reduced, and too wide if it was cropped" if whole
               else "it was cropped, and its field of view may be too wide")
        )  # fmt: skip
    if turns % 2:
        across = _across(across, height / width)
    return across


def _fov_across(known: _Metadata, original: float, original_height: float) -> float | None:
    """Return the field of view in degrees across the width of the picture as it was taken, of `original` pixels.

    An equivalent focal length tells that across the longer side.
    """
    if (calibrated := number(known.xmp, "CalibratedFocalLength")) is not None and calibrated > 0:
        return _possible(cameras.fov_of_sensor(original, calibrated))
    focal_length = _positive(known.exif.get(ExifTags.Base.FocalLength))
    density = _positive(known.exif.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _UNITS.get(known.exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal_length is not None and density is not None and unit is not None:
        sensor = original * unit / density
        if _SENSOR_WIDTHS[0] <= sensor <= _SENSOR_WIDTHS[1]:
            zoom = _positive(known.exif.get(ExifTags.Base.DigitalZoomRatio)) or 1.0
            return _possible(cameras.fov_of_sensor(sensor / zoom, focal_length))
    equivalent = _positive(known.exif.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent is None:
        return None
    longer = cameras.fov_of_equivalent(equivalent, focal_length)
    return _possible(_across(longer, min(original / original_height, 1.0)))


def _across(fov: float, ratio: float) -> float:
    """Return the field of view in degrees across a length that is `ratio` times that of the field of view `fov`."""
    return 2 * math.degrees(math.atan(math.tan(math.radians(fov) / 2) * ratio))


def _possible(fov: float) -> float | None:
    return fov if 0.1 <= fov <= 170.0 else None


def _times(known: _Metadata) -> tuple[float | None, float | None]:
    """Return the time of exposure in UTC and on the camera's clock, in seconds since 1970-01-01."""
    stamp = _text(known.exif.get(ExifTags.Base.DateTimeOriginal) or known.main.get(ExifTags.Base.DateTime))
    fraction = _text(known.exif.get(ExifTags.Base.SubsecTimeOriginal)).strip()
    local = _seconds(stamp, "%Y:%m:%d %H:%M:%S")
    if local is not None and fraction.isascii() and fraction.isdecimal():
        local += float(f"0.{fraction}")
    for name in ("UTCAtExposure", "sensefly:UTCTime"):
        text = known.xmp.get(name, "").removesuffix("Z").replace(" ", "T")
        if (utc := _iso_seconds(_FRACTION.sub(r"\1", text))) is not None:
            return utc, local
    zone = _zone(_text(known.exif.get(ExifTags.Base.OffsetTimeOriginal)))
    if local is not None and zone is not None:
        return local - zone, local
    return _gps_time(known.gps), local


def _gps_time(gps: dict[int, Any]) -> float | None:
    day = _seconds(_text(gps.get(ExifTags.GPS.GPSDateStamp)), "%Y:%m:%d")
    parts = gps.get(ExifTags.GPS.GPSTimeStamp)
    if day is None or not isinstance(parts, tuple | list) or len(parts) != 3:
        return None
    hours, minutes, seconds = (_number(part) for part in parts)
    if hours is None or minutes is None or seconds is None or not 0 <= hours < 24:
        return None
    return day + 3600 * hours + 60 * minutes + seconds


def _seconds(text: str, pattern: str) -> float | None:
    try:
        return datetime.strptime(text.strip(), pattern).replace(tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        return None


def _iso_seconds(text: str) -> float | None:
    try:
        found = datetime.fromisoformat(text)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def _zone(text: str) -> float | None:
    """Return the seconds of a zone such as "+02:00"."""
    found = re.fullmatch(r"([+-])(\d\d):(\d\d)", text.strip(), re.ASCII)
    if found is None or int(found[2]) > 14 or int(found[3]) > 59:
        return None
    offset = timezone(timedelta(hours=int(found[2]), minutes=int(found[3]))).utcoffset(None)
    return offset.total_seconds() * (1 if found[1] == "+" else -1)


def _number(value: Any) -> float | None:
    """Return an EXIF value as a finite float, else None."""
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return found if math.isfinite(found) else None


def _positive(value: Any) -> float | None:
    found = _number(value)
    return found if found is not None and found > 0 else None


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
        notes.append("No photo tells its time in UTC: times are seconds since the first photo.")
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
