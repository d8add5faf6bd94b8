"""A map: sheets in one local metric frame, cut into pictures of windows."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Sequence
from datetime import date
from threading import Lock
from typing import Any

import msgspec
import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.homography import corner_pixels
from lpn.core.texts import listed
from lpn.flight.maps import window as windows
from lpn.flight.maps.elevation import Elevation
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.sheet import Bounds, Sheet, bounds_of, datum_notes
from lpn.flight.maps.window import Window

# Side of the blocks in which a picture is cut, which bounds the memory.
_BLOCK = 512
# Maximum of cells of the coverage along the longer side.
_COVERAGE = 1024
# Pixels along the longer side of the overview that a map keeps in memory, some 16 MB.
OVERVIEW = 2 * _COVERAGE
# Least share of a window's ground that the map shows.
_MIN_VALID = 0.5
# Windows of a block.
_WINDOWS = 1 << 16
# Widest map in metres: beyond it, grid north and scale of one frame are too far off.
_MAX_WIDTH = 400_000.0
_MAX_PIXELS = 16_384
# Minimum of pixels along a map's shorter side: fewer show no place.
_MIN_SIDE = 16
# Default error of a map's places in pixels, and its minimum in metres: those of a map from tags without ground control.
_PIXELS, _METRES = 3.0, 1.0

SEASONS = ("spring", "summer", "autumn", "winter")
_DAY = re.compile(r"\d{4}-\d{2}-\d{2}")
_LONGEST = 120


class MapPlace(msgspec.Struct, frozen=True, omit_defaults=True):
    """A map's place, as its maker named it.

    Raises:
        InputError: for a text that is too long or not printable, or a time that is neither a day nor a season.

    Attributes:
        name: such as "Dripping Springs, Texas"; "" if it is not known.
        photographed: the day of the map's pictures, "2014-10-19", or their season, "spring"; "" if neither is known.
        credit: author and licence of the pictures; "" if they are not known.
        source: web address of the pictures; "" if there is none.
    """

    name: str = ""
    photographed: str = ""
    credit: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        for text in (self.name, self.photographed, self.credit, self.source):
            if len(text) > _LONGEST or text != printable(text):
                raise InputError(
                    f"The place of a map has the text {printable(text[:_LONGEST])!r}; expected printable text of at most "
                    f"{_LONGEST} characters."
                )
        if self.source and not self.source.startswith("https://"):
            raise InputError(f"The source of a map is {self.source!r}; expected an address that begins with https://.")
        try:
            known = self.photographed in ("", *SEASONS) or self.day is not None
        except ValueError:
            known = False
        if not known:
            raise InputError(
                f"The time of the map's pictures is {self.photographed!r}; expected a day such as 2014-10-19, or "
                f"{listed(SEASONS, 'or')}."
            )

    @property
    def day(self) -> date | None:
        """The day of the map's pictures; None if it is not known."""
        return date.fromisoformat(self.photographed) if _DAY.fullmatch(self.photographed) else None


