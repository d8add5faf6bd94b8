"""Windows of a map named by their places, so that each can be cut again from its name and the map.

48.0042137,9.0133251,70m            centre in WGS 84 degrees (7 decimals are 1 cm), side in metres, north up
48.0042137,9.0133251,70m,30deg      heading of the picture's top, where it is not north
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from lpn.core.arrays import UInt8Array
from lpn.core.errors import DataError, PictureError
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map
from lpn.flight.maps.window import Window

_NAME = re.compile(r"(-?\d{1,2}\.\d{7}),(-?\d{1,3}\.\d{7}),(\d{1,6}(?:\.\d{1,2})?)m(?:,(\d{1,3}(?:\.\d{1,2})?)deg)?")


@dataclass(frozen=True)
class NamedWindow:
    """A window of a map, in degrees.

    Attributes:
        latitude, longitude: of its centre, WGS 84 degrees.
        size: its side in metres.
        heading: direction of its picture's top, degrees clockwise from north, 0 to below 360.
    """

    latitude: float
    longitude: float
    size: float
    heading: float = 0.0

    @property
    def name(self) -> str:
        """The window's name, which `parse` reads."""
        turned = f",{_short(self.heading)}deg" if self.heading else ""
        return f"{self.latitude:.7f},{self.longitude:.7f},{_short(self.size)}m{turned}"

    @classmethod
    def parse(cls, name: str) -> Self | None:
        """Return the window of a name; None if it is not the name of a window."""
        match = _NAME.fullmatch(name)
        if match is None:
            return None
        named = cls(float(match[1]), float(match[2]), float(match[3]), float(match[4] or 0.0))
        valid = abs(named.latitude) <= 90 and abs(named.longitude) <= 180 and named.size > 0 and named.heading < 360
        return named if valid else None

    @classmethod
    def all_of(cls, windows: Sequence[Window], frame: LocalFrame) -> list[Self]:
        """Name windows of a map's frame: centres are rounded to 1e-7 degrees, sides to 1 cm, headings to 0.01 degrees."""
        places = frame.degrees([(window.x, window.y) for window in windows]).round(7).tolist()
        return [
            cls(latitude, longitude, round(window.size, 2), round(window.heading, 2) % 360)
            for (latitude, longitude), window in zip(places, windows, strict=True)
        ]

    @staticmethod
    def all_on(windows: Sequence[NamedWindow], frame: LocalFrame) -> list[Window]:
        """Return windows in metres of a map's frame."""
        places = frame.xy([one.latitude for one in windows], [one.longitude for one in windows]).tolist()
        return [Window(x, y, one.size, one.heading) for (x, y), one in zip(places, windows, strict=True)]


@dataclass(frozen=True)
class WindowCut:
    """Cuts a window's picture from a map.

    Attributes:
        pixels: side of the picture.
    """

    basemap: Map
    window: Window
    pixels: int

    def __call__(self) -> UInt8Array:
        """Return the picture, (pixels, pixels, 3) RGB; PictureError if the map's file is damaged there."""
        try:
            return self.basemap.read(self.window, self.pixels)[0]
        except DataError as error:
            raise PictureError(str(error)) from error


def describe_offset(x: float, y: float) -> str:
    """Describe a point of a map, x and y in metres, as "46 m west and 3 m north of the map's middle"."""
    east, north = round(x), round(y)
    sides = [
        f"{abs(metres):,} m {names[metres > 0]}"
        for metres, names in ((east, ("west", "east")), (north, ("south", "north")))
        if metres
    ]
    return f"{' and '.join(sides)} of the map's middle" if sides else "in the map's middle"


def describe_place(window: Window, with_size: bool = True) -> str:
    """Describe a window by the metres from the map's origin to its centre, and its side."""
    east, north = round(window.x), round(window.y)
    place = f"{abs(east)} {'W' if east < 0 else 'E'} {abs(north)} {'S' if north < 0 else 'N'}"
    return f"{place} ({window.size:.0f} m)" if with_size else place


def caption_of(window: Window) -> str:
    """Describe a window by the way from the map's middle to its centre, as "46 m W, 0 m N, 37 m wide"."""
    east, north = round(window.x), round(window.y)
    return f"{abs(east):,} m {'W' if east < 0 else 'E'}, {abs(north):,} m {'S' if north < 0 else 'N'}, {window.size:.0f} m wide"


def covers_part_of(basemap: Map, window: Window) -> bool:
    """Return whether a window lies at least partly within a map's bounds."""
    west, south, east, north = basemap.bounds
    turned = math.radians(window.heading)
    reach = window.size / 2 * (abs(math.cos(turned)) + abs(math.sin(turned)))
    return west - reach < window.x < east + reach and south - reach < window.y < north + reach


def _short(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
