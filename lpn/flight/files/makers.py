"""The properties of XMP that tell a camera's position, height, angles, and focal length, by maker.

Namespaces are told apart by URI, whose scheme, version, and last slash differ between programs. A namespace whose URI is not
declared is known by its prefix. DJI's names, which other makers copy, count in every namespace. Rows of one field stand best
first. Names are compared without regard to case.

A **convention** says how angles are meant; angles are combined only within one:

gimbal       yaw, pitch, roll of the camera against north, east, down; pitch 0 looks at the horizon, -90 down; roll about the
             optical axis
nadir        yaw, pitch, roll of a body whose camera looks straight down; pitch 0 looks down, 90 at the horizon
on platform  as gimbal, but against the aircraft; its angles are to be added
fixed        of an aircraft without a gimbal, whose camera looks straight down in level flight
direction    a compass direction of the camera
aircraft     of an aircraft whose camera may look elsewhere
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

from lpn.flight.files.xmp import XmpProperty

Convention = Literal["", "gimbal", "nadir", "on platform", "fixed", "direction", "aircraft"]
Unit = Literal["degrees", "degrees and minutes", "metres", "metres, 0 if unknown", "pixels", "millimetres", "text"]


class Namespace(NamedTuple):
    """A maker's namespace: its URIs without scheme, "www.", version, and last slash, and the prefixes that are its own."""

    uris: tuple[str, ...]
    prefixes: tuple[str, ...]


class XmpRow(NamedTuple):
    """The meaning of one XMP property.

    Attributes:
        namespace: a key of `NAMESPACES`.
        name: of the property; "/" before the name of a nested one.
        field: a field of `Frame`, or a value from which one is computed; "EXIF Tag" replaces that tag in files without it.
        unit, convention: of the value.
        source: where this is documented, or a public file that has it.
    """

    namespace: str
    name: str
    field: str
    unit: Unit
    convention: Convention
    source: str


NAMESPACES: Mapping[str, Namespace] = {
    "drone-dji": Namespace(("dji.com/drone-dji",), ("drone-dji", "drone", "drone-autel")),
    "drone-parrot": Namespace(("parrot.com/drone-parrot",), ("drone-parrot",)),
    "drone-skydio": Namespace(("skydio.com/drone-skydio",), ("drone-skydio", "skydio")),
    "drone-yuneec": Namespace(("yuneec.com/drone-yuneec",), ("drone-yuneec",)),
    "Camera": Namespace(("pix4d.com/camera", "pix4d.com", "ns.sensefly.com/camera", "camera"), ("camera",)),
    "sensefly": Namespace(("ns.sensefly.com/sensefly", "sensefly.com/sensefly"), ("sensefly",)),
    "Sentera": Namespace(("ns.myname.com/sentera", "sentera.com/camera"), ("sentera",)),
    "FLIR": Namespace(("ns.flir.com/xmp",), ("flir",)),
    "GPano": Namespace(("ns.google.com/photos/1.0/panorama",), ("gpano",)),
    "exif": Namespace(("ns.adobe.com/exif",), ("exif",)),
    "xmp": Namespace(("ns.adobe.com/xap",), ("xmp", "xap")),
}

_DJI = "https://github.com/exiftool/exiftool lib/Image/ExifTool/DJI.pm"
_DJI_GUIDE = "Mavic 3M Image Processing Guide, https://ag.dji.com/mavic-3-m"
_DJI_MANUAL = "Mavic 3M User Manual, page 90, https://www.easymanua.ls/dji/mavic-3m/manual?p=90"
_DJI_SDK = "https://github.com/dji-sdk/Mobile-SDK-Android/issues/984"
_PARROT = "https://developer.parrot.com/docs/groundsdk-tools/photo-metadata.html"
_PIX4D = "https://support.pix4d.com/hc/en-us/articles/360016450032"
_PIX4D_ANGLES = "https://support.pix4d.com/hc/en-us/articles/202558969"
_SKYDIO = "https://support.skydio.com/hc/en-us/articles/4417425974683"
_SKYDIO_X10 = "https://support.skydio.com/hc/en-us/articles/20866347470491"
_YUNEEC = "https://github.com/h-elsner/EXIFupdate source/exifupdate_main.pas"
_SENSEFLY = "https://github.com/OpenDroneMap/odm_data_seneca"
_SENTERA = "https://github.com/SenteraLLC/py-image-metadata-parser tests/data"
_FLIR = "https://github.com/MikeKovarik/exifr test/fixtures/issue-exif-js-124.tiff"
_TEAL = "https://github.com/Theta-Limited/OpenAthenaIOS OpenAthenaIOS/examples/teal2_img_eo_00015.jpg"
_GPANO = "https://developers.google.com/streetview/spherical-metadata"
_MINI_5 = "https://github.com/hotosm/drone-tm/issues/777"
_OSX = "https://github.com/RhetTbull/osxphotos/issues/269"
_EXIF = "XMP Specification Part 2, Exif schema"

