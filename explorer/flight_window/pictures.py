"""The pictures of a flight over its map, which the page loads by their addresses: tiles, photos, and cuts of the map."""

from __future__ import annotations

import math
import re
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import cv2
import numpy as np

from explorer.compute.cache import SingleFlightCache
from explorer.server.picture_route import PREFIX, EncodedPicture
from lpn.core import images
from lpn.core.arrays import BoolArray, Float32Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.homography import apply_homography, middle_pixel
from lpn.locate.belief import belief
from lpn.locate.located import LocatedFlight, LocatedFrame
from lpn.maps import Map, Window
from lpn.maps.map import OVERVIEW

TILE = 256
# Tiles and photos in the cache, some 20 KB and 150 KB each.
_TILES, _PHOTOS = 1000, 40
# Longer side of a photo, and side of the pictures that compare a photo with the map, in pixels.
_PHOTO, _PAIR = 1280, 220
_QUALITY = 82
# The finest level whose tiles are cut from the map's overview, which `Map.coverage` has often read already. Without it, each
# coarse tile would read most pixels of a map.
_COARSE = int(math.log2(OVERVIEW / TILE))
_TILE_PATH = re.compile(r"tile/(\d{1,2})/(\d{1,7})/(\d{1,7})", re.ASCII)
_FRAME_PATH = re.compile(r"(photo|pair|ground)/(\d{1,7})", re.ASCII)


@dataclass(frozen=True)
class Pyramid:
    """The levels of tiles of a map; level z divides a square into 2^z by 2^z tiles.

    Attributes:
        west, north: corner of the square in metres of the map's frame.
        side: of the square in metres.
        levels: the finest level has the map's own resolution or less than twice it.
    """

    west: float
    north: float
    side: float
    levels: int

    @classmethod
    def of(cls, basemap: Map) -> Pyramid:
        """Lay a pyramid over a map from its north-west corner on."""
        west, south, east, north = basemap.bounds
        side = max(east - west, north - south)
        levels = max(0, math.ceil(math.log2(side / (TILE * basemap.resolution))))
        return cls(west, north, side, levels)

    def window(self, level: int, column: int, row: int) -> Window | None:
        """Return the window of a tile, None if there is no such tile."""
        if not (0 <= level <= self.levels and 0 <= column < 1 << level and 0 <= row < 1 << level):
            return None
        size = self.side / (1 << level)
        return Window(self.west + (column + 0.5) * size, self.north - (row + 0.5) * size, size)


class HasFlight(Protocol):
    """A holder of a located flight, which may be replaced while it is shown, such as a workspace."""

    flight: LocatedFlight | None


