"""A local metric frame: transverse Mercator about a point, on the WGS 84 ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.flight.maps import _gdal


@dataclass(frozen=True)
class LocalFrame:
    """Metres east and north of an origin, true to 0.05 % within 200 km east and west of it.

    North is exact on the origin's meridian. At d km east of it, grid north lies 0.009 d tan(latitude) degrees from true north.

    Attributes:
        latitude, longitude: of the origin, WGS 84 degrees.
    """

    latitude: float
    longitude: float

    @cached_property
    def crs(self) -> Any:
        """The frame as a rasterio CRS."""
        return _gdal.rasterio().crs.CRS.from_proj4(
            f"+proj=tmerc +lat_0={self.latitude!r} +lon_0={self.longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
        )

    def xy(self, latitude: npt.ArrayLike, longitude: npt.ArrayLike) -> Float64Array:
        """Convert WGS 84 degrees, (N,) each, to metres east and north of the origin, (N, 2); NaN stays NaN."""
        east, north = np.broadcast_arrays(*np.atleast_1d(longitude, latitude))
        return self.from_crs(_gdal.epsg(4326), np.stack([east, north], axis=1))

    def from_crs(self, crs: Any, coordinates: npt.ArrayLike) -> Float64Array:
        """Convert coordinates in a rasterio CRS, (N, 2), easting first, to metres east and north of the origin, (N, 2)."""
        return _transformed(crs, self.crs, coordinates)

    def degrees(self, xy: npt.ArrayLike) -> Float64Array:
        """Convert metres east and north, (N, 2), to latitude and longitude in WGS 84 degrees, (N, 2); NaN stays NaN."""
        return np.ascontiguousarray(_transformed(self.crs, _gdal.epsg(4326), xy)[:, ::-1])

    @cached_property
    def utm_zone(self) -> int:
        """EPSG code of the origin's UTM zone on WGS 84; the exceptions of Norway and Svalbard are ignored."""
        zone = min(int((self.longitude + 180) // 6), 59) + 1
        return (32600 if self.latitude >= 0 else 32700) + zone

    def utm(self, xy: npt.ArrayLike) -> Float64Array:
        """Convert metres east and north, (N, 2), to eastings and northings in `utm_zone`, (N, 2); NaN stays NaN."""
        return _transformed(self.crs, _gdal.epsg(self.utm_zone), xy)

    def polynomials(self, bounds: tuple[float, float, float, float]) -> Float64Array:
        """Return cubic polynomials that approximate `degrees` within bounds, for a reader without a projection library.

        Their error is at most 1 mm within 20 km of the origin, and 1 m within 100 km.

        Args:
            bounds: west, south, east, north in metres.

        Returns:
            (2, 10): coefficients of latitude and longitude over 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3, where u and v run
            from -1 to 1 from west to east and from south to north.
        """
        u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1, 1, 9)] * 2))
        west, south, east, north = bounds
        xy = np.stack([(west + east + u * (east - west)) / 2, (south + north + v * (north - south)) / 2], axis=1)
        terms = np.stack([u**i * v**j for n in range(4) for i, j in ((n - k, k) for k in range(n + 1))], axis=1)
        return np.asarray(np.linalg.lstsq(terms, self.degrees(xy), rcond=None)[0].T, np.float64)


def _transformed(source: Any, target: Any, coordinates: npt.ArrayLike) -> Float64Array:
    points = np.asarray(coordinates, np.float64).reshape(-1, 2)
    transformed = np.full(points.shape, np.nan)
    known = np.isfinite(points).all(axis=1)
    if known.any():
        transformed[known] = _gdal.transform(source, target, points[known])
    transformed[~np.isfinite(transformed).all(axis=1)] = np.nan
    return transformed
