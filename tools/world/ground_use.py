"""The uses of the ground in the tiles of a rendered city, from its plan; see `lpn.datasets.ground_use`."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np

from lpn.core.arrays import Float64Array, UInt8Array
from tools.world.cameras import Tile
from tools.world.city import SPECIES, City
from tools.world.meshes import CROWNS

# Cells of a grid along each side, and pixels along each side of a cell from which the majority is taken.
_GRID, _WITHIN = 16, 8
_PIXELS = _GRID * _WITHIN
_LETTERS = ".grwtbpsfy"
_OF_SURFACE = {
    "lawn": "g", "meadow": "g", "garden": "g", "playground": "g", "field": "f", "wood": "t", "water": "w", "pool": "w",
    "parking": "p", "pitch": "s", "track": "s", "court": "s", "paved": "y", "asphalt": "y", "concrete": "y", "plaza": "y",
    "gravel": "y", "dirt": "y", "sand": "y", "solar": "y",
}  # fmt: skip


def ground_csv(city: City, tiles: Iterable[tuple[str, Tile]]) -> bytes:
    """Return `ground.csv` for tiles by their paths."""
    lines = ["path,uses", *(f"{path},{' '.join(_letters(city, tile))}" for path, tile in tiles)]
    return ("\n".join(lines) + "\n").encode()


def _letters(city: City, tile: Tile) -> list[str]:
    """Return the rows of a tile's grid: the majority of the plan's uses in each cell."""
    canvas = np.full((_PIXELS, _PIXELS), _LETTERS.index("g"), np.uint8)  # what no block covers is a meadow
    x, y, reach = tile.x, tile.y, tile.size
    scale, angle = _PIXELS / tile.size, math.radians(tile.heading)

    def pixels(points: Float64Array) -> Float64Array:
        east, north = points[..., 0] - x, points[..., 1] - y
        right = east * math.cos(angle) - north * math.sin(angle)
        up = east * math.sin(angle) + north * math.cos(angle)
        return np.stack([_PIXELS / 2 + right * scale, _PIXELS / 2 - up * scale], axis=-1)

    def near(points: Float64Array) -> bool:
        low, high = points.min(axis=0), points.max(axis=0)
        return bool((low < (x + reach, y + reach)).all() and (high > (x - reach, y - reach)).all())

    def fill(polygon: Float64Array, letter: str) -> None:
        if near(polygon):
            cv2.fillPoly(canvas, [np.rint(pixels(polygon)).astype(np.int32)], _LETTERS.index(letter))

    def line(points: Float64Array, width: float, letter: str) -> None:
        if near(points):
            path = np.rint(pixels(points)).astype(np.int32)
            cv2.polylines(canvas, [path], False, _LETTERS.index(letter), max(round(width * scale), 1))

    for block in city.blocks:
        fill(block.polygon, _OF_SURFACE[block.surface])
    for patch in city.patches:
        fill(patch.polygon, _OF_SURFACE[patch.surface])
    for street in city.streets:
        line(street.line, street.width, "r")
    river = city.terrain.river
    line(river.line, river.width, "w")
    for bridge in city.bridges:
        along = bridge.length / 2 * np.array([math.cos(bridge.angle), math.sin(bridge.angle)])
        line(np.array([bridge.x, bridge.y]) + np.stack([-along, along]), bridge.width, "r")
    for building in city.buildings:
        fill(city.footprint(building), "b")
    trees = city.trees
    beside = np.flatnonzero((np.abs(trees.x - x) < reach) & (np.abs(trees.y - y) < reach))
    middles = np.rint(pixels(np.stack([trees.x[beside], trees.y[beside]], axis=-1))).astype(int)
    crowns = np.array([CROWNS[species][0] for species in SPECIES])[trees.species[beside].astype(int)]
    for (column, row), radius in zip(middles.tolist(), (crowns * trees.height[beside] * scale).tolist(), strict=True):
        cv2.circle(canvas, (column, row), max(round(radius), 1), _LETTERS.index("t"), -1)
    return ["".join(_LETTERS[_majority(cell)] for cell in row) for row in _cells(canvas)]


def _cells(canvas: UInt8Array) -> UInt8Array:
    """Return the pixels of each cell, (rows, columns, pixels)."""
    split = canvas.reshape(_GRID, _WITHIN, _GRID, _WITHIN).swapaxes(1, 2)
    return split.reshape(_GRID, _GRID, _WITHIN * _WITHIN)


def _majority(cell: UInt8Array) -> int:
    return int(np.bincount(cell).argmax())
