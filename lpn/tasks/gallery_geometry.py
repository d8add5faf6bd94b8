"""Positions of a task's queries and tiles on the ground, in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.datasets import Dataset, Picture, geo
from lpn.datasets.geo import Position

# Width of a tile that has no neighbour.
_LONE_TILE_M = 100.0
_SAMPLE = 500


@dataclass(frozen=True, eq=False)
class GalleryGeometry:
    """The positions of one task's pictures.

    Attributes:
        queries, tiles: positions, in the order of the pictures; an unknown one is None for a query, and NaN for a tile.
        origin: the middle of the tiles.
        ground: centre of each tile in metres east and north of the origin, (G, 2).
        width: side of a tile on the ground in metres; by default the median distance from a position to its nearest neighbour.
    """

    queries: Sequence[Position | None]
    tiles: Sequence[Position]
    origin: Position
    ground: Float64Array
    width: float

    @classmethod
    def of(cls, queries: Sequence[Position | None], tiles: Sequence[Position]) -> GalleryGeometry:
        """Lay out a task's pictures around the middle of its tiles."""
        placed = [tile for tile in tiles if not math.isnan(tile.latitude)]
        latitudes, longitudes = ([getattr(tile, key) for tile in placed] for key in ("latitude", "longitude"))
        origin = Position((min(latitudes) + max(latitudes)) / 2, (min(longitudes) + max(longitudes)) / 2)
        ground = geo.on_plane(tiles, origin)
        widths = [tile.width for tile in tiles if tile.width is not None]
        width = float(np.median(widths)) if widths else _neighbour_distance(ground[_distinct(ground)])
        return cls(queries, tiles, origin, ground, width)

    @classmethod
    def of_dataset(
        cls, dataset: Dataset, queries: Sequence[Picture], gallery: Sequence[Picture]
    ) -> GalleryGeometry | None:
        """Lay out a task's pictures by the data set's positions; None without any."""
        positions = dataset.positions()
        return None if positions is None else cls.of(positions.of(queries), positions.of(gallery))

    def errors_m(self, query: int) -> Float64Array | None:
        """Return metres from a query's place to the centre of each tile, (G,); None if its place is unknown."""
        place = self.queries[query]
        return None if place is None else self.metres_from(place)

    def metres_from(self, place: Position) -> Float64Array:
        """Return metres from a place to the centre of each tile, (G,)."""
        return geo.geodesic(geo.degrees([place]), self._degrees)

    def answer_errors_m(self, answers: Int64Array) -> Float64Array:
        """Return metres from each query's place to its answer, (Q,).

        The answer -1 means no answer, and gives infinity. A query of unknown place gives NaN.
        """
        metres = geo.geodesic(geo.degrees(self._known_or_nan), self._degrees[answers])
        return np.where((answers < 0) & ~np.isnan(metres), np.inf, metres)

    @cached_property
    def query_ground(self) -> Float64Array:
        """Return each query's place in metres east and north of the origin, (Q, 2); NaN if unknown."""
        return geo.on_plane(self._known_or_nan, self.origin)

    @property
    def _known_or_nan(self) -> list[Position]:
        return [Position(math.nan, math.nan) if place is None else place for place in self.queries]

    @cached_property
    def _degrees(self) -> Float64Array:
        return geo.degrees(self.tiles)

    @cached_property
    def places(self) -> Int64Array:
        """The first tile at each position, in the order of the tiles; all drone pictures of a place share a position."""
        return _distinct(self.ground)

    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, and north border of all tiles, in metres from the origin."""
        low, high = (
            self.ground[self.places].min(axis=0) - self.width / 2,
            self.ground[self.places].max(axis=0) + self.width / 2,
        )
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _distinct(ground: Float64Array) -> Int64Array:
    """Return the first index of each distinct known position, (G, 2) metres, rounded to a decimetre; ascending."""
    known = np.flatnonzero(~np.isnan(ground).any(axis=1))
    return np.sort(known[np.unique(ground[known].round(1), axis=0, return_index=True)[1]])


def _neighbour_distance(ground: Float64Array) -> float:
    """Return the median distance to the nearest neighbour in metres, from an even sample of distinct positions."""
    if len(ground) < 2:
        return _LONE_TILE_M
    sample = ground[:: max(1, len(ground) // _SAMPLE)]
    nearest = np.partition(np.linalg.norm(sample[:, None] - ground[None], axis=2), 1, axis=1)[:, 1]
    return max(float(np.median(nearest)), 1.0)
