"""The arrays that the page's script draws a map of queries from: places, outcomes, and colours; no viser here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from explorer.failure_lab.service import Findings, MapPoints
from lpn.core.arrays import Float64Array, Int64Array, UInt8Array
from lpn.core.tables import Column
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.drawing import overlays, theme

# The column's name that stands for found and failed.
OUTCOME = ""
# The code of a query without a value, and that of all values beyond the most frequent ones.
UNKNOWN, OTHER = 255, 8
# Flags of a query, from the lowest bit on.
SELECTED, FAILED, CHOSEN = 1, 2, 4
# The ends of a numbers' scale, in percent of the queries: a few far values do not take all colours.
_ENDS = 2.0, 98.0
# The largest number of failures that are joined with their answers.
_MAX_LINES = 60


@dataclass(frozen=True, eq=False)
class Colours:
    """The colours of all queries by one column.

    Attributes:
        codes: of each query, (Q,); `UNKNOWN` without a value.
        palette: the colour of each code from 0 on, as CSS.
        labels: of each code, for values that are not numbers; empty for numbers.
        ends: the values of the first and of the last colour in words; None unless they are numbers.
    """

    codes: UInt8Array
    palette: list[str]
    labels: list[str]
    ends: tuple[str, str] | None = None


def colours(findings: Findings, name: str) -> Colours:
    """Return the colours of the queries by a column of the table, or by `OUTCOME`."""
    if name == OUTCOME:
        outcomes = findings.outcomes
        codes = np.where(outcomes.known, outcomes.failed, UNKNOWN).astype(np.uint8)
        labels = {"found": theme.TRUE_COLOUR, "failed": theme.FALSE_COLOUR}
        if findings.doubtful is not None and (doubtful := findings.doubtful & outcomes.known).any():
            codes[doubtful] = len(labels)
            labels["not graded"] = theme.UNKNOWN_COLOUR
        return Colours(codes, list(map(theme.css, labels.values())), list(labels))
    column = findings.table.column(name)
    return _of_numbers(column) if column.kind == "number" else _of_words(column)


def _of_numbers(column: Column) -> Colours:
    values, known = column.values.astype(np.float64), column.known
    codes = np.full(len(values), UNKNOWN, np.uint8)
    low, high = (float(end) for end in np.percentile(values[known], _ENDS)) if known.any() else (0.0, 0.0)
    share = (values[known] - low) / max(high - low, 1e-12)
    codes[known] = np.rint(np.clip(share, 0, 1) * (UNKNOWN - 1)).astype(np.uint8)
    scale = overlays.heat_cells(np.linspace(0, 1, UNKNOWN)[None], 0, 1)[0, :, :3]
    palette = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in scale.tolist()]
    unit = f" {column.unit}" if column.unit else ""
    least, most = (values[known].min(), values[known].max()) if known.any() else (low, high)
    ends = (
        f"{'≤ ' if least < low else ''}{low:,.4g}{unit}",
        f"{'≥ ' if most > high else ''}{high:,.4g}{unit}",
    )
    return Colours(codes, palette, [], ends)


def _of_words(column: Column) -> Colours:
    words, which, counts = np.unique(column.values.astype(str), return_inverse=True, return_counts=True)
    order = [int(i) for i in np.argsort(-counts, kind="stable") if words[i]]
    code_of = np.full(len(words), OTHER, np.uint8)
    code_of[order[:OTHER]] = np.arange(len(order[:OTHER]))
    code_of[words == ""] = UNKNOWN
    palette = [theme.css(theme.part_colour(code)) for code in range(min(len(order), OTHER))]
    labels = [str(words[i]) for i in order[:OTHER]]
    if len(order) > OTHER:
        palette.append(theme.css(theme.DIM))
        labels.append(f"{len(order) - OTHER} others")
    return Colours(code_of[which.ravel()], palette, labels)


def plane(points: MapPoints) -> bytes:
    """Return the places of queries, then of tiles, as float32 pairs; they are divided by a scale of their own, see `scale`."""
    origin, unit = scale(points)
    both = np.concatenate([points.queries, points.tiles])
    return bytes(((both - origin) / unit).astype("<f4").tobytes())


def scale(points: MapPoints) -> tuple[Float64Array, float]:
    """Return the origin and the unit of `plane` in the map's own units, so that float32 holds its details."""
    both = np.concatenate([points.queries, points.tiles])
    known = both[np.isfinite(both).all(axis=1)]
    if not len(known):
        return np.zeros(2), 1.0
    low, high = known.min(axis=0), known.max(axis=0)
    return (low + high) / 2, max(float((high - low).max()) / 2, 1e-9)


def proportion(points: MapPoints) -> float:
    """Return the width of all that a map draws divided by its height; 1 if nothing has a place."""
    corners = [np.concatenate([points.queries, points.tiles])]
    if points.ground is not None:
        corners.append(np.reshape(points.ground[1], (2, 2)))
    drawn = np.concatenate(corners)
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    if not len(drawn):
        return 1.0
    width, height = np.maximum(np.ptp(drawn, axis=0), 1e-9)
    return float(width / height)


def degrees(points: MapPoints, origin: Position) -> list[tuple[float, float]]:
    """Return ((latitude, degrees per unit), (longitude, degrees per unit)): the affine map from `plane` to WGS 84.

    Args:
        origin: the position that the points count their metres from.
    """
    (east, north), unit = scale(points)
    in_latitude, in_longitude = geo.metres_per_degree(origin.latitude)
    return [
        (float(origin.latitude + north / in_latitude), unit / in_latitude),
        (float(origin.longitude + east / in_longitude), unit / in_longitude),
    ]


def flags(findings: Findings, rows: Int64Array, chosen: Int64Array) -> bytes:
    """Return one byte for each query, of `SELECTED`, `FAILED`, and `CHOSEN`, given the selected queries and the chosen rows."""
    failed = findings.failed
    selected = np.isin(np.arange(len(failed)), rows)
    marked = np.isin(np.arange(len(failed)), chosen)
    return bytes((SELECTED * selected + FAILED * failed + CHOSEN * marked).astype(np.uint8).tobytes())


def lines(findings: Findings, points: MapPoints, rows: Int64Array) -> list[list[int]]:
    """Return [query, tile] of selected failures and their answers on the ground, none if there are many."""
    outcomes = findings.outcomes
    misses = rows[findings.failed[rows] & (outcomes.answer[rows] >= 0)]
    if points.ground is None or len(misses) > _MAX_LINES:
        return []
    placed = np.isfinite(points.tiles[:, 0])
    return [[int(row), int(outcomes.answer[row])] for row in misses if placed[outcomes.answer[row]]]


def counted(colours: Colours, rows: Int64Array) -> list[int]:
    """Return how many of the selected queries have each code of the palette, and last how many have none."""
    counts = np.bincount(colours.codes[rows], minlength=UNKNOWN + 1)
    return [*counts[: len(colours.labels)].tolist(), int(counts[UNKNOWN])]


def legend(colours: Colours, rows: Int64Array) -> dict[str, Any]:
    """Return what the script writes below the map."""
    return {"labels": colours.labels, "counts": counted(colours, rows), "ends": colours.ends}
