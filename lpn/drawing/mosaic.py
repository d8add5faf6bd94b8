"""A gallery's tiles at their positions, drawn as one picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import PictureError
from lpn.datasets import Picture
from lpn.drawing import theme
from lpn.tasks.gallery_geometry import GalleryGeometry

# Pixels of the mosaic's longer side.
LARGEST = 1536
# A larger gallery is drawn from an even sample of this many tiles.
MOST_TILES = 2000
_EARTH: theme.Colour = (38, 40, 42)


def draw(geometry: GalleryGeometry, gallery: Sequence[Picture]) -> UInt8Array:
    """Draw the tiles' pictures on a map, north up: (H, W, 3) uint8, at most LARGEST pixels a side.

    Of several tiles at one position, only the first is drawn. No tile is rotated, and tiles without pictures are skipped.
    """
    west, south, east, north = geometry.bounds()
    scale = LARGEST / max(east - west, north - south)
    canvas = np.empty((max(round((north - south) * scale), 1), max(round((east - west) * scale), 1), 3), np.uint8)
    canvas[:] = _EARTH
    side = max(round(geometry.width * scale), 1)
    places = geometry.places
    for index in places[:: max(1, len(places) // MOST_TILES)]:
        if gallery[index].missing:
            continue
        try:
            tile = images.resize(gallery[index].load(), side, side)
        except PictureError:
            continue  # the ground shows in place of a damaged picture
        x, y = geometry.ground[index]
        _paste(canvas, tile, round((x - west) * scale - side / 2), round((north - y) * scale - side / 2))
    return canvas


def _paste(canvas: UInt8Array, tile: UInt8Array, left: int, top: int) -> None:
    height, width = canvas.shape[:2]
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + tile.shape[1], width), min(top + tile.shape[0], height)
    if x0 < x1 and y0 < y1:
        canvas[y0:y1, x0:x1] = tile[y0 - top : y1 - top, x0 - left : x1 - left]
