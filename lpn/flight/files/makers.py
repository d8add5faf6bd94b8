"""The EXIF and XMP properties of a camera's position, height, angles, lens, and time, by maker.

EXIF's tags are named by XMP's namespace exif, which copies them. Other namespaces are recognised by a part of their address, or
by an undeclared prefix. Case is ignored. Names that DJI coined and other makers copy count in every namespace, and so does EXIF's
DigitalZoomRatio. Rows of one field are sorted from best to worst.

A **convention** defines the angles:

gimbal       yaw, pitch, roll of the camera against north, east, down; pitch 0 looks at the horizon, -90 down; roll about the
             optical axis
on platform  as gimbal, but against the aircraft, whose angles are added
nadir        yaw, pitch, roll of a body whose camera looks straight down; pitch 0 looks down, 90 at the horizon
direction    a compass direction of the camera
fixed        of an aircraft without a gimbal, whose camera looks straight down in level flight
aircraft     of an aircraft whose camera may look elsewhere

An altitude's convention is its zero, "sea" or "ellipsoid"; without one, the file's altitude type may name it.

ElementTree reads a well-formed XMP packet. From a damaged one, complete attributes and elements are used. Entities of a document
type are never expanded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from html import unescape
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree

from lpn.flight.files import values

Convention = Literal["", "gimbal", "on platform", "nadir", "direction", "fixed", "aircraft", "sea", "ellipsoid"]
Unit = Literal["degrees", "metres", "metres, 0 if unknown", "pixels", "millimetres", "times", "text"]


class PropertyRow(NamedTuple):
    """The meaning of one property, or of two or three that belong together.

    Attributes:
        field: a field of `Frame`, or a value from which one is computed.
        namespace: a key of `NAMESPACES`.
        names: of the properties, separated by blanks; "/" precedes a nested property's name.
        unit, convention: of the values.
        source: the documentation, or a public file with the property.
    """

    field: str
    namespace: str
    names: str
    unit: Unit
    convention: Convention
    source: str


# Parts of each namespace's addresses, in lower case.
NAMESPACES: Mapping[str, tuple[str, ...]] = {
    "drone-dji": ("drone-dji",),
    "drone-parrot": ("drone-parrot",),
    "drone-skydio": ("drone-skydio",),
    "drone-yuneec": ("drone-yuneec",),
    "sensefly": ("sensefly.com/sensefly",),
    "Camera": ("pix4d.com", "sensefly.com/camera"),
    "Sentera": ("sentera",),
    "FLIR": ("ns.flir.com/xmp",),
    "GPano": ("google.com/photos/1.0/panorama",),
    "exif": ("ns.adobe.com/exif",),
    "xmp": ("ns.adobe.com/xap/1.0",),
}

_DJI = "https://github.com/exiftool/exiftool lib/Image/ExifTool/DJI.pm"
_DJI_GUIDE = "Mavic 3M Image Processing Guide, https://ag.dji.com/mavic-3-m"
_DJI_MANUAL = "Mavic 3M User Manual, page 90, https://www.easymanua.ls/dji/mavic-3m/manual?p=90"
_DJI_SDK = "https://github.com/dji-sdk/Mobile-SDK-Android/issues/984"
_DJI_P1 = "Zenmuse P1 User Manual, page 22, https://www.easymanua.ls/dji/zenmuse-p1/manual?p=22"
_DJI_ALTITUDE = "https://developer.dji.com/onboard-sdk/documentation/guides/component-guide-altitude.html"
_PARROT = "https://developer.parrot.com/docs/groundsdk-tools/photo-metadata.html"
_PIX4D = "https://support.pix4d.com/hc/en-us/articles/360016450032"
_PIX4D_ANGLES = "https://support.pix4d.com/hc/en-us/articles/202558969"
_SKYDIO = "https://support.skydio.com/hc/en-us/articles/4417425974683"
_SKYDIO_X10 = "https://support.skydio.com/hc/en-us/articles/20866347470491"
_SKYDIO_RTK = "https://support.skydio.com/hc/en-us/articles/32887502774171"
_YUNEEC = "https://github.com/h-elsner/EXIFupdate source/exifupdate_main.pas"
_SENSEFLY = "https://github.com/OpenDroneMap/odm_data_seneca"
_SENTERA = "https://github.com/SenteraLLC/py-image-metadata-parser tests/data"
_FLIR = "https://github.com/MikeKovarik/exifr test/fixtures/issue-exif-js-124.tiff"
_TEAL = "https://github.com/Theta-Limited/OpenAthenaIOS OpenAthenaIOS/examples/teal2_img_eo_00015.jpg"
_GPANO = "https://developers.google.com/streetview/spherical-metadata"
_MINI_5 = "https://github.com/hotosm/drone-tm/issues/777"
_EXIF = "XMP Specification Part 2, Exif schema"
_DJI_CALIBRATION = "CalibratedFocalLength CalibratedOpticalCenterX CalibratedOpticalCenterY"
_SKYDIO_CALIBRATION = "CalibratedFocalLength/X CalibratedOpticalCenter/X CalibratedOpticalCenter/Y"


def _axes(name: str) -> str:
    return " ".join(name.format(axis) for axis in ("Yaw", "Pitch", "Roll"))


ROWS: tuple[PropertyRow, ...] = (
    PropertyRow("position", "drone-dji", "GpsLatitude GpsLongitude", "degrees", "", _DJI),
    PropertyRow("position", "drone-dji", "GpsLatitude GpsLongtitude", "degrees", "", _DJI),
    PropertyRow("position", "drone-dji", "Latitude Longitude", "degrees", "", _DJI),
    PropertyRow("position", "drone-skydio", "Latitude Longitude", "degrees", "", _SKYDIO),
    PropertyRow("position", "sensefly", "Latitude Longitude", "degrees", "", _SENSEFLY),
    PropertyRow("position", "exif", "GPSLatitude GPSLongitude", "degrees", "", _EXIF),
    PropertyRow("rtk", "drone-dji", "RtkFlag", "times", "", _DJI_P1),
    PropertyRow("height_above_ground", "sensefly", "Height", "metres", "", _SENSEFLY),
    PropertyRow("height_above_ground", "Camera", "AboveGroundAltitude", "metres", "", _PIX4D),
    PropertyRow("height_above_ground", "Sentera", "AltimeterCalculatedAGL", "metres", "", _SENTERA),
    PropertyRow("height_above_ground", "Sentera", "AltimeterCalcuatedAGL", "metres", "", _SENTERA),
    PropertyRow("height_above_takeoff", "drone-dji", "RelativeAltitude", "metres", "", _DJI_GUIDE),
    PropertyRow("height_above_takeoff", "drone-skydio", "RelativeAltitude", "metres", "", _SKYDIO_X10),
    PropertyRow("height_above_takeoff", "drone-yuneec", "AboveHomeAltitude", "metres", "", _YUNEEC),
    PropertyRow("height_above_takeoff", "FLIR", "MAVRelativeAltitude", "metres, 0 if unknown", "", _FLIR),
    PropertyRow("altitude", "drone-dji", "AbsoluteAltitude", "metres", "", _DJI_GUIDE),
    PropertyRow("altitude", "drone-skydio", "GpsMslHeight", "metres", "sea", _SKYDIO_X10),
    PropertyRow("altitude", "drone-skydio", "AbsoluteAltitude", "metres", "", _SKYDIO),
    PropertyRow("altitude", "drone-yuneec", "GPSAltitude", "metres", "", _YUNEEC),
    PropertyRow("altitude", "sensefly", "AltitudeAMSL", "metres", "sea", _SENSEFLY),
    PropertyRow("altitude", "sensefly", "AltitudeWGS84", "metres", "ellipsoid", _SENSEFLY),
    PropertyRow("altitude", "exif", "GPSAltitude", "metres", "", _EXIF),
    PropertyRow("altitude", "xmp", "GPSAltitude", "metres", "", _YUNEEC),
    PropertyRow("altitude type", "drone-dji", "AltitudeType", "text", "", _DJI_ALTITUDE),
    PropertyRow("altitude type", "drone-skydio", "VertCS", "text", "", _SKYDIO_RTK),
    PropertyRow("altitude type", "Camera", "VertCS", "text", "", _PIX4D),
    PropertyRow("angles", "drone-dji", _axes("Gimbal{}Degree"), "degrees", "gimbal", _DJI_GUIDE),
    PropertyRow("angles", "drone-skydio", _axes("CameraOrientationNED/{}"), "degrees", "gimbal", _SKYDIO),
    PropertyRow("angles", "drone-parrot", _axes("Camera{}Degree"), "degrees", "gimbal", _PARROT),
    PropertyRow("angles", "drone-yuneec", _axes("Gimbal{}"), "degrees", "gimbal", _YUNEEC),
    PropertyRow("angles", "xmp", _axes("Camera{}"), "degrees", "gimbal", _YUNEEC),
    PropertyRow("angles", "exif", _axes("Camera{}"), "degrees", "on platform", _TEAL),
    PropertyRow("angles", "Camera", _axes("{}"), "degrees", "nadir", _PIX4D_ANGLES),
    PropertyRow("angles", "GPano", "PoseHeadingDegrees PosePitchDegrees PoseRollDegrees", "degrees", "direction", _GPANO),
    PropertyRow("angles", "exif", "GPSImgDirection", "degrees", "direction", _EXIF),
    PropertyRow("angles", "sensefly", "Heading PitchAngle RollAngle", "degrees", "fixed", _SENSEFLY),
    PropertyRow("angles", "drone-dji", _axes("Flight{}Degree"), "degrees", "aircraft", _DJI_SDK),
    PropertyRow("angles", "drone-dji", "FlightYaw", "degrees", "aircraft", _DJI_SDK),
    PropertyRow("angles", "drone-skydio", _axes("VehicleOrientationNED/{}"), "degrees", "aircraft", _SKYDIO),
    PropertyRow("angles", "drone-yuneec", _axes("Drone{}"), "degrees", "aircraft", _YUNEEC),
    PropertyRow("angles", "exif", _axes("Platform{}"), "degrees", "aircraft", _TEAL),
    PropertyRow("angles", "FLIR", _axes("MAV{}"), "degrees", "aircraft", _FLIR),
    PropertyRow("projection", "GPano", "ProjectionType", "text", "", _GPANO),
    PropertyRow("lens", "drone-dji", "DewarpData", "text", "", _DJI_MANUAL),
    PropertyRow("undistorted", "drone-dji", "DewarpFlag", "text", "", _DJI_MANUAL),
    PropertyRow("fov", "exif", "CameraHorizontalFOV", "degrees", "", _TEAL),
    PropertyRow("calibration", "drone-dji", _DJI_CALIBRATION, "pixels", "", _DJI),
    PropertyRow("calibration", "drone-skydio", _SKYDIO_CALIBRATION, "pixels", "", _SKYDIO),
    PropertyRow("perspective", "Camera", "PerspectiveFocalLength", "millimetres", "", _PIX4D),
    PropertyRow("principal point", "Camera", "PrincipalPoint", "text", "", _PIX4D),
    PropertyRow("focal length", "exif", "FocalLength", "millimetres", "", _EXIF),
    PropertyRow("equivalent", "exif", "FocalLengthIn35mmFilm", "millimetres", "", _EXIF),
    PropertyRow("resolution", "exif", "FocalPlaneXResolution FocalPlaneResolutionUnit", "pixels", "", _EXIF),
    PropertyRow("size", "exif", "ExifImageWidth ExifImageHeight", "pixels", "", _EXIF),
    PropertyRow("size", "exif", "PixelXDimension PixelYDimension", "pixels", "", _EXIF),
    PropertyRow("zoom", "exif", "DigitalZoomRatio", "times", "", _EXIF),
    PropertyRow("taken", "exif", "DateTimeOriginal", "text", "", _EXIF),
    PropertyRow("taken", "exif", "DateTimeDigitized", "text", "", _EXIF),
    PropertyRow("taken", "xmp", "CreateDate", "text", "", _MINI_5),
    PropertyRow("taken", "exif", "DateTime", "text", "", _EXIF),
    PropertyRow("zone", "exif", "OffsetTimeOriginal", "text", "", _EXIF),
    PropertyRow("utc", "drone-dji", "UTCAtExposure", "text", "", _DJI_GUIDE),
    PropertyRow("utc", "sensefly", "UTCTime", "text", "", _SENSEFLY),
    PropertyRow("utc", "exif", "GPSTimeStamp", "text", "", _EXIF),
)  # fmt: skip

_KNOWN = frozenset((row.namespace, name.casefold()) for row in ROWS for name in row.names.split())
_COINED = re.compile(r"(?:gimbal|flight)\w+degree|(?:relative|absolute)altitude|gps(?:lat|long|longt)itude")
# Heights in metres and angles in degrees beyond these come from wrong bytes.
_MOST: Mapping[str, float] = {"degrees": 720.0, "metres": 1e5, "metres, 0 if unknown": 1e5}
# Limits of an XMP packet: bytes, and levels of properties within properties.
_MOST_BYTES, _MOST_LEVELS = 2_000_000, 12
_OPENING = re.compile(r"<([\w-]{1,40}:(?:xmpmeta|RDF))\b")
# Namespaces of XMP's envelope; their elements are no properties.
_FRAME = ("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}", "{adobe:ns:meta/}", "{http://www.w3.org/XML/1998/namespace}")
_PREFIX = re.compile(r"""\bxmlns:([\w-]{1,40})="([^"<]{0,200})""")
# An attribute with its value, or an element with its text. The bounded repeats keep the search linear.
_PROPERTY = re.compile(
    r'(?<![\w-])(?!xmlns:)([\w-]{1,40}):(\w{1,60})(?:\s{0,9}=\s{0,9}"([^"<>]{0,2000})"|>([^<>]{0,2000})</\1:\2>)'
)


class Properties:
    """The properties of a photo by namespace and name; the first value of each counts.

    Attributes:
        unreadable: properties of the table with unreadable values, such as "exif:GPSAltitude".
    """

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], Any] = {}
        self.unreadable: list[str] = []

    def add(self, namespace: str, name: str, value: Any) -> None:
        """Add a value of EXIF, or a text of XMP; blank ones are ignored."""
        key = namespace, name.casefold()
        if key not in _KNOWN:
            copied = {"digitalzoomratio": "exif"}.get(key[1], "drone-dji" if _COINED.fullmatch(key[1]) else namespace)
            key = copied, key[1]
        if value is not None and value != "":
            self._values.setdefault(key, value)

    def add_xmp(self, packet: bytes) -> bool:
        """Add the properties of an XMP packet, without nested ones if it is damaged, and return whether it is."""
        wide = packet[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = packet[:_MOST_BYTES].decode("utf-16" if wide else "utf-8", "replace")
        if (opening := _OPENING.search(text)) is None:
            return True
        # The cut removes a document type, which precedes the first element, so the parser sees none of its entities.
        end = text.rfind(f"</{opening[1]}")
        text = text[opening.start() : None if end < 0 else text.find(">", end) + 1]
        is_damaged = False
        try:
            found = list(_properties(ElementTree.fromstring(text), ()))
        except (ElementTree.ParseError, RecursionError):
            is_damaged = True
            declared = dict(_PREFIX.findall(text))
            told = _PROPERTY.findall(text)
            found = [(declared.get(prefix, prefix), name, unescape(one or other)) for prefix, name, one, other in told]
        for address, name, value in found:
            self.add(_namespace(address), name, value.strip())
        return is_damaged

    def raw(self, name: str, namespace: str = "exif") -> Any:
        """Return the raw value of a property; None without one."""
        return self._values.get((namespace, name.casefold()))

    def rows(self, field: str) -> Iterator[tuple[PropertyRow, tuple[Any, ...]]]:
        """Yield the rows of a field with a value, best first, each with three numbers or texts, None where unknown."""
        for row in ROWS:
            found = [self._value(row, name) for name in row.names.split() if row.field == field]
            if any(value is not None for value in found):
                yield row, (*found, None, None)[:3]

    def first(self, field: str) -> Any:
        """Return the number or text of the best row of a field; None without one."""
        return next((found[0] for _, found in self.rows(field) if found[0] is not None), None)

    def refuse(self, name: str) -> None:
        """Note a property with an unreadable value, such as "exif:GPSAltitude"."""
        self.unreadable += [] if name in self.unreadable else [name]

    def _value(self, row: PropertyRow, name: str) -> float | str | None:
        raw = self.raw(name, row.namespace)
        if raw is None or row.unit == "text":
            return text_of(raw) or None
        value = degrees(raw) if row.unit == "degrees" else number(raw)
        if value is None or abs(value) > _MOST.get(row.unit, math.inf):
            # A camera that did not zoom may write 0/0.
            if row.field != "zoom":
                self.refuse(f"{row.namespace}:{name}")
            return None
        if row.field == "position" and row.namespace == "exif":
            reference = text_of(self.raw(f"{name}Ref"))[:1].upper()
            if reference in ("S", "W"):
                return -abs(value)
            # Without a letter, a sign or a text tells the hemisphere.
            if reference not in ("N", "E") and value > 0 and not isinstance(raw, str):
                self.refuse(f"exif:{name}Ref")
                return None
        return None if value == 0 and row.unit == "metres, 0 if unknown" else value


def _properties(element: ElementTree.Element, tags: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Yield address, name, and text of an element's properties in the order of the packet; `tags` are the elements around it."""
    tags = tags if element.tag.startswith(_FRAME) else (*tags, element.tag)
    for tag, text in [*element.attrib.items(), ("", element.text or "")]:
        path = [name.removeprefix("{").rpartition("}") for name in (*tags, tag) if name]
        if path and text.strip() and not tag.startswith(_FRAME):
            yield path[0][0], "/".join(name for _, _, name in path), text
    for child in element if len(tags) < _MOST_LEVELS else ():
        yield from _properties(child, tags)


