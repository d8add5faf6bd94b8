"""A sheet of a map: a raster, its coordinate reference system, and the transform of its pixels."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import wrap_degrees
from lpn.flight.maps import _gdal
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.raster import Raster
from lpn.flight.maps.window import Window

# West, south, east, and north in metres of a frame.
Bounds = tuple[float, float, float, float]
# Points on each side of a rectangle at which the projection is computed; between them it is a polynomial of degree 4.
_NODES = 5
# Points on each side of a sheet's outline.
_OUTLINE = 21
# Metres of a pixel that a map may have.
_RESOLUTIONS = (1e-4, 1e4)
# A sheet with a metric CRS whose coordinates could be degrees is refused if it is smaller than this.
_DEGREES_AT_MOST = 10.0


class Sheet:
    """A georeferenced raster.

    Args:
        name: for messages.
        raster: its pixels.
        crs: a rasterio CRS.
        matrix: (2, 3), from column and row (0, 0 is the corner of the first pixel) to the coordinates of `crs`.

    Raises:
        DataError: if it lies outside the world or outside what its CRS covers.
    """

    def __init__(self, name: str, raster: Raster, crs: Any, matrix: Float64Array) -> None:
        self.name, self.raster, self.crs, self.matrix = name, raster, crs, matrix
        whole = np.vstack([matrix, [0, 0, 1]])
        if not (np.isfinite(matrix).all() and abs(np.linalg.det(whole)) > 0):
            raise DataError(f"{printable(name)} has the pixel size 0 in its georeference; expected one above 0.")
        self._inverse: Float64Array = np.linalg.inv(whole)[:2]
        self.outline = self._outline()

    def locate(self, frame: LocalFrame) -> None:
        """Compute bounds and resolution in a frame.

        Raises:
            DataError: if its pixels have no possible size on the ground.
        """
        self.frame = frame
        xy = frame.xy(*self.outline.T)
        if not np.isfinite(xy).all():
            raise DataError(f"{printable(self.name)} lies too far from the other sheets; open it as a map of its own.")
        (west, south), (east, north) = xy.min(0).tolist(), xy.max(0).tolist()
        self.bounds: Bounds = (west, south, east, north)
        width, height = self.raster.width, self.raster.height
        cross = self._ground(np.array([(1, 2), (3, 2), (2, 1), (2, 3)]) / 4 * (width, height))
        across, down = (cross[1] - cross[0]) / (width / 2), (cross[3] - cross[2]) / (height / 2)
        self.pixel = float(np.hypot(*across)), float(np.hypot(*down))
        self.resolution = math.sqrt(self.pixel[0] * self.pixel[1])
        if not _RESOLUTIONS[0] <= self.resolution <= _RESOLUTIONS[1]:
            raise DataError(
                f"A pixel of {printable(self.name)} would be {self.resolution:.3g} m wide on the ground; its transform does not "
                f"fit its CRS {describe(self.crs)}, so give the right one with --crs."
            )

    def read(self, window: Window, pixels: int, part: tuple[int, int, int, int]) -> tuple[UInt8Array, BoolArray] | None:
        """Cut a rectangle of the picture of a window.

        Args:
            window: in the frame of `locate`.
            pixels: side of the whole picture.
            part: first column and row, columns and rows of the rectangle.

        Returns:
            RGB (rows, columns, 3) and which pixels are valid (rows, columns); None where the sheet has none.
        """
        left, top, columns, rows = part
        metres = window.size / pixels
        # Twice the pixels where the sheet is finer, so that their mean does not alias.
        finer = 2 if metres > 1.01 * min(self.pixel) else 1
        nodes = np.cos(np.linspace(math.pi, 0, _NODES)) / 2 + 0.5
        u, v = np.meshgrid(left - 0.5 + nodes * columns, top - 0.5 + nodes * rows)
        cells = self._cells(window.to_ground(np.stack([u.ravel(), v.ravel()], axis=1), pixels))
        if not np.isfinite(cells).all():
            return None
        box = self._box(cells, metres / finer)
        if box is None:
            return None
        reduction = [max(1.0, metres / finer / side) for side in self.pixel]
        size = tuple(max(1, math.ceil(side / by)) for side, by in zip(box[2:], reduction, strict=True))
        picture, valid = self.raster.read(box, (size[0], size[1]))
        if not valid.any():
            return None
        along, down = _basis(nodes, columns * finer), _basis(nodes, rows * finer)
        grids = [
            (down @ cells[:, axis].reshape(_NODES, _NODES) @ along.T - box[axis]) * (size[axis] / box[2 + axis]) - 0.5
            for axis in (0, 1)
        ]
        return _resampled(picture, valid, grids[0].astype(np.float32), grids[1].astype(np.float32), finer)

    def _cells(self, xy: Float64Array) -> Float64Array:
        """Return column and row, (N, 2), of points of the frame, (N, 2)."""
        x, y = _gdal.transform(self.frame.crs, self.crs, xy[:, 0], xy[:, 1])
        if self.crs.is_geographic:
            # Longitudes of a sheet may pass 180 degrees.
            middle = self.matrix[0] @ (self.raster.width / 2, self.raster.height / 2, 1)
            x = middle + wrap_degrees(x - middle)
        return np.stack([x, y, np.ones(len(x))], axis=1) @ self._inverse.T

    def _ground(self, cells: Float64Array) -> Float64Array:
        """Return points of the frame, (N, 2), of columns and rows, (N, 2)."""
        return self.frame.xy(*self._degrees(cells).T)

    def _degrees(self, cells: Float64Array) -> Float64Array:
        """Return latitude and longitude, (N, 2), of columns and rows, (N, 2)."""
        xy = np.column_stack([cells, np.ones(len(cells))]) @ self.matrix.T
        longitude, latitude = _gdal.transform(self.crs, _gdal.rasterio().crs.CRS.from_epsg(4326), xy[:, 0], xy[:, 1])
        return np.stack([latitude, longitude], axis=1)

    def _outline(self) -> Float64Array:
        """Return latitude and longitude along the outline, (N, 2)."""
        side = np.linspace(0, 1, _OUTLINE)
        zero, one = np.zeros(_OUTLINE), np.ones(_OUTLINE)
        around = np.concatenate(
            [np.stack(pair, axis=1) for pair in ((side, zero), (one, side), (side, one), (zero, side))]
        )
        cells = around * (self.raster.width, self.raster.height)
        corners = np.column_stack([cells, np.ones(len(cells))]) @ self.matrix.T
        low, high = corners.min(0), corners.max(0)
        span = f"{low[0]:.9g} to {high[0]:.9g} and {low[1]:.9g} to {high[1]:.9g}"
        name, crs = printable(self.name), describe(self.crs)
        if not (self.crs.is_geographic or self.crs.is_projected):
            raise DataError(
                f"The CRS {crs} of {name} is neither in degrees nor a projection, and does not say where on earth it lies; give "
                "the right one with --crs."
            )
        if self.crs.is_geographic:
            if low[1] < -90.001 or high[1] > 90.001 or low[0] < -360 or high[0] > 360:
                raise DataError(
                    f"The coordinates of {name} ({span}) lie outside the world for its CRS {crs}, which is in degrees; give the "
                    "right one with --crs, or correct its georeference."
                )
        elif max(high - low) < _DEGREES_AT_MOST and (np.abs(corners).max(0) <= (180, 90)).all():
            raise DataError(
                f"The coordinates of {name} ({span}) look like degrees, but its CRS {crs} is not in degrees; give the right one "
                "with --crs, such as EPSG:4326."
            )
        degrees = self._degrees(cells)
        if not np.isfinite(degrees).all() or np.abs(degrees[:, 0]).max() > 90.001:
            raise DataError(
                f"The coordinates of {name} ({span}) lie outside of what its CRS {crs} covers; give the right one with "
                "--crs, or correct its georeference."
            )
        return degrees

    def _box(self, cells: Float64Array, metres: float) -> tuple[int, int, int, int] | None:
        """Return the rectangle of pixels that is read for points with these columns and rows; None if it is empty."""
        box = []
        for axis, count in enumerate((self.raster.width, self.raster.height)):
            margin = 2 * max(1.0, metres / self.pixel[axis])
            spread = np.ptp(cells[:, axis]) * 0.01  # the outline may bulge between the nodes
            first = max(0, math.floor(cells[:, axis].min() - margin - spread))
            last = min(count, math.ceil(cells[:, axis].max() + margin + spread))
            if first >= last:
                return None
            box.append((first, last - first))
        return box[0][0], box[1][0], box[0][1], box[1][1]


def describe(crs: Any) -> str:
    """Return a CRS as its EPSG code, else as its name, for messages."""
    code = crs.to_epsg()
    if code:
        return f"EPSG:{code}"
    return printable(str(crs.to_wkt()).partition('"')[2].partition('"')[0]) or "without a name"


def _basis(nodes: Float64Array, count: int) -> Float64Array:
    """Return the Lagrange polynomials of the nodes at the centres of `count` equal intervals of 0 .. 1: (count, nodes)."""
    at = (np.arange(count) + 0.5) / count
    basis = np.ones((count, len(nodes)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            basis[:, i] *= (at - other) / (node - other)
    return basis


def _resampled(
    picture: UInt8Array, valid: BoolArray, columns: Float64Array, rows: Float64Array, finer: int
) -> tuple[UInt8Array, BoolArray]:
    """Sample a picture bilinearly at columns and rows, and average `finer` by `finer` samples, invalid ones left out."""
    # A border of one invalid pixel, so that pixels beyond the raster's edge are invalid.
    share = cv2.copyMakeBorder(valid.astype(np.float32), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    shape = columns.shape[1] // finer, columns.shape[0] // finer

    def sampled(source: Any, offset: int) -> Any:
        resampled = cv2.remap(
            source, columns + offset, rows + offset, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return resampled if finer == 1 else cv2.resize(resampled, shape, interpolation=cv2.INTER_AREA)

    shares = sampled(share, 1)
    if valid.all():
        return sampled(picture, 0), shares >= 0.5
    weighted = sampled(picture.astype(np.float32) * valid[:, :, None], 0)
    inside = sampled(valid.astype(np.float32), 0)
    resampled = weighted / np.maximum(inside, 1e-6)[:, :, None]
    return np.clip(resampled.round(), 0, 255).astype(np.uint8), shares >= 0.5
