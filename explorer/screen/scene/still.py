"""A still of the city for browsers without WebGL: the ground, the buildings, and what `city` lays over them."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw

from explorer.screen.result import ScreenResult
from explorer.screen.scene import city, plan, shapes
from lpn.core.arrays import AnyArray, Float64Array, UInt8Array
from lpn.drawing import captions

# Lines are drawn this much finer before the picture is shrunk.
_FINER = 2
# Metres in front of the camera at which lines end.
_NEAR = 1.0
# Brightness of a wall that looks away from the light, and of a roof.
_DARK, _BRIGHT = 0.45, 1.0
_BUILDING = np.array([140, 152, 166])


def draw(result: ScreenResult, width: int, height: int, dark: bool) -> UInt8Array:
    """Draw the city of a result whose tiles have places, (height, width, 3)."""
    places = result.task.geometry
    assert places is not None
    wide, high = width * _FINER, height * _FINER
    laid = city.lay(result, places, width / height, dark)
    view = _View(laid, wide, high)
    image = Image.new("RGB", (wide, high), shapes.GROUND[dark])
    _ground(image, view, result, places.bounds())
    pen = ImageDraw.Draw(image)
    found = plan.buildings(result.workspace.root, places.origin)
    if found is not None:
        _buildings(pen, view, *found)
    for lines in laid.lines.values():
        for start, end in view.clipped(lines.segments):
            pen.line([*start, *end], fill=lines.colour, width=round(lines.thickness * _FINER))
    for badge in laid.badges.values():
        _paste(image, view, badge)
    if laid.metres is not None:
        text, place = laid.metres
        at = tuple(view.project(place[None])[0, :2])
        ground = shapes.GROUND[dark]
        pen.text(
            at, text, shapes.INK[dark], captions.font(15 * _FINER), anchor="mb", stroke_width=6, stroke_fill=ground
        )
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))


class _View:
    """The camera of a city over a picture.

    Attributes:
        scale: pixels of a metre at a metre's depth.
        middle: of the picture, in pixels.
    """

    def __init__(self, laid: city.LaidCity, width: int, height: int) -> None:
        self._axes, self._position = laid.axes, laid.position
        self.scale, self.middle = height / 2 / math.tan(city.FOV / 2), np.array([width / 2, height / 2])

    def project(self, points: AnyArray) -> Float64Array:
        """Return pixels and metres of depth of points (N, 3), (N, 3)."""
        seen = (np.asarray(points, np.float64) - self._position) @ self._axes
        depth = np.maximum(seen[:, 2:], _NEAR)
        return np.concatenate([seen[:, :2] / depth * self.scale + self.middle, seen[:, 2:]], axis=1)

    def clipped(self, segments: AnyArray) -> Float64Array:
        """Return the ends in pixels of segments (N, 2, 3) that lie before the camera, (M, 2, 2)."""
        ends = self.project(segments.reshape(-1, 3)).reshape(-1, 2, 3)
        return np.asarray(ends[(ends[:, :, 2] > _NEAR).all(axis=1), :, :2])

    def ground(self, size: tuple[int, int], bounds: tuple[float, float, float, float]) -> list[float]:
        """Return PIL's eight numbers of a perspective, from pixels here to those of a picture of the ground."""
        west, south, east, north = bounds
        across, down = (east - west) / size[0], (south - north) / size[1]
        to_metres = np.array([[across, 0, west], [0, down, north], [0, 0, 1.0]])
        camera = np.diag([self.scale, self.scale, 1.0])
        camera[:2, 2] = self.middle
        level = np.stack([self._axes[0], self._axes[1], -self._axes.T @ self._position], axis=1)
        inverse = np.linalg.inv(camera @ level @ to_metres)
        return [*(inverse / inverse[2, 2]).ravel()[:8].tolist()]


def _ground(image: Image.Image, view: _View, result: ScreenResult, bounds: tuple[float, float, float, float]) -> None:
    mosaic = Image.fromarray((result.workspace.mosaic(result.task) * 0.78).astype(np.uint8))
    numbers = view.ground(mosaic.size, bounds)
    ground = mosaic.transform(image.size, Image.Transform.PERSPECTIVE, numbers, Image.Resampling.BILINEAR)
    covered = Image.new("L", mosaic.size, 255).transform(image.size, Image.Transform.PERSPECTIVE, numbers)
    image.paste(ground, (0, 0), covered)


def _buildings(pen: ImageDraw.ImageDraw, view: _View, vertices: AnyArray, faces: AnyArray) -> None:
    """Draw the faces that are in sight, the farthest first."""
    corners = view.project(vertices)[faces]
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    light = normals @ np.array([0.3, 0.2, 1.0]) / np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
    shades = _DARK + (_BRIGHT - _DARK) * np.clip(light, 0, 1)
    size = 2 * view.middle
    inside = (corners[:, :, :2].max(axis=1) > 0).all(axis=1) & (corners[:, :, :2].min(axis=1) < size).all(axis=1)
    shown = np.flatnonzero(inside & (corners[:, :, 2] > _NEAR).all(axis=1))
    for face in shown[np.argsort(-corners[shown, :, 2].mean(axis=1))].tolist():
        colour = tuple((_BUILDING * shades[face]).astype(int).tolist())
        pen.polygon([tuple(corner) for corner in corners[face, :, :2].tolist()], fill=colour)


def _paste(image: Image.Image, view: _View, badge: city.Badge) -> None:
    x, y, depth = view.project(badge.middle[None])[0].tolist()
    if depth > _NEAR:
        wide, high = (max(round(side / depth * view.scale), 1) for side in badge.size)
        pixels = Image.fromarray(badge.pixels).resize((wide, high), Image.Resampling.LANCZOS)
        image.paste(pixels, (round(x - wide / 2), round(y - high / 2)), pixels)