def _namespace(address: str) -> str:
    """Return the key of a namespace's address, or of an undeclared prefix; "" for others."""
    address = address.casefold().rstrip("/#")
    found = (key for key, parts in NAMESPACES.items() if address == key.casefold() or any(p in address for p in parts))
    return next(found, "")


def text_of(value: Any) -> str:
    """Return a value of EXIF or XMP as text, stripped of blanks and NULs; "" for numbers."""
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return value.strip("\x00 \t\r\n") if isinstance(value, str) else ""


def number(value: Any) -> float | None:
    """Return a value of EXIF or XMP, such as "+39.80", "-8759/100", or "12.5 m", as a finite number, else None."""
    if isinstance(value, tuple | list) and len(value) == 1:
        value = value[0]
    return values.number(text_of(value) or str(value), comma=True)


def degrees(value: Any) -> float | None:
    """Return degrees of a number, a text such as "47,18.074N", or EXIF's degrees, minutes, and seconds, else None."""
    if isinstance(value, str | bytes) and "/" not in text_of(value):
        return values.angle(text_of(value))
    if not isinstance(value, tuple | list):
        return number(value)
    parts = [number(part) for part in value]
    total = 0.0
    for i, part in enumerate(parts[:3]):
        if part is None or (i and abs(part) > 60):
            return None
        total += abs(part) / 60.0**i
        # Values after a decimal one are ignored: some programs write 0/0 there, others the decimals again.
        if part % 1:
            break
    return -total if any(part is not None and part < 0 for part in parts) else total
