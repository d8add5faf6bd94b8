"""Draws a map of a task's queries as one picture, and finds the queries at its points; no viser here."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from explorer.failure_lab.service import MapPoints
from lpn.analysis import embedding_map
from lpn.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from lpn.drawing import theme

Bounds = tuple[float, float, float, float]
# Pixels of the page within which the mouse points at a query.
_REACH = 9.0
# Pixels of the picture for each pixel of the page.
_SCALE = 2
# Space around the points, as a share of the picture.
_BORDER = 0.04
# The largest number of failures that are joined with their answers.
_MAX_LINES = 60
_OUTLINE = (12, 12, 14)
_UNSELECTED = (92, 92, 92)
_TILE = (112, 118, 124)


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """A map as the page shows it.

    Attributes:
        picture: (2 height, 2 width, 3) RGB.
        bounds: west, south, east, and north border of the picture, in the plane's units.
        size: width and height on the page, in pixels.
        points: the queries in the plane's units, (Q, 2); NaN where their places are unknown.
        selected: which queries are selected, (Q,).
    """

    picture: UInt8Array
    bounds: Bounds
    size: tuple[int, int]
    points: Float64Array
    selected: BoolArray

    def inside(self, corner: tuple[float, float], opposite: tuple[float, float]) -> Int64Array:
        """Return the queries in a rectangle of the picture, ascending; corners are fractions from left and top."""
        return embedding_map.inside(self.points, self._on_plane(*corner), self._on_plane(*opposite))

    def near(self, x: float, y: float) -> Int64Array:
        """Return the queries at the place nearest to a point of the picture, none if it is too far away.

        Selected queries go before others, which are returned only if no selected one is near.
        """
        offsets = (_fractions(self.points, self.bounds) - (x, y)) * self.size
        distance = np.nan_to_num(np.hypot(offsets[:, 0], offsets[:, 1]), nan=np.inf)
        for among in (self.selected, ~self.selected):
            nearest = float(distance[among].min(initial=np.inf))
            if nearest <= _REACH:
                return np.flatnonzero(among & (distance < nearest + 0.5))
        return np.zeros(0, np.int64)

    def _on_plane(self, x: float, y: float) -> tuple[float, float]:
        west, south, east, north = self.bounds
        return west + x * (east - west), north - y * (north - south)


def draw(
    points: MapPoints,
    failed: BoolArray,
    selected: BoolArray,
    answers: Int64Array,
    size: tuple[int, int],
    zoomed: bool,
    query: int | None = None,
    positive: int = -1,
) -> DrawnMap:
    """Draw found queries as yellow dots, failures as blue crosses, and queries that are not selected in grey.

    Lines join the current query with its tiles, and on the ground a few selected failures with their answers.

    Args:
        failed, selected: (Q,).
        answers: the tile that came first for each query, -1 for none, (Q,).
        size: width and height on the page, in pixels.
        zoomed: fit the map to the selected queries.
        query: the current query, which gets a ring.
        positive: its nearest true tile, -1 if it has none.
    """
    placed: BoolArray = ~np.isnan(points.queries[:, 0])
    # No line leads to an answer without a position, nor to none.
    answers = np.where(np.append(np.isfinite(points.tiles).all(axis=1), False)[answers], answers, -1)
    selected = selected & placed
    bounds = _bounds(points, selected if zoomed and selected.any() else None, size)
    width, height = (_SCALE * side for side in size)
    canvas = _background(points, bounds, (width, height))
    places = _pixels(points.queries, bounds, (width, height))
    tiles = _pixels(points.tiles, bounds, (width, height))
    count = int(selected.sum())
    radius = 9 if count <= 400 else 7 if count <= 3000 else 5 if count <= 12000 else 4
    if points.ground is None:
        _stamp(canvas, tiles, _offsets(3), _TILE)
    _stamp(canvas, places[~selected], _disc(max(radius - 3, 2)), _UNSELECTED)
    misses = np.flatnonzero(selected & failed & (answers >= 0))
    if points.ground is not None and len(misses) <= _MAX_LINES:
        for row in misses:
            _line(canvas, places[row], tiles[answers[row]], theme.FALSE_COLOUR, 2)
    single = selected if points.ground is None else _draw_pies(canvas, places, failed, selected)
    hits, misses = places[single & ~failed], places[single & failed]
    _stamp(canvas, hits, _disc(radius), _OUTLINE)
    _stamp(canvas, hits, _disc(radius - 2), theme.TRUE_COLOUR)
    _stamp(canvas, misses, _cross(radius + 2, 3.4), _OUTLINE)
    _stamp(canvas, misses, _cross(radius + 1, 1.6), theme.FALSE_COLOUR)
    if query is not None and placed[query]:
        _mark_query(canvas, points, places[query], tiles, int(answers[query]), positive)
    return DrawnMap(canvas, bounds, size, points.queries, selected)


def _mark_query(
    canvas: UInt8Array, points: MapPoints, place: Int64Array, tiles: Int64Array, answer: int, positive: int
) -> None:
    """Ring the current query and join it with its tiles; on the ground, the positive lies at the query itself."""
    marks = [(answer, theme.FALSE_COLOUR)] if answer != positive else []
    if points.ground is None:
        marks.append((positive, theme.TRUE_COLOUR))
    for tile, colour in marks:
        if tile >= 0:
            _line(canvas, place, tiles[tile], colour, 3)
            _stamp(canvas, tiles[tile : tile + 1], _offsets(10), _OUTLINE)
            _stamp(canvas, tiles[tile : tile + 1], _offsets(8), colour)
    radius = 17 if points.ground is None else 28
    _stamp(canvas, place[None], _ring(radius + 1, 6.5), _OUTLINE)
    _stamp(canvas, place[None], _ring(radius, 4), (255, 255, 255))


def _draw_pies(canvas: UInt8Array, places: Int64Array, failed: BoolArray, selected: BoolArray) -> BoolArray:
    """Draw queries that share a pixel as one pie, failures in blue; return which queries have a pixel alone, (Q,)."""
    rows = np.flatnonzero(selected)
    spots, which, counts = np.unique(places[rows], axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    failures = np.bincount(which, failed[rows], len(spots))
    radii = np.clip(8 + 2.4 * np.sqrt(counts), 10, 24).astype(int)
    for spot, count, bad, radius in zip(spots, counts, failures, radii, strict=True):
        if count > 1:
            centre, size = (int(spot[0]), int(spot[1])), (int(radius), int(radius))
            cv2.circle(canvas, centre, int(radius) + 3, _OUTLINE, -1, cv2.LINE_AA)
            cv2.circle(canvas, centre, int(radius), theme.TRUE_COLOUR, -1, cv2.LINE_AA)
            if bad:
                cv2.ellipse(canvas, centre, size, -90, 0, 360 * bad / count, theme.FALSE_COLOUR, -1, cv2.LINE_AA)
    single = np.zeros(len(selected), bool)
    single[rows[counts[which] == 1]] = True
    return single


def _bounds(points: MapPoints, selected: BoolArray | None, size: tuple[int, int]) -> Bounds:
    """Return the bounds of the picture; a map of the ground has one scale in both directions."""
    shown = points.queries[selected] if selected is not None else np.concatenate([points.queries, points.tiles])
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    if points.ground is not None and selected is None:
        west, south, east, north = points.ground[1]
        low, high = np.minimum(low, (west, south)), np.maximum(high, (east, north))
    span = np.maximum(high - low, 200.0 if points.ground is not None else 1e-3)
    centre = (low + high) / 2
    if points.ground is not None:
        span = np.full(2, max(span[0] / size[0], span[1] / size[1])) * size
    half = span * (0.5 + _BORDER)
    west, south, east, north = (float(value) for value in (*(centre - half), *(centre + half)))
    return west, south, east, north


def _fractions(points: Float64Array, bounds: Bounds) -> Float64Array:
    """Return points as fractions of the picture from its left and its top border, (N, 2)."""
    west, south, east, north = bounds
    return np.column_stack([(points[:, 0] - west) / (east - west), (north - points[:, 1]) / (north - south)])


def _pixels(points: Float64Array, bounds: Bounds, size: tuple[int, int]) -> Int64Array:
    near = np.nan_to_num(np.clip(_fractions(points, bounds), -2, 3), nan=-2.0)
    return np.rint(near * size).astype(np.int64)


def _background(points: MapPoints, bounds: Bounds, size: tuple[int, int]) -> UInt8Array:
    """Return the canvas: the picture of the ground, dimmed so that points stand out, or a plain colour."""
    width, height = size
    canvas = np.empty((height, width, 3), np.uint8)
    canvas[:] = (24, 25, 27)
    if points.ground is None:
        return canvas
    picture, (west, south, east, north) = points.ground
    corners = _fractions(np.array([(west, north), (east, north), (west, south)]), bounds) * size
    source = np.array([(0, 0), (picture.shape[1], 0), (0, picture.shape[0])], np.float32)
    transform = cv2.getAffineTransform(source, corners.astype(np.float32))
    dimmed = (0.5 * picture).astype(np.uint8)
    cv2.warpAffine(dimmed, transform, size, canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return canvas


def _stamp(canvas: UInt8Array, places: Int64Array, shape: Int64Array, colour: theme.Colour) -> None:
    """Paint a shape, given as offsets (K, 2) from its centre, at each of the pixels (N, 2)."""
    height, width = canvas.shape[:2]
    for right, down in shape:
        x, y = places[:, 0] + right, places[:, 1] + down
        visible = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        canvas[y[visible], x[visible]] = colour


def _line(canvas: UInt8Array, start: Int64Array, end: Int64Array, colour: theme.Colour, thickness: int) -> None:
    cv2.line(canvas, (int(start[0]), int(start[1])), (int(end[0]), int(end[1])), colour, thickness, cv2.LINE_AA)


def _offsets(radius: int) -> Int64Array:
    """Return the offsets (K, 2) of a square from its centre."""
    return np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1).T[:, ::-1].astype(np.int64)


def _disc(radius: int) -> Int64Array:
    square = _offsets(radius)
    inside: BoolArray = np.hypot(*square.T) <= radius
    return square[inside]


def _ring(radius: int, thickness: float) -> Int64Array:
    square = _offsets(radius)
    inside: BoolArray = np.abs(np.hypot(*square.T) - radius + thickness / 2) <= thickness / 2
    return square[inside]


def _cross(radius: int, half: float) -> Int64Array:
    square = _offsets(radius)
    x, y = square.T
    arms = np.minimum(np.abs(x - y), np.abs(x + y)) <= half * 1.3
    inside: BoolArray = arms & (np.hypot(x, y) <= radius + 1)
    return square[inside]
