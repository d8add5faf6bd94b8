"""Offsets between a registered photo and the map: at its matched details, and at patches all over it.

Seams of a mosaic, the lens, and objects on the ground shift parts of a photo, which one homography cannot follow. Square places
of the laid photo are searched on the map by normalised cross-correlation, and each match is searched again on the photo.
"""

from __future__ import annotations

from typing import cast

import cv2
import msgspec
import numpy as np

from lpn.core import images
from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.homography import apply_homography, corner_pixels, inverse, middle_pixel
from lpn.core.texts import counted
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.registration import Registration
from lpn.flight.maps import Map, Window

# Pixels of the square around the laid photo, of a place's side, and of the search around a place.
_PHOTO, _PLACE, _REACH = 456, 56, 64
# Side in pixels of the compared square of ground, with room for the search from photo to map and back.
_SIDE = _PHOTO + 4 * _REACH
# Maximum side in metres of a photo's square on the ground.
_LARGEST = 5000.0
# Standard deviation in pixels of the blur that is subtracted: light and season differ more than edges.
_BLUR = 8.0
# A place counts if its correlation is at least _LEAST, exceeds all others more than _BESIDE pixels away by _STANDS_OUT, and the
# match back ends within _BACK pixels.
_LEAST, _STANDS_OUT, _BESIDE, _BACK = 0.55, 0.15, 5, 3.0
# Minimum share of a place that photo and map show, and its minimum contrast in grey levels.
_SHOWN, _CONTRAST = 0.98, 2.0
# Minimum number of places that are evidence on the rest of the photo.
_FEW_PLACES = 3
# Maximum of matched details in a sample, as a person cannot distinguish more; and their rows, numbered from left to right.
_SAMPLE, _ROWS = 24, 4
# From this share of the reach on, larger offsets may lie outside of the search.
_BORDER = 0.9


class PhotoPlaces(msgspec.Struct, frozen=True):
    """Places of a photo with their offsets on the map.

    Attributes:
        rows: for each place its shares of the photo's width and height, then its offset from the registration to the map in
            metres east and north.
    """

    rows: list[tuple[float, float, float, float]]

    @property
    def places(self) -> Float64Array:
        """The places as shares of the photo's width and height, (N, 2)."""
        return np.array(self.rows, np.float64).reshape(-1, 4)[:, :2]

    @property
    def offsets(self) -> Float64Array:
        """Offsets from the registration to the map, metres east and north, (N, 2)."""
        return np.array(self.rows, np.float64).reshape(-1, 4)[:, 2:]

    @property
    def metres(self) -> Float64Array:
        return cast(Float64Array, np.hypot(*self.offsets.T))


def _offset_rows(places: Float64Array, offsets: Float64Array, digits: int) -> list[tuple[float, float, float, float]]:
    """Return the rows of `PhotoPlaces` for places (N, 2) and offsets (N, 2), in metres rounded to these digits."""
    rounded = np.hstack([places.round(4), offsets.round(digits)]).tolist()
    return [(across, down, east, north) for across, down, east, north in rounded]


class MatchedDetails(PhotoPlaces, frozen=True):
    """The matches of a photo that agree with its registration, and a sample spread over the photo.

    Attributes:
        rows: see `PhotoPlaces`; of the sample.
        median: the median distance of all these matches in metres.
        limit: metres within which a match agrees.
    """

    median: float
    limit: float

    @classmethod
    def of(cls, registration: Registration, view: PhotoView) -> MatchedDetails | None:
        """Return the matches of an accepted registration; None for a refused one.

        Args:
            view: the registered picture.
        """
        if not registration.accepted or registration.ground is None or registration.homography is None:
            return None
        best = registration.places[0]
        pixels = view.pixels(best.u)
        offsets = np.stack([best.m.real, best.m.imag], axis=1) - apply_homography(registration.homography, pixels)
        metres = np.hypot(*offsets.T)
        agree = np.flatnonzero(metres < best.limit)
        places = (pixels[agree] + 0.5) / view.size
        chosen = _spread(places * view.size)
        chosen = chosen[np.lexsort((places[chosen, 0], np.floor(places[chosen, 1] * _ROWS)))]
        rows = _offset_rows(places[chosen], offsets[agree][chosen], 3)
        return cls(rows, round(float(np.median(metres[agree])), 3), round(best.limit, 3))

    def on_map(self, homography: Float64Array, width: int, height: int) -> Float64Array:
        """Return the sample's places on the map, metres east and north, (N, 2).

        Args:
            homography: of the registration, from pixels of the photo to metres, (3, 3).
            width, height: of the photo in pixels.
        """
        return apply_homography(homography, self.places * (width, height) - 0.5) + self.offsets


def _spread(points: Float64Array) -> Int64Array:
    """Return the indices of at most `_SAMPLE` points, (N, 2), each as far as possible from earlier ones."""
    chosen: list[int] = []
    # The first is nearest to the mean of all.
    far = -np.hypot(*(points - points.mean(axis=0)).T)
    for _ in range(min(_SAMPLE, len(points))):
        chosen.append(int(far.argmax()))
        near = np.hypot(*(points - points[chosen[-1]]).T)
        far = near if len(chosen) == 1 else np.minimum(far, near)
    return np.array(chosen, np.int64)


