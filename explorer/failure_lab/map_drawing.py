"""A map of a task's queries as one picture, and which query is where on it. Arrays in, arrays out; no viser here."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from explorer.failure_lab.service import Points
from lpn.analysis import embedding_map
from lpn.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from lpn.drawing import overlays

Bounds = tuple[float, float, float, float]
NEAR = 9.0
"""Pixels of the page within which a point is meant by the mouse."""
_SHARP = 2
"""Pixels of the picture for each of the page."""
_MARGIN = 0.04
_LINES = 60
"""Failures up to this many are joined with their answers."""
_DARK = (12, 12, 14)
_OTHER = (92, 92, 92)
_TILE = (112, 118, 124)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A map as it is shown.

    Attributes:
        picture: what is sent to the page.
        bounds: west, south, east, and north border of the picture, in the plane's own units.
        size: width and height on the page.
        points: the queries, (Q, 2), in the plane's own units.
        chosen: which of them are chosen, (Q,).
    """

    picture: UInt8Array
    bounds: Bounds
    size: tuple[int, int]
    points: Float64Array
    chosen: BoolArray

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where in the plane a point of the picture is, from its fractions from the left and from the top."""
        west, south, east, north = self.bounds
        return west + x * (east - west), north - y * (north - south)

    def inside(self, one: tuple[float, float], other: tuple[float, float]) -> Int64Array:
        """The queries in a rectangle between two points of the picture, ascending."""
        return embedding_map.inside(self.points, self.place(*one), self.place(*other))

    def near(self, x: float, y: float) -> Int64Array:
        """The queries at the place nearest to a point of the picture, chosen ones alone where there are; none far away."""
        apart = (_fractions(self.points, self.bounds) - (x, y)) * self.size
        distance = np.hypot(apart[:, 0], apart[:, 1])
        for among in (self.chosen, ~self.chosen):
            reach = float(distance[among].min(initial=np.inf))
            if reach <= NEAR:
                return np.flatnonzero(among & (distance < reach + 0.5))
        return np.zeros(0, np.int64)


def draw(
    points: Points,
    failed: BoolArray,
    chosen: BoolArray,
    answers: Int64Array,
    size: tuple[int, int],
    fit: bool,
    query: int | None = None,
    truth: int = -1,
) -> Drawn:
    """Draw a map: queries that were found as yellow dots, failures as blue crosses, those that are not chosen grey.

    Few chosen failures on the ground are joined with their answers, and so is the current query on any map.

    Args:
        failed, chosen: of each query, (Q,).
        answers: the tile that came first for each query, -1 for none, (Q,).
        size: width and height of the picture on the page, in pixels.
        fit: show as much as the chosen queries take.
        query: the current query, which is ringed; truth: its nearest true tile, -1 where it has none.
    """
    bounds = _bounds(points, chosen if fit and chosen.any() else None, size)
    width, height = (_SHARP * side for side in size)
    canvas = _ground(points, bounds, (width, height))
    places = _pixels(points.queries, bounds, (width, height))
    tiles = _pixels(points.tiles, bounds, (width, height))
    count = int(chosen.sum())
    radius = 9 if count <= 400 else 7 if count <= 3000 else 5 if count <= 12000 else 4
    if points.ground is None:
        _stamp(canvas, tiles, _square(3), _TILE)
    _stamp(canvas, places[~chosen], _disc(max(radius - 3, 2)), _OTHER)
    missed = np.flatnonzero(chosen & failed & (answers >= 0))
    if points.ground is not None and len(missed) <= _LINES:
        for row in missed:
            _line(canvas, places[row], tiles[answers[row]], overlays.FALSE_COLOUR, 2)
    alone = chosen if points.ground is None else _pies(canvas, places, failed, chosen)
    found = places[alone & ~failed]
    _stamp(canvas, found, _disc(radius), _DARK)
    _stamp(canvas, found, _disc(radius - 2), overlays.TRUE_COLOUR)
    crossed = places[alone & failed]
    _stamp(canvas, crossed, _cross(radius + 2, 3.4), _DARK)
    _stamp(canvas, crossed, _cross(radius + 1, 1.6), overlays.FALSE_COLOUR)
    if query is not None:
        _mark(canvas, points, places[query], tiles, int(answers[query]), truth)
    return Drawn(canvas, bounds, size, points.queries, chosen)


def _mark(canvas: UInt8Array, points: Points, place: Int64Array, tiles: Int64Array, answer: int, truth: int) -> None:
    """Ring the current query and join it with its truth and its answer; on the ground, the truth is where the query is."""
    shown = [(answer, overlays.FALSE_COLOUR)] if answer != truth else []
    if points.ground is None:
        shown.append((truth, overlays.TRUE_COLOUR))
    for tile, colour in shown:
        if tile >= 0:
            _line(canvas, place, tiles[tile], colour, 3)
            _stamp(canvas, tiles[tile : tile + 1], _square(10), _DARK)
            _stamp(canvas, tiles[tile : tile + 1], _square(8), colour)
    radius = 17 if points.ground is None else 28
    _stamp(canvas, place[None], _ring(radius + 1, 6.5), _DARK)
    _stamp(canvas, place[None], _ring(radius, 4), (255, 255, 255))


def _pies(canvas: UInt8Array, places: Int64Array, failed: BoolArray, chosen: BoolArray) -> BoolArray:
    """Draw chosen queries that share a pixel as one disc whose blue part is the share that failed; which are left, (Q,)."""
    rows = np.flatnonzero(chosen)
    spots, which, counts = np.unique(places[rows], axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    missed = np.bincount(which, failed[rows], len(spots))
    radii = np.clip(8 + 2.4 * np.sqrt(counts), 10, 24).astype(int)
    for spot, count, bad, radius in zip(spots, counts, missed, radii, strict=True):
        if count > 1:
            middle, size = (int(spot[0]), int(spot[1])), (int(radius), int(radius))
            cv2.circle(canvas, middle, int(radius) + 3, _DARK, -1, cv2.LINE_AA)
            cv2.circle(canvas, middle, int(radius), overlays.TRUE_COLOUR, -1, cv2.LINE_AA)
            if bad:
                cv2.ellipse(canvas, middle, size, -90, 0, 360 * bad / count, overlays.FALSE_COLOUR, -1, cv2.LINE_AA)
    left = np.zeros(len(chosen), bool)
    left[rows[counts[which] == 1]] = True
    return left


def _bounds(points: Points, chosen: BoolArray | None, size: tuple[int, int]) -> Bounds:
    """What the picture shows; of the ground, both directions to one scale."""
    shown = points.queries[chosen] if chosen is not None else np.concatenate([points.queries, points.tiles])
    low, high = shown.min(axis=0), shown.max(axis=0)
    if points.ground is not None and chosen is None:
        west, south, east, north = points.ground[1]
        low, high = np.minimum(low, (west, south)), np.maximum(high, (east, north))
    span = np.maximum(high - low, 200.0 if points.ground is not None else 1e-3)
    middle = (low + high) / 2
    if points.ground is not None:
        span = np.full(2, max(span[0] / size[0], span[1] / size[1])) * size
    half = span * (0.5 + _MARGIN)
    return (
        float(middle[0] - half[0]),
        float(middle[1] - half[1]),
        float(middle[0] + half[0]),
        float(middle[1] + half[1]),
    )


def _fractions(points: Float64Array, bounds: Bounds) -> Float64Array:
    """Where points are on the picture, from its left and its top border: (N, 2)."""
    west, south, east, north = bounds
    return np.column_stack([(points[:, 0] - west) / (east - west), (north - points[:, 1]) / (north - south)])


def _pixels(points: Float64Array, bounds: Bounds, size: tuple[int, int]) -> Int64Array:
    far = np.clip(_fractions(points, bounds), -2, 3)
    return np.rint(far * size).astype(np.int64)


def _ground(points: Points, bounds: Bounds, size: tuple[int, int]) -> UInt8Array:
    """The canvas: the ground, dimmed so that points stand out, or a plain one."""
    width, height = size
    canvas = np.empty((height, width, 3), np.uint8)
    canvas[:] = (24, 25, 27)
    if points.ground is None:
        return canvas
    picture, (west, south, east, north) = points.ground
    corners = _fractions(np.array([(west, north), (east, north), (west, south)]), bounds) * size
    of = np.array([(0, 0), (picture.shape[1], 0), (0, picture.shape[0])], np.float32)
    turn = cv2.getAffineTransform(of, corners.astype(np.float32))
    dimmed = (0.5 * picture).astype(np.uint8)
    cv2.warpAffine(dimmed, turn, size, canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return canvas


def _stamp(canvas: UInt8Array, places: Int64Array, shape: Int64Array, colour: overlays.Colour) -> None:
    """Paint a shape, offsets (K, 2) from its middle, at each of some pixels (N, 2)."""
    height, width = canvas.shape[:2]
    for right, down in shape:
        x, y = places[:, 0] + right, places[:, 1] + down
        on = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        canvas[y[on], x[on]] = colour


def _line(canvas: UInt8Array, one: Int64Array, other: Int64Array, colour: overlays.Colour, thickness: int) -> None:
    ends = [tuple(int(v) for v in end) for end in (one, other)]
    cv2.line(canvas, ends[0], ends[1], colour, thickness, cv2.LINE_AA)


def _grid(radius: int) -> tuple[Int64Array, Int64Array]:
    across, down = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1))
    return across.ravel(), down.ravel()


def _of(radius: int, inside: BoolArray) -> Int64Array:
    return np.column_stack(_grid(radius))[inside]


def _disc(radius: int) -> Int64Array:
    x, y = _grid(radius)
    return _of(radius, np.hypot(x, y) <= radius)


def _ring(radius: int, thickness: float) -> Int64Array:
    x, y = _grid(radius)
    return _of(radius, np.abs(np.hypot(x, y) - radius + thickness / 2) <= thickness / 2)


def _square(radius: int) -> Int64Array:
    x, y = _grid(radius)
    return _of(radius, (np.abs(x) <= radius) & (np.abs(y) <= radius))


def _cross(radius: int, half: float) -> Int64Array:
    x, y = _grid(radius)
    return _of(radius, (np.minimum(np.abs(x - y), np.abs(x + y)) <= half * 1.3) & (np.hypot(x, y) <= radius + 1))
