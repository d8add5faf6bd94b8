"""What is done to a query before it is described, to see what its retrieval withstands: turned, zoomed, shifted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.datasets import Picture as Picture

MAX_SCALE = 16.0


@dataclass(frozen=True)
class Change:
    """A change of query pictures. The default is none.

    Attributes:
        rotate: degrees counter-clockwise it is turned about its centre on its own canvas, corners black (Table IV).
        shift: pixels of the network's input it is moved to the right, black at its left, as the released test does by padding
            and cropping; a negative number moves it to the left.
        scale: zoom about its centre on its own canvas; above 1 it is magnified and cropped, below 1 it has black around it.
        down: pixels of the network's input it is moved down, likewise; a negative number moves it up.
        around: it is a panorama, which is turned by moving its columns around: turned counter-clockwise, what was in the east
            is in the north, so they move to the left.

    Raises:
        InputError: when a number is not finite, a shift not whole, or the scale outside 1/16 .. 16.
    """

    rotate: float = 0.0
    shift: int = 0
    scale: float = 1.0
    down: int = 0
    around: bool = False

    def __post_init__(self) -> None:
        if not np.isfinite(self.rotate):
            raise InputError(f"The rotation is {self.rotate}; expected degrees.")
        for pixels in (self.shift, self.down):
            if not np.isfinite(pixels) or pixels != int(pixels):
                raise InputError(f"The shift is {pixels}; expected a whole number of pixels.")
        if not 1 / MAX_SCALE <= self.scale <= MAX_SCALE:
            raise InputError(f"The scale is {self.scale:g}; expected a factor from 1/{MAX_SCALE:g} to {MAX_SCALE:g}.")
        object.__setattr__(self, "rotate", float(self.rotate))
        object.__setattr__(self, "shift", int(self.shift))
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "down", int(self.down))
        # Only what is turned is turned around, so that two ways of doing nothing are one.
        object.__setattr__(self, "around", bool(self.around and self.rotate % 360))

    def __bool__(self) -> bool:
        """Whether anything is changed."""
        return bool(self.rotate or self.shift or self.scale != 1 or self.down)

    def apply(self, picture: UInt8Array) -> UInt8Array:
        """Turn and zoom a picture at its own resolution: (H, W, 3) uint8 to the same shape."""
        turned = images.roll(picture, self.rotate) if self.around else images.rotate(picture, self.rotate)
        return images.zoom(turned, self.scale)

    def for_picture(self, picture: Picture) -> Change:
        """The same as it is done to that picture, which may be a panorama."""
        return replace(self, around=picture.panorama)

    def move(self, shaped: UInt8Array) -> UInt8Array:
        """Shift a picture that has the network's input size: (height, width, 3) uint8 to the same shape; see `check`."""
        height, width = shaped.shape[:2]
        self.check((height, width))
        return images.shift(shaped, self.shift, self.down)

    def show(self, applied: UInt8Array, size: tuple[int, int]) -> UInt8Array:
        """Shift a picture of any resolution by as much of its sides as `move` shifts one of the network's (height, width)."""
        height, width = applied.shape[:2]
        return images.shift(applied, round(self.shift * width / size[1]), round(self.down * height / size[0]))

    def check(self, size: tuple[int, int]) -> None:
        """Raise InputError when nothing of a network's input of that (height, width) would be left."""
        for pixels, side, said in ((self.down, size[0], "high"), (self.shift, size[1], "wide")):
            if abs(pixels) >= side:
                raise InputError(
                    f"The shift is {pixels} pixels; the network's input is {side} {said}, so shift by fewer than that."
                )

    def describe(self) -> str:
        """The changes in words, such as "turned 30°, scaled by 1.2"; empty without any."""
        how = " (columns moved around)" if self.around else ""
        said = [f"turned {self.rotate:g}°{how}"] if self.rotate else []
        said += [f"scaled by {self.scale:g}"] if self.scale != 1 else []
        said += [f"shifted {abs(self.shift)} px to the {'right' if self.shift > 0 else 'left'}"] if self.shift else []
        said += [f"shifted {abs(self.down)} px {'down' if self.down > 0 else 'up'}"] if self.down else []
        return ", ".join(said)


UNCHANGED = Change()