ROWS: tuple[XmpRow, ...] = (
    XmpRow("drone-dji", "GpsLatitude", "latitude", "degrees", "", _DJI),
    XmpRow("drone-dji", "Latitude", "latitude", "degrees", "", _DJI),
    XmpRow("drone-dji", "GpsLongitude", "longitude", "degrees", "", _DJI),
    XmpRow("drone-dji", "GpsLongtitude", "longitude", "degrees", "", _DJI),
    XmpRow("drone-dji", "Longitude", "longitude", "degrees", "", _DJI),
    XmpRow("drone-dji", "RelativeAltitude", "height_above_takeoff", "metres", "", _DJI_GUIDE),
    XmpRow("drone-dji", "AbsoluteAltitude", "altitude", "metres", "", _DJI_GUIDE),
    XmpRow("drone-dji", "GimbalYawDegree", "heading", "degrees", "gimbal", _DJI_GUIDE),
    XmpRow("drone-dji", "GimbalPitchDegree", "pitch", "degrees", "gimbal", _DJI_GUIDE),
    XmpRow("drone-dji", "GimbalRollDegree", "roll", "degrees", "gimbal", _DJI_GUIDE),
    XmpRow("drone-skydio", "CameraOrientationNED/Yaw", "heading", "degrees", "gimbal", _SKYDIO),
    XmpRow("drone-skydio", "CameraOrientationNED/Pitch", "pitch", "degrees", "gimbal", _SKYDIO),
    XmpRow("drone-skydio", "CameraOrientationNED/Roll", "roll", "degrees", "gimbal", _SKYDIO),
    XmpRow("drone-parrot", "CameraYawDegree", "heading", "degrees", "gimbal", _PARROT),
    XmpRow("drone-parrot", "CameraPitchDegree", "pitch", "degrees", "gimbal", _PARROT),
    XmpRow("drone-parrot", "CameraRollDegree", "roll", "degrees", "gimbal", _PARROT),
    XmpRow("drone-yuneec", "GimbalYaw", "heading", "degrees", "gimbal", _YUNEEC),
    XmpRow("drone-yuneec", "GimbalPitch", "pitch", "degrees", "gimbal", _YUNEEC),
    XmpRow("drone-yuneec", "GimbalRoll", "roll", "degrees", "gimbal", _YUNEEC),
    XmpRow("xmp", "CameraYaw", "heading", "degrees", "gimbal", _YUNEEC),
    XmpRow("xmp", "CameraPitch", "pitch", "degrees", "gimbal", _YUNEEC),
    XmpRow("xmp", "CameraRoll", "roll", "degrees", "gimbal", _YUNEEC),
    XmpRow("Camera", "Yaw", "heading", "degrees", "nadir", _PIX4D_ANGLES),
    XmpRow("Camera", "Pitch", "pitch", "degrees", "nadir", _PIX4D_ANGLES),
    XmpRow("Camera", "Roll", "roll", "degrees", "nadir", _PIX4D_ANGLES),
    XmpRow("exif", "CameraYaw", "heading", "degrees", "on platform", _TEAL),
    XmpRow("exif", "CameraPitch", "pitch", "degrees", "on platform", _TEAL),
    XmpRow("exif", "CameraRoll", "roll", "degrees", "on platform", _TEAL),
    XmpRow("sensefly", "Heading", "heading", "degrees", "fixed", _SENSEFLY),
    XmpRow("sensefly", "PitchAngle", "pitch", "degrees", "fixed", _SENSEFLY),
    XmpRow("sensefly", "RollAngle", "roll", "degrees", "fixed", _SENSEFLY),
    XmpRow("GPano", "PoseHeadingDegrees", "heading", "degrees", "direction", _GPANO),
    XmpRow("GPano", "PosePitchDegrees", "pitch", "degrees", "direction", _GPANO),
    XmpRow("GPano", "PoseRollDegrees", "roll", "degrees", "direction", _GPANO),
    XmpRow("GPano", "ProjectionType", "projection", "text", "", _GPANO),
    XmpRow("exif", "GPSImgDirection", "heading", "degrees", "direction", _EXIF),
    XmpRow("drone-dji", "FlightYawDegree", "heading", "degrees", "aircraft", _DJI_SDK),
    XmpRow("drone-dji", "FlightYaw", "heading", "degrees", "aircraft", _DJI_SDK),
    XmpRow("drone-dji", "FlightPitchDegree", "pitch", "degrees", "aircraft", _DJI_SDK),
    XmpRow("drone-dji", "FlightRollDegree", "roll", "degrees", "aircraft", _DJI_SDK),
    XmpRow("drone-skydio", "VehicleOrientationNED/Yaw", "heading", "degrees", "aircraft", _SKYDIO),
    XmpRow("drone-skydio", "VehicleOrientationNED/Pitch", "pitch", "degrees", "aircraft", _SKYDIO),
    XmpRow("drone-skydio", "VehicleOrientationNED/Roll", "roll", "degrees", "aircraft", _SKYDIO),
    XmpRow("drone-yuneec", "DroneYaw", "heading", "degrees", "aircraft", _YUNEEC),
    XmpRow("drone-yuneec", "DronePitch", "pitch", "degrees", "aircraft", _YUNEEC),
    XmpRow("drone-yuneec", "DroneRoll", "roll", "degrees", "aircraft", _YUNEEC),
    XmpRow("exif", "PlatformYaw", "heading", "degrees", "aircraft", _TEAL),
    XmpRow("exif", "PlatformPitch", "pitch", "degrees", "aircraft", _TEAL),
    XmpRow("exif", "PlatformRoll", "roll", "degrees", "aircraft", _TEAL),
    XmpRow("FLIR", "MAVYaw", "heading", "degrees", "aircraft", _FLIR),
    XmpRow("FLIR", "MAVPitch", "pitch", "degrees", "aircraft", _FLIR),
    XmpRow("FLIR", "MAVRoll", "roll", "degrees", "aircraft", _FLIR),
    XmpRow("drone-skydio", "Latitude", "latitude", "degrees", "", _SKYDIO),
    XmpRow("drone-skydio", "Longitude", "longitude", "degrees", "", _SKYDIO),
    XmpRow("drone-skydio", "RelativeAltitude", "height_above_takeoff", "metres", "", _SKYDIO_X10),
    XmpRow("drone-skydio", "AbsoluteAltitude", "altitude", "metres", "", _SKYDIO),
    XmpRow("drone-skydio", "GpsMslHeight", "altitude", "metres", "", _SKYDIO_X10),
    XmpRow("drone-yuneec", "AboveHomeAltitude", "height_above_takeoff", "metres", "", _YUNEEC),
    XmpRow("drone-yuneec", "GPSAltitude", "altitude", "metres", "", _YUNEEC),
    XmpRow("sensefly", "Latitude", "latitude", "degrees", "", _SENSEFLY),
    XmpRow("sensefly", "Longitude", "longitude", "degrees", "", _SENSEFLY),
    XmpRow("sensefly", "Height", "height_above_ground", "metres", "", _SENSEFLY),
    XmpRow("sensefly", "AltitudeAMSL", "altitude", "metres", "", _SENSEFLY),
    XmpRow("sensefly", "AltitudeWGS84", "altitude", "metres", "", _SENSEFLY),
    XmpRow("Camera", "AboveGroundAltitude", "height_above_ground", "metres", "", _PIX4D),
    XmpRow("Sentera", "AltimeterCalculatedAGL", "height_above_ground", "metres", "", _SENTERA),
    XmpRow("Sentera", "AltimeterCalcuatedAGL", "height_above_ground", "metres", "", _SENTERA),
    XmpRow("FLIR", "MAVRelativeAltitude", "height_above_takeoff", "metres, 0 if unknown", "", _FLIR),
    XmpRow("exif", "GPSLatitude", "latitude", "degrees and minutes", "", _EXIF),
    XmpRow("exif", "GPSLongitude", "longitude", "degrees and minutes", "", _EXIF),
    XmpRow("exif", "GPSLatitudeRef", "latitude reference", "text", "", _OSX),
    XmpRow("exif", "GPSLongitudeRef", "longitude reference", "text", "", _OSX),
    XmpRow("exif", "GPSAltitude", "exif altitude", "metres", "", _EXIF),
    XmpRow("exif", "GPSAltitudeRef", "exif altitude reference", "text", "", _EXIF),
    XmpRow("exif", "GPSImgDirectionRef", "direction reference", "text", "", _EXIF),
    XmpRow("xmp", "GPSAltitude", "altitude", "metres", "", _YUNEEC),
    XmpRow("drone-dji", "CalibratedFocalLength", "focal length", "pixels", "", _DJI),
    XmpRow("drone-skydio", "CalibratedFocalLength/X", "focal length", "pixels", "", _SKYDIO),
    XmpRow("drone-dji", "CalibratedOpticalCenterX", "optical centre", "pixels", "", _DJI),
    XmpRow("drone-dji", "CalibratedOpticalCenterY", "optical centre's height", "pixels", "", _DJI),
    XmpRow("drone-skydio", "CalibratedOpticalCenter/X", "optical centre", "pixels", "", _SKYDIO),
    XmpRow("drone-skydio", "CalibratedOpticalCenter/Y", "optical centre's height", "pixels", "", _SKYDIO),
    XmpRow("drone-dji", "DewarpData", "lens", "text", "", _DJI_MANUAL),
    XmpRow("drone-dji", "DewarpFlag", "undistorted", "text", "", _DJI_MANUAL),
    XmpRow("exif", "CameraHorizontalFOV", "fov", "degrees", "", _TEAL),
    XmpRow("Camera", "PerspectiveFocalLength", "perspective focal length", "millimetres", "", _PIX4D),
    XmpRow("Camera", "PerspectiveFocalLengthUnits", "perspective unit", "text", "", _PIX4D),
    XmpRow("Camera", "PrincipalPoint", "principal point", "text", "", _PIX4D),
    XmpRow("exif", "FocalLength", "EXIF FocalLength", "millimetres", "", _EXIF),
    XmpRow("exif", "FocalLengthIn35mmFilm", "EXIF FocalLengthIn35mmFilm", "millimetres", "", _EXIF),
    XmpRow("exif", "FocalPlaneXResolution", "EXIF FocalPlaneXResolution", "pixels", "", _EXIF),
    XmpRow("exif", "FocalPlaneResolutionUnit", "EXIF FocalPlaneResolutionUnit", "pixels", "", _EXIF),
    XmpRow("exif", "PixelXDimension", "EXIF ExifImageWidth", "pixels", "", _EXIF),
    XmpRow("exif", "PixelYDimension", "EXIF ExifImageHeight", "pixels", "", _EXIF),
    XmpRow("exif", "DigitalZoomRatio", "EXIF DigitalZoomRatio", "pixels", "", _EXIF),
    XmpRow("exif", "DateTimeOriginal", "EXIF DateTimeOriginal", "text", "", _EXIF),
    XmpRow("xmp", "CreateDate", "EXIF DateTimeOriginal", "text", "", _MINI_5),
    XmpRow("drone-dji", "UTCAtExposure", "utc", "text", "", _DJI_GUIDE),
    XmpRow("sensefly", "UTCTime", "utc", "text", "", _SENSEFLY),
    XmpRow("exif", "GPSTimeStamp", "utc", "text", "", _EXIF),
)  # fmt: skip

