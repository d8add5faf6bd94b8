"""A gallery on the ground: where its tiles lie, and the picture they make together. Arrays in, arrays out; no viser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np

from lpn.core import images
from lpn.core.arrays import Float64Array, Int64Array, UInt8Array
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.drawing import overlays

LARGEST = 1536
"""Pixels of the longer side of the picture of all tiles."""
MOST_TILES = 2000
"""A larger gallery is drawn from an even choice of this many of its tiles."""

_EARTH: overlays.Colour = (38, 40, 42)


@dataclass(frozen=True, eq=False)
class Places:
    """Where one task's pictures are.

    Attributes:
        queries, tiles: positions, in the order of the pictures.
        origin: where east and north are counted from, the middle of the tiles.
        ground: metres east and north of each tile's centre, (G, 2).
        width: metres of ground a tile shows; where not given, the usual distance to the nearest neighbour.
    """

    queries: list[Position]
    tiles: list[Position]
    origin: Position
    ground: Float64Array
    width: float

    def off(self, query: int) -> Float64Array:
        """Metres from what a query shows to the centre of each tile: (G,)."""
        return geo.metres_between(geo.radians([self.queries[query]]), self._radians)

    def errors(self, found: Int64Array) -> Float64Array:
        """Metres from what each query shows to the tile that was found for it; infinite where none was, -1: (Q,)."""
        metres = geo.metres_between(geo.radians(self.queries), self._radians[found])
        return np.where(found < 0, np.inf, metres)

    @cached_property
    def _radians(self) -> Float64Array:
        return geo.radians(self.tiles)

    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, and north border of all tiles, in metres from the origin."""
        low, high = self.ground.min(axis=0) - self.width / 2, self.ground.max(axis=0) + self.width / 2
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def places(queries: list[Position], tiles: list[Position]) -> Places:
    """Lay a task's pictures out around the middle of its tiles."""
    latitudes, longitudes = ([getattr(tile, key) for tile in tiles] for key in ("latitude", "longitude"))
    origin = Position((min(latitudes) + max(latitudes)) / 2, (min(longitudes) + max(longitudes)) / 2)
    ground = geo.on_plane(tiles, origin)
    given = [tile.width for tile in tiles if tile.width is not None]
    width = float(np.median(given)) if given else _usual_distance(ground)
    return Places(queries, tiles, origin, ground, width)


def mosaic(laid: Places, files: Sequence[Path]) -> UInt8Array:
    """The world seen from above, as far as tiles show it: north up, at most LARGEST pixels a side."""
    west, south, east, north = laid.bounds()
    scale = LARGEST / max(east - west, north - south)
    canvas = np.empty((max(round((north - south) * scale), 1), max(round((east - west) * scale), 1), 3), np.uint8)
    canvas[:] = _EARTH
    side = max(round(laid.width * scale), 1)
    step = max(1, len(files) // MOST_TILES)
    for index in range(0, len(files), step):
        tile = overlays.square(images.load_picture(files[index]), side)
        x, y = laid.ground[index]
        left, top = round((x - west) * scale - side / 2), round((north - y) * scale - side / 2)
        _paste(canvas, tile, left, top)
    return canvas


def _paste(canvas: UInt8Array, tile: UInt8Array, left: int, top: int) -> None:
    height, width = canvas.shape[:2]
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + tile.shape[1], width), min(top + tile.shape[0], height)
    if x0 < x1 and y0 < y1:
        canvas[y0:y1, x0:x1] = tile[y0 - top : y1 - top, x0 - left : x1 - left]


def _usual_distance(ground: Float64Array) -> float:
    """Median distance to the nearest neighbour, from an even choice of tiles; 100 m for one tile alone."""
    if len(ground) < 2:
        return 100.0
    some = ground[:: max(1, len(ground) // 500)]
    gaps = np.linalg.norm(some[:, None] - ground[None], axis=2)
    nearest = np.partition(gaps, 1, axis=1)[:, 1]
    return max(float(np.median(cast(Float64Array, nearest))), 1.0)
