"""Photos with EXIF and XMP, read as frames.

`lpn.flight.files.makers` lists the properties of each maker, best first. A maker's XMP replaces EXIF's position, which some
firmware truncates. A position (0, 0) is unknown, and so are a camera's angles that are all 0. Oddities of a photo are collected.
"""

from __future__ import annotations

import hashlib
import io
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import ExifTags, Image

from lpn.core.errors import PictureError
from lpn.core.files import first_few, printable
from lpn.core.numbers import wrap_degrees
from lpn.datasets.integrity import stream_error
from lpn.flight.files import cameras
from lpn.flight.files.base import Frame, HeadingSource, local_metres, on_earth
from lpn.flight.files.lenses import Lens, lens_of_text
from lpn.flight.files.makers import Convention, Properties, degrees, number, text_of
from lpn.flight.files.values import moment

# Pillow raises these on damaged EXIF.
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, LookupError, struct.error, OverflowError, RecursionError)
# Quarter turns clockwise that make a picture upright, by EXIF orientation, after a mirrored picture is mirrored back.
_TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
_MIRRORED = (2, 4, 5, 7)
# Millimetres of EXIF's FocalPlaneResolutionUnit.
_UNITS: Mapping[float | None, float] = {None: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Millimetres of a sensor's width; others come from wrong tags.
_SENSOR_WIDTHS = (1.0, 60.0)
# A narrower field of view in degrees comes from wrong tags, unless a digital zoom narrowed it.
_LEAST_FOV = 1.0
# Proportions and widths of one picture differ by less than this share.
_SAME = 0.01
# Metres: positions farther apart contradict each other.
_OTHER_PLACE = 1000.0
# If 0 is straight down, a pitch below this is impossible, so it counts from the horizon.
_MOST_BACK = -30.0
# If twice the optical centre differs from the width by a larger share, the calibration is for another picture size.
_OFF_CENTRE = 0.1
# By convention: the source of the heading, and degrees to add to the pitch; None if the pitch is not that of the camera.
_CONVENTIONS: Mapping[Convention, tuple[HeadingSource, float | None]] = {
    "gimbal": ("gimbal", 0.0), "on platform": ("gimbal", 0.0), "nadir": ("camera", -90.0), "direction": ("camera", 0.0),
    "fixed": ("aircraft", -90.0), "aircraft": ("aircraft", None),
}  # fmt: skip
_RTK_FIXED = 50
# Texts that mark an altitude above the ellipsoid: DJI's AltitudeType, and VertCS of Pix4D and Skydio.
_ELLIPSOIDAL = ("rtkalt", "ellipsoidal")
_ZONE = re.compile(r"\s*(?:Z|[-+]\d\d:?\d\d)$", re.ASCII)


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

    def facts(self, data: bytes) -> list[tuple[str, str]]:
        """Return names and values of a photo for display; `data` are its file's bytes. A missing value is "unknown"."""
        frame, place = self.frame, "unknown"
        if frame.latitude is not None:
            place = f"{frame.latitude:.6f}, {frame.longitude:.6f} (latitude and longitude of the camera)"
        clocks = {"by the camera's clock": self.local, "UTC": self.utc}
        times = {clock: datetime.fromtimestamp(time, UTC) for clock, time in clocks.items() if time is not None}
        return [
            ("File", printable(frame.name)),
            ("SHA-256", hashlib.sha256(data).hexdigest()),
            ("Size", f"{frame.width} × {frame.height} pixels, {len(data):,} bytes"),
            ("Taken", ", ".join(f"{time:%Y-%m-%d %H:%M:%S} {clock}" for clock, time in times.items()) or "unknown"),
            ("Camera", printable(self.camera) or "unknown"),
            ("GPS tag", place),
        ]


class _Metadata(Properties):
    """EXIF and XMP properties of a picture file with its stored size, and their oddities."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__()
        self.width, self.height = width, height
        self.oddities: list[str] = []

    @property
    def zoom(self) -> float:
        """The factor of the digital zoom, which narrows the lens's field of view."""
        return max(self.first("zoom") or 1.0, 1.0)

    @property
    def taken_size(self) -> tuple[float, float]:
        """Width and height in pixels of the picture as it was taken."""
        _, told = next(self.rows("size"), (None, (None, None)))
        width, height = told[0] or self.width, told[1] or self.height
        # A program that turned the picture may have kept the old sizes.
        return (height, width) if abs(height / width * self.height / self.width - 1) <= _SAME else (width, height)

    @property
    def is_whole(self) -> bool:
        """False if the proportions show that the picture was cropped after it was taken."""
        width, height = self.taken_size
        return abs(width / height * self.height / self.width - 1) <= _SAME


class _Angles(NamedTuple):
    """Angles of a `Frame` in degrees by one source."""

    heading: float | None = None
    pitch: float | None = None
    roll: float | None = None
    source: HeadingSource | None = None


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
    orientation = known.raw("Orientation")
    turns = _TURNS.get(orientation, 0)
    if orientation in _MIRRORED:
        known.oddities.append(
            "is mirrored by its EXIF orientation; if its file is no mirror image, remove that tag, as a mirror image fits no map"
        )
    elif orientation is not None and orientation not in _TURNS:
        known.refuse("exif:Orientation")
    latitude, longitude = _position(known)
    heading, pitch, roll, source = _angles(known, turns)
    lens, fov = _view(known, turns)
    utc, local = _times(known)
    width, height = (known.height, known.width) if turns % 2 else (known.width, known.height)
    frame = Frame(
        file.name, file, width, height, None, latitude, longitude, known.first("height_above_ground"),
        known.first("height_above_takeoff"), _altitude(known), heading, source, pitch, roll, fov, lens,
    )  # fmt: skip
    if known.unreadable:
        known.oddities.append(f"has values that cannot be read: {first_few(known.unreadable, 12)}")
    maker, model = (text_of(known.raw(name)) for name in ("Make", "Model"))
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
                names: Mapping[int, str] = ExifTags.GPSTAGS if directory is ExifTags.IFD.GPSInfo else ExifTags.TAGS
                for tag, value in tags.items():
                    known.add("exif", names.get(tag, ""), value)
                if directory is None and picture.format == "TIFF":
                    # Pillow turns the size by the orientation for TIFF only.
                    known.width = tags.get(ExifTags.Base.ImageWidth, known.width)
                    known.height = tags.get(ExifTags.Base.ImageLength, known.height)
            packets = [data for marker, data in getattr(picture, "applist", ()) if marker == "APP1" and b":RDF" in data]
            others = (*map(picture.info.get, ("xmp", "XML:com.adobe.xmp")), known.raw("XMLPacket"))
    packets = packets or [next((packet for packet in others if packet and isinstance(packet, str | bytes)), b"")]
    for packet in filter(None, packets):
        if known.add_xmp(packet.encode() if isinstance(packet, str) else packet):
            known.oddities.append("has damaged XMP, of which the readable properties were used")
    return known


def _position(known: _Metadata) -> tuple[float | None, float | None]:
    found = []
    for row, (latitude, longitude, _) in known.rows("position"):
        if not on_earth(latitude or 0.0, longitude or 0.0):
            known.refuse(f"{row.namespace}:{row.names.split()[0]}")
        elif latitude is not None and longitude is not None and (latitude or longitude):
            found.append((row.namespace, (latitude, longitude)))
    if not found:
        return None, None
    namespaces, places = zip(*found, strict=True)
    for namespace, metres in zip(namespaces, np.hypot(*local_metres(np.array(places)).T), strict=True):
        if metres > _OTHER_PLACE:
            known.oddities.append(f"has another position in {namespace} than in {namespaces[0]}, which was used")
    flag = known.first("rtk")
    if flag is not None and flag != _RTK_FIXED:
        known.oddities.append(f"has a position without an RTK fix (RtkFlag {flag:g}), which may be metres off")
    latitude, longitude = places[0]
    return latitude, longitude


def _altitude(known: _Metadata) -> float | None:
    """Return the altitude in metres; an altitude above the ellipsoid is an oddity."""
    row, (altitude, *_) = next(known.rows("altitude"), (None, (0.0,)))
    if row is None:
        return None
    reference = known.raw("GPSAltitudeRef") if row.namespace == "exif" else None
    # 1 is below the sea; 2 is above the ellipsoid, and 3 below it, in EXIF 3.0.
    kind = str(reference[0] if isinstance(reference, bytes) and reference else reference)
    told = (known.first("altitude type") or "").casefold() in _ELLIPSOIDAL or kind in ("2", "3")
    if row.convention == "ellipsoid" or (told and row.convention != "sea"):
        known.oddities.append("has its altitude above the ellipsoid, not above the sea")
    return -abs(float(altitude)) if kind in ("1", "3") else float(altitude)


def _angles(known: _Metadata, turns: int) -> _Angles:
    """Return the angles of the upright picture: the heading of the best source, and the tilt of this source if it has one."""
    told = list(_told_angles(known))
    best = next((angles for angles in told if angles.heading is not None), _Angles())
    tilt = next((angles for angles in (best, *told) if angles.pitch is not None), _Angles())
    if best.heading is not None and turns:
        known.oddities.append(turned_oddity(turns))
    return _Angles(*cameras.turned(best.heading, tilt.pitch, tilt.roll, turns), best.source)


def _told_angles(known: _Metadata) -> Iterator[_Angles]:
    """Yield the angles by each source, best first; a camera's angles that are all 0 are unknown."""
    for row, told in known.rows("angles"):
        convention, (yaw, pitch, roll) = row.convention, told
        if yaw == pitch == 0 and not roll:
            if convention != "aircraft":
                known.oddities.append("has camera angles that are all 0, which some cameras write for unknown ones")
            continue
        if convention == "on platform":
            platform = next((of for other, of in known.rows("angles") if other.names.startswith("Platform")), (None,))
            if None in (*told, *platform):
                continue
            yaw, pitch, roll = np.add(told, platform).tolist()
        elif convention == "nadir" and (pitch or 0.0) < _MOST_BACK:
            known.oddities.append(
                f"has a pitch below {_MOST_BACK:g} although 0 is straight down; it was taken to count from the horizon"
            )
            convention = "gimbal"
        elif row.names == "GPSImgDirection" and text_of(known.raw("GPSImgDirectionRef")).upper().startswith("M"):
            known.oddities.append("has a direction from magnetic north, which was not corrected")
        source, down = _CONVENTIONS[convention]
        if down is None:
            pitch = roll = None
        elif pitch is not None:
            pitch += down
        if source == "gimbal" and yaw is not None and pitch is not None:
            yaw, pitch, roll = cameras.from_gimbal(yaw, pitch, roll or 0.0)
        pitch, roll = (angle if angle is None or abs(angle) <= 180 else wrap_degrees(angle) for angle in (pitch, roll))
        yield _Angles(None if yaw is None else yaw % 360.0, pitch, roll, source)


def turned_oddity(turns: int) -> str:
    return f"is turned by {90 * turns}° by its EXIF orientation, and its heading with it"


def _view(known: _Metadata, turns: int) -> tuple[Lens | None, float | None]:
    """Return the lens if the picture still has its known distortion, and the upright picture's horizontal field of view."""
    if projection := known.first("projection"):
        known.oddities.append(
            f"is a panorama ({printable(projection)[:40]}), which cannot be laid over a map; leave it out"
        )
        return None, None
    width, height = known.taken_size
    text = known.first("lens")
    if text and known.first("undistorted") != "1":
        try:
            if turns or not known.is_whole:
                raise ValueError("the table of a picture that was turned or cropped")
            # The coefficients describe the whole picture; a digital zoom shows its middle.
            lens = lens_of_text(text, width / known.zoom)
        except ValueError as error:
            known.oddities.append(f"has a DewarpData that was not used, because it has {printable(str(error))[:80]}")
        else:
            return lens, lens.fov
    fovs = (fov for fov in _fovs(known, width, height) if _LEAST_FOV <= fov <= cameras.FOV_RANGE[1])
    if (fov := next(fovs, None)) is None:
        return None, None
    if known.zoom > 1 and fov != cameras.fov_across(known.first("fov") or 0.0, known.zoom):
        known.oddities.append(
            f"has a digital zoom of {known.zoom:g}, which narrows its field of view; the field is too narrow if the focal length "
            "in the file includes the zoom, as on some phones"
        )
    if abs(width / known.width - 1) > _SAME:
        doubt = "its field of view is right if it was reduced, and too wide if it was cropped"
        known.oddities.append(
            f"is {known.width} x {known.height} pixels where its EXIF says {width:.0f} x {height:.0f}; "
            + (doubt if known.is_whole else "it was cropped, and its field of view may be too wide")
        )
    fov = cameras.fov_across(fov, (known.height / known.width if turns % 2 else 1.0) / known.zoom)
    return None, fov if fov >= cameras.FOV_RANGE[0] else None


def _fovs(known: _Metadata, width: float, height: float) -> Iterator[float]:
    """Yield the degrees of view across the picture as taken, without its digital zoom, by each source, best first."""
    if fov := known.first("fov"):
        yield cameras.fov_across(fov, known.zoom)
    for _, (focal, across, down) in known.rows("calibration"):
        if not focal:
            continue
        if not across or abs(2 * across / width - 1) <= _OFF_CENTRE:
            yield cameras.fov_of_sensor(width, focal)
        # A picture of another size was reduced, unless it is much narrower: then the calibration is of another camera.
        elif not down or width / height * down / across >= 1 - _OFF_CENTRE / 2:
            yield cameras.fov_of_sensor(2 * across, focal)
        else:
            known.oddities.append("has a focal length calibrated for other proportions, which was not used")
    focal, equivalent, perspective, principal = map(
        known.first, ("focal length", "equivalent", "perspective", "principal point")
    )
    sensors = [
        (width * _UNITS.get(unit, 0.0) / density, focal)
        for _, (density, unit, _) in known.rows("resolution")
        if density
    ]
    # The principal point is the sensor's middle to within some hundredths of its width.
    sensors.append((2 * (number((principal or "").split(",")[0]) or 0.0), perspective))
    for sensor, length in sensors:
        if length and _SENSOR_WIDTHS[0] <= sensor <= _SENSOR_WIDTHS[1]:
            yield cameras.fov_of_sensor(sensor, length)
    if equivalent:
        # The 35 mm equivalent gives the field of view across the longer side.
        yield cameras.fov_across(cameras.fov_of_equivalent(equivalent, focal), min(width / height, 1.0))


def _times(known: _Metadata) -> tuple[float | None, float | None]:
    """Return the seconds since 1970-01-01 in UTC and on the camera's clock."""
    # Editing programs set DateTime, the last of the table, to the time of the change. Some cameras write blanks for zeros.
    row, (stamp, *_) = next(known.rows("taken"), (None, ("",)))
    stamp = stamp.replace(": ", ":0")
    taken = moment(_ZONE.sub("", stamp))
    if row is not None and taken is None and re.search("[1-9]", stamp):
        known.refuse(f"{row.namespace}:{row.names}")
    fraction = text_of(known.raw("SubsecTimeOriginal"))
    part = float(f"0.{fraction}") if fraction.isascii() and fraction.isdecimal() else 0.0
    local = None if taken is None else taken.seconds + part
    for row, (text, *_) in known.rows("utc"):
        if (exposed := moment(text)) is not None:
            return exposed.seconds, local
        known.refuse(f"{row.namespace}:{row.names}")
    zone = known.first("zone") or ""
    for zoned in map(moment, (stamp, stamp + zone)):
        if zoned is not None and zoned.zoned:
            return zoned.seconds + part, local
    if local is not None and (_ZONE.search(stamp) or re.search(r"\w", zone)):
        known.refuse("exif:OffsetTimeOriginal")
    clock = known.raw("GPSTimeStamp")
    day, hours = moment(f"{text_of(known.raw('GPSDateStamp'))} 00:00:00"), degrees(clock)
    if clock is not None and (hours is None or not 0 <= hours < 24):
        known.refuse("exif:GPSTimeStamp")
        return None, local
    return None if day is None or hours is None else day.seconds + round(3600 * hours, 3), local