class Map:
    """A georeferenced map of one or several sheets; thread safe.

    Where sheets overlap, the finest valid one is shown.

    Args:
        frame: a recorded frame; None takes the middle of the sheets as its origin.
        coverage: a recorded coverage; None computes it at first use.
        notes: see `own_notes`.

    Attributes:
        name: of the map.
        sheets: at least one, the finest first.
        frame: the local metric frame of all windows.
        bounds: west, south, east, north in metres of the frame.
        resolution: metres per pixel of the finest sheet.
        elevation: heights of its ground; None if unknown.
        place: facts about its place; empty if unknown.
        error: 1-sigma error of its places in metres along each axis by the map's own data; None if unknown.
        surveyed_error: the same error, measured by a person against known positions, above 0; None if not measured. It replaces
            all others.
        own_notes: sentences about how the map was made, and about files that are left out.

    Raises:
        DataError: if the sheets lie more than 400 km apart, or have fewer than 16 pixels along a side.
    """

    def __init__(
        self,
        name: str,
        sheets: Sequence[Sheet],
        frame: LocalFrame | None = None,
        coverage: Float32Array | None = None,
        elevation: Elevation | None = None,
        place: MapPlace | None = None,
        error: float | None = None,
        surveyed_error: float | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        self.name, self.elevation, self.place = name, elevation, place or MapPlace()
        self.error, self.surveyed_error, self.own_notes = error, surveyed_error, tuple(notes)
        self.frame = frame or _frame_of(sheets)
        for sheet in sheets:
            sheet.locate(self.frame)
        self.sheets = sorted(sheets, key=lambda sheet: sheet.resolution)
        self._boxes = np.array([sheet.bounds for sheet in self.sheets])
        self.bounds = bounds_of(self._boxes.reshape(-1, 2))
        self.resolution = self.sheets[0].resolution
        self._check_pixels()
        self._coverage = coverage
        self._datum_notes = datum_notes((sheet.name, sheet.crs) for sheet in self.sheets)
        self._sums: Float64Array | None = None
        self._lock, self._overview_lock = Lock(), Lock()
        self._overview: tuple[UInt8Array, BoolArray] | None = None

    def metres_off(self, point: FloatingArray) -> float:
        """Return how many metres a point of the frame, (2,), lies from the nearest point of the bounds; 0 inside."""
        low, high = np.array(self.bounds[:2]), np.array(self.bounds[2:])
        return float(np.hypot(*np.maximum(np.maximum(low - point, point - high), 0.0)))

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height in metres: of a single sheet, which may be turned, else of the bounds."""
        if len(self.sheets) > 1:
            west, south, east, north = self.bounds
            return east - west, north - south
        sheet = self.sheets[0]
        return sheet.pixel[0] * sheet.raster.width, sheet.pixel[1] * sheet.raster.height

    @property
    def notes(self) -> list[str]:
        """Sentences about how sheets and elevation are read, and about oddities."""
        notes = [*self.own_notes, *(note for sheet in self.sheets for note in sheet.raster.notes)]
        notes += [sheet.warning for sheet in self.sheets if sheet.warning is not None]
        notes += self._datum_notes
        return notes + ([] if self.elevation is None else self.elevation.notes)

    @property
    def default_error(self) -> float:
        """The default 1-sigma error of its places in metres along each axis.

        It is the surveyed error. Without one it is 3 pixels, at least 1 m, with the map's own `error` added in quadrature.
        """
        if self.surveyed_error is not None:
            return self.surveyed_error
        return math.hypot(max(_METRES, _PIXELS * self.resolution), self.error or 0.0)

    def total_error(self, given: float | None) -> float:
        """Return the 1-sigma error of its places in metres: a person's value for this run, else `default_error`."""
        return self.default_error if given is None else given

    def place_error(self, given: float | None) -> float:
        """Return the part of `total_error` that is the map's error against true positions on earth; 0 if unknown.

        A person's value for one run says nothing about this part.
        """
        return 0.0 if given is not None else self.surveyed_error or self.error or 0.0

    def heights(self, xy: Float64Array) -> Float64Array:
        """Return the heights of the ground in metres above the elevation's datum, (N,), at metres east and north, (N, 2).

        Unknown heights are NaN.

        Raises:
            DataError: if the elevation's file is damaged.
        """
        if self.elevation is None:
            return np.full(len(xy), np.nan)
        return self.elevation.heights(self.frame, xy)

    def read(self, window: Window, pixels: int) -> tuple[UInt8Array, BoolArray]:
        """Cut the picture of a window.

        Args:
            window: in metres of the map's frame; it may reach beyond the map.
            pixels: side of the picture, 1 to 16384.

        Returns:
            RGB, (pixels, pixels, 3), 0 where nothing is known, and the valid pixels, (pixels, pixels).

        Raises:
            InputError: if `pixels` is out of range.
            DataError: if a sheet's file is damaged.
        """
        if not 1 <= pixels <= _MAX_PIXELS:
            raise InputError(f"A picture of {pixels} pixels a side cannot be cut; expected 1 to {_MAX_PIXELS}.")
        return self._read(window, pixels, pixels, pixels)

    def pyramid(self, sizes: Sequence[float], overlap: float = 0.5) -> list[Window]:
        """Return windows, north up, in the order of `sizes`, on grids that cover the map; at least half of each has data.

        Sizes with a factor of sqrt(2) or 2 between them cover a range of flying heights.

        Args:
            sizes: sides in metres.
            overlap: share of a window's side that its neighbour covers too, 0 to below 1.

        Raises:
            InputError: if a number is out of range.
        """
        return [window for block in self.pyramid_blocks(sizes, overlap) for window in block]

    def count_pyramid(self, sizes: Sequence[float], overlap: float = 0.5) -> int:
        """Return the number of windows of `pyramid`, without making them."""
        return sum(len(block) for size in sizes for block in self._centres(size, overlap))

    def pyramid_blocks(self, sizes: Sequence[float], overlap: float = 0.5) -> Iterator[list[Window]]:
        """Yield the windows of `pyramid` in blocks of at most 65,536, to bound the memory."""
        for size in sizes:
            for centres in self._centres(size, overlap):
                yield [Window(x, y, size) for x, y in centres.tolist()]

    def _centres(self, size: float, overlap: float) -> Iterator[Float64Array]:
        """Yield the centres of windows of a size in blocks, (B, 2)."""
        if not 0 <= overlap < 1:
            raise InputError(f"The overlap {overlap:g} is out of range; expected 0 to below 1.")
        centres = windows.grid(self.bounds, size, size * (1 - overlap))
        for start in range(0, len(centres), _WINDOWS):
            some = centres[start : start + _WINDOWS]
            # The tolerance keeps a share of exactly `_MIN_VALID` from failing by rounding.
            yield some[self.valid_shares(some, size) >= _MIN_VALID - 1e-6]

    def valid_shares(self, centres: Float64Array, size: float) -> Float64Array:
        """Return the share of ground, (N,), that the map shows in north-up windows of a size about centres (N, 2)."""
        coverage = self.coverage()
        cell = self._side / max(coverage.shape)
        # sums[r, c] is the sum of all cells above row r and left of column c. Two threads may both compute it.
        if self._sums is None:
            self._sums = np.pad(coverage.astype(np.float64), ((1, 0), (1, 0))).cumsum(0).cumsum(1)
        sums = self._sums
        low, high = centres - size / 2, centres + size / 2
        left, right = ((x - self.bounds[0]) / cell for x in (low[:, 0], high[:, 0]))
        top, bottom = ((self.bounds[3] - y) / cell for y in (high[:, 1], low[:, 1]))
        total = _at(sums, bottom, right) - _at(sums, top, right) - _at(sums, bottom, left) + _at(sums, top, left)
        # Round: differences of sums are not exactly 0 over ground that the map does not show.
        return np.asarray(np.clip(np.round(total / (size / cell) ** 2, 6), 0, 1))

    def coverage(self) -> Float32Array:
        """Return the share of each cell of the map's bounds that is valid, (rows, columns), from 0 to 1, north up."""
        with self._lock:
            if self._coverage is None:
                cells = max(1, min(_COVERAGE, math.ceil(self._side / self.resolution)))
                valid = self.overview(2 * cells)[1]
                rows, columns = valid.shape
                even = np.zeros((rows + rows % 2, columns + columns % 2), np.float32)
                even[:rows, :columns] = valid
                self._coverage = even.reshape(len(even) // 2, 2, -1, 2).mean((1, 3), dtype=np.float32)
            return self._coverage

    def overview(self, pixels: int) -> tuple[UInt8Array, BoolArray]:
        """Return a picture of the whole map, north up, `pixels` along its longer side.

        Sheets without overviews are read whole, so the picture of `OVERVIEW` pixels is cached.

        Returns:
            RGB (rows, columns, 3) from the north-west corner of `bounds` on, and the valid pixels (rows, columns); cached arrays
            are read-only.
        """
        if pixels != OVERVIEW:
            return self.picture(self.bounds, pixels)
        with self._overview_lock:
            if self._overview is None:
                self._overview = self.picture(self.bounds, pixels)
                for array in self._overview:
                    array.setflags(write=False)
            return self._overview

    def picture(self, bounds: Bounds, pixels: int) -> tuple[UInt8Array, BoolArray]:
        """Return a picture of bounds in metres of the frame, north up, `pixels` along its longer side; see `overview`."""
        west, south, east, north = bounds
        side = max(east - west, north - south)
        columns, rows = (max(1, math.ceil(pixels * length / side - 1e-9)) for length in (east - west, north - south))
        return self._read(Window(west + side / 2, north - side / 2, side), pixels, columns, rows)

    def digest(self) -> str:
        """Return a digest of names, sizes, and times of change of all files, and of their places.

        The folder is not part of the digest, so that a map may be moved.
        """
        facts: list[Any] = [self.frame.latitude, self.frame.longitude]
        for sheet in self.sheets:
            facts.append([sheet.bounds, sheet.matrix.tolist(), sheet.raster.shown])
            for file in sheet.raster.files():
                stat = file.stat()
                facts.append([file.name, stat.st_size, stat.st_mtime_ns])
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    def identity(self) -> str:
        """Return a digest of the sheets' places, names, and sizes; a copy of the map has the same one."""
        facts: list[Any] = [self.frame.latitude, self.frame.longitude]
        for sheet in self.sheets:
            raster, bounds = sheet.raster, np.round(sheet.bounds, 2).tolist()
            facts.append([sheet.name, raster.width, raster.height, raster.path.stat().st_size, bounds])
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]

    def close(self) -> None:
        """Close the files of all sheets."""
        for sheet in self.sheets:
            sheet.raster.close()

    def _check_pixels(self) -> None:
        """Raise DataError if there are too few pixels for a map; some sheets of it may be narrow strips."""
        rasters = [sheet.raster for sheet in self.sheets]
        columns, rows = max(((raster.width, raster.height) for raster in rasters), key=min)
        if len(rasters) > 1 and min(columns, rows) < _MIN_SIDE:
            west, south, east, north = self.bounds
            columns, rows = (round(length / self.resolution) for length in (east - west, north - south))
        if min(columns, rows) < _MIN_SIDE:
            raise DataError(
                f"The map {printable(self.name)} has {columns} x {rows} pixels; expected at least {_MIN_SIDE} on each side, so "
                "give the map itself, not a preview or a strip of it."
            )

    @property
    def _side(self) -> float:
        return max(self.bounds[2] - self.bounds[0], self.bounds[3] - self.bounds[1])

    def _read(self, window: Window, pixels: int, columns: int, rows: int) -> tuple[UInt8Array, BoolArray]:
        """Cut the first columns and rows of a window's picture, block by block."""
        picture, valid = np.zeros((rows, columns, 3), np.uint8), np.zeros((rows, columns), bool)
        for top in range(0, rows, _BLOCK):
            for left in range(0, columns, _BLOCK):
                block = left, top, min(_BLOCK, columns - left), min(_BLOCK, rows - top)
                place = np.s_[top : top + block[3], left : left + block[2]]
                self._fill(window, pixels, block, picture[place], valid[place])
        return picture, valid

    def _fill(
        self, window: Window, pixels: int, block: tuple[int, int, int, int], picture: UInt8Array, valid: BoolArray
    ) -> None:
        """Write a block of a window's picture, (rows, columns, 3), and of its mask, from the finest sheet to the coarsest."""
        corners = window.to_ground(corner_pixels(*block[2:]) + block[:2], pixels)
        low, high = corners.min(0), corners.max(0)
        near = (self._boxes[:, :2] <= high).all(1) & (self._boxes[:, 2:] >= low).all(1)
        for number in np.flatnonzero(near).tolist():
            if (cut := self.sheets[number].read(window, pixels, block)) is not None:
                new = cut[1] & ~valid
                picture[new] = cut[0][new]
                valid |= new
            if valid.all():
                return


def _frame_of(sheets: Sequence[Sheet]) -> LocalFrame:
    degrees = np.radians(np.concatenate([sheet.outline for sheet in sheets]))
    latitude, longitude = degrees.T
    middle = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    ).mean(axis=1)
    rough = LocalFrame(
        float(np.degrees(np.arctan2(middle[2], np.hypot(*middle[:2])))),
        float(np.degrees(np.arctan2(middle[1], middle[0]))),
    )
    xy = rough.xy(*np.degrees(degrees).T)
    if not np.isfinite(xy).all() or np.ptp(xy, axis=0).max() > _MAX_WIDTH:
        wide = np.degrees(np.ptp(degrees, axis=0))
        raise DataError(
            f"The map spans {wide[0]:.3g} degrees of latitude and {wide[1]:.3g} of longitude; expected at most "
            f"{_MAX_WIDTH / 1000:.0f} km, so cut out the part that is flown over, or open the sheets one by one."
        )
    latitude, longitude = rough.degrees([(xy.min(0) + xy.max(0)) / 2])[0].round(6).tolist()
    return LocalFrame(latitude, longitude)


def _at(sums: Float64Array, rows: Float64Array, columns: Float64Array) -> Float64Array:
    """Interpolate a summed-area table, (R, C), at fractional rows and columns, (N,) each, clamped to it."""
    r, c = np.clip(rows, 0, len(sums) - 1), np.clip(columns, 0, sums.shape[1] - 1)
    r0, c0 = np.minimum(r.astype(int), len(sums) - 2), np.minimum(c.astype(int), sums.shape[1] - 2)
    dr, dc = r - r0, c - c0
    upper = sums[r0, c0] * (1 - dc) + sums[r0, c0 + 1] * dc
    lower = sums[r0 + 1, c0] * (1 - dc) + sums[r0 + 1, c0 + 1] * dc
    return np.asarray(upper * (1 - dr) + lower * dr)
