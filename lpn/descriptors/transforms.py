"""Transforms of a query before it is described, to test the robustness of its retrieval: weather, rotation, zoom, shift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.datasets import Picture
from lpn.descriptors.weather import CLEAR, Weather

MAX_SCALE = 16.0


@dataclass(frozen=True)
class Change:
    """A transform of query pictures; the default is the identity.

    Attributes:
        rotate: degrees counter-clockwise about the centre on the picture's canvas, corners black (Table IV).
        shift: pixels of the network's input to the right, with black at the left, as in the released test by padding and
            cropping; negative: to the left.
        scale: zoom factor about the centre on the picture's canvas; above 1 crops, below 1 adds a black border.
        down: pixels of the network's input downwards; negative: upwards.
        around: whether the picture is a panorama, rotated by rolling its columns: counter-clockwise is to the left.
        zoom: the picture's own zoom, by which `scale` is multiplied; see `Picture.zoom`.
        released: whether to read and rotate like the released test: without the EXIF orientation, and to the nearest pixel.
        weather: drawn on the picture first.

    Raises:
        InputError: if a number is not finite, a shift is not whole, or the scale is outside 1/16 .. 16.
    """

    rotate: float = 0.0
    shift: int = 0
    scale: float = 1.0
    down: int = 0
    around: bool = False
    zoom: float = 1.0
    released: bool = False
    weather: Weather = CLEAR

    def __post_init__(self) -> None:
        if not np.isfinite(self.rotate):
            raise InputError(f"The rotation is {self.rotate}; expected degrees.")
        for pixels in (self.shift, self.down):
            if not np.isfinite(pixels) or pixels != int(pixels):
                raise InputError(f"The shift is {pixels}; expected a whole number of pixels.")
        if not 1 / MAX_SCALE <= self.scale <= MAX_SCALE:
            raise InputError(f"The scale is {self.scale:g}; expected a factor from 1/{MAX_SCALE:g} to {MAX_SCALE:g}.")
        # Normalise, so that equal transforms compare equal.
        for name, number in (("rotate", float), ("shift", int), ("scale", float), ("down", int)):
            object.__setattr__(self, name, number(getattr(self, name)))
        object.__setattr__(self, "around", bool(self.around and self.rotate % 360))

    def __bool__(self) -> bool:
        """Return whether this is not the identity."""
        moved = self.rotate or self.shift or self.scale * self.zoom != 1 or self.down
        return bool(moved or self.released or self.weather)

    def apply(self, picture: UInt8Array) -> UInt8Array:
        """Draw the weather, rotate, and zoom: (H, W, 3) uint8 to the same shape, or smaller (`Weather.apply`, `images.zoom`)."""
        turn = images.roll if self.around else images.rotate_nearest if self.released else images.rotate
        return images.zoom(turn(self.weather.apply(picture), self.rotate), self.scale * self.zoom)

    def for_picture(self, picture: Picture, zoom: float | None = None) -> Change:
        """Return this transform for a picture, which may be a panorama; `zoom` replaces the picture's zoom."""
        return replace(self, around=picture.panorama, zoom=picture.zoom if zoom is None else zoom)

    def move(self, shaped: UInt8Array) -> UInt8Array:
        """Shift a picture of the network's input size: (height, width, 3) uint8 to the same shape; see `check`."""
        height, width = shaped.shape[:2]
        self.check((height, width))
        return images.shift(shaped, self.shift, self.down)

    def show(self, applied: UInt8Array, size: tuple[int, int]) -> UInt8Array:
        """Shift a picture of any resolution as far in proportion as `move` does at the network's (height, width)."""
        height, width = applied.shape[:2]
        return images.shift(applied, round(self.shift * width / size[1]), round(self.down * height / size[0]))

    def check(self, size: tuple[int, int]) -> None:
        """Raise InputError if the shift moves everything out of a network input (height, width)."""
        for pixels, side, dimension in ((self.down, size[0], "high"), (self.shift, size[1], "wide")):
            if abs(pixels) >= side:
                raise InputError(
                    f"The shift is {pixels} pixels; the network's input is {side} {dimension}, so shift by fewer than that."
                )

    def describe(self) -> str:
        """Describe the transform in words, such as "in fog, turned 30°, scaled by 1.2"; empty for the identity."""
        how = " (columns moved around)" if self.around else " (nearest pixel)" if self.released else ""
        words = [self.weather.describe()] if self.weather else []
        words += [f"turned {self.rotate:g}°{how}"] if self.rotate else []
        words += [f"scaled by {self.scale:g}"] if self.scale != 1 else []
        words += [f"shifted {abs(self.shift)} px to the {'right' if self.shift > 0 else 'left'}"] if self.shift else []
        words += [f"shifted {abs(self.down)} px {'down' if self.down > 0 else 'up'}"] if self.down else []
        return ", ".join(words)


UNCHANGED = Change()
