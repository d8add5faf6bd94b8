"""Photos with EXIF and XMP, read as frames.

`lpn.flight.files.makers` lists the properties of each maker, best first. A maker's XMP precedes EXIF's position, which some
firmware truncates. A position (0, 0) is unknown, and so are a camera's angles that are all 0. Oddities of a photo are collected.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image

from lpn.core.errors import PictureError
from lpn.core.files import first_few, printable
from lpn.core.numbers import wrap_degrees
from lpn.datasets.integrity import stream_error
from lpn.flight.files import cameras
from lpn.flight.files.base import Frame, HeadingSource
from lpn.flight.files.lenses import Lens, lens_of_dewarp_data
from lpn.flight.files.makers import Convention, Properties, number, text_of
from lpn.flight.files.values import moment
from lpn.flight.files.xmp import read_xmp

# Pillow raises these on damaged EXIF.
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, LookupError, struct.error, OverflowError, RecursionError)
_XMP_TAG = 700
# Quarter turns clockwise that make a picture upright, by EXIF orientation, after a mirrored picture is mirrored back.
_TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
_MIRRORED = (2, 4, 5, 7)
# XMP's names of tags for which Pillow has other names.
_NAMES = {"ExifImageWidth": "PixelXDimension", "ExifImageHeight": "PixelYDimension"}
# Millimetres of EXIF's FocalPlaneResolutionUnit.
_UNITS: Mapping[float | None, float] = {None: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Range of a sensor's width in millimetres; other values come from wrong tags.
_SENSOR_WIDTHS = (1.0, 60.0)
# Proportions and widths of one picture differ by less than this share.
_SAME = 0.01
# Degrees of latitude, some 1 km: positions farther apart contradict each other.
_OTHER_PLACE = 0.009
# If 0 is straight down, a pitch below this is impossible, so it counts from the horizon.
_MOST_BACK = -30.0
# If twice the optical centre differs from the width by a larger share, the calibration is for another picture size.
_OFF_CENTRE = 0.1
_SOURCES: Mapping[Convention, HeadingSource] = {
    "gimbal": "gimbal", "on platform": "gimbal", "nadir": "camera", "direction": "camera", "fixed": "aircraft",
    "aircraft": "aircraft",
}  # fmt: skip
_RTK_FIXED = 50
# Texts that mark an altitude above the ellipsoid: DJI's AltitudeType, and VertCS of Pix4D and Skydio.
_ELLIPSOIDAL = ("rtkalt", "ellipsoidal")
_ZONE = re.compile(r"\s*(?:Z|[-+]\d\d:?\d\d)$", re.ASCII)
_QUARTER = 900.0


@dataclass(frozen=True)
class Photo:
    """A photo's frame without a time, and facts for its flight.

    Attributes:
        utc, local: seconds since 1970-01-01 in UTC and on the camera's clock.
        turns: quarter turns clockwise that make the picture upright, by EXIF orientation.
        oddities: predicates of "The photo ...", such as "has damaged EXIF"; the flight's notes count equal ones.
        camera: maker and model by EXIF; "" if unknown.
    """

    frame: Frame
    utc: float | None = None
    local: float | None = None
    turns: int = 0
    oddities: tuple[str, ...] = ()
    camera: str = ""


@dataclass
class _Metadata:
    """A picture file's metadata: its stored size, EXIF and XMP properties, and their oddities."""

    width: int
    height: int
    properties: Properties = field(default_factory=Properties)
    oddities: list[str] = field(default_factory=list)

    @property
    def zoom(self) -> float:
        """The factor of the digital zoom, by which the field of view is narrower than the lens's."""
        zoom = self.properties.first("zoom")
        return zoom if zoom is not None and zoom > 1 else 1.0

    @property
    def taken_size(self) -> tuple[float, float]:
        """Width and height in pixels of the picture as it was taken."""
        told = next((numbers for _, numbers in self.properties.rows("size")), (None, None, None))
        width, height = told[0] or float(self.width), told[1] or float(self.height)
        # A program that turned the picture may have kept the old sizes.
        return (height, width) if abs(height / width * self.height / self.width - 1) <= _SAME else (width, height)

    @property
    def is_whole(self) -> bool:
        """True unless the proportions show that the picture was cropped after it was taken."""
        width, height = self.taken_size
        return abs(width / height * self.height / self.width - 1) <= _SAME


