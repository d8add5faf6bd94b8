"""The city's drawing of a result: frames, badges, the drone's camera, and the viewpoint. Geometry alone; no viser scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import viser.transforms as tf

from explorer.screen.result import ScreenResult
from explorer.screen.scene import shapes
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.numbers import distance
from lpn.datasets import geo
from lpn.drawing.theme import Colour
from lpn.retrieval import Match
from lpn.tasks.gallery_geometry import GalleryGeometry

# Vertical field of view in radians.
FOV = math.radians(38)
# Metres from the ground to the frames of tiles, and from the drone's camera to its photo.
LIFT, DEPTH = 3.0, 34.0
# The view: degrees right of the photo's heading, degrees above the horizon, and the share of the screen that is filled.
_BESIDE, _BELOW, _ROOM = 35.0, -38.0, 0.8
# Ranked tiles that have frames.
_FRAMES = 3
# Height of a badge as a share of the picture's height.
_BADGE = 0.09


@dataclass(frozen=True, eq=False)
class Lines:
    """Segments (N, 2, 3) of a width in pixels."""

    segments: Float32Array
    colour: Colour
    thickness: float


@dataclass(frozen=True, eq=False)
class Badge:
    """A picture (H, W, 4) that stands upright in the view, with its middle in metres and its width and height."""

    pixels: UInt8Array
    middle: Float64Array
    size: tuple[float, float]


@dataclass(frozen=True, eq=False)
class PhotoCamera:
    """The drone's camera: its place (3,), its axes as columns (3, 3), and its field of view in radians."""

    place: Float64Array
    axes: Float64Array
    fov: float


@dataclass(eq=False)
class LaidCity:
    """The shapes above the ground.

    Attributes:
        lines, badges: by their names.
        photo: the drone's camera; None if it is unknown.
        metres: the distance from a wrong answer to the truth in words, and the place of this text.
        tiles: gallery position, middle, and half side of each frame, in reverse order of drawing.
        position, target, axes: of the view's camera.
    """

    photo: PhotoCamera | None
    axes: Float64Array
    lines: dict[str, Lines] = field(default_factory=dict)
    badges: dict[str, Badge] = field(default_factory=dict)
    metres: tuple[str, Float64Array] | None = None
    tiles: list[tuple[int, Float64Array, float]] = field(default_factory=list)
    position: Float64Array = field(default_factory=lambda: np.zeros(3))
    target: Float64Array = field(default_factory=lambda: np.zeros(3))


def lay(result: ScreenResult, places: GalleryGeometry, aspect: float, dark: bool) -> LaidCity:
    """Return the city's shapes for a result and a picture's aspect: nearest tiles, truth, and camera."""
    photo, heading = _photo(result, places)
    city = LaidCity(photo, shapes.camera_axes(heading + _BESIDE, _BELOW))
    seen = [] if photo is None else [photo.place]
    matches = [*result.analysis.matches[:_FRAMES]]
    truth = result.analysis.positive
    if truth is not None and all(truth.index != match.index for match in matches):
        matches.append(truth)
    marked = [match for match in matches if np.isfinite(places.ground[match.index]).all()]
    for match in reversed(marked):
        corners = _frame(city, match, result, places, dark)
        seen += corners if match.index == result.first.index or match.true else []
    city.position, city.target = shapes.fitting(np.array(seen or [np.zeros(3)]), city.axes, FOV, aspect, _ROOM)
    for match in reversed(marked):
        _badge(city, match, result, places, dark)
    if photo is not None:
        _footprint(city, photo, dark)
    _way(city, result, places, dark)
    return city


def _photo(result: ScreenResult, places: GalleryGeometry) -> tuple[PhotoCamera | None, float]:
    """Return the photo's camera and its heading."""
    place = None if result.state.own else places.queries[result.state.query]
    stands = None if place is None else geo.camera(place, places.origin)
    if place is None or stands is None:
        return None, 0.0
    heading, tilt = place.heading or 0.0, -90.0 if place.tilt is None else place.tilt
    # The photo is turned counter-clockwise, so its camera is turned about its axis the other way.
    turned = tf.SO3.from_z_radians(math.radians(result.state.angle)).as_matrix()
    return PhotoCamera(stands, shapes.camera_axes(heading, tilt) @ turned, math.radians(place.fov or 40.0)), heading


