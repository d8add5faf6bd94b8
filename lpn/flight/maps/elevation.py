"""The elevation model of a map: a raster of heights in metres at its own resolution, sampled bilinearly."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import printable
from lpn.core.texts import counted
from lpn.flight.maps import _gdal
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.sheet import Bounds, cells_of

HeightUnit = Literal["metre", "foot", "us-foot"]
# Metres of each unit.
UNITS: dict[HeightUnit, float] = {"metre": 1.0, "foot": 0.3048, "us-foot": 1200 / 3937}
# Spellings of units in files, in lower case without blanks, hyphens, and underscores.
_SPELLINGS: dict[str, HeightUnit] = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), "metre"),
    **dict.fromkeys(("ft", "foot", "feet", "internationalfoot", "internationalfeet"), "foot"),
    **dict.fromkeys(("usft", "ftus", "ussurveyfoot", "ussurveyfeet", "footus", "surveyfoot", "surveyfeet"), "us-foot"),
}
# The range of heights in metres of the earth's surface and of everything on it.
_LOWEST, _HIGHEST = -500.0, 9000.0
# Least share of a map that its elevation must cover, and the share below which a note tells how much is missing.
_LEAST, _WHOLE = 0.5, 0.98
# Points along a side at which coverage is tested, and pixels along a side that are read to test heights.
_PROBES, _LOOK = 64, 512
# Maximum of pixels that are read at once: 64 MB.
_MOST_PIXELS = 1 << 24


class Elevation:
    """Heights in metres in the folder of a map.

    Args:
        path: the file that `write_elevation` wrote.
        name: of the user's file.
        notes: sentences about how it is read.

    Raises:
        DataError: if it cannot be read.
    """

    def __init__(self, path: Path, name: str, notes: list[str]) -> None:
        self.path, self.name, self.notes = path, name, notes
        with _gdal.opened(path) as file:
            self._crs, self._matrix = file.crs, np.array(file.transform[:6]).reshape(2, 3)
            self._size = np.array([file.width, file.height])

    def heights(self, frame: LocalFrame, xy: Float64Array) -> Float64Array:
        """Return heights in metres above the model's datum, (N,), at metres east and north in a frame, (N, 2).

        Heights are interpolated between the four nearest pixels, and NaN where one of these is unknown.

        Raises:
            DataError: if the file is damaged.
        """
        cells = cells_of(self._crs, self._matrix, self._size[0], frame, xy) - 0.5
        values = np.full(len(cells), np.nan)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((cells >= 0) & (cells <= self._size - 1)).all(axis=1))
        if not inside.any():
            return values
        low = np.floor(cells[inside].min(0)).astype(int)
        columns, rows = np.minimum(np.floor(cells[inside].max(0)).astype(int) + 2, self._size) - low
        # Points that spread over too many pixels are sampled from a reduced picture.
        by = max(1.0, math.sqrt(columns * rows / _MOST_PIXELS))
        shape = max(1, round(rows / by)), max(1, round(columns / by))
        with _gdal.opened(self.path) as file:
            box = _gdal.rasterio().windows.Window(*low.tolist(), int(columns), int(rows))
            heights = file.read(1, window=box, out_shape=shape).astype(np.float64)
        scale = np.array([shape[1] / columns, shape[0] / rows])
        c, r = np.clip((cells[inside] - low + 0.5) * scale - 0.5, 0, np.array(shape)[::-1] - 1).T
        left, top = np.floor(c).astype(int), np.floor(r).astype(int)
        right, bottom = np.minimum(left + 1, shape[1] - 1), np.minimum(top + 1, shape[0] - 1)
        a, b = c - left, r - top
        weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
        near = heights[[top, bottom, top, bottom], [left, left, right, right]]
        # An unknown neighbour of weight 0 must not make the value unknown.
        values[inside] = np.where(weights > 0, near * weights, 0.0).sum(axis=0)
        return values

    def digest(self) -> list[str | int]:
        """Return the file's name, size, and time of change, which change with the heights."""
        stat = self.path.stat()
        return [self.path.name, stat.st_size, stat.st_mtime_ns]