class MapAgreement(PhotoPlaces, frozen=True):
    """Places of a photo with their offsets by cross-correlation.

    Attributes:
        reach: metres of the search around a place, to the east, west, north, and south.
    """

    reach: float

    @property
    def median(self) -> float | None:
        """Median length of the offsets; None with too few places."""
        return float(np.median(self.metres)) if len(self.rows) >= _FEW_PLACES else None

    @property
    def largest(self) -> float | None:
        """Largest length of the offsets; None with too few places."""
        return float(self.metres.max()) if len(self.rows) >= _FEW_PLACES else None

    @property
    def unchecked(self) -> str:
        """A sentence that places are too few to check the photo away from its middle; "" if they are enough."""
        count = len(self.rows)
        if count >= _FEW_PLACES:
            return ""
        found = "no place" if not count else f"only {counted(count, 'place')}"
        return (
            f"Away from its middle, {found} of the photo could be found on the map. At least {_FEW_PLACES} such places are "
            "needed to check that the photo fits there, too."
        )

    @property
    def may_be_larger(self) -> bool:
        """True if the largest offset is so near the limit of the search that larger ones may exist."""
        return bool(self.rows) and float(np.abs(self.offsets[self.metres.argmax()]).max()) >= _BORDER * self.reach


def map_agreement(basemap: Map, photo: UInt8Array, homography: Float64Array, size: tuple[int, int]) -> MapAgreement:
    """Compare places of a photo with the map.

    Args:
        photo: RGB (H, W, 3) of any size, without the distortion of its lens.
        homography: from pixels of the original photo to metres of the map's frame, (3, 3).
        size: the original photo's width and height in pixels.
    """
    corners = apply_homography(homography, corner_pixels(*size))
    middle = apply_homography(homography, middle_pixel(*size))
    extent = 2 * float(np.abs(corners - middle).max())
    if not extent <= _LARGEST:  # the photo looks above the horizon, or nearly so
        return MapAgreement([], 0.0)
    scale = _PHOTO / extent
    side = _SIDE / scale
    photo = images.shrink(photo, _PHOTO)
    height, width = photo.shape[:2]
    # From pixels of the small photo to pixels of the original, to metres, to pixels of the square of ground.
    zoom = np.array([size[0] / width, size[1] / height])
    own = np.array([[zoom[0], 0, (zoom[0] - 1) / 2], [0, zoom[1], (zoom[1] - 1) / 2], [0, 0, 1]])
    half = (_SIDE - 1) / 2
    to_square = np.array([[scale, 0, half - scale * middle[0]], [0, -scale, half + scale * middle[1]], [0, 0, 1]])
    lay = to_square @ homography @ own
    laid = _edges(cast(UInt8Array, cv2.warpPerspective(photo, lay, (_SIDE, _SIDE), flags=cv2.INTER_LINEAR)))
    seen = cv2.warpPerspective(np.full((height, width), 255, np.uint8), lay, (_SIDE, _SIDE)) == 255
    picture, valid = basemap.read(Window(float(middle[0]), float(middle[1]), side), _SIDE)
    ground = _edges(picture)
    matched, offsets = [], []
    first = 2 * _REACH + _PLACE // 2
    for y in range(first, _SIDE - first + 1, _PLACE):
        for x in range(first, _SIDE - first + 1, _PLACE):
            if not _comparable(laid, seen, valid, (x, y)) or (there := _match(laid, ground, (x, y))) is None:
                continue
            back = _match(ground, laid, there)
            if back is not None and np.hypot(back[0] - x, back[1] - y) <= _BACK:
                matched.append((x, y))
                offsets.append(((there[0] - x) / scale, (y - there[1]) / scale))
    pixels = apply_homography(inverse(to_square @ homography), np.array(matched, np.float64).reshape(-1, 2))
    rows = _offset_rows((pixels + 0.5) / size, np.array(offsets, np.float64).reshape(-1, 2), 2)
    return MapAgreement(rows, round(_REACH / scale, 2))


def _edges(picture: UInt8Array) -> Float32Array:
    """Return the detail finer than the blur, in grey levels."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), _BLUR), np.float32)


def _around(place: tuple[int, int], reach: int) -> tuple[slice, slice]:
    half = _PLACE // 2 + reach
    return np.s_[max(place[1] - half, 0) : place[1] + half, max(place[0] - half, 0) : place[0] + half]


def _comparable(laid: Float32Array, seen: BoolArray, valid: BoolArray, place: tuple[int, int]) -> bool:
    return bool(
        seen[_around(place, 0)].mean() >= _SHOWN
        and valid[_around(place, _REACH)].mean() >= _SHOWN
        and laid[_around(place, 0)].std() >= _CONTRAST
    )


def _match(one: Float32Array, other: Float32Array, place: tuple[int, int]) -> tuple[int, int] | None:
    """Return the match of a picture's place in another; None if it is unclear, or at the border of the search."""
    searched = other[_around(place, _REACH)]
    if searched.shape != (_PLACE + 2 * _REACH,) * 2:
        return None
    scores = cv2.matchTemplate(searched, one[_around(place, 0)], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    best = float(scores[row, column])
    if row in (0, 2 * _REACH) or column in (0, 2 * _REACH):
        return None
    scores[max(row - _BESIDE, 0) : row + _BESIDE + 1, max(column - _BESIDE, 0) : column + _BESIDE + 1] = -1
    if best < _LEAST or best - float(scores.max()) < _STANDS_OUT:
        return None
    return place[0] + int(column) - _REACH, place[1] + int(row) - _REACH
