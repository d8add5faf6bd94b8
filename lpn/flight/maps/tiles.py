"""A set of tiles in Web Mercator as one raster of its deepest zoom."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.maps import _gdal
from lpn.flight.maps.borders import Borders, PixelBox, border_note, find_borders, overview_size
from lpn.flight.maps.raster import Treatment
from lpn.flight.maps.tile_sets import Extent, FolderTiles, TileAddress

# Half the side of the square that Web Mercator (EPSG:3857) shows, in its own metres.
_HALF = math.pi * 6_378_137.0
_CACHED_TILES = 128
# Pillow would run Ghostscript for a tile in PostScript.
_FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP")
# Pixels of a tile's side.
_MIN_SIDE, _MAX_SIDE = 16, 4096
# Tiles that are looked at for the size of all.
_SAMPLES = 5
# Pairs of neighbouring tiles that are compared, and how many pixels an edge must show.
_PAIRS, _EDGE = 24, 32
# White and black of borders, and the standard deviation below which an edge has one colour.
_WHITE, _BLACK, _FLAT = 240, 16, 2.0
# Tiles fit together where their edges differ by less than this share of what they differ when shifted, and in other orders.
_FITS = 0.6

# A picture, (side, side, 3), and which of its pixels are valid, (side, side).
TilePicture = tuple[UInt8Array, BoolArray]

# How stored numbers count: column and row from the north, column and row from the south, row from the north and column.
_XYZ, _TMS, _YX = "XYZ", "TMS", "YX"
# Rows and columns of a tile's edges.
_TOP, _BOTTOM, _LEFT, _RIGHT = np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]
# For each order, the edges that touch where the second number of two tiles follows.
_TOUCHING: dict[str, tuple[Any, Any]] = {_XYZ: (_BOTTOM, _TOP), _TMS: (_TOP, _BOTTOM), _YX: (_RIGHT, _LEFT)}


class TileRaster:
    """The deepest zoom of a set of tiles; missing tiles are invalid.

    Args:
        path: a folder of tiles.
        treatment: a recorded treatment; None decides about borders.
        keep_borders: do not look for white and black borders.

    Attributes:
        zoom: the deepest zoom, whose pixels are those of the raster.
        crs: Web Mercator.
        matrix: (2, 3), from column and row to coordinates of `crs`.

    Raises:
        DataError: if it holds no tiles, or they are no pictures in Web Mercator.
    """

    def __init__(self, path: Path, treatment: Treatment | None = None, keep_borders: bool = False) -> None:
        self.path, self.treatment = path, treatment
        self._tiles = tiles = FolderTiles(path)
        self.notes: list[str] = []
        self.zoom = max(tiles.zooms)
        self._side = self._usual_side()
        self._read_tile = lru_cache(_CACHED_TILES)(self._tile)
        self._order = self._find_order()
        self._place()
        extent = tiles.zooms[self.zoom]
        whole = extent.count * self._side**2 >= self.width * self.height
        if treatment is None and whole and not keep_borders:
            self.treatment = self._find_borders()

    def read(self, box: PixelBox, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """See `Raster.read`."""
        picture, valid = self._cut(box, size)
        if self.treatment is not None and self.treatment.border:
            valid &= ~self._borders.within(np.moveaxis(picture, 2, 0), box, size)
        return picture, valid

    def _cut(self, box: PixelBox, size: tuple[int, int]) -> tuple[UInt8Array, BoolArray]:
        """Read a rectangle, borders included."""
        reduction = min(box[2] / size[0], box[3] / size[1])
        level = min(int(math.log2(max(1.0, reduction))), self.zoom)
        # Pixels of the coarser zoom, counted from its own first tile.
        by = 1 << level
        left, top = ((start + first) / by for start, first in zip(self._origin, box, strict=False))
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
        return self._tiles.files()

    def close(self) -> None:
        """Forget the decoded tiles."""
        self._read_tile.cache_clear()

    def _overview(self) -> tuple[UInt8Array, BoolArray]:
        """Return an overview, (3, height, width), and which of its pixels are valid, (height, width)."""
        picture, valid = self._cut((0, 0, self.width, self.height), overview_size(self.width, self.height))
        return np.moveaxis(picture, 2, 0), valid

    def _find_borders(self) -> Treatment | None:
        """Decide about borders on an overview."""
        values, valid = self._overview()
        borders = find_borders(values, deep=False) if valid.all() else {}
        self.notes += [border_note(colour, self._name, region) for colour, region in borders.items()]
        return Treatment((1, 2, 3), border=tuple(borders)) if borders else None

    @cached_property
    def _borders(self) -> Borders:
        colours = self.treatment.border if self.treatment is not None else ()
        return Borders(self._overview()[0], colours, (self.width, self.height), deep=False)

    @property
    def _name(self) -> str:
        return printable(self.path.name)

    def _usual_side(self) -> int:
        """Return the side of most tiles of the deepest zoom, in pixels, by a few that show something."""
        places = self._tiles.places(self.zoom)
        spread = [places[number] for number in np.linspace(0, len(places) - 1, _SAMPLES).astype(int).tolist()]
        sides: list[int] = []
        for place in dict.fromkeys([*spread, *places]):
            tile = self._decoded(self.zoom, place)
            if tile is None:
                continue
            if tile[0].shape[0] != tile[0].shape[1] or len(tile[0]) < _MIN_SIDE:
                raise self._size_error(self.zoom, place, tile[0], 256)
            sides.append(len(tile[0]))
            if len(sides) == _SAMPLES:
                break
        if not sides:
            raise DataError(f"All tiles of {printable(str(self.path))} at zoom {self.zoom} are empty; make them again.")
        return max(sides, key=lambda side: (sides.count(side), side))

    def _place(self) -> None:
        """Compute origin, size, and matrix of the raster, and say what was decided."""
        tiles, side = self._tiles, self._side
        extent = tiles.zooms[self.zoom]
        corners = [self._turned(self.zoom, place) for place in (extent.low, extent.high)]
        (west, north), (east, south) = np.min(corners, 0).tolist(), np.max(corners, 0).tolist()
        if min(west, north) < 0 or max(east, south) >= 1 << self.zoom:
            raise DataError(
                f"{printable(str(self.path))} has the tile {extent.high[0]}, {extent.high[1]} at zoom {self.zoom}; expected "
                f"numbers below {1 << self.zoom}."
            )
        columns, rows = east - west + 1, south - north + 1
        missing = 1 - extent.count / (columns * rows)
        self.notes.append(
            f"{self._name} is shown at zoom {self.zoom}, the deepest of {len(tiles.zooms)}"
            + (f"; {missing:.0%} of its rectangle have no tile." if missing > 0 else ".")
        )
        self.notes += self._order_notes
        wider = [zoom for zoom, other in tiles.zooms.items() if not _covers(extent, other, self.zoom - zoom)]
        if wider:
            self.notes.append(
                f"Zoom {max(wider)} of {self._name} reaches further than zoom {self.zoom}; that part is not shown."
            )
        left, top, right, bottom = west * side, north * side, (east + 1) * side, (south + 1) * side
        self._origin = left, top
        bounds = self._bounds()
        if bounds is not None:
            # Tiles at the edge reach beyond the map, and show white or black there.
            closer = [round(edge) for edge in bounds]
            removed = closer[0] - left, closer[1] - top, right - closer[2], bottom - closer[3]
            if max(removed) < side and min(closer[2] - closer[0], closer[3] - closer[1]) >= _MIN_SIDE:
                left, top = max(left, closer[0]), max(top, closer[1])
                right, bottom = min(right, closer[2]), min(bottom, closer[3])
                self._origin = left, top
            else:
                self.notes.append(
                    f"The bounds that {self._name} states do not fit its tiles, and are left out of account."
                )
        self.width, self.height = right - left, bottom - top
        self.crs = _gdal.rasterio().crs.CRS.from_epsg(3857)
        pixel = 2 * _HALF / (side << self.zoom)
        self.matrix: Float64Array = np.array([[pixel, 0, left * pixel - _HALF], [0, -pixel, _HALF - top * pixel]])

    def _bounds(self) -> tuple[float, float, float, float] | None:
        """Return the stated bounds in pixels of the deepest zoom: left, top, right, bottom; None without any."""
        if self._tiles.declared.bounds is None:
            return None
        west, south, east, north = self._tiles.declared.bounds
        world = self._side << self.zoom

        def down(latitude: float) -> float:
            sine = math.sin(math.radians(max(-85.06, min(85.06, latitude))))
            return (0.5 - math.atanh(sine) / (2 * math.pi)) * world

        return (west + 180) / 360 * world, down(north), (east + 180) / 360 * world, down(south)

    def _find_order(self) -> str:
        """Return how the stored numbers count: as the tiles fit together, else as bounds or metadata say."""
        said = self._tiles.declared.from_south
        usual = _TMS if said else _XYZ
        self._order_notes: list[str] = []
        fitting = self._fitting_order()
        order = fitting or self._order_by_bounds() or usual
        how = {
            _XYZ: "rows count from the north (XYZ)",
            _TMS: "rows count from the south (TMS)",
            _YX: "names are {z}/{y}/{x}, with rows from the north",
        }[order]
        if order != usual:
            why = "there the tiles fit together" if fitting else "there they lie in the stated bounds"
            self._order_notes.append(f"In {self._name}, {how}: {why}.")
        elif not fitting and said is None:
            self._order_notes.append(
                f"{self._name} does not say where its rows begin; they are counted from the north (XYZ). For rows from the "
                "south (TMS), add a tilemapresource.xml."
            )
        return order

    def _fitting_order(self) -> str | None:
        """Return the order in which the edges of neighbouring tiles agree; None if that does not tell."""
        orders = (_XYZ, _TMS, _YX)
        sums = {order: np.zeros(2) for order in orders}
        for one, other in self._neighbours():
            for order in orders:
                sums[order] += _differences(one, other, *_TOUCHING[order])
        misfits = sorted((apart / shifted, order) for order, (apart, shifted) in sums.items() if shifted)
        if misfits and misfits[0][0] < _FITS * min([1.0, *(misfit for misfit, _ in misfits[1:])]):
            return misfits[0][1]
        return None

    def _neighbours(self) -> Iterator[tuple[TilePicture, TilePicture]]:
        """Yield pairs of tiles whose second numbers follow, from all over the deepest zoom."""
        places = self._tiles.places(self.zoom)
        known = set(places)
        pairs = [(place, after) for place in places if (after := (place[0], place[1] + 1)) in known]
        for number in np.unique(np.linspace(0, len(pairs) - 1, _PAIRS).astype(int)).tolist() if pairs else ():
            one, other = (self._decoded(self.zoom, place) for place in pairs[number])
            if one is not None and other is not None and one[0].shape == other[0].shape:
                yield one, other

    def _order_by_bounds(self) -> str | None:
        """Return the order in which the tiles lie where the stated bounds are; None if that does not tell."""
        bounds = self._bounds()
        if bounds is None:
            return None
        extent = self._tiles.zooms[self.zoom]
        middle = int((bounds[1] + bounds[3]) / 2) // self._side
        high = (1 << self.zoom) - 1
        rows = {_XYZ: (extent.low[1], extent.high[1]), _TMS: (high - extent.high[1], high - extent.low[1])}
        fitting = [order for order, (first, last) in rows.items() if first <= middle <= last]
        return fitting[0] if len(fitting) == 1 else None

    def _turned(self, zoom: int, place: TileAddress) -> TileAddress:
        """Return column and row from the north of stored numbers, or the stored numbers of column and row."""
        if self._order == _YX:
            return place[1], place[0]
        return (place[0], (1 << zoom) - 1 - place[1]) if self._order == _TMS else place

    def _tile(self, zoom: int, column: int, row: int) -> TilePicture | None:
        """Return a tile and its mask: its own picture, else made of the four of the next zoom; None if it shows nothing."""
        place = self._turned(zoom, (column, row))
        tile = self._decoded(zoom, place) if zoom in self._tiles.zooms else None
        side = self._side
        if tile is not None:
            picture, valid = tile
            # Tiles of twice the pixels ({y}@2x.png) may stand beside plain ones.
            if picture.shape[0] == picture.shape[1] and len(picture) in (side // 2, 2 * side):
                picture = np.asarray(cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA), np.uint8)
                valid = cv2.resize(valid.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST) > 0
            if picture.shape != (side, side, 3):
                raise self._size_error(zoom, place, picture, side)
            return picture, valid
        extent = self._tiles.zooms[self.zoom]
        if zoom >= self.zoom or not self._reaches(zoom, column, row, extent.low, extent.high):
            return None
        half = side // 2
        picture, valid = np.zeros((side, side, 3), np.uint8), np.zeros((side, side), bool)
        for down in (0, 1):
            for right in (0, 1):
                tile = self._tile(zoom + 1, 2 * column + right, 2 * row + down)
                if tile is not None:
                    at = np.s_[down * half : (down + 1) * half, right * half : (right + 1) * half]
                    picture[at] = cv2.resize(tile[0], (half, half), interpolation=cv2.INTER_AREA)
                    valid[at] = tile[1][::2, ::2]
        return (picture, valid) if valid.any() else None

    def _reaches(self, zoom: int, column: int, row: int, low: TileAddress, high: TileAddress) -> bool:
        """Return whether a tile lies over the rectangle of the deepest zoom."""
        finer = self.zoom - zoom
        corners = np.array([self._turned(self.zoom, place) for place in (low, high)]) >> finer
        return bool(((corners.min(0) <= (column, row)) & (corners.max(0) >= (column, row))).all())

    def _decoded(self, zoom: int, place: TileAddress) -> TilePicture | None:
        """Return a stored tile and its mask; None if there is none, or an empty one."""
        data = self._tiles.read(zoom, place)
        if data is None:
            return None
        if data[:64].lstrip().startswith((b"<", b"{")):
            note = f"Some tiles of {self._name} are text, as a failed download leaves them; they have no data."
            if note not in self.notes:
                self.notes.append(note)
            return None
        try:
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                if max(image.size) > _MAX_SIDE:
                    raise ValueError(f"{image.size[0]} x {image.size[1]} pixels")
                pixels: AnyArray = np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(
                f"The tile {self._tiles.name(zoom, place)} cannot be read as a picture; delete it, or make it again."
            ) from error
        return np.ascontiguousarray(pixels[:, :, :3]), pixels[:, :, 3] > 0

    def _size_error(self, zoom: int, place: TileAddress, picture: UInt8Array, side: int) -> DataError:
        return DataError(
            f"The tile {self._tiles.name(zoom, place)} has {picture.shape[1]} x {picture.shape[0]} pixels; expected {side} x "
            f"{side}, as other tiles have."
        )


def _differences(one: TilePicture, other: TilePicture, first: Any, second: Any) -> tuple[float, float]:
    """Return by how much an edge of one tile differs from that of another, and from the same edge shifted by half a side.

    Where the edges touch, the first number is far below the second one. Both are 0 where the edges tell nothing: white and black
    of borders, and edges of one colour, fit everywhere.
    """
    edges = np.stack([one[0][first], other[0][second]]).astype(int)
    plain = (edges.min(2) >= _WHITE) | (edges.max(2) <= _BLACK)
    known = one[1][first] & other[1][second] & ~plain.any(0)
    half = len(known) // 2
    known &= np.roll(known, half)
    if known.sum() < _EDGE or edges[:, known].std(1).max(1).min() < _FLAT:
        return 0.0, 0.0
    apart, shifted = (np.abs(edges[0] - np.roll(edges[1], by, axis=0))[known].sum() for by in (0, half))
    return float(apart), float(shifted)


def _covers(deepest: Extent, other: Extent, finer: int) -> bool:
    """Return whether the deepest zoom covers another one, which is coarser by so many levels."""
    low, high = (np.array(place) >> finer for place in (deepest.low, deepest.high))
    return bool((low <= other.low).all() and (high >= other.high).all())


def _within(start: float, side: int, scale: float, count: int) -> tuple[slice, Float64Array]:
    """Return which of `count` samples, `scale` apart, lie in a tile from `start` on, and their pixels in it."""
    at = (np.arange(count) + 0.5) * scale - start
    inside = np.flatnonzero((at >= 0) & (at < side))
    if not len(inside):
        return slice(0, 0), np.zeros(0)
    return slice(int(inside[0]), int(inside[-1]) + 1), np.clip(at[inside] - 0.5, 0, side - 1)
