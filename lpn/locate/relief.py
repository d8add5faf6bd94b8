"""The relief of a map as a 3-D model: its elevation as a mesh, with the map on it."""

from __future__ import annotations

import cv2
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.glb import Primitive, glb
from lpn.core.images import jpeg
from lpn.datasets.city_model import CityModel
from lpn.datasets.geo import Position
from lpn.maps import Map
from lpn.maps.map import OVERVIEW

# Vertices along the longer side, which one primitive can hold; and quality of the map's picture.
_VERTICES, _QUALITY = 250, 80
# Quantile of the heights that lies on the stage's ground, and metres of tiles and lines above the highest point.
_BASE, _ABOVE = 0.02, 8.0


def relief_model(basemap: Map) -> CityModel | None:
    """Return the relief of a map's elevation; None if the map has none.

    Vertices lie on a grid over the map's bounds. Ground without a height is left out.

    Raises:
        DataError: if a file of the map is damaged.
    """
    if basemap.elevation is None:
        return None
    west, south, east, north = basemap.bounds
    step = max(east - west, north - south) / (_VERTICES - 1)
    columns, rows = (max(2, round(length / step) + 1) for length in (east - west, north - south))
    x, y = np.meshgrid(np.linspace(west, east, columns), np.linspace(north, south, rows))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    heights = basemap.heights(places)
    known = np.isfinite(heights)
    if not known.any():
        return None
    base = float(np.quantile(heights[known], _BASE))
    faces = _faces(rows, columns)
    faces = faces[known[faces].all(axis=1)]
    latitude, longitude = basemap.frame.latitude, basemap.frame.longitude
    vertices: Float64Array = np.column_stack([places, np.where(known, heights - base, 0.0)])
    share = np.stack([(x - west) / (east - west), (north - y) / (north - south)], axis=-1).reshape(-1, 2)
    picture = basemap.overview(OVERVIEW)[0]
    # A square whose side is a power of two is not resampled again by the browser.
    drawn = cv2.resize(picture, (OVERVIEW // 2,) * 2, interpolation=cv2.INTER_AREA)
    data = glb(
        [Primitive("relief", vertices, faces, uv=share, picture=jpeg(np.asarray(drawn, np.uint8), _QUALITY))],
        {"latitude": latitude, "longitude": longitude},
    )
    top = float(heights[known].max()) - base + _ABOVE
    return CityModel(data, Position(latitude, longitude), base, top)


def _faces(rows: int, columns: int) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return the triangles of a grid of vertices, (t, 3), counter-clockwise from above; the first row is the northern one."""
    index = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