_ROWS: Mapping[tuple[str, str], XmpRow] = {(row.namespace, row.name.casefold()): row for row in ROWS}
# Names that DJI coined, and that firmware of others writes below namespaces of its own.
_COPIED = frozenset(
    row.name.casefold()
    for row in ROWS
    if row.namespace == "drone-dji" and re.match(r"(?:Gimbal|Flight)\w+Degree|(?:Relative|Absolute)Alt|GpsL", row.name)
)
_SPACES: Mapping[str, str] = {uri: key for key, space in NAMESPACES.items() for uri in space.uris}
_PREFIXES: Mapping[str, str] = {prefix: key for key, space in NAMESPACES.items() for prefix in space.prefixes}
_VERSION = re.compile(r"/[0-9]+(?:\.[0-9]+)*$")
# Words of names that tell a position, a height, or an angle.
_TELLING = frozenset((
    "lat", "latitude", "lon", "lng", "longitude", "longtitude", "position", "alt", "altitude", "height", "elevation", "agl",
    "amsl", "msl", "yaw", "pitch", "roll", "heading", "bearing", "azimuth", "tilt", "direction", "orientation",
))  # fmt: skip
_HEADING = frozenset(("yaw", "heading", "bearing", "azimuth", "direction", "orientation"))
# Words in names of angles and positions that are not the camera's, or of their accuracy.
_ELSEWHERE = frozenset((
    "accuracy", "error", "std", "dop", "speed", "velocity", "rate", "climb", "reverse", "home", "target", "lrf", "sun", "solar",
    "irradiance", "light", "gyro", "accel", "initial", "image", "full", "cropped", "area", "pixels", "ref",
    "relatives", "dewarp", "offset", "dest", "track", "status", "mode", "type",
))  # fmt: skip
# Words in names of Skydio's angles in other reference frames; a note names these only if no heading of the table is there.
_SAME_ANGLES = frozenset(("quat", "flu"))
# Skydio's positions are metres from the place of take-off.
_LOCAL = ("positionned", "positionflu")
# Namespaces of programs, of depth maps, of regions, and of the light sensor. Their directions are not the camera's.
_OTHERS = re.compile(
    r"ns\.adobe\.com/(?!exif/1|xap/1\.0/?$)|purl\.org|google\.com/photos/1\.0/(?!panorama)|microsoft\.com|metadataworkinggroup|"
    r"iptc\.org|useplus|w3\.org|digikam|acdsee|apple\.com|camerabits|gimp\.org|cipa\.jp|micasense\.com/dls"
)
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_NUMBER = re.compile(
    r"([-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:e[-+]?[0-9]+)?)(?:\s*/\s*([0-9]+(?:\.[0-9]+)?))?\s*"
    r"(?:m|met(?:er|re)s?|°|deg(?:rees?)?)?",
    re.IGNORECASE,
)
_PARTS = re.compile(r"[0-9]+(?:\.[0-9]+)?")
_HEMISPHERES = re.compile(
    r"(?<![a-z])([nsew])(?:orth|outh|ast|est)?\s*$|^\s*([nsew])(?:orth|outh|ast|est)?(?![a-z])", re.IGNORECASE
)
# Heights in metres and angles in degrees beyond these come from wrong bytes.
_MOST: Mapping[str, float] = {
    "degrees": 720.0,
    "metres": 1e5,
    "metres, 0 if unknown": 1e5,
    "pixels": 1e6,
    "millimetres": 1e5,
}


