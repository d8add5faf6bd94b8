"""A sheet of a map: a raster, its coordinate reference system, and the transform of its pixels."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.core.numbers import wrap_degrees
from lpn.flight.maps import _gdal
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.raster import Raster
from lpn.flight.maps.window import Window

# West, south, east, and north in metres of a frame.
Bounds = tuple[float, float, float, float]
# Points along the sides of a block at which the projection is computed, as shares of the side.
_NODES = np.array([0.0, 0.5, 1.0])
# Points on each side of a sheet's outline.
_OUTLINE = 21
# Least and most metres of a map's pixel.
_RESOLUTIONS = (1e-4, 1e4)
# A sheet with a metric CRS whose coordinates could be degrees is refused if it is smaller than these metres.
_DEGREES_AT_MOST = 10.0
# A corner is hardly on a map if both coordinates are smaller than these, in units of the CRS or degrees. The same holds for a
# UTM easting outside of the zone and its neighbours.
_ORIGIN, _ORIGIN_DEGREES, _UTM_EASTINGS = 1000.0, 0.01, (100_000.0, 900_000.0)

# Old datums by their WKT names, with the error in metres of EPSG's best transformation to WGS 84 without a national grid; 0 if
# there is none.
_DATUMS = {
    "North_American_Datum_1927": 20, "Ordnance_Survey_of_Great_Britain_1936": 2, "Deutsches_Hauptdreiecksnetz": 3,
    "System_of_the_Unified_Trigonometrical_Cadastral_Network": 6, "European_Datum_1950": 10, "Pulkovo_1942": 5,
    "Pulkovo_1942_58": 10, "Pulkovo_1942_83": 5, "Tokyo": 9, "Nouvelle_Triangulation_Francaise": 2,
    "Australian_Geodetic_Datum_1966": 5, "Australian_Geodetic_Datum_1984": 5, "New_Zealand_Geodetic_Datum_1949": 5,
    "Monte_Mario": 4, "South_American_Datum_1969": 10, "Provisional_South_American_Datum_1956": 20, "Cape": 15,
    "Corrego_Alegre_1970-72": 5, "Beijing_1954": 15, "Xian_1980": 0, "New_Beijing": 0,
}  # fmt: skip
# Variants of these datums with another prime meridian.
_MERIDIANS = re.compile("_(Ferro|Paris|Rome)$")


class Sheet:
    """A georeferenced raster.

    Args:
        name: for messages.
        raster: its pixels.
        crs: a rasterio CRS.
        matrix: (2, 3), from column and row (0, 0 is the corner of the first pixel) to the coordinates of `crs`.

    Raises:
        DataError: if it lies outside the world or outside the area of its CRS.
    """

    def __init__(self, name: str, raster: Raster, crs: Any, matrix: Float64Array) -> None:
        self.name, self.raster, self.crs, self.matrix = name, raster, crs, matrix
        whole = np.vstack([matrix, [0, 0, 1]])
        if not (np.isfinite(matrix).all() and abs(np.linalg.det(whole)) > 0):
            raise DataError(f"{printable(name)} has the pixel size 0 in its georeference; expected one above 0.")
        self.warning: str | None = None
        self.outline = self._outline()

    def locate(self, frame: LocalFrame) -> None:
        """Compute bounds and resolution in a frame; DataError if a pixel has no possible size on the ground."""
        self.frame = frame
        self.bounds = bounds_of(frame.xy(*self.outline.T))
        width, height = self.raster.width, self.raster.height
        cross = self._ground(np.array([(1, 2), (3, 2), (2, 1), (2, 3)]) / 4 * (width, height))
        across, down = (cross[1] - cross[0]) / (width / 2), (cross[3] - cross[2]) / (height / 2)
        self.pixel = float(np.hypot(*across)), float(np.hypot(*down))
        self.resolution = math.sqrt(self.pixel[0] * self.pixel[1])
        if not _RESOLUTIONS[0] <= self.resolution <= _RESOLUTIONS[1]:
            raise DataError(
                f"A pixel of {printable(self.name)} would be {self.resolution:.3g} m wide on the ground; its transform does not "
                f"fit its CRS {describe(self.crs)}, so give the right one with --crs."
            )

    def read(self, window: Window, pixels: int, part: tuple[int, int, int, int]) -> tuple[UInt8Array, BoolArray] | None:
        """Cut a rectangle of the picture of a window.

        Args:
            window: in the frame of `locate`.
            pixels: side of the whole picture.
            part: first column and row, columns and rows of the rectangle.

        Returns:
            RGB (rows, columns, 3) and the valid pixels (rows, columns); None if the sheet has none there.
        """
        left, top, columns, rows = part
        u, v = (grid.ravel() for grid in np.meshgrid(*(_NODES * side for side in (columns, rows))))
        ground = window.to_ground(np.stack([left + u, top + v], axis=1) - 0.5, pixels)
        cells = cells_of(self.crs, self.matrix, self.raster.width, self.frame, ground)
        if not np.isfinite(cells).all():
            return None
        # Within a block, a map projection is linear to a small part of a pixel.
        matrix = np.linalg.lstsq(np.stack([u, v, np.ones(len(u))], axis=1), cells, rcond=None)[0].T
        picture, valid = self.raster.cut(matrix, (columns, rows), window.size / pixels / max(self.pixel))
        return (picture, valid) if valid.any() else None

    def _ground(self, cells: Float64Array) -> Float64Array:
        """Convert columns and rows, (N, 2), to points of the frame, (N, 2)."""
        return self.frame.xy(*self._degrees(cells).T)

    def _degrees(self, cells: Float64Array) -> Float64Array:
        """Convert columns and rows, (N, 2), to latitude and longitude, (N, 2)."""
        xy = np.column_stack([cells, np.ones(len(cells))]) @ self.matrix.T
        return np.ascontiguousarray(_gdal.transform(self.crs, _gdal.epsg(4326), xy)[:, ::-1])

    def _outline(self) -> Float64Array:
        side = np.linspace(0, 1, _OUTLINE)
        zero, one = np.zeros(_OUTLINE), np.ones(_OUTLINE)
        around = np.concatenate(
            [np.stack(pair, axis=1) for pair in ((side, zero), (one, side), (side, one), (zero, side))]
        )
        cells = around * (self.raster.width, self.raster.height)
        corners = np.column_stack([cells, np.ones(len(cells))]) @ self.matrix.T
        low, high = corners.min(0), corners.max(0)
        span = f"{low[0]:.9g} to {high[0]:.9g} and {low[1]:.9g} to {high[1]:.9g}"
        name, crs = printable(self.name), describe(self.crs)
        why, degrees = "", np.zeros((0, 2))
        if not (self.crs.is_geographic or self.crs.is_projected):
            why = "is neither in degrees nor a projection, and does not say where on earth it lies"
        elif self.crs.is_geographic and (low[1] < -90.001 or high[1] > 90.001 or low[0] < -360 or high[0] > 360):
            why = "is in degrees, and they lie outside the world"
        elif not self.crs.is_geographic and max(high - low) < _DEGREES_AT_MOST and (np.abs(corners) <= (180, 90)).all():
            why = "is not in degrees, and they look like degrees"
        else:
            degrees = self._degrees(cells)
            if not np.isfinite(degrees).all() or np.abs(degrees[:, 0]).max() > 90.001:
                why = "does not cover them"
        if why:
            raise DataError(
                f"The coordinates of {name} ({span}) do not fit its CRS {crs}, which {why}; give the right one with --crs, such "
                "as EPSG:4326, or correct its georeference."
            )
        self.warning = self._far_off(corners, degrees)
        return degrees

    def _far_off(self, corners: Float64Array, degrees: Float64Array) -> str | None:
        """Return a warning if the coordinates hardly fit this CRS: near its origin, or far outside its UTM zone."""
        near = np.abs(corners).max(axis=1)
        least = int(near.argmin())
        code = self.crs.to_epsg() or 0
        utm = 32601 <= code <= 32660 or 32701 <= code <= 32760
        eastings = corners[:, 0] if utm else np.zeros(0)
        beyond = (eastings < _UTM_EASTINGS[0]) | (eastings > _UTM_EASTINGS[1])
        if near[least] >= (_ORIGIN_DEGREES if self.crs.is_geographic else _ORIGIN) and not beyond.any():
            return None
        (x, y), (latitude, longitude) = corners[least], degrees[least]
        return (
            f"{printable(self.name)} has a corner at {x:.6g}, {y:.6g} in its CRS {describe(self.crs)}, which is {latitude:.4f}, "
            f"{longitude:.4f} on Earth. If that is not the map's place, the picture lost its position, or the CRS is another one "
            "(--crs)."
        )


def bounds_of(points: Float64Array) -> Bounds:
    """Return the bounds of points of a frame, (N, 2)."""
    (west, south), (east, north) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return west, south, east, north


def cells_of(crs: Any, matrix: Float64Array, width: int, frame: LocalFrame, xy: Float64Array) -> Float64Array:
    """Convert points of a frame, (N, 2), to a raster's columns and rows, (N, 2); 0 is the corner of the first pixel.

    Args:
        crs, matrix: see `Sheet`.
        width: of the raster in pixels.
    """
    x, y = _gdal.transform(frame.crs, crs, xy).T
    if crs.is_geographic:
        # Longitudes of a raster may pass 180 degrees.
        middle = float(matrix[0] @ (width / 2, 0, 1))
        x = middle + wrap_degrees(x - middle)
    inverse = np.linalg.inv(np.vstack([matrix, [0, 0, 1]]))[:2]
    return np.asarray(np.stack([x, y, np.ones(len(x))], axis=1) @ inverse.T)


def datum_notes(sheets: Iterable[tuple[str, Any]]) -> list[str]:
    """Return a sentence for each old datum of sheets, which are pairs of a name and a rasterio CRS."""
    on: dict[tuple[str, int], list[str]] = {}
    for name, crs in sheets:
        found = re.search(r'\bDATUM\["([^"]+)",SPHEROID\["([^"]+)"', crs.to_wkt())
        datum, ellipsoid = found.groups() if found else ("", "")
        metres = _DATUMS.get(_MERIDIANS.sub("", datum))
        ellipsoid_alone = datum.startswith(("Unknown", "Not_specified")) and not ellipsoid.startswith(("GRS", "WGS"))
        if metres is None and ellipsoid_alone and "TOWGS84[" not in crs.to_wkt():
            metres = 0
        if metres is not None:
            on.setdefault((printable(datum.replace("_", " ")), metres), []).append(printable(name))
    return [
        f"The datum of {first_few(names, 3)} is {datum}, by which places may be off by "
        + (f"some {metres} m, unless PROJ's grids of its country are installed" if metres else "more than 100 m")
        + ". Deliver the map on WGS 84, or tell its --error."
        for (datum, metres), names in on.items()
    ]


def describe(crs: Any) -> str:
    """Return a CRS as its EPSG code, else as its name, for messages."""
    code = crs.to_epsg()
    if code:
        return f"EPSG:{code}"
    return printable(str(crs.to_wkt()).partition('"')[2].partition('"')[0]) or "without a name"