class ElevationFile:
    """A user's file of heights, checked as far as possible without the map.

    Args:
        path: a raster of one band that GDAL reads, with its coordinate reference system.
        unit: of its heights; None takes the unit that the file names.

    Raises:
        DataError: if it cannot be read, holds no heights, has no CRS, or its unit is unknown or implausible.
        InputError: if the unit is none of `UNITS`.
    """

    def __init__(self, path: Path, unit: HeightUnit | None = None) -> None:
        self.path, self.name = path, printable(str(path))
        self.notes: list[str] = []
        if unit is not None and unit not in UNITS:
            raise InputError(f"The unit of heights is {printable(unit)!r}; expected {', '.join(UNITS)}.")
        with _gdal.opened(path) as file:
            self._check(file)
            _gdal.check_work(file, path)
            self.crs, self.matrix = file.crs, np.array(file.transform[:6]).reshape(2, 3)
            self.width, self.height = int(file.width), int(file.height)
            self.metres = UNITS[self._unit(file, unit)]
            self._scale = float(file.scales[0]), float(file.offsets[0])
            columns, rows = min(_LOOK, self.width), min(_LOOK, self.height)
            heights = self.cut(file, (0, 0, self.width, self.height), (columns, rows))
        if not np.isfinite(heights).any():
            raise DataError(f"The elevation {self.name} has no valid height; expected heights of the map's ground.")
        low, high = np.nanmin(heights), np.nanmax(heights)
        if low < _LOWEST or high > _HIGHEST:
            raise DataError(
                f"The elevation {self.name} has heights from {low:.0f} to {high:.0f} m, and the earth's surface has "
                f"{_LOWEST:.0f} to {_HIGHEST:.0f}; check their unit (--elevation-unit), and the value for unknown ones."
            )

    def cut(self, file: Any, box: tuple[int, int, int, int], size: tuple[int, int] | None = None) -> Float32Array:
        """Read a rectangle (first column and row, columns and rows) as metres, NaN where unknown."""
        columns, rows = size or box[2:]
        window = _gdal.rasterio().windows.Window(*box)
        values = file.read(1, window=window, out_shape=(rows, columns), masked=True).astype(np.float64)
        metres = (values * self._scale[0] + self._scale[1]) * self.metres
        return np.asarray(metres.filled(np.nan), np.float32)

    def box(self, frame: LocalFrame, bounds: Bounds) -> tuple[int, int, int, int]:
        """Return the rectangle of pixels that holds a map's bounds."""
        cells = cells_of(self.crs, self.matrix, self.width, frame, _grid(bounds, np.linspace(0, 1, 9)))
        known = cells[np.isfinite(cells).all(axis=1)]
        if len(known):
            low, high = np.floor(known.min(0)) - 2, np.ceil(known.max(0)) + 2
            left, top = (max(0, int(value)) for value in low)
            right, bottom = min(self.width, int(high[0])), min(self.height, int(high[1]))
            if left < right and top < bottom:
                return left, top, right - left, bottom - top
        raise DataError(
            f"The elevation {self.name} covers none of the map, which lies about {frame.latitude:.5f}, "
            f"{frame.longitude:.5f}; give the elevation of this place."
        )

    def _check(self, file: Any) -> None:
        found = None
        if file.count != 1 or file.dtypes[0] == "uint8" or np.dtype(file.dtypes[0]).kind == "c":
            found = f"{counted(file.count, 'band')} of the type {file.dtypes[0]}, as a picture has"
        elif file.crs is None:
            found = "no coordinate reference system"
        elif file.transform.is_identity or not file.transform.determinant:
            found = "no georeference"
        if found is not None:
            raise DataError(
                f"The elevation {self.name} has {found}; expected one band of heights with its place, such as a surface or "
                "terrain model as GeoTIFF."
            )

    def _unit(self, file: Any, given: HeightUnit | None) -> HeightUnit:
        stated = _SPELLINGS.get(re.sub(r"[\s_\-.]", "", (file.units[0] or "").lower())) or _vertical_unit(file.crs)
        if unit := given or stated:
            return unit
        found = f"heights in {printable(file.units[0])[:40]!r}" if file.units[0] else ""
        if not found and file.crs.is_projected and abs(file.crs.linear_units_factor[1] - 1) > 1e-6:
            found = f"coordinates in {printable(file.crs.linear_units_factor[0])}"
        if found:
            raise DataError(
                f"The elevation {self.name} has {found}, which does not tell the unit of its heights; give --elevation-unit as "
                f"{', '.join(UNITS)}."
            )
        self.notes.append(f"{self.path.name} does not say its unit of heights; metres are assumed (--elevation-unit).")
        return "metre"


