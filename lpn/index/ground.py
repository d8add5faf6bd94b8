"""Where the tiles of an index lie: positions in metres, for errors and maps, of tiles that searches return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.index.base import DegreeBox, SearchResult
from lpn.index.gallery import IndexGallery
from lpn.index.shared import SharedIndex
from lpn.maps import Map, NamedWindow
from lpn.models.base import Model, normalise
from lpn.tasks.gallery_geometry import GalleryGeometry

# Searches by drawn descriptors that show where an index's tiles lie, and how large windows are.
_PROBES = 2
_PROBED = 100
# Share of the width of a map without a raster that is added on each side, as an index may not tell how far its tiles reach.
_BORDER = 0.1


@dataclass(frozen=True, eq=False)
class IndexGeometry(GalleryGeometry):
    """The positions of an index's tiles that were seen; the borders stay as they are while tiles are added.

    Attributes:
        borders: west, south, east, north in metres from the origin.
        degrees: latitude and longitude of each tile, (G, 2).
    """

    borders: tuple[float, float, float, float]
    degrees: Float64Array

    @property
    def _degrees(self) -> Float64Array:
        return self.degrees

    def bounds(self) -> tuple[float, float, float, float]:
        return self.borders


@dataclass(frozen=True, eq=False)
class IndexGround:
    """Where the tiles of an index lie; `frame` is a map's, whose metres are exact."""

    origin: Position
    width: float
    borders: tuple[float, float, float, float]
    basemap: Map | None

    def geometry(self, places: Sequence[Position | None], gallery: IndexGallery) -> IndexGeometry:
        degrees = gallery.degrees()
        ground = (
            geo.degrees_on_plane(degrees, self.origin)
            if self.basemap is None
            else self.basemap.frame.xy(degrees[:, 0], degrees[:, 1])
        )
        tiles = TilePositions(gallery, degrees)
        return IndexGeometry(places, tiles, self.origin, ground, self.width, self.borders, degrees)


class TilePositions(Sequence[Position]):
    """The positions of a gallery's tiles, made when they are asked for: an index may have shown 10^5."""

    def __init__(self, gallery: IndexGallery, degrees: Float64Array) -> None:
        self._gallery, self._degrees = gallery, degrees

    def __len__(self) -> int:
        return len(self._degrees)

    def __getitem__(self, place: Any) -> Any:
        latitude, longitude = self._degrees[place].tolist()
        return Position(latitude, longitude, width=_window_size(self._gallery.name_of(place)))


def ground_of(
    probes: Sequence[SearchResult], extent: DegreeBox | None, places: Sequence[Position | None], basemap: Map | None
) -> tuple[IndexGround | None, str]:
    """Return where tiles lie, and why that is not known, as a sentence.

    Args:
        probes: some tiles of the index; those without a position count for nothing.
        extent: see `Index.extent`.
        places: what queries show; without a map, the borders hold them, too.
        basemap: the map; its borders are the ground's.

    Raises:
        InputError: if no tile lies on the map.
    """
    degrees = np.concatenate([one.positions for one in probes])
    degrees = degrees[~np.isnan(degrees).any(axis=1)]
    if not len(degrees):
        return (
            None,
            "The tiles of the index are without a position, so there is no map; lpn index --data adds positions.",
        )
    sizes = [size for one in probes for name in one.ids if (size := _window_size(name)) is not None]
    if basemap is not None:
        xy = basemap.frame.xy(degrees[:, 0], degrees[:, 1])
        west, south, east, north = basemap.bounds
        inside = (xy[:, 0] >= west) & (xy[:, 0] <= east) & (xy[:, 1] >= south) & (xy[:, 1] <= north)
        if not inside.any():
            raise InputError(
                f"None of {len(xy)} tiles of the index lies on the map {printable(basemap.name)}; give the "
                "map that was described."
            )
        origin = Position(basemap.frame.latitude, basemap.frame.longitude)
        width = float(np.median(sizes)) if sizes else max(east - west, north - south) / 20
        return IndexGround(origin, width, basemap.bounds, basemap), ""
    tiles = [Position(*row) for row in np.unique(degrees, axis=0).tolist()]
    corners = [] if extent is None else [Position(*extent[:2]), Position(*extent[2:])]
    known = [*tiles, *corners, *(place for place in places if place is not None)]
    layout = GalleryGeometry.of([], known)
    width = float(np.median(sizes)) if sizes else GalleryGeometry.of([], tiles).width
    west, south, east, north = layout.bounds()
    pad = _BORDER * max(east - west, north - south)
    return IndexGround(layout.origin, width, (west - pad, south - pad, east + pad, north + pad), None), ""


def some_windows(index: SharedIndex, model: Model) -> list[NamedWindow]:
    """Return some windows that an index holds, which tell its sizes and headings; none if its tiles are no windows."""
    named = (NamedWindow.parse(name) for one in probes(index, model) for name in one.ids)
    return [one for one in named if one is not None]


def probes(index: SharedIndex, model: Model) -> list[SearchResult]:
    """Search with drawn descriptors: their results show what tiles an index holds."""
    rng = np.random.default_rng(0)
    shape = (_PROBES, model.n_parts, model.embedding)
    return [index.search(one, None, _PROBED) for one in normalise(rng.standard_normal(shape).astype(np.float32))]


def _window_size(name: str) -> float | None:
    window = NamedWindow.parse(name)
    return None if window is None else window.size