class FlightPictures:
    """The pictures of a flight, encoded once for all browsers; thread-safe.

    Attributes:
        address: folder of the pictures, relative to the page; it is another one each time that the app starts.
    """

    def __init__(self, flown: HasFlight) -> None:
        self._flown, self._name = flown, secrets.token_hex(4)
        self.address = f"{PREFIX.lstrip('/')}{self._name}/"
        self._tiles: SingleFlightCache[tuple[int, ...], EncodedPicture] = SingleFlightCache(_TILES)
        self._photos: SingleFlightCache[tuple[str, int], EncodedPicture] = SingleFlightCache(_PHOTOS)

    def find(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return what computes the picture of a path; None if there is no such picture. The path is untrusted."""
        flight = self._flown.flight
        name, _, rest = path.partition("/")
        if flight is None or name != self._name:
            return None
        if match := _TILE_PATH.fullmatch(rest):
            level, column, row = map(int, match.groups())
            if Pyramid.of(flight.basemap).window(level, column, row) is None:
                return None
            return lambda: self._tiles.get(
                (level, column, row), lambda: encoded(*tile(flight.basemap, level, column, row))
            )
        if (match := _FRAME_PATH.fullmatch(rest)) and (frame := int(match[2])) < len(flight.frames):
            kind, located = match[1], flight.frames[frame]
            if kind == "ground":
                return lambda: ground(flight.basemap, located)
            make = _photo if kind == "photo" else _square_photo
            return lambda: self._photos.get((kind, frame), lambda: make(located))
        return None


def tile(basemap: Map, level: int, column: int, row: int) -> tuple[UInt8Array, BoolArray]:
    """Return a tile of a map's pyramid, RGB (TILE, TILE, 3), and which pixels are valid, (TILE, TILE)."""
    pyramid = Pyramid.of(basemap)
    window = pyramid.window(level, column, row)
    assert window is not None
    if level > _COARSE or pyramid.levels <= _COARSE:
        return basemap.read(window, TILE)
    try:
        overview = basemap.overview(OVERVIEW)
    except DataError:  # a damaged part of the map must not hide the others
        return basemap.read(window, TILE)
    step = OVERVIEW >> level
    part = np.s_[row * step : (row + 1) * step, column * step : (column + 1) * step]
    picture, valid = (array[part] for array in overview)
    # The overview ends where the map does.
    missing = ((0, step - valid.shape[0]), (0, step - valid.shape[1]))
    shares = _reduced(np.pad(valid, missing).astype(np.float32))
    sums = _reduced(np.pad(picture, (*missing, (0, 0))).astype(np.float32))
    mean = sums / np.maximum(shares, 1e-6)[..., None]  # invalid pixels are 0
    return np.clip(mean.round(), 0, 255).astype(np.uint8), shares >= 0.5


def _reduced(array: Float32Array) -> Float32Array:
    return cast(Float32Array, cv2.resize(array, (TILE, TILE), interpolation=cv2.INTER_AREA))


def encoded(picture: UInt8Array, valid: BoolArray | None = None) -> EncodedPicture:
    """Return a picture, (H, W, 3), as JPEG, or as WebP with transparency where a part of it is not valid, (H, W)."""
    if valid is None or valid.all():
        return EncodedPicture(images.jpeg(picture, _QUALITY), "image/jpeg")
    layers = np.dstack([picture[..., ::-1], np.where(valid, 255, 0).astype(np.uint8)])
    data = cv2.imencode(".webp", layers, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return EncodedPicture(data.tobytes(), "image/webp")


def ground_window(located: LocatedFrame, stage: str | None) -> Window | None:
    """Return the square of the map that a frame's middle shows by a stage's answer, turned like the frame; None without one.

    For stages other than the registration it is as large as the best window, and turned like it.
    """
    frame, answer = located.frame, None if stage is None else located.stages.get(stage)
    if answer is None or answer.x is None or answer.y is None:
        return None
    if stage == "registration" and answer.homography is not None and answer.width is not None:
        middle = middle_pixel(frame.width, frame.height)
        x, y = apply_homography(np.array(answer.homography).reshape(3, 3), middle).tolist()
        share = min(frame.width, frame.height) / frame.width
        return Window(x, y, answer.width * share, answer.heading or 0.0)
    if not located.windows:
        return None
    best = located.windows[0]
    return Window(answer.x, answer.y, best.size, best.heading)


def pair(basemap: Map, located: LocatedFrame) -> tuple[EncodedPicture, EncodedPicture]:
    """Return the middle of a frame, and the map where its answer is, empty without one."""
    return _square_photo(located), ground(basemap, located)


def _photo(located: LocatedFrame) -> EncodedPicture:
    frame = located.frame
    return encoded(frame.undistorted(images.shrink(images.load_picture(frame.file), _PHOTO)))


def _square_photo(located: LocatedFrame) -> EncodedPicture:
    return encoded(middle_square(located.frame.undistorted(images.load_picture(located.frame.file))))


def middle_square(picture: UInt8Array) -> UInt8Array:
    """Return the largest square in the middle of a picture, (H, W, 3), at the size in which it is compared with the map."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return images.resize(picture[top : top + side, left : left + side], _PAIR, _PAIR)


def ground(basemap: Map, located: LocatedFrame) -> EncodedPicture:
    """Return the map where a frame's answer is, of one transparent pixel without an answer."""
    window = ground_window(located, belief(located).stage)
    if window is None:
        return encoded(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), bool))
    return encoded(*basemap.read(window, _PAIR))
