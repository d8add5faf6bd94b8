"""The files of a rendered flight: photos with EXIF and XMP, and its map as a GeoTIFF.

photos  XMP in the form of DJI's namespace `drone-dji`, EXIF with position, focal length, and time
map     north-up in the UTM zone of the site, on WGS 84, tiled, with overviews
"""

from __future__ import annotations

import io
import math
from datetime import UTC, datetime
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.numbers import wrap_degrees
from tools.world.cameras import SatelliteImage, Site
from tools.world.flight_plan import EQUIVALENT, FOV, FlightPicture

_QUALITY, _MAP_QUALITY = 90, 92
# Millimetres of a sensor of 6.4 x 4.8 mm with the field of view.
_FOCAL_LENGTH = 3.2 / math.tan(math.radians(FOV / 2))
_AXES = ("Yaw", "Pitch", "Roll")
_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="LPN world" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{properties}/>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


def photo_bytes(picture: FlightPicture, pixels: NDArray[np.uint8]) -> bytes:
    """Encode a photo (h, w, 3) as JPEG with EXIF and XMP.

    XMP has latitude and longitude to 1e-9 degrees, heights to 0.01 m, and angles to 0.1 degrees.
    """
    height, width = pixels.shape[:2]
    data = io.BytesIO()
    Image.fromarray(pixels).save(
        data, "JPEG", quality=_QUALITY, exif=_exif(picture, width, height), xmp=_xmp(picture, width)
    )
    return data.getvalue()


def _exif(picture: FlightPicture, width: int, height: int) -> bytes:
    tag, time = picture.tag, datetime.fromtimestamp(picture.time, UTC)
    base, gps = ExifTags.Base, ExifTags.GPS
    exif = Image.Exif()
    exif[base.Make], exif[base.Model] = "LPN Explorer", "Rendered"
    exif[base.Orientation] = 1
    exif.get_ifd(ExifTags.IFD.Exif).update({
        base.DateTimeOriginal: f"{time:%Y:%m:%d %H:%M:%S}", base.SubsecTimeOriginal: f"{time.microsecond // 1000:03d}",
        base.OffsetTimeOriginal: "+00:00", base.FocalLength: _ratio(_FOCAL_LENGTH, 1000),
        base.FocalLengthIn35mmFilm: round(EQUIVALENT), base.ExifImageWidth: width, base.ExifImageHeight: height,
    })  # fmt: skip
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({
        gps.GPSVersionID: b"\x02\x03\x00\x00",
        gps.GPSLatitudeRef: "N" if tag.latitude >= 0 else "S", gps.GPSLatitude: _sexagesimal(tag.latitude),
        gps.GPSLongitudeRef: "E" if tag.longitude >= 0 else "W", gps.GPSLongitude: _sexagesimal(tag.longitude),
        gps.GPSAltitudeRef: b"\x00" if tag.altitude >= 0 else b"\x01", gps.GPSAltitude: _ratio(abs(tag.altitude), 1000),
        gps.GPSMapDatum: "WGS-84",
    })  # fmt: skip
    return exif.tobytes()


def _ratio(value: float, per: int) -> IFDRational:
    return IFDRational(round(value * per), per)


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Return degrees, minutes, and seconds to 1e-4, which is 3 mm."""
    units = round(Fraction(abs(degrees)) * 36_000_000)
    return (
        IFDRational(units // 36_000_000, 1),
        IFDRational(units // 600_000 % 60, 1),
        IFDRational(units % 600_000, 10_000),
    )


def _xmp(picture: FlightPicture, width: int) -> bytes:
    tag, time = picture.tag, datetime.fromtimestamp(picture.time, UTC)
    values = {
        "UTCAtExposure": f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond // 1000:03d}",
        "GpsStatus": "GPS",
        "GpsLatitude": f"{tag.latitude:+.9f}", "GpsLongitude": f"{tag.longitude:+.9f}",
        "AbsoluteAltitude": f"{tag.altitude:+.2f}", "RelativeAltitude": f"{tag.takeoff_height:+.2f}",
        **{f"Gimbal{axis}Degree": f"{value:+.1f}" for axis, value in zip(_AXES, _signed(tag.gimbal), strict=True)},
        **{f"Flight{axis}Degree": f"{value:+.1f}" for axis, value in zip(_AXES, _signed(tag.aircraft), strict=True)},
        "FlightXSpeed": f"{tag.speed[1]:+.1f}", "FlightYSpeed": f"{tag.speed[0]:+.1f}", "FlightZSpeed": f"{-tag.speed[2]:+.1f}",
        "CalibratedFocalLength": f"{width / 2 / math.tan(math.radians(FOV / 2)):.6f}",
    }  # fmt: skip
    return _XMP.format(properties="\n".join(f'   drone-dji:{name}="{text}"' for name, text in values.items())).encode()


def _signed(angles: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return yaw, pitch, and roll with the yaw from -180 to 180 degrees, as DJI writes it."""
    return wrap_degrees(angles[0]), angles[1], angles[2]


