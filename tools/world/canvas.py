"""A canvas for a window of the city: polygons and lines with grain, in linear reflectance."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float32Array, Float64Array
from tools.world.architecture import Reflectance

_PERIOD = 1024


@lru_cache(maxsize=8)
def noise(scale: float) -> Float32Array:
    """Make a periodic field (1024, 1024) of mean 0 and deviation 1 with blobs about `scale` pixels wide."""
    rng = np.random.default_rng(int(scale * 97))
    frequency = np.fft.fftfreq(_PERIOD)
    squared = frequency[:, None] ** 2 + frequency[None] ** 2
    keep = np.exp(-squared * (scale * 1.8) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(_PERIOD, _PERIOD))) * keep).real
    return np.asarray(((field - field.mean()) / field.std()).astype(np.float32))


class Canvas:
    """The ground of a window of the city, painted in layers.

    Attributes:
        colour: (h, w, 3) linear reflectance, north up.
        water: (h, w) fraction of water.
    """

    def __init__(self, west: float, north: float, width: float, height: float, scale: float) -> None:
        self.west, self.north, self.scale = west, north, scale
        self.shape = (round(height / scale), round(width / scale))
        self.colour = np.zeros((*self.shape, 3), np.float32)
        self.water = np.zeros(self.shape, np.float32)

    def pixels(self, points: Float64Array) -> Float64Array:
        """Convert points (n, 2) to columns and rows."""
        return np.stack([points[:, 0] - self.west, self.north - points[:, 1]], axis=1) / self.scale

    def field(self, metres: float, rows: slice, columns: slice) -> Float32Array:
        """Return noise with blobs of that size, which is the same for one place of the city in every window."""
        pixels = metres / self.scale
        shrink = max(1, int(pixels // 24))
        y0, x0 = round(-self.north / self.scale), round(self.west / self.scale)
        at = (np.arange(rows.start, rows.stop) + y0) // shrink % _PERIOD
        along = (np.arange(columns.start, columns.stop) + x0) // shrink % _PERIOD
        values: Float32Array = noise(pixels / shrink)[np.ix_(at, along)]
        return np.asarray(cv2.blur(values, (shrink, shrink)), np.float32) if shrink > 1 else values

    def mask(
        self, points: Float64Array, grow: float, thick: int | None = None
    ) -> tuple[slice, slice, NDArray[np.uint8]] | None:
        """Return rows, columns, and the mask of a polygon, or of a line `thick` pixels wide; None outside the window.

        Args:
            grow: pixels of the mask around the points.
        """
        at = self.pixels(points)
        low = np.floor(at.min(axis=0) - grow - 2).astype(int)
        high = np.ceil(at.max(axis=0) + grow + 3).astype(int)
        x0, y0 = np.maximum(low, 0)
        x1, y1 = np.minimum(high, (self.shape[1], self.shape[0]))
        if x0 >= x1 or y0 >= y1:
            return None
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        sixteenths = [((at - (x0, y0)) * 16).astype(np.int32)]
        if thick is None:
            cv2.fillPoly(mask, sixteenths, 255, cv2.LINE_AA, 4)
        else:
            cv2.polylines(mask, sixteenths, False, 255, thick, cv2.LINE_AA, 4)
        return slice(int(y0), int(y1)), slice(int(x0), int(x1)), mask

    def fill(self, polygon: Float64Array, colour: Reflectance, grain: float = 0.1, blotch: float = 0.1, strength: float = 1.0,
             water: float = 0.0, soft: float = 0.0) -> None:  # fmt: skip
        """Fill a polygon with a colour that varies finely (`grain`) and in large blotches; `soft` metres blur its edge."""
        self._blend(self.mask(polygon, soft / self.scale * 2), colour, grain, blotch, strength, water, soft)

    def line(self, line: Float64Array, width: float, colour: Reflectance, grain: float = 0.05, strength: float = 1.0,
             blotch: float = 0.0, soft: float = 0.0) -> None:  # fmt: skip
        mask = self.mask(line, width / self.scale, max(1, round(width / self.scale)))
        strength = min(1.0, strength * width / self.scale) if width < self.scale else strength
        self._blend(mask, colour, grain, blotch, strength, 0.0, soft)

    def _blend(self, where: tuple[slice, slice, NDArray[np.uint8]] | None, colour: Reflectance, grain: float, blotch: float,
               strength: float, water: float, soft: float) -> None:  # fmt: skip
        if where is None:
            return
        rows, columns, mask = where
        weight = mask.astype(np.float32) * np.float32(strength / 255)
        if soft:
            weight = cv2.GaussianBlur(weight, (0, 0), soft / self.scale).astype(np.float32)
        value = np.ones(weight.shape, np.float32)
        if grain:
            value += grain * self.field(0.5, rows, columns)
        if blotch:
            value += blotch * (0.6 * self.field(4, rows, columns) + 0.7 * self.field(23, rows, columns))
        layer = np.clip(value, 0.3, 2.0)[..., None] * np.array(colour, np.float32)
        self.colour[rows, columns] += weight[..., None] * (layer - self.colour[rows, columns])
        self.water[rows, columns] += weight * (np.float32(water) - self.water[rows, columns])
