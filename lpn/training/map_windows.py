"""The training set of a map: random windows, each as a cut tile and as a simulated photo of its ground."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.homography import apply_homography, corner_pixels, four_point_homography, middle_pixel, translation
from lpn.core.views import View
from lpn.descriptors.weather import draw_any
from lpn.flight.files import Frame, footprint
from lpn.flight.files.cut import CUT, cut_square
from lpn.flight.maps import Map, Window
from lpn.flight.maps.window import grid
from lpn.training.augmentation import change_appearance, compress, recolour
from lpn.training.recipe import Recipe

# Default sides of windows, as multiples of the ground that the network's input shows at the map's resolution.
_SIZES = (0.5, 2.0)
# The largest window as a share of the map's shorter side: a batch needs windows that do not overlap.
_LARGEST = 0.5
# Number of sizes for which places for windows are computed; sizes between them are drawn log-uniformly.
_LEVELS = 6
# Least valid share of a window, steps of the centre along a window's side, and the maximum of centres for a size.
_MIN_VALID = 0.75
_STEPS = 8
_MAX_PLACES = 50_000
# Side of the ground read around a window, as a multiple of the window's side.
_AROUND = 1.8
# Proportions of the photos, and the range of fields of view in degrees.
_PROPORTIONS = ((4, 3), (3, 2), (16, 9))
_FOV = (50.0, 85.0)


class MapWindows:
    """Windows of a map to train on, each a place of its own; every epoch draws new ones.

    Args:
        basemap: the map.
        recipe: its `windows` are the number of places of an epoch; its other settings change the views.
        sizes: smallest and largest side of a window in metres; by default half to twice the ground of the network's input at
            the map's resolution, as far as they fit.

    Attributes:
        sizes: the sides in metres.
        windows: a function that returns an epoch's windows, each turned by up to the recipe's `place_rotation`.

    Raises:
        InputError: if the sizes are no range, or the windows do not fit on the map.
        DataError: if the map has no windows with data.
    """

    views: tuple[View, ...] = ("satellite", "drone")
    panoramas = False

    def __init__(self, basemap: Map, recipe: Recipe, sizes: tuple[float, float] | None = None) -> None:
        if not recipe.windows:
            raise InputError("The recipe cuts no windows of a map, as windows is 0; give --recipe map with --map.")
        self.basemap, self.recipe = basemap, recipe
        self.sizes = _check_sizes(basemap, recipe.size, sizes)
        edges = np.geomspace(*self.sizes, _LEVELS + 1)
        self._levels = [_places(basemap, float(size)) for size in np.sqrt(edges[1:] * edges[:-1])]
        if not all(len(centres) for centres, _ in self._levels):
            raise DataError(
                f"The map {printable(basemap.name)} has no window of up to {self.sizes[1]:.3g} m with data on "
                f"{_MIN_VALID:.0%} of it; give smaller ones with --window-sizes."
            )
        self.windows = lru_cache(4)(self._draw_windows)

    def __len__(self) -> int:
        return self.recipe.windows

    def digest(self) -> str:
        """Hash the map and the sizes: a run can be resumed only with equal ones."""
        return hashlib.sha256(json.dumps([self.basemap.digest(), self.sizes]).encode()).hexdigest()

    def overlapping(self, places: Int64Array, epoch: int) -> BoolArray:
        """Return the pairs of an epoch's windows, by their numbers (B,), that share ground, (B, B); the diagonal is True."""
        windows = self.windows(epoch)
        return overlaps(np.stack([windows[place].corners for place in places.tolist()]))

    def draw(self, place: int, epoch: int) -> dict[str, list[UInt8Array]]:
        """Return the picture of each view of a window, (H, W, 3) uint8; thread safe.

        The satellite view is a window as in retrieval. The drone view is cut from a photo as in retrieval.
        """
        recipe, window = self.recipe, self.windows(epoch)[place]
        rng = np.random.default_rng([recipe.seed, epoch, place + 1])
        ground = GroundPicture.read(self.basemap, window, recipe.size)
        tile = ground.tile(window, recipe.size)
        photo = ground.photo(draw_photo(window, recipe, rng), recipe.size)
        if recipe.flip == "place" and rng.random() < 0.5:
            tile, photo = (cast(UInt8Array, np.ascontiguousarray(view[:, ::-1])) for view in (tile, photo))
        if recipe.colour:
            tile = recolour(tile, recipe.colour, rng)
        photo = draw_any(change_appearance(photo, recipe, rng), recipe.weather, rng)
        photo = compress(photo, recipe.compression, rng)
        return {"satellite": [tile], "drone": [photo]}

    def _draw_windows(self, epoch: int) -> list[Window]:
        recipe, (low, high) = self.recipe, self.sizes
        rng = np.random.default_rng([recipe.seed, epoch, len(self) + 1])
        windows = []
        for level in rng.integers(_LEVELS, size=len(self)).tolist():
            centres, step = self._levels[level]
            x, y = centres[rng.integers(len(centres))] + rng.uniform(-0.5, 0.5, 2) * step
            size = low * (high / low) ** ((level + rng.random()) / _LEVELS)
            heading = rng.uniform(-1, 1) * recipe.place_rotation
            windows.append(Window(float(x), float(y), float(size), float(heading)))
        return windows


