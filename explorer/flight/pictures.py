"""The pictures of a flight, which the page loads by their addresses: tiles and cuts of its map, and photos."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import cast

import cv2
import numpy as np

from explorer.compute.cache import SingleFlightCache
from explorer.feeds import Feeds
from explorer.server.picture_route import EncodedPicture
from lpn.core import images
from lpn.core.arrays import BoolArray, Float32Array, UInt8Array
from lpn.core.errors import DataError
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import Map, Window
from lpn.flight.maps.map import OVERVIEW

TILE = 256
# Tiles and photos in the cache, some 20 KB and 150 KB each.
_TILES, _PHOTOS = 1000, 40
# Longer side of a photo, and side of the pictures that compare a photo with the map, in pixels.
LAID, _PAIR = 1280, 220
_QUALITY = 82
# Maximum of levels: the number of a tile in its level has seven digits at most.
_MOST_LEVELS = 11
# The finest level whose tiles are cut from the map's overview. Otherwise each coarse tile would read most pixels of a map.
_COARSE = int(math.log2(OVERVIEW / TILE))


@dataclass(frozen=True)
class TilePyramid:
    """The levels of tiles of a map; level z divides a square into 2^z by 2^z tiles.

    Attributes:
        west, north: corner of the square in metres of the map's frame.
        side: side of the square in metres.
        levels: the finest level. Unless limited, its pixels are as large as the map's, or more than half as large.
    """

    west: float
    north: float
    side: float
    levels: int

    @classmethod
    def of(cls, basemap: Map) -> TilePyramid:
        """Lay a pyramid over a map from its north-west corner on."""
        west, south, east, north = basemap.bounds
        side = max(east - west, north - south)
        levels = math.ceil(math.log2(side / (TILE * basemap.resolution)))
        return cls(west, north, side, min(max(0, levels), _MOST_LEVELS))

    def window(self, level: int, column: int, row: int) -> Window:
        """Return the window of a tile."""
        size = self.side / (1 << level)
        return Window(self.west + (column + 0.5) * size, self.north - (row + 0.5) * size, size)


class FlightPicturesFeed:
    """The pictures of a flight at addresses of the feeds, encoded once for all tabs; thread-safe.

    Attributes:
        addresses: folders relative to the page. "tiles" of each level are numbered by row * 2^level + column; "photo",
            its middle "square", and the map at its answer, "ground", by the frame's number.

    Args:
        flight: returns the newest state of the flight.
    """

    def __init__(self, feeds: Feeds, flight: Callable[[], LocatedFlight]) -> None:
        self._flight = flight
        self._tiles: SingleFlightCache[tuple[int, int], EncodedPicture] = SingleFlightCache(_TILES)
        self._photos: SingleFlightCache[tuple[str, int], EncodedPicture] = SingleFlightCache(_PHOTOS)
        self._pyramid = TilePyramid.of(flight().basemap)

        def publish(name: str, piece: Callable[[int], EncodedPicture | None]) -> str:
            return feeds.address + feeds.publish(self, name, piece)

        levels = range(self._pyramid.levels + 1)
        self.addresses = {
            "tiles": [publish(f"tiles {level}", partial(self._tile, level)) for level in levels],
            "photo": publish("photo", partial(self._frame, "photo", _photo)),
            "square": publish("square", partial(self._frame, "square", _square)),
            "ground": publish("ground", self._ground),
        }

    def _tile(self, level: int, number: int) -> EncodedPicture | None:
        row, column = divmod(number, 1 << level)
        if row >= 1 << level:
            return None
        basemap = self._flight().basemap
        return self._tiles.get((level, number), lambda: encoded(*tile(basemap, self._pyramid, level, column, row)))

    def _frame(self, kind: str, make: Callable[[LocatedFrame], EncodedPicture], frame: int) -> EncodedPicture | None:
        frames = self._flight().frames
        return None if frame >= len(frames) else self._photos.get((kind, frame), lambda: make(frames[frame]))

    def _ground(self, frame: int) -> EncodedPicture | None:
        flight = self._flight()
        return None if frame >= len(flight.frames) else ground(flight.basemap, flight.frames[frame])


def tile(basemap: Map, pyramid: TilePyramid, level: int, column: int, row: int) -> tuple[UInt8Array, BoolArray]:
    """Return a tile of a map's pyramid, RGB (TILE, TILE, 3), and which pixels are valid, (TILE, TILE)."""
    window = pyramid.window(level, column, row)
    if level > _COARSE or pyramid.levels <= _COARSE:
        return basemap.read(window, TILE)
    try:
        overview = basemap.overview(OVERVIEW)
    except DataError:  # a damaged part of the map must not hide the others
        return basemap.read(window, TILE)
    step = OVERVIEW >> level
    part = np.s_[row * step : (row + 1) * step, column * step : (column + 1) * step]
    picture, valid = (array[part] for array in overview)
    # The overview ends at the map's border.
    missing = ((0, step - valid.shape[0]), (0, step - valid.shape[1]))
    shares = _reduced(np.pad(valid, missing).astype(np.float32))
    sums = _reduced(np.pad(picture, (*missing, (0, 0))).astype(np.float32))
    mean = sums / np.maximum(shares, 1e-6)[..., None]  # invalid pixels are 0
    return np.clip(mean.round(), 0, 255).astype(np.uint8), shares >= 0.5


def _reduced(array: Float32Array) -> Float32Array:
    return cast(Float32Array, cv2.resize(array, (TILE, TILE), interpolation=cv2.INTER_AREA))


def encoded(picture: UInt8Array, valid: BoolArray | None = None) -> EncodedPicture:
    """Encode a picture, (H, W, 3), as JPEG, or as transparent WebP if some pixels are not `valid`, (H, W)."""
    if valid is None or valid.all():
        return EncodedPicture(images.jpeg(picture, _QUALITY), "image/jpeg")
    layers = np.dstack([picture[..., ::-1], np.where(valid, 255, 0).astype(np.uint8)])
    data = cv2.imencode(".webp", layers, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return EncodedPicture(data.tobytes(), "image/webp")


def ground_window(located: LocatedFrame, stage: str | None) -> Window | None:
    """Return the square of the map that a stage's answer assigns to a frame's middle, turned like the frame; None without one.

    For stages other than the registration, it has the size and the turn of the best window.
    """
    frame, answer = located.frame, located.stages.get(stage or "")
    if answer is None or answer.x is None or answer.y is None:
        return None
    if stage == "registration" and answer.homography is not None and answer.width is not None:
        x, y = located.middle(answer).tolist()
        return Window(x, y, answer.width * min(1.0, frame.height / frame.width), answer.heading or 0.0)
    if not located.windows:
        return None
    return Window(answer.x, answer.y, located.windows[0].size, located.windows[0].heading)


def _photo(located: LocatedFrame) -> EncodedPicture:
    frame = located.frame
    return encoded(frame.undistorted(images.shrink(images.load_picture(frame.file), LAID)))


def _square(located: LocatedFrame) -> EncodedPicture:
    return encoded(middle_square(located.frame.undistorted(images.load_picture(located.frame.file))))


def middle_square(picture: UInt8Array) -> UInt8Array:
    """Return the largest square in the middle of a picture, (H, W, 3), at the size of the comparison with the map."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return images.resize(picture[top : top + side, left : left + side], _PAIR, _PAIR)


def ground(basemap: Map, located: LocatedFrame) -> EncodedPicture:
    """Return the map at a frame's answer; one transparent pixel without an answer."""
    window = ground_window(located, judge(located).stage)
    if window is None:
        return encoded(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), bool))
    return encoded(*basemap.read(window, _PAIR))