def _colour(match: Match, result: ScreenResult, dark: bool) -> Colour:
    if match.true:
        return shapes.RIGHT[dark]
    return (shapes.WRONG if match.index == result.first.index and match.true is False else shapes.INK)[dark]


def _half(match: Match, places: GalleryGeometry) -> float:
    return (places.tiles[match.index].width or places.width) / 2


def _frame(
    city: LaidCity, match: Match, result: ScreenResult, places: GalleryGeometry, dark: bool
) -> list[Float64Array]:
    """Frame a tile, and return its corners."""
    middle, half = places.ground[match.index], _half(match, places)
    thickness = 3 if match.true or match.index == result.first.index else 2
    segments = shapes.rectangle(middle.tolist(), half, LIFT)
    city.lines[f"tile{match.index}"] = Lines(segments, _colour(match, result, dark), thickness)
    city.tiles.insert(0, (match.index, middle, half))
    return [*segments[:, 0].astype(np.float64)]


def _badge(city: LaidCity, match: Match, result: ScreenResult, places: GalleryGeometry, dark: bool) -> None:
    """Put a tile's rank and verdict at a corner that the photo does not hide; all badges look equally large."""
    middle, half = places.ground[match.index], _half(match, places)
    sign = match.true if match.true or match.index == result.first.index else None
    pixels = shapes.badge(str(match.rank), _colour(match, result, dark), sign)
    share = pixels.shape[1] / pixels.shape[0]
    corners = np.array([[*(middle + np.array(side) * half), LIFT] for side in ((-1, -1), (-1, 1), (1, -1), (1, 1))])
    corners = corners[np.argsort(-(corners @ city.axes[:, 0]))]  # from right to left
    high = 2 * math.tan(FOV / 2) * ((corners - city.position) @ city.axes[:, 2]) * _BADGE
    places_of = corners - city.axes[:, 1] * high[:, None]
    at = next((at for at in (0, 3, 1, 2) if not _hidden(city, places_of[at], high[at], share)), 0)
    size = float(high[at]) * share, float(high[at])
    city.badges[f"tile{match.index}/rank"] = Badge(pixels, places_of[at], size)


def _hidden(city: LaidCity, middle: Float64Array, high: float, share: float) -> bool:
    """Return whether a badge lies behind the photo."""
    if city.photo is None:
        return False
    photo, across = city.photo, DEPTH * math.tan(city.photo.fov / 2)
    corners = [photo.place + photo.axes @ np.array([x, y, DEPTH]) for x in (-across, across) for y in (-across, across)]
    seen = (np.array([*corners, middle]) - city.position) @ city.axes
    flat, off = seen[:, :2] / seen[:, 2:], np.array([share, 1.0]) * high / 2 / seen[-1, 2]
    return bool((flat[-1] + off > flat[:-1].min(axis=0)).all() and (flat[-1] - off < flat[:-1].max(axis=0)).all())


def _footprint(city: LaidCity, photo: PhotoCamera, dark: bool) -> None:
    """Draw the outline of the photo on the ground, and the rays to its corners."""
    across = math.tan(photo.fov / 2)
    rays = [photo.axes @ np.array([x * across, y * across, 1.0]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    hits = [shapes.on_level(photo.place, direction, LIFT) for direction in rays]
    if all(hit is not None for hit in hits):
        ground = np.array(hits)
        way = np.stack([np.repeat(photo.place[None], 4, axis=0), ground], axis=1)
        segments = np.concatenate([shapes.sides(ground), way]).astype(np.float32)
        city.lines["footprint"] = Lines(segments, shapes.INK[dark], 1)


def _way(city: LaidCity, result: ScreenResult, places: GalleryGeometry, dark: bool) -> None:
    """Draw a dashed line with its metres from a wrong answer to the truth."""
    truth = result.analysis.positive
    if result.first.true is not False or truth is None:
        return
    ends = [np.array([*places.ground[index], LIFT]) for index in (result.first.index, truth.index)]
    if np.isfinite(ends).all():
        city.lines["way"] = Lines(shapes.dashes(ends[0], ends[1], 18, 12), shapes.WRONG[dark], 2)
        city.metres = distance(float(np.linalg.norm(ends[1] - ends[0]))), (ends[0] + ends[1]) / 2