def write_elevation(
    source: ElevationFile, out: Path, frame: LocalFrame, bounds: Bounds, places: Float64Array
) -> Elevation:
    """Write the heights of a map's ground in metres, at the source's resolution and in its CRS, and open the file.

    Args:
        out: the file, a tiled GeoTIFF.
        bounds: of the map in metres of the frame.
        places: where the map shows ground, (N, 2) metres.

    Raises:
        DataError: if fewer than half of these places have a height.
        OutputError: if the file cannot be written.
    """
    box = source.box(frame, bounds)
    library = _gdal.rasterio()
    corner = source.matrix @ (*box[:2], 1)
    transform = library.Affine(*np.column_stack([source.matrix[:, :2], corner]).ravel())
    undeclared = 0
    try:
        with (
            _gdal.opened(source.path) as file,
            library.open(
                out, "w", driver="GTiff", width=box[2], height=box[3], count=1, dtype="float32", nodata=math.nan,
                crs=source.crs, transform=transform, tiled=True, compress="deflate", predictor=3, BIGTIFF="IF_SAFER",
            ) as written,
        ):  # fmt: skip
            for _, block in written.block_windows(1):
                rectangle = box[0] + block.col_off, box[1] + block.row_off, block.width, block.height
                heights = source.cut(file, rectangle)
                # The file may mark unknown heights by an undeclared value, on so few pixels that the check above saw none.
                impossible = (heights < _LOWEST) | (heights > _HIGHEST)
                undeclared += int(np.count_nonzero(impossible))
                heights[impossible] = np.nan
                written.write(heights, 1, window=block)
            written.units = ("metre",)
    except _gdal.failures(OSError) as error:
        raise OutputError(
            f"{printable(str(out))} cannot be written ({printable(str(error))[:200]}); free space, or check "
            f"{printable(source.path.name)}."
        ) from error
    share = float(np.isfinite(Elevation(out, source.name, []).heights(frame, places)).mean())
    if share < _LEAST:
        raise DataError(
            f"The elevation {source.name} covers {share:.0%} of the map; expected {_LEAST:.0%} at least, so give the elevation "
            "of this place."
        )
    notes = list(source.notes)
    if undeclared:
        notes.append(
            f"{undeclared} heights of {source.path.name} lie outside {_LOWEST:.0f} to {_HIGHEST:.0f} m, and count as unknown."
        )
    if share < _WHOLE:
        notes.append(f"{source.path.name} covers {share:.0%} of the map; matches on the rest have no height.")
    return Elevation(out, source.path.name, notes)


def _vertical_unit(crs: Any) -> HeightUnit | None:
    """Return the unit of a compound CRS's heights; None if it has none, or an unknown one."""
    vertical = crs.to_wkt().partition("VERT_CS[")[2]
    if not (unit := re.search(r'UNIT\["[^"]*",([0-9.eE+-]+)', vertical)):
        return None
    return next((name for name, size in UNITS.items() if abs(size - float(unit[1])) < 1e-8), None)


def probes(bounds: Bounds) -> Float64Array:
    """Return points on a grid over bounds, (N, 2) metres, at which an elevation's coverage is tested."""
    return _grid(bounds, (np.arange(_PROBES) + 0.5) / _PROBES)


def _grid(bounds: Bounds, shares: Float64Array) -> Float64Array:
    """Return points, (N, 2), at shares of the width and the height of bounds."""
    west, south, east, north = bounds
    grid = np.meshgrid(west + shares * (east - west), south + shares * (north - south))
    return np.stack(grid, axis=-1).reshape(-1, 2)