class MapGrid:
    """The pixels of the map: a north-up square in the site's UTM zone.

    Args:
        x, y: middle of the map in metres of the plan.
        side: of the map in metres.
        pixel: side of a pixel in metres of the zone's grid.

    Attributes:
        pixels: of a side.
        crs: the zone, a rasterio CRS.
        west, north: of the top-left corner, in whole metres of the zone.
    """

    def __init__(self, site: Site, x: float, y: float, side: float, pixel: float) -> None:
        import rasterio
        import rasterio.warp

        self._site, self._pixel, self._warp = site, pixel, rasterio.warp.transform
        self._degrees = rasterio.crs.CRS.from_epsg(4326)
        latitude, longitude = site.degrees(x, y)
        zone = int((longitude + 180) // 6) + 1
        self.crs: Any = rasterio.crs.CRS.from_epsg((32600 if latitude >= 0 else 32700) + zone)
        self.pixels = round(side / pixel)
        (east,), (north,) = self._warp(self._degrees, self.crs, [longitude], [latitude])
        self.west, self.north = float(round(east - side / 2)), float(round(north + side / 2))

    def plan(self, column: Float64Array, row: Float64Array) -> Float64Array:
        """Return the points (n, 2) of the plan at columns and rows (n,), counted from the outer corner of the first pixel."""
        east, north = self.west + column * self._pixel, self.north - row * self._pixel
        longitudes, latitudes = self._warp(self.crs, self._degrees, east, north)
        return np.stack(self._site.metres(np.array(latitudes), np.array(longitudes)), axis=1)  # type: ignore[arg-type]

    def cut(self, values: Float32Array, sweep: SatelliteImage, interpolation: int) -> Float32Array:
        """Resample an orthographic picture of the plan, (m, m, c), to the map's pixels, (n, n, c), by a method of OpenCV."""
        # Over a kilometre, the zone's grid is a polynomial of second degree of the plan to a tenth of a millimetre.
        at = np.linspace(0, self.pixels, 12)
        columns, rows = (grid.ravel() for grid in np.meshgrid(at, at))
        points = self.plan(columns, rows)
        pixels = sweep.project(np.concatenate([points, np.full((len(points), 1), sweep.z)], axis=1))
        scale = 1 / self.pixels
        fit = np.linalg.lstsq(_terms(columns * scale, rows * scale), pixels, rcond=None)[0]
        middles = (np.arange(self.pixels) + 0.5) * scale
        cut = np.empty((self.pixels, self.pixels, values.shape[2]), np.float32)
        for row, middle in enumerate(middles):
            source_pixels = (_terms(middles, np.full(self.pixels, middle)) @ fit - 0.5).astype(np.float32)
            across, down = source_pixels.T[:, None]
            taken = cv2.remap(values, across, down, interpolation, borderMode=cv2.BORDER_REPLICATE)
            cut[row] = taken.reshape(self.pixels, -1)
        return cut

    def geotiff(self, pixels: NDArray[np.uint8]) -> bytes:
        """Encode the map (n, n, 3) as a tiled GeoTIFF with overviews, JPEG-compressed."""
        return geotiff(pixels, self.crs, self._transform, _MAP_QUALITY)

    def elevation(self, heights: Float32Array) -> bytes:
        """Encode heights in metres (n, n) as a tiled GeoTIFF, rounded to centimetres."""
        from rasterio.io import MemoryFile

        with MemoryFile() as file:
            with file.open(
                driver="GTiff", width=self.pixels, height=self.pixels, count=1, dtype="float32", crs=self.crs,
                transform=self._transform, tiled=True, blockxsize=256, blockysize=256, compress="deflate", predictor=3,
            ) as written:  # fmt: skip
                written.write(np.round(heights, 2).astype(np.float32), 1)
                written.units = ("metre",)
            return bytes(file.read())

    @property
    def _transform(self) -> Any:
        from rasterio import Affine

        return Affine(self._pixel, 0.0, self.west, 0.0, -self._pixel, self.north)


def geotiff(pixels: NDArray[np.uint8], crs: Any, transform: Any, quality: int) -> bytes:
    """Encode a picture (h, w, 3) as a tiled GeoTIFF with overviews."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.io import MemoryFile

    height, width = pixels.shape[:2]
    with rasterio.Env(JPEG_QUALITY_OVERVIEW=quality), MemoryFile() as file:
        with file.open(
            driver="GTiff", width=width, height=height, count=3, dtype="uint8", crs=crs, transform=transform,
            tiled=True, blockxsize=256, blockysize=256, compress="jpeg", photometric="ycbcr", jpeg_quality=quality,
        ) as written:  # fmt: skip
            written.write(np.moveaxis(pixels, 2, 0))
            written.build_overviews([2, 4, 8], Resampling.average)
        return bytes(file.read())


def _terms(x: NDArray[np.floating], y: NDArray[np.floating]) -> Float64Array:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