@dataclass(frozen=True)
class SimulatedPhoto:
    """A camera's photo of a window, and the square that is cut from it.

    Attributes:
        frame: the camera: heading, pitch, roll, field of view, height above ground, and the photo's pixels.
        centre: metres east and north of the photo's middle on the ground, (2,).
        heading: of the square, in degrees from the photo's top; 0 keeps the top.
        share: of the photo's width that the square's side covers.
    """

    frame: Frame
    centre: Float64Array
    heading: float
    share: float

    def to_ground(self) -> Float64Array:
        """Return the homography from the photo's column and row to metres east and north, (3, 3)."""
        frame = self.frame
        seen = footprint(frame)
        assert seen is not None
        homography = four_point_homography(corner_pixels(frame.width, frame.height), seen)
        middle = apply_homography(homography, middle_pixel(frame.width, frame.height))
        return translation(self.centre - middle) @ homography


def draw_photo(window: Window, recipe: Recipe, rng: np.random.Generator) -> SimulatedPhoto:
    """Draw a camera that looks at a window, with the recipe's tilt, scale, and shift, from any heading.

    The square has the window's heading up, with an error of up to the recipe's `rotation`. It has the pixels of the network's
    input.
    """
    proportion = _PROPORTIONS[rng.integers(len(_PROPORTIONS))]
    height = math.ceil(recipe.size / CUT)
    width = round(height * proportion[0] / proportion[1])
    share = CUT * min(1.0, height / width)
    pitch, roll = -90.0 + rng.uniform(-1, 1) * recipe.tilt, rng.uniform(-1, 1) * recipe.tilt
    heading, error = rng.uniform(0, 360), rng.uniform(-1, 1) * recipe.rotation
    fov = rng.uniform(*_FOV)
    metres = window.size / share * math.exp(rng.uniform(-1, 1) * recipe.scale)
    above = metres / 2 / math.tan(math.radians(fov) / 2) * -math.sin(math.radians(pitch))
    frame = Frame(
        "", Path(), width, height, height_above_ground=above, heading=heading % 360, pitch=pitch, roll=roll, fov=fov
    )
    centre = np.array([window.x, window.y]) + rng.uniform(-1, 1, 2) * recipe.shift * window.size
    return SimulatedPhoto(frame, centre, heading - window.heading + error, share)