class _Angles(NamedTuple):
    """Heading, pitch, and roll of a `Frame` by one source, in degrees, before the picture is turned upright."""

    heading: float | None
    pitch: float | None
    roll: float | None
    source: HeadingSource


def read_photo(file: Path) -> Photo:
    """Read a photo's metadata without decoding pixels; the end of the file is checked.

    Raises:
        PictureError: if the file is no readable picture, or is cut short.
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
    known = _metadata(data)
    properties = known.properties
    turns = _turns(known)
    latitude, longitude = _position(known)
    heading, pitch, roll, source = _angles(known, turns)
    lens, fov = _view(known, turns)
    utc, local = _times(known)
    width, height = (known.height, known.width) if turns % 2 else (known.width, known.height)
    frame = Frame(
        file.name, file, width, height, None, latitude, longitude, properties.first("height_above_ground"),
        properties.first("height_above_takeoff"), _altitude(known), heading, source, pitch, roll, fov, lens,
    )  # fmt: skip
    if properties.unreadable:
        known.oddities.append(f"has values that cannot be read: {first_few(properties.unreadable, 12)}")
    maker, model = (text_of(properties.raw(name)) for name in ("Make", "Model"))
    camera = model if model.startswith(maker) else f"{maker} {model}".strip()
    return Photo(frame, utc, local, turns, tuple(dict.fromkeys(known.oddities)), camera)


def _metadata(data: bytes) -> _Metadata:
    """Read EXIF and XMP; damaged parts become oddities, and readable parts are used."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(io.BytesIO(data)) as picture:
            known = _Metadata(*picture.size)
            for directory in (None, ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                try:
                    exif = picture.getexif()
                    tags = dict(exif if directory is None else exif.get_ifd(directory))
                except DAMAGED:
                    known.oddities.append("has damaged EXIF, which was not used")
                    continue
                names: Any = ExifTags.GPSTAGS if directory is ExifTags.IFD.GPSInfo else ExifTags.TAGS
                for tag, value in tags.items():
                    name = names.get(tag, "")
                    known.properties.add("exif", _NAMES.get(name, name), value)
                if directory is None and picture.format == "TIFF":
                    # Pillow turns the size by the orientation for TIFF only.
                    known.width = tags.get(ExifTags.Base.ImageWidth, known.width)
                    known.height = tags.get(ExifTags.Base.ImageLength, known.height)
            packets = list(_packets(picture, known.properties.raw(ExifTags.TAGS[_XMP_TAG])))
    for packet in packets:
        found, damaged = read_xmp(packet)
        for namespace, name, text in found:
            known.properties.add(namespace, name, text)
        if damaged:
            known.oddities.append("has damaged XMP, of which the readable properties were used")
    return known


def _packets(picture: Image.Image, tag: Any) -> Iterator[bytes]:
    """Yield the XMP packets of a picture: segments of a JPEG, else its format's packet, else a TIFF tag's."""
    segments = [data for marker, data in getattr(picture, "applist", ()) if marker == "APP1" and b":RDF" in data]
    if segments:
        yield from segments
        return
    packet = picture.info.get("xmp") or picture.info.get("XML:com.adobe.xmp") or tag
    if isinstance(packet, str):
        yield packet.encode()
    elif isinstance(packet, bytes):
        yield packet


def _turns(known: _Metadata) -> int:
    orientation = known.properties.raw("Orientation")
    if orientation in _MIRRORED:
        known.oddities.append(
            "is mirrored by its EXIF orientation; if its file is no mirror image, remove that tag, as a mirror image fits no map"
        )
    elif orientation is not None and orientation not in _TURNS:
        known.properties.refuse("exif:Orientation")
    return _TURNS.get(orientation, 0)


def _position(known: _Metadata) -> tuple[float | None, float | None]:
    places: list[tuple[float, float, str]] = []
    for row, pair in known.properties.rows("position"):
        latitude, longitude, *_ = (
            _signed(known, name, value, "SW"[i]) if row.namespace == "exif" else value
            for i, (name, value) in enumerate(zip(row.names.split(), pair, strict=False))
        )
        if latitude is None or longitude is None or latitude == longitude == 0:
            continue
        if abs(latitude) <= 90 and abs(longitude) <= 180:
            places.append((latitude, longitude, row.namespace))
        else:
            known.properties.refuse(f"{row.namespace}:{row.names.split()[0]}")
    if not places:
        return None, None
    (latitude, longitude, name), *others = places
    for north, east, other in others:
        aside = wrap_degrees(east - longitude) * math.cos(math.radians(latitude))
        if math.hypot(north - latitude, aside) > _OTHER_PLACE:
            known.oddities.append(f"has another position in {other} than in {name}, which was used")
    flag = known.properties.first("rtk")
    if flag is not None and flag != _RTK_FIXED:
        known.oddities.append(f"has a position without an RTK fix (RtkFlag {flag:g}), which may be metres off")
    return latitude, longitude


def _signed(known: _Metadata, name: str, value: float | None, south: str) -> float | None:
    """Return a coordinate of EXIF with the sign of its reference; None if neither reference nor value has a sign."""
    reference = text_of(known.properties.raw(f"{name}Ref"))[:1].upper()
    if value is None:
        return None
    if reference == south:
        return -abs(value)
    if reference not in ("N", "E") and value > 0 and not isinstance(known.properties.raw(name), str):
        known.properties.refuse(f"exif:{name}Ref")
        return None
    return value


def _altitude(known: _Metadata) -> float | None:
    """Return the altitude in metres; an altitude above the ellipsoid is an oddity."""
    row, altitude = next(((row, numbers[0]) for row, numbers in known.properties.rows("altitude")), (None, None))
    if row is None or altitude is None:
        return None
    kind = ""
    if row.namespace == "exif":
        reference = known.properties.raw("GPSAltitudeRef")
        # 1 is below the sea; 2 is above the ellipsoid, and 3 below it, in EXIF 3.0.
        kind = str(reference[0] if isinstance(reference, bytes) and reference else reference)
        altitude = -abs(altitude) if kind in ("1", "3") else altitude
    told = known.properties.text("altitude type").casefold() in _ELLIPSOIDAL or kind in ("2", "3")
    if row.convention == "ellipsoid" or (told and row.convention != "sea"):
        known.oddities.append("has its altitude above the ellipsoid, not above the sea")
    return altitude


def _angles(known: _Metadata, turns: int) -> tuple[float | None, float | None, float | None, HeadingSource | None]:
    """Return heading, pitch, and roll of the upright picture, and the heading's source."""
    told = list(_told_angles(known))
    best = next((angles for angles in told if angles.heading is not None), None)
    tilt = best if best is not None and best.pitch is not None else next((a for a in told if a.pitch is not None), None)
    pitch, roll = (None, None) if tilt is None else (tilt.pitch, tilt.roll)
    if best is not None and turns:
        known.oddities.append(turned_oddity(turns))
    heading, pitch, roll = cameras.turned(0.0 if best is None else best.heading or 0.0, pitch, roll, turns)
    return (None, pitch, roll, None) if best is None else (heading, pitch, roll, best.source)


def _told_angles(known: _Metadata) -> Iterator[_Angles]:
    """Yield the angles by each source, best first; a camera's angles that are all 0 are unknown."""
    properties = known.properties
    for row, (yaw, pitch, roll) in properties.rows("angles"):
        convention = row.convention
        if yaw == pitch == 0 and roll in (0, None):
            if convention != "aircraft":
                known.oddities.append("has camera angles that are all 0, which some cameras write for unknown ones")
            continue
        if convention == "on platform":
            platform = next(
                (told for of, told in properties.rows("angles") if of.names.startswith("Platform")), (None,)
            )
            angles = [
                a + b for a, b in zip((yaw, pitch, roll), platform, strict=False) if a is not None and b is not None
            ]
            if len(angles) < 3:
                continue
            yaw, pitch, roll = angles
        elif convention == "nadir" and pitch is not None and pitch < _MOST_BACK:
            known.oddities.append(
                f"has a pitch below {_MOST_BACK:g} where 0 is straight down, which was taken to count from the horizon"
            )
            convention = "gimbal"
        elif convention in ("nadir", "fixed") and pitch is not None:
            pitch -= 90.0
        elif convention == "aircraft":
            pitch = roll = None
        elif row.names == "GPSImgDirection" and text_of(properties.raw("GPSImgDirectionRef")).upper().startswith("M"):
            known.oddities.append("has a direction from magnetic north, which was not corrected")
        if convention in ("gimbal", "on platform") and yaw is not None and pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        pitch, roll = (angle if angle is None or abs(angle) <= 180 else wrap_degrees(angle) for angle in (pitch, roll))
        yield _Angles(None if yaw is None else yaw % 360.0, pitch, roll, _SOURCES[convention])


def turned_oddity(turns: int) -> str:
    return f"is turned by {90 * turns}° by its EXIF orientation, and its heading with it"


def _view(known: _Metadata, turns: int) -> tuple[Lens | None, float | None]:
    """Return the lens if the picture still has its known distortion, and the upright picture's horizontal field of view."""
    if projection := known.properties.text("projection"):
        known.oddities.append(
            f"is a panorama ({printable(projection)[:40]}), whose ground has not the map's shape; leave it out"
        )
        return None, None
    width, height = known.taken_size
    text = known.properties.text("lens")
    if text and known.properties.text("undistorted") != "1":
        try:
            if turns or not known.is_whole:
                raise ValueError("the table of a picture that was turned or cropped")
            # The coefficients describe the whole picture; a digital zoom shows its middle.
            lens = lens_of_dewarp_data(text, width / known.zoom)
        except ValueError as error:
            known.oddities.append(f"has a DewarpData that was not used, because it has {printable(str(error))[:80]}")
        else:
            return lens, lens.fov
    if (fov := known.properties.first("fov")) is None:
        fov = _lens_fov(known, width, height)
        if fov is not None and known.zoom > 1:
            known.oddities.append(
                f"has a digital zoom of {known.zoom:g}, which narrows its field of view; if its maker's focal length counts the "
                "zoom already, as that of some phones, it is too narrow"
            )
    if fov is None:
        return None, None
    if abs(width / known.width - 1) > _SAME:
        known.oddities.append(
            f"is {known.width} x {known.height} pixels where its EXIF says {width:.0f} x {height:.0f}; "
            + ("its field of view is right if it was reduced, and too wide if it was cropped" if known.is_whole
               else "it was cropped, and its field of view may be too wide")
        )  # fmt: skip
    fov = cameras.fov_across(fov, known.height / known.width) if turns % 2 else fov
    return None, fov if cameras.FOV_RANGE[0] <= fov <= cameras.FOV_RANGE[1] else None


def _lens_fov(known: _Metadata, width: float, height: float) -> float | None:
    """Return the field of view in degrees across the width of the picture as taken, with zoom; None if unknown.

    An equivalent focal length gives the field of view across the longer side.
    """
    properties = known.properties
    if (ratio := _sensor_ratio(known, width, height)) is not None:
        return cameras.fov_of_sensor(ratio / known.zoom, 1.0)
    if not (equivalent := properties.first("equivalent")) or equivalent < 0:
        return None
    longer = cameras.fov_of_equivalent(equivalent, properties.first("focal length"))
    return cameras.fov_across(longer, min(width / height, 1.0) / known.zoom)


def _sensor_ratio(known: _Metadata, width: float, height: float) -> float | None:
    """Return the sensor's width in focal lengths, by a calibration, EXIF's resolution, or Pix4D; None without these."""
    properties = known.properties
    for _, (calibrated, across, down) in properties.rows("calibration"):
        if not calibrated or calibrated < 0:
            continue
        if not across or abs(2 * across / width - 1) <= _OFF_CENTRE:
            return width / calibrated
        # A picture of another size was reduced. If its proportions are less wide, the calibration is another camera's.
        if not down or width / height * down / across >= 1 - _OFF_CENTRE / 2:
            return 2 * across / calibrated
        known.oddities.append("has a focal length calibrated for other proportions, which was not used")
    focal = properties.first("focal length") or 0.0
    for _, (density, unit, _) in properties.rows("resolution"):
        sensor = width * _UNITS.get(unit, 0.0) / density if density else 0.0
        if focal > 0 and _SENSOR_WIDTHS[0] <= sensor <= _SENSOR_WIDTHS[1]:
            return sensor / focal
    perspective = properties.first("perspective") or 0.0
    # The principal point is the sensor's middle to within some hundredths of its width.
    sensor = 2 * (number(properties.text("principal point").split(",")[0]) or 0.0)
    if (
        perspective > 0
        and properties.text("perspective unit") in ("", "mm")
        and _SENSOR_WIDTHS[0] <= sensor <= _SENSOR_WIDTHS[1]
    ):
        return sensor / perspective
    return None


def _times(known: _Metadata) -> tuple[float | None, float | None]:
    properties = known.properties
    # Editing programs set DateTime, the last of the table, to the time of the change. Some cameras write blanks for zeros.
    name, stamp = next(properties.texts("taken"), ("", ""))
    clock = _ZONE.sub("", stamp.replace(": ", ":0"))
    taken = moment(clock)
    if taken is None and re.search("[1-9]", stamp):
        properties.refuse(name)
    fraction = text_of(properties.raw("SubsecTimeOriginal"))
    fraction = fraction if fraction.isascii() and fraction.isdecimal() else "0"
    local = None if taken is None else taken.seconds + float(f"0.{fraction}")
    for name, text in properties.texts("utc"):
        if (exposed := moment(text)) is not None:
            return exposed.seconds, local
        properties.refuse(name)
    own_zone = _ZONE.search(stamp)
    zone = properties.text("zone") if own_zone is None else own_zone[0]
    zoned = moment(clock + zone)
    if local is not None and zoned is not None and zoned.zoned:
        return zoned.seconds + float(f"0.{fraction}"), local
    if local is not None and re.search(r"\w", zone):
        properties.refuse("exif:OffsetTimeOriginal")
    return _gps_time(properties), local


def _gps_time(properties: Properties) -> float | None:
    raw = properties.raw("GPSTimeStamp")
    parts = [number(part) for part in raw] if isinstance(raw, tuple | list) else []
    clock = [part for part in parts if part is not None and 0 <= part <= 60]
    day = moment(f"{text_of(properties.raw('GPSDateStamp'))} 00:00:00")
    if raw is not None and (len(parts) != 3 or len(clock) != 3 or clock[0] >= 24):
        properties.refuse("exif:GPSTimeStamp")
        return None
    return None if day is None or not clock else day.seconds + 3600 * clock[0] + 60 * clock[1] + clock[2]


def set_times(photos: Sequence[Photo]) -> tuple[list[Frame], bool, list[str]]:
    """Put the photos of a flight on one clock, and order them by time, then by name.

    Returns:
        Frames, whether their times are UTC (else seconds since the first), and notes about the clocks.
    """
    pairs = sorted(photo.utc - photo.local for photo in photos if photo.utc is not None and photo.local is not None)
    notes = _clock_notes(pairs)
    is_utc = any(photo.utc is not None for photo in photos)
    times = [photo.local if not is_utc else photo.utc for photo in photos]
    if is_utc and pairs:
        behind = pairs[len(pairs) // 2]
        times = [
            photo.local + behind if time is None and photo.local is not None else time
            for photo, time in zip(photos, times, strict=True)
        ]
    known = [time for time in times if time is not None]
    start = 0.0
    if known and not is_utc:
        start = min(known)
        notes.append("No photo has its time in UTC: times are seconds since the first photo.")
    frames = [
        replace(photo.frame, time=None if time is None else time - start)
        for photo, time in zip(photos, times, strict=True)
    ]
    if len(known) < len(frames):
        notes.append(
            f"{len(frames) - len(known)} of {len(frames)} photos have no time: the photos are in the order of their names."
        )
        return sorted(frames, key=lambda frame: natural(frame.name)), is_utc, notes
    return sorted(frames, key=lambda frame: (frame.time, natural(frame.name))), is_utc, notes


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that compares numbers in names by value: "9.jpg" precedes "10.jpg"."""
    return [(int(digits or 0), letters.casefold()) for digits, letters in re.findall(r"([0-9]*)([^0-9]*)", name)]


def _clock_notes(pairs: Sequence[float]) -> list[str]:
    """Compare the camera's clock with UTC; `pairs` are sorted differences in seconds, positive if the camera is behind."""
    if not pairs:
        return []
    middle, spread = pairs[len(pairs) // 2], pairs[-1] - pairs[0]
    zone = -round(middle / _QUARTER) * _QUARTER
    late, notes = middle + zone, []
    if abs(late) > 2:
        hours = f"UTC{zone / 3600:+g}" if zone else "UTC"
        notes.append(f"The camera's clock is {abs(late):.0f} s {'behind' if late > 0 else 'ahead of'} {hours}.")
    if spread > 2:
        notes.append(f"The camera's clock and UTC move apart by {spread:.0f} s during the flight.")
    return notes