class XmpValues:
    """The values of a photo's XMP properties, by the table's rows.

    Attributes:
        values: the first readable value of each row: a finite number, or the text of rows of text.
        names: of the properties that were read, by row, as the packet writes them.
        unread: properties that look like a position, height, or angle, and that no row describes.
        unreadable: properties of a row whose value cannot be read.
        contradictory: properties that occur again with another value.
    """

    def __init__(self, properties: Iterable[XmpProperty] = ()) -> None:
        self.values: dict[XmpRow, float | str] = {}
        self.names: dict[XmpRow, str] = {}
        unread: dict[str, None] = {}
        unreadable: dict[str, None] = {}
        contradictory: dict[str, None] = {}
        others: dict[str, None] = {}
        for item in properties:
            name = item.name.casefold()
            row = _ROWS.get((_space(item) or "", name)) or (_ROWS["drone-dji", name] if name in _COPIED else None)
            if row is None:
                if _looks_telling(item):
                    (others if _words(item.name) & _SAME_ANGLES else unread).setdefault(str(item))
            elif (value := item.text if row.unit == "text" else _value(item.text, row.unit)) is None:
                unreadable.setdefault(str(item))
            elif row not in self.values:
                self.values[row], self.names[row] = value, str(item)
            elif self.values[row] != value:
                contradictory.setdefault(str(item))
        if not any(row.field == "heading" for row in self.values):
            unread |= others
        # The table's order is best first.
        self.values = {row: self.values[row] for row in ROWS if row in self.values}
        self.unread, self.unreadable, self.contradictory = list(unread), list(unreadable), list(contradictory)

    def all_of(self, field: str, convention: Convention = "") -> list[XmpRow]:
        """Return the rows of a field that have a value, best first."""
        return [row for row in self.values if row.field == field and row.convention == convention]

    def number(self, row: XmpRow) -> float | None:
        """Return the number of a row; None without one. An unknown 0 counts as none."""
        value = self.values.get(row)
        if not isinstance(value, float) or (row.unit == "metres, 0 if unknown" and value == 0):
            return None
        return value

    def first(self, field: str, convention: Convention = "", namespace: str | None = None) -> float | None:
        """Return the number of the best row of a field, of one namespace if given; None without one."""
        for row in self.all_of(field, convention):
            if namespace in (None, row.namespace) and (value := self.number(row)) is not None:
                return value
        return None

    def text(self, field: str) -> str:
        """Return the text of the best row of a field; "" without one."""
        return next((str(self.values[row]) for row in self.all_of(field)), "")

    @property
    def heading_unread(self) -> bool:
        """True if a property that was not read, or whose value cannot be read, looks like a heading."""
        return any(_words(name.rpartition(":")[2]) & _HEADING for name in (*self.unread, *self.unreadable))


