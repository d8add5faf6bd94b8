"""Bars of shares and of evidence as inline SVG.

Positions are percentages of the width, so bars stretch with a table's cell, but their text does not. Text and lines take their
colours from the page, see `css/charts.css`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from markupsafe import Markup

from lpn.core.arrays import FloatingArray
from lpn.core.numbers import signed
from lpn.core.templates import environment
from lpn.drawing import theme
from lpn.explain import Evidence

STYLE = (Path(__file__).parent / "css" / "charts.css").read_text("utf-8")
EVIDENCE_COLOURS = {
    "cells for": theme.mark("for"),
    "cells against": theme.mark("against"),
    "constant": "var(--chart-constant, #828282)",
}

# Narrowest bar with a number in it, in percent.
_LABELLED = 7.5

Span = tuple[float, float]


@dataclass(frozen=True)
class _Bar:
    """One bar: start and width in percent, a tooltip, and the number written in it."""

    start: float
    width: float
    colour: str
    title: str
    label: str = ""
    part: int | None = None


def part_colour(part: int) -> str:
    """Return the CSS colour of a part."""
    return theme.mark(f"part-{part % theme.N_PART_COLOURS}")


def share_bar(contributions: FloatingArray, full: float, names: Sequence[str]) -> Markup:
    """Draw the parts' shares of a squared distance, (n,), side by side; `full` is the distance that fills the bar."""
    # Python floats, because rounding and formatting NumPy numbers is slow, and a page draws many bars for each query.
    bars, start = [], 0.0
    for part, (name, share) in enumerate(zip(names, contributions.tolist(), strict=True)):
        width = 100 * max(share, 0.0) / max(full, 1e-9)
        label = f"{share:.2f}" if width > _LABELLED else ""
        hint = f"part {name}: {share:.4f}" if len(names) > 1 else f"{share:.4f}"
        bars.append(_Bar(round(start, 2), round(width, 2), part_colour(part), hint, label, part))
        start += width
    return _draw("bars", "shares of the squared distance", "shares", bars)


def evidence_segments(evidence: Evidence, part: int) -> list[tuple[str, float, float]]:
    """Stack the evidence of a part's cells for and against, and its constant, from zero outwards.

    Returns:
        Kind (a key of `EVIDENCE_COLOURS`), begin, and end of each segment, in units of the score.
    """
    above = below = 0.0
    segments = []
    for kind, values in zip(EVIDENCE_COLOURS, evidence.part_sums, strict=True):
        value = float(values[part])
        begin = above if value >= 0 else below
        segments.append((kind, begin, begin + value))
        above, below = above + max(value, 0.0), below + min(value, 0.0)
    return segments


def evidence_span(pairs: Sequence[Evidence]) -> Span:
    """Return the lowest and the highest end of the evidence bars of some pairs, for one scale."""
    ends = [0.0]
    for evidence in pairs:
        for part in range(len(evidence.cosines)):
            ends += [end for _, _, end in evidence_segments(evidence, part)]
    return min(ends), max(*ends, min(ends) + 1e-9)


def evidence_bars(evidence: Evidence, span: Span) -> list[Markup]:
    """Draw each part's evidence in the query's cells, its constant, and a mark at their sum."""
    low, high = span
    scale = 100 / (high - low)
    drawn = []
    for part, total in enumerate(evidence.weighted_cosines):
        bars = [
            _Bar(
                round((min(begin, end) - low) * scale, 2),
                round(abs(end - begin) * scale, 2),
                EVIDENCE_COLOURS[kind],
                f"{kind}: {signed(end - begin, 4)}",
            )
            for kind, begin, end in evidence_segments(evidence, part)
        ]
        mark = round((float(total) - low) * scale, 2), f"sum: {signed(total, 4)}"
        drawn.append(_draw("bars", "evidence", "evidence", bars, round(-low * scale, 2), mark))
    return drawn


@cache
def _macros() -> Any:
    return environment("lpn.drawing").get_template("charts.svg.j2").module


def _draw(macro: str, *arguments: object) -> Markup:
    return Markup(getattr(_macros(), macro)(*arguments))