@dataclass(frozen=True, eq=False)
class GroundPicture:
    """A picture of the ground around a window, at about the resolution of the window's views.

    Attributes:
        window: the area of the picture, north up.
        picture: the ground (pixels, pixels, 3); pixels without data have the colour of the nearest valid one.
        valid: 255 for pixels with data, else 0, (pixels, pixels).
    """

    window: Window
    picture: UInt8Array
    valid: UInt8Array

    @classmethod
    def read(cls, basemap: Map, window: Window, pixels: int) -> GroundPicture:
        """Read the ground around a window, at the resolution at which the window fills `pixels` a side."""
        around = Window(window.x, window.y, _AROUND * window.size)
        picture, valid = basemap.read(around, math.ceil(_AROUND * pixels))
        mask = valid.astype(np.uint8) * np.uint8(255)
        return cls(around, _filled(picture, mask), mask)

    def tile(self, window: Window, pixels: int) -> UInt8Array:
        """Cut a window's picture like `Map.read`, (pixels, pixels, 3), black without data."""
        matrix = self._to_pixels(four_point_homography(corner_pixels(pixels, pixels), window.corners))
        cut = _warp(self.picture, matrix, pixels, pixels)
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        cut[cv2.warpPerspective(self.valid, matrix, (pixels, pixels), flags=nearest) == 0] = 0
        return cut

    def photo(self, shot: SimulatedPhoto, pixels: int) -> UInt8Array:
        """Take a photo and cut the square from it, (pixels, pixels, 3); the photo has no holes."""
        taken = _warp(self.picture, self._to_pixels(shot.to_ground()), shot.frame.width, shot.frame.height)
        return cut_square(taken, shot.heading, shot.share, pixels)

    def _to_pixels(self, to_ground: Float64Array) -> Float64Array:
        """Return the homography from a view's pixels to this picture, (3, 3), from the view's homography to metres."""
        origin, along = self.window.to_pixels([(0.0, 0.0), (1.0, 1.0)], len(self.picture))
        step = along - origin
        return np.array([[step[0], 0, origin[0]], [0, step[1], origin[1]], [0, 0, 1]]) @ to_ground


def overlaps(corners: npt.ArrayLike) -> BoolArray:
    """Return the pairs of rectangles, given by corners (N, 4, 2), that share ground, (N, N), by the separating axes.

    Axes along the first two sides suffice for rectangles.
    """
    points = np.asarray(corners, np.float64)
    axes = points[:, 1:3] - points[:, :2]
    # Projection of each point of j on each axis of i: (i, axis, j, point).
    along = np.einsum("iad,jpd->iajp", axes, points)
    low, high = along.min(3), along.max(3)
    own = np.arange(len(points))
    first, last = low[own, :, own][..., None], high[own, :, own][..., None]
    meets = ((low < last) & (high > first)).all(axis=1)
    return np.asarray(meets & meets.T)


def _check_sizes(basemap: Map, pixels: int, sizes: tuple[float, float] | None) -> tuple[float, float]:
    """Return the sides of windows in metres; InputError if they are not possible."""
    west, south, east, north = basemap.bounds
    most = _LARGEST * min(east - west, north - south)
    if sizes is None:
        low, high = (factor * pixels * basemap.resolution for factor in _SIZES)
        low, high = min(low, most / 2), min(high, most)
        # A map of irregular outline may have data for smaller windows only.
        while high > 1.5 * low and not len(_places(basemap, high)[0]):
            high *= 0.8
        return low, high
    low, high = sizes
    if not 0 < low <= high < math.inf:
        raise InputError(
            f"The windows are {low:g} to {high:g} m wide; expected two numbers above 0, the smaller one first."
        )
    if high > most:
        raise InputError(
            f"Windows of {high:g} m are too large for the map {printable(basemap.name)}, which is {east - west:.0f} m by "
            f"{north - south:.0f} m; give at most {most:.3g} m, half of its shorter side, with --window-sizes."
        )
    return float(low), float(high)


def _places(basemap: Map, size: float) -> tuple[Float64Array, float]:
    """Return the centres, (N, 2) metres, of windows with enough data, and the step between them in metres."""
    west, south, east, north = basemap.bounds
    step = max(size / _STEPS, math.sqrt((east - west) * (north - south) / _MAX_PLACES))
    centres = grid(basemap.bounds, size, step)
    return centres[basemap.valid_shares(centres, size) >= _MIN_VALID], step


def _filled(picture: UInt8Array, mask: UInt8Array) -> UInt8Array:
    """Give each pixel without data the colour of the nearest valid one."""
    if mask.all() or not mask.any():
        return picture
    _, labels = cv2.distanceTransformWithLabels(255 - mask, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    colours = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    colours[labels[mask > 0]] = picture[mask > 0]
    return cast(UInt8Array, colours[labels])


def _warp(picture: UInt8Array, matrix: Float64Array, width: int, height: int) -> UInt8Array:
    """Sample a picture bilinearly by the homography from the view to the picture, which is mirrored beyond its edges."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    view = cv2.warpPerspective(picture, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
    return cast(UInt8Array, view)