def number(text: str) -> float | None:
    """Return a number as XMP writes it, such as "+39.80", "-8759/100", "39,8", or "12.5 m"; None for others."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None:
        return None
    value = float(match[1].replace(",", "."))
    if match[2] is not None:
        divisor = float(match[2])
        value = value / divisor if divisor else math.nan
    return value if math.isfinite(value) else None


def degrees_of(text: str) -> float | None:
    """Return signed degrees of a text such as "47,18.074N", "47,18,4.4N", "47° 18' 4.4\" N", or "-47.3012"; None for others."""
    if (value := number(text)) is not None:
        return value
    hemisphere = _HEMISPHERES.search(text)
    parts = [float(part) for part in _PARTS.findall(text)]
    if hemisphere is None or not 1 <= len(parts) <= 3 or any(part >= 60.5 for part in parts[1:]):
        return None
    total = sum(part / 60.0**i for i, part in enumerate(parts))
    south = (hemisphere[1] or hemisphere[2]).upper() in "SW" or text.lstrip().startswith("-")
    return -total if south else total


def _value(text: str, unit: str) -> float | None:
    value = degrees_of(text) if unit.startswith("degrees") else number(text)
    return None if value is None or abs(value) > _MOST.get(unit, math.inf) else value


def _space(item: XmpProperty) -> str | None:
    """Return the key of a property's namespace; None for others."""
    uri = item.namespace.strip().casefold()
    uri = uri.partition("://")[2].removeprefix("www.") if "://" in uri else uri
    key = _SPACES.get(uri.rstrip("/#")) or _SPACES.get(_VERSION.sub("", uri.rstrip("/#")))
    prefix = item.prefix.casefold()
    # Programs write addresses of their own for the namespaces of drones, whose prefixes nobody else uses.
    if key is None and ("://" not in item.namespace or prefix.startswith("drone-")):
        key = _PREFIXES.get(prefix)
    return key


def _words(name: str) -> set[str]:
    return {word.casefold() for word in _WORD.findall(name)}


def _looks_telling(item: XmpProperty) -> bool:
    """Return whether a property has a number, and a name that tells a position, a height, or an angle of the camera."""
    words = _words(item.name)
    if not words & _TELLING or words & _ELSEWHERE or _OTHERS.search(item.namespace.casefold()):
        return False
    return degrees_of(item.text) is not None and not any(name in item.name.casefold() for name in _LOCAL)
