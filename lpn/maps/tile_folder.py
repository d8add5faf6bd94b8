"""A folder of Web Mercator tiles, {z}/{x}/{y}.png, as one raster of its deepest zoom."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.maps.raster import Box

# Half the side of the square that Web Mercator (EPSG:3857) shows, in its own metres.
_HALF = math.pi * 6_378_137.0
_MAX_ZOOM = 30
_NUMBER = re.compile(r"[0-9]{1,9}")
_TILE = re.compile(r"([0-9]{1,9})\.(png|jpg|jpeg|webp)", re.IGNORECASE)
# gdal2tiles writes this file beside tiles that count rows from the south (TMS).
_TMS = "tilemapresource.xml"
_CACHED_TILES = 128


def is_tile_folder(folder: Path) -> bool:
    """Return whether a folder has the layout {z}/{x}/{y}.png."""
    return any(_tiles(column) for zoom in _numbered(folder) for column in _numbered(zoom))


class TileFolder:
    """The deepest zoom of a folder of tiles; missing tiles are invalid.

    Args:
        path: the folder of the zooms.

    Attributes:
        zoom: the deepest zoom, whose pixels are those of the raster.
        matrix: (2, 3), from column and row to coordinates of EPSG:3857.

    Raises:
        DataError: if it holds no tile.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.treatment = path, None
        self._from_south = (path / _TMS).is_file()
        self._zooms: dict[int, dict[tuple[int, int], Path]] = {}
        for folder in _numbered(path):
            zoom = int(folder.name)
            tiles = {place: file for column in _numbered(folder) for place, file in self._column(zoom, column)}
            if tiles and zoom <= _MAX_ZOOM:
                self._zooms[zoom] = tiles
        if not self._zooms:
            raise DataError(f"{printable(str(path))} holds no tiles {{z}}/{{x}}/{{y}}.png; check the path.")
        self.zoom = max(self._zooms)
        places = np.array(list(self._zooms[self.zoom]))
        (self._west, self._north), (east, south) = places.min(0).tolist(), places.max(0).tolist()
        if max(east, south) >= 1 << self.zoom:
            raise DataError(
                f"{printable(str(path))} has the tile {east}, {south} at zoom {self.zoom}; expected numbers "
                f"below {1 << self.zoom}."
            )
        self._side = len(self._decoded(next(iter(self._zooms[self.zoom].values())))[0])
        self._read_tile = lru_cache(_CACHED_TILES)(self._tile)
        self.width = (east - self._west + 1) * self._side
        self.height = (south - self._north + 1) * self._side
        metres = 2 * _HALF / (1 << self.zoom)
        pixel = metres / self._side
        self.matrix: Float64Array = np.array(
            [[pixel, 0, self._west * metres - _HALF], [0, -pixel, _HALF - self._north * metres]]
        )
        missing = 1 - len(places) * self._side**2 / (self.width * self.height)
        self.notes = [
            f"{path.name} is shown at zoom {self.zoom}, the deepest of {len(self._zooms)}"
            + (f"; {missing:.0%} of its rectangle have no tile." if missing else ".")
        ]

    def read(self, box: Box, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """See `Raster.read`."""
        reduction = min(box[2] / size[0], box[3] / size[1])
        level = min(int(math.log2(max(1.0, reduction))), self.zoom)
        # Pixels of the coarser zoom, counted from its own first tile.
        by = 1 << level
        left, top = (
            (start * self._side + first) / by for start, first in zip((self._west, self._north), box, strict=False)
        )
        right, bottom = left + box[2] / by, top + box[3] / by
        columns = range(int(left) // self._side, math.ceil(right / self._side))
        rows = range(int(top) // self._side, math.ceil(bottom / self._side))
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        valid = np.zeros((size[1], size[0]), bool)
        scale = (right - left) / size[0], (bottom - top) / size[1]
        for row in rows:
            for column in columns:
                tile = self._read_tile(self.zoom - level, column, row)
                if tile is None:
                    continue
                # The pixels of the result whose centres lie in this tile.
                across, x = _within(column * self._side - left, self._side, scale[0], size[0])
                down, y = _within(row * self._side - top, self._side, scale[1], size[1])
                place = np.s_[down, across]
                grid = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
                if not grid[0].size:
                    continue
                picture[place] = cv2.remap(tile[0], *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                valid[place] = tile[1][np.ix_(y.round().astype(int), x.round().astype(int))]
        return picture, valid

    def files(self) -> list[Path]:
        """See `Raster.files`."""
        return sorted(file for tiles in self._zooms.values() for file in tiles.values())

    def close(self) -> None:
        """Forget the decoded tiles."""
        self._read_tile.cache_clear()

    def _column(self, zoom: int, folder: Path) -> Iterable[tuple[tuple[int, int], Path]]:
        for row, file in _tiles(folder):
            yield (int(folder.name), (1 << zoom) - 1 - row if self._from_south else row), file

    def _tile(self, zoom: int, column: int, row: int) -> tuple[UInt8Array, BoolArray] | None:
        """Return a tile and its mask: its own file, else made of the four tiles of the next zoom; None if it shows nothing."""
        file = self._zooms.get(zoom, {}).get((column, row))
        if file is not None:
            picture, valid = self._decoded(file)
            if picture.shape != (self._side, self._side, 3):
                raise DataError(
                    f"{printable(str(file))} has {picture.shape[1]} x {picture.shape[0]} pixels; expected {self._side} x "
                    f"{self._side}, as other tiles have."
                )
            return picture, valid
        if zoom >= self.zoom:
            return None
        half = self._side // 2
        picture, valid = np.zeros((self._side, self._side, 3), np.uint8), np.zeros((self._side, self._side), bool)
        for down in (0, 1):
            for right in (0, 1):
                tile = self._tile(zoom + 1, 2 * column + right, 2 * row + down)
                if tile is not None:
                    place = np.s_[down * half : (down + 1) * half, right * half : (right + 1) * half]
                    picture[place] = cv2.resize(tile[0], (half, half), interpolation=cv2.INTER_AREA)
                    valid[place] = tile[1][::2, ::2]
        return (picture, valid) if valid.any() else None

    def _decoded(self, file: Path) -> tuple[UInt8Array, BoolArray]:
        try:
            with Image.open(file) as image:
                pixels: AnyArray = np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(f"The tile {printable(str(file))} cannot be read; delete it, or make it again.") from error
        return np.ascontiguousarray(pixels[:, :, :3]), pixels[:, :, 3] >= 128


def _within(start: float, side: int, scale: float, count: int) -> tuple[slice, Float64Array]:
    """Return which of `count` samples, `scale` apart, lie in a tile from `start` on, and their pixels in it."""
    at = (np.arange(count) + 0.5) * scale - start
    inside = np.flatnonzero((at >= 0) & (at < side))
    if not len(inside):
        return slice(0, 0), np.zeros(0)
    return slice(int(inside[0]), int(inside[-1]) + 1), np.clip(at[inside] - 0.5, 0, side - 1)


def _numbered(folder: Path) -> list[Path]:
    return sorted(
        (path for path in folder.iterdir() if _NUMBER.fullmatch(path.name) and path.is_dir()), key=lambda p: int(p.name)
    )


def _tiles(folder: Path) -> list[tuple[int, Path]]:
    return [(int(match[1]), path) for path in sorted(folder.iterdir()) if (match := _TILE.fullmatch(path.name))]
