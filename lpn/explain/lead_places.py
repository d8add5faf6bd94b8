"""Where in a query the lead of one tile over another comes from, and what both tiles show there, as far as somebody knows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, FloatingArray
from lpn.datasets.ground_use import Letters, named_uses

# Cells lie on one side if their mean is farther from the middle than this share of their mean distance from it.
ONE_SIDED = 0.25
# Half of the sector that counts as one side, in degrees.
_HALF_SECTOR = 45.0


@dataclass(frozen=True)
class TileGround:
    """The uses of the ground in a tile.

    Attributes:
        letters: see `lpn.datasets.ground_use`, (rows, columns).
        zoom: at which the tile is described.
    """

    letters: Letters
    zoom: float = 1.0


@dataclass(frozen=True, eq=False)
class LeadPlace:
    """The place that does most for one tile against another.

    Attributes:
        parts: those that do most, alike.
        share: their part of all that speaks for the tile, 0 .. 1.
        cells: of the query, what speaks for the tile in these parts, (h, w), 0 elsewhere.
        uses: what the tile, and the other one, shows there; empty where it is not known.
    """

    parts: Sequence[int]
    share: float
    cells: Float64Array
    uses: tuple[Sequence[str], Sequence[str]] = (), ()


def lead_place(
    terms: FloatingArray,
    parts: Sequence[int],
    cells: Float64Array,
    areas: tuple[BoolArray, BoolArray],
    grounds: tuple[TileGround | None, TileGround | None] = (None, None),
    turn: float | None = None,
) -> LeadPlace:
    """Find the place that does most for a tile.

    Args:
        terms: each part's term of the lead, (n,), positive for the tile.
        parts: that are looked at.
        cells: each cell's share of the lead on the query's side, (h, w), positive for the tile.
        areas: the cells of each part, of the query and of a tile, each (n, h, w).
        grounds: of the tile, and of the one that it is ahead of.
        turn: degrees counter-clockwise by which tiles are turned to lie like the query; None if that is not known.
    """
    within = areas[0][list(parts)].any(axis=0)
    speaking = np.where(within, np.maximum(cells, 0.0), 0.0)
    side = middle_of(speaking)
    there = cast(BoolArray, areas[1][list(parts)].any(axis=0))
    if side is not None and turn is not None:
        there = there & _sector(there.shape, math.degrees(math.atan2(side[1], side[0])) - turn)
    # Without a turn, nobody knows where in the tile a side of the query lies.
    known = side is None or turn is not None
    uses = [named_uses(one.letters, there, one.zoom) if known and one is not None else [] for one in grounds]
    positive = float(np.maximum(terms, 0.0).sum())
    share = float(np.maximum(terms[list(parts)], 0.0).sum()) / positive if positive > 0 else 0.0
    return LeadPlace(parts, share, speaking, (uses[0], uses[1]))


def middle_of(weights: Float64Array) -> tuple[float, float] | None:
    """Return the mean offset of weights, (h, w), to the right and up, in shares of the sides; None if they lie on no side."""
    height, width = weights.shape
    up = 0.5 - (np.arange(height)[:, None] + 0.5) / height
    right = (np.arange(width)[None, :] + 0.5) / width - 0.5
    total = float((weights * np.hypot(up, right)).sum())
    east, north = float((weights * right).sum()), float((weights * up).sum())
    return None if total <= 0 or math.hypot(east, north) < ONE_SIDED * total else (east, north)


def _sector(shape: tuple[int, ...], degrees: float) -> BoolArray:
    """Return the cells of (h, w) whose direction from the middle is near one, in degrees counter-clockwise from the right."""
    height, width = shape
    up = (height - 1) / 2 - np.arange(height)[:, None]
    right = np.arange(width)[None, :] - (width - 1) / 2
    apart = (np.degrees(np.arctan2(up, right)) - degrees + 180) % 360 - 180
    near: BoolArray = np.abs(apart) <= _HALF_SECTOR
    return near
