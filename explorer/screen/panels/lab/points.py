"""Arrays of the laboratory's map: positions, outcomes, and colours of all queries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from explorer.screen.panels.lab.service import LabFindings, PlanePoints
from lpn.core.arrays import Float64Array, Int64Array, UInt8Array
from lpn.core.tables import Column
from lpn.drawing import overlays, theme

# The code of a query without a value, and the common code of all values that are not among the most frequent.
UNKNOWN, OTHER = 255, 8
# Percentiles at the ends of a scale of numbers, so that a few far values do not take all colours.
_ENDS = 2.0, 98.0
# Up to this many misses are joined with their answers on the ground.
_MOST_LINES = 60


@dataclass(frozen=True, eq=False)
class PointColours:
    """The colours of all queries by one column.

    Attributes:
        codes: colour code of each query, (Q,); `UNKNOWN` without a value.
        palette: CSS colour of each code from 0 on.
        labels: text of each code; empty for numbers.
        ends: the least and the greatest number in words; None for texts.
    """

    codes: UInt8Array
    palette: list[str]
    labels: list[str]
    ends: tuple[str, str] | None = None


def colours(findings: LabFindings, name: str) -> PointColours:
    """Return the colours of the queries by a column of the table, or by their outcome for any other name."""
    column = findings.table.columns.get(name)
    if column is not None:
        return _of_numbers(column) if column.kind == "number" else _of_words(column)
    graded = findings.graded
    codes = np.where(graded.known, graded.failed, UNKNOWN).astype(np.uint8)
    return PointColours(codes, ["--right", "--wrong"], ["✓ found", "✗ missed"])


def _of_numbers(column: Column) -> PointColours:
    values, known = column.values.astype(np.float64), column.known
    codes = np.full(len(values), UNKNOWN, np.uint8)
    low, high = (float(end) for end in np.percentile(values[known], _ENDS)) if known.any() else (0.0, 0.0)
    share = (values[known] - low) / max(high - low, 1e-12)
    codes[known] = np.rint(np.clip(share, 0, 1) * (UNKNOWN - 1)).astype(np.uint8)
    scale = overlays.heat_cells(np.linspace(0, 1, UNKNOWN)[None], 0, 1)[0, :, :3]
    palette = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in scale.tolist()]
    unit = f" {column.unit}" if column.unit else ""
    return PointColours(codes, palette, [], (f"{low:,.4g}{unit}", f"{high:,.4g}{unit}"))


def _of_words(column: Column) -> PointColours:
    words, which, counts = np.unique(column.values.astype(str), return_inverse=True, return_counts=True)
    order = [int(i) for i in np.argsort(-counts, kind="stable") if words[i]]
    code_of = np.full(len(words), OTHER, np.uint8)
    code_of[order[:OTHER]] = np.arange(len(order[:OTHER]))
    code_of[words == ""] = UNKNOWN
    palette = [theme.css(theme.part_colour(code)) for code in range(min(len(order), OTHER))]
    labels = [str(words[i]) for i in order[:OTHER]]
    if len(order) > OTHER:
        palette.append(theme.css(theme.DARK.dim))
        labels.append(f"{len(order) - OTHER} others")
    return PointColours(code_of[which.ravel()], palette, labels)


def scale(points: PlanePoints) -> tuple[Float64Array, float]:
    """Return origin and unit of `plane`: float32 is precise enough only near the middle of a map."""
    both = np.concatenate([points.queries, points.tiles])
    known = both[np.isfinite(both).all(axis=1)]
    if not len(known):
        return np.zeros(2), 1.0
    low, high = known.min(axis=0), known.max(axis=0)
    unit = 1.0 if points.ground is not None else max(float((high - low).max()) / 2, 1e-9)
    return (low + high) / 2, unit


def plane(points: PlanePoints) -> bytes:
    """Return the places of queries, then of tiles, as float32 pairs, see `scale`."""
    origin, unit = scale(points)
    return bytes(((np.concatenate([points.queries, points.tiles]) - origin) / unit).astype("<f4").tobytes())


def marks(findings: LabFindings, coloured: PointColours, rows: Int64Array) -> bytes:
    """Return two bytes for each query: 1 if selected plus 2 if missed, and the code of its colour."""
    failed = findings.graded.failed
    flags = np.isin(np.arange(len(failed)), rows) + 2 * failed
    return np.stack([flags.astype(np.uint8), coloured.codes], axis=1).tobytes()


def legend(coloured: PointColours, rows: Int64Array) -> dict[str, Any]:
    """Return the colours of the map, and the number of selected queries of each."""
    counts = np.bincount(coloured.codes[rows], minlength=UNKNOWN + 1)
    return {
        "palette": coloured.palette,
        "labels": coloured.labels,
        "counts": counts[: len(coloured.labels)].tolist(),
        "unknown": int(counts[UNKNOWN]),
        "ends": coloured.ends,
    }


def ground(points: PlanePoints) -> list[list[float]] | None:
    """Return the lower left and the upper right corner of the ground's picture, y before x; None for descriptors."""
    return None if points.ground is None else _corners(points, np.array(points.ground[1]).reshape(2, 2))


def bounds(points: PlanePoints) -> list[list[float]]:
    """Return the corners of the box around all points, y before x."""
    both = np.concatenate(
        [points.queries, points.tiles, *([] if points.ground is None else [np.reshape(points.ground[1], (2, 2))])]
    )
    known = both[np.isfinite(both).all(axis=1)]
    return _corners(points, np.array([known.min(axis=0), known.max(axis=0)]) if len(known) else np.zeros((2, 2)))


def _corners(points: PlanePoints, corners: Float64Array) -> list[list[float]]:
    origin, unit = scale(points)
    shifted: list[list[float]] = ((corners - origin) / unit)[:, ::-1].tolist()
    return shifted


def lines(findings: LabFindings, points: PlanePoints, rows: Int64Array) -> list[list[int]]:
    """Return [query, tile] of selected misses and their answers on the ground; none if there are many."""
    answers = findings.outcomes.answer
    misses = rows[findings.graded.failed[rows] & (answers[rows] >= 0)]
    if points.ground is None or len(misses) > _MOST_LINES:
        return []
    return [[int(row), int(answers[row])] for row in misses if np.isfinite(points.tiles[answers[row], 0])]
