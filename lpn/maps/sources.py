"""Files that are a map: how each is recognised, and where its georeference comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.maps import _gdal
from lpn.maps.raster import GdalRaster
from lpn.maps.sheet import Sheet

# Largest error, in pixels, of the affine transform that stands for ground control points.
_CONTROL_ERROR = 2.0


@dataclass(frozen=True)
class MapOptions:
    """What is known about a map's files beyond what they say.

    Attributes:
        crs: coordinate reference system, such as EPSG:32632; it takes precedence over that of the files.
        corners: latitude and longitude of the top-left, then of the bottom-right corner of a picture.
        bands: numbers, from 1, of the bands shown as red, green, and blue, or of one shown as grey.
        keep_borders: white and black borders belong to the picture.
    """

    crs: str | None = None
    corners: tuple[float, float, float, float] | None = None
    bands: tuple[int, ...] | None = None
    keep_borders: bool = False


def raster_sheet(path: Path, options: MapOptions) -> Sheet:
    """Open a raster file with its georeference.

    Raises:
        DataError: if it cannot be read, or has no georeference, or an impossible one.
        InputError: if an option is malformed.
    """
    with _gdal.open_raster(path) as file:
        crs, matrix = _georeference(path, file, options)
    raster = GdalRaster(path, bands=options.bands, keep_borders=options.keep_borders)
    return Sheet(path.name, raster, crs, matrix)


def parse_crs(text: str) -> Any:
    """Return the rasterio CRS of a text such as EPSG:32632, PROJ parameters, or WKT.

    Raises:
        InputError: if it is none.
    """
    library = _gdal.rasterio()
    try:
        return library.crs.CRS.from_user_input(f"EPSG:{text}" if text.isdecimal() else text)
    except (library.errors.RasterioError, ValueError) as error:
        raise InputError(f"There is no CRS {printable(text)[:100]!r}; expected one such as EPSG:32632.") from error


def _georeference(path: Path, file: Any, options: MapOptions) -> tuple[Any, Float64Array]:
    """Return the CRS of a raster and the (2, 3) matrix from its columns and rows to coordinates."""
    if options.corners is not None:
        if options.crs is not None:
            raise InputError("Corners are latitudes and longitudes; give --corners or --crs, not both.")
        return _from_corners(options.corners, file.width, file.height, "--corners")
    matrix = _matrix(path, file)
    if matrix is None:
        raise DataError(
            f"{printable(str(path))} has no georeference: it is no GeoTIFF, and no world file lies beside it; add one, or give "
            "--corners with the latitude and longitude of its top-left and bottom-right corner."
        )
    if options.crs is not None:
        return parse_crs(options.crs), matrix
    crs = file.crs or file.gcps[1] or _projection_file(path)
    if not crs:
        raise DataError(
            f"{printable(str(path))} has coordinates but no coordinate reference system; add {path.stem}.prj, or give --crs, "
            "such as EPSG:32632 (UTM) or EPSG:4326 (degrees)."
        )
    return crs, matrix


def _matrix(path: Path, file: Any) -> Float64Array | None:
    """Return the transform of a raster from its tags, its world file, or its control points; None without any."""
    if not file.transform.is_identity:
        return np.array(file.transform[:6], np.float64).reshape(2, 3)
    points = file.gcps[0]
    if len(points) >= 3:
        cells = np.array([(point.col, point.row, 1.0) for point in points])
        found = np.linalg.lstsq(cells, np.array([(point.x, point.y) for point in points]), rcond=None)[0].T
        inverse = np.linalg.pinv(found[:, :2])
        off = (np.array([(point.x, point.y) for point in points]) - cells @ found.T) @ inverse.T
        if np.abs(off).max() > _CONTROL_ERROR:
            raise DataError(
                f"The control points of {printable(str(path))} lie up to {np.abs(off).max():.0f} pixels off a plane; warp the "
                "file first, such as with gdalwarp."
            )
        return np.asarray(found, np.float64)
    world = _beside(path, [f".{path.suffix[1:2]}{path.suffix[-1:]}w", f"{path.suffix}w", ".wld"])
    return None if world is None else _world_file(world)


def _world_file(path: Path) -> Float64Array:
    """Read a world file: the steps of x and y for a column, those for a row, and the centre of the first pixel."""
    try:
        numbers = [float(text) for text in path.read_text("ascii").split()]
        if len(numbers) != 6 or not np.isfinite(numbers).all():
            raise ValueError
    except (OSError, ValueError) as error:
        raise DataError(f"{printable(str(path))} is no world file; expected six numbers, one a line.") from error
    a, d, b, e, x, y = numbers
    return np.array([[a, b, x - (a + b) / 2], [d, e, y - (d + e) / 2]])


def _projection_file(path: Path) -> Any:
    """Return the CRS in the .prj file beside a raster; None without one."""
    found = _beside(path, [".prj"])
    if found is None:
        return None
    library = _gdal.rasterio()
    try:
        return library.crs.CRS.from_wkt(found.read_text("utf-8-sig"), morph_from_esri_dialect=True)
    except (OSError, ValueError, library.errors.RasterioError) as error:
        raise DataError(
            f"{printable(str(found))} holds no coordinate reference system that can be read; give --crs."
        ) from error


def _beside(path: Path, suffixes: Sequence[str]) -> Path | None:
    """Return the file beside another one with its stem and one of these suffixes, case ignored."""
    wanted = [path.stem.lower() + suffix.lower() for suffix in suffixes]
    found = {other.name.lower(): other for other in path.parent.iterdir() if other.name.lower() in wanted}
    return next((found[name] for name in wanted if name in found), None)


def _from_corners(corners: Sequence[float], width: int, height: int, what: str) -> tuple[Any, Float64Array]:
    """Return CRS and matrix of a picture by latitude and longitude of its top-left and bottom-right corner."""
    top, left, bottom, right = corners
    if not all(map(np.isfinite, corners)) or max(abs(top), abs(bottom)) > 90 or max(abs(left), abs(right)) > 180:
        raise DataError(
            f"The corners {top:g}, {left:g} and {bottom:g}, {right:g} of {what} lie outside the world; expected latitude, then "
            "longitude, of the top-left and of the bottom-right corner."
        )
    if left > right + 180:  # across the antimeridian
        right += 360
    if not (top > bottom and left < right):
        raise DataError(
            f"The corners {top:g}, {left:g} and {bottom:g}, {right:g} of {what} are not top left and bottom right; expected the "
            "first one north and west of the second."
        )
    matrix = np.array([[(right - left) / width, 0, left], [0, (bottom - top) / height, top]])
    return _gdal.rasterio().crs.CRS.from_epsg(4326), matrix
