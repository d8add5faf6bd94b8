"""Charts as inline SVG for the app and for reports: bars of shares, of evidence, and of a margin, and sweep profiles.

Bars are placed in percent of their width, so they stretch with a table's cell while their text keeps its size. Text
and lines take their colours from the page, see `css/charts.css`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from lpn.core.arrays import FloatingArray
from lpn.core.numbers import rounded_to_sum, signed
from lpn.core.templates import environment
from lpn.drawing import theme
from lpn.drawing.words import say
from lpn.explain import Evidence
from lpn.explain.sweeps import SweepPoint, SweepResult, signed_value, swept_label

STYLE = (Path(__file__).parent / "css" / "charts.css").read_text("utf-8")
EVIDENCE_COLOURS = {
    "cells for": theme.mark("for"),
    "cells against": theme.mark("against"),
    "constant": "var(--chart-constant, #828282)",
}

# Percent of a waterfall's width kept free on both sides for the numbers.
_LABEL_ROOM = 13.0
# Narrowest bar that has its number written in it, in percent.
_LABELLED = 7.5
_LEFT, _RIGHT = 52, 20
_CHART_WIDTH, _CHART_HEIGHT = 340, 150
_RANKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 10_000, 100_000)

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


@dataclass(frozen=True)
class _Series:
    """One line of a panel: its value at each point and how it is drawn."""

    values: Sequence[float]
    colour: str = "currentColor"
    kind: str = "followed"


@dataclass(frozen=True)
class TaskRecall:
    """A whole task with its queries turned by `degrees` counter-clockwise; Recall@1 and AP in percent."""

    degrees: float
    recall: float
    ap: float


@dataclass(frozen=True)
class _Panel:
    """One diagram of a profile: series over the shared x axis, and labelled ticks; `low` is drawn at the bottom."""

    title: str
    height: int
    series: Sequence[_Series]
    low: float
    high: float
    ticks: Sequence[tuple[float, str]]
    clickable: bool = True


@dataclass(frozen=True)
class ModelPoint:
    """One model of a `model_chart`.

    Attributes:
        key: stands for the model.
        number, label: what the models differ in, as a number by which they are ordered, and in words.
        percent: the model's height.
        role: "own" for the model that all others are compared with, "compared" for the one that is.
    """

    key: int | None
    name: str
    number: float
    label: str
    percent: float
    role: Literal["own", "compared", "other"]


def part_colour(part: int) -> str:
    """Return the CSS colour of a part."""
    return theme.mark(f"part-{part % len(theme.PART_COLOURS)}")


def share_bar(contributions: FloatingArray, full: float, names: Sequence[str]) -> Markup:
    """Draw the parts' shares of a squared distance, (n,), side by side; `full` is the distance that fills the bar."""
    # Python numbers, because rounding and formatting numpy's is slow and a page draws many bars for each query.
    bars, start = [], 0.0
    for part, (name, share) in enumerate(zip(names, contributions.tolist(), strict=True)):
        width = 100 * max(share, 0.0) / max(full, 1e-9)
        label = f"{share:.2f}" if width > _LABELLED else ""
        hint = f"{say('part')} {name}: {share:.4f}" if len(names) > 1 else f"{share:.4f}"
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
    """Return the lowest and the highest end of the evidence bars of some pairs, so that all share one scale."""
    ends = [0.0]
    for evidence in pairs:
        for part in range(len(evidence.cosines)):
            ends += [end for _, _, end in evidence_segments(evidence, part)]
    return min(ends), max(*ends, min(ends) + 1e-9)


def evidence_bars(evidence: Evidence, span: Span) -> list[Markup]:
    """Draw for each part its evidence in the query's cells, its constant, and a mark at their sum."""
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


def waterfall(margin: FloatingArray, sure: bool = True, sum_shown: float | None = None) -> list[Markup]:
    """Draw a margin, (n,), as steps: one drawing for each part, and a last one for the sum; stacked, they join.

    Bars to the right of the zero line speak for the positive, bars to its left for the hardest negative. The numbers are rounded
    so that they add up.

    Args:
        sure: one tile is known to be right and the other wrong; else the colours are those of what speaks for and against.
        sum_shown: the sum as it is shown elsewhere, see `lpn.core.numbers.shown_difference`.
    """
    ends = np.concatenate([[0.0], np.cumsum(margin)])
    scale = (100 - 2 * _LABEL_ROOM) / max(float(np.ptp(ends)), 1e-9)
    places = [round(float(place), 2) for place in _LABEL_ROOM + (ends - ends.min()) * scale]
    zero, total = places[0], float(ends[-1]) if sum_shown is None else sum_shown
    drawn = [
        _draw("step", zero, begin, end, value, part_colour(part), begin, end)
        for part, (value, (begin, end)) in enumerate(
            zip(rounded_to_sum(margin.tolist(), total=sum_shown), pairwise(places), strict=True)
        )
    ]
    ahead, behind = ("right", "wrong") if sure else ("for", "against")
    verdict = theme.mark(ahead if total >= 0 else behind)
    return [*drawn, _draw("step", zero, zero, places[-1], total, verdict, places[-1], None)]


def profile_charts(
    profile: SweepResult,
    names: Sequence[str],
    width: int,
    current: float | None = None,
    attributes: Callable[[SweepPoint], Markup] | None = None,
    recalls: Sequence[TaskRecall] = (),
) -> Markup:
    """Draw rank, score, and part cosines of the followed tile over a turn, shift, or zoom, or over weathers.

    Args:
        names: of the parts.
        width: of the drawing in pixels. Shown at this width, its text is as large as the page's.
        current: the angle, shift, zoom, or weather to mark with a line.
        attributes: HTML attributes of a point's circle; without it, points have no circles.
        recalls: the whole task with turned queries, drawn in a panel of its own once the full circle is there.
    """
    over = profile.over
    pairs = sorted(((signed_value(over, point.change), point) for point in profile.points), key=lambda pair: pair[0])
    if over == "rotation" and pairs[-1][0] == 180:
        pairs.insert(0, (-180.0, pairs[-1][1]))  # a full turn ends with the picture that it begins with
    numbers, points = [number for number, _ in pairs], [point for _, point in pairs]

    def place(number: float) -> float:
        return math.log(number) if over == "zoom" else number

    first, last = place(numbers[0]), place(numbers[-1])
    scale = (width - _LEFT - _RIGHT) / max(last - first, 1e-9)

    def x(number: float) -> float:
        return round(_LEFT + (place(number) - first) * scale, 1)

    panels: list[dict[str, Any]] = []
    top = 0
    best = points.index(profile.best_rank)
    for panel in _panels(points, names):
        heights = [_heights(panel, series.values, top) for series in panel.series]
        spots = list(zip(map(x, numbers), heights[-1], points, strict=True)) if panel.clickable else []
        lines = [
            (" ".join(f"{x(n)},{y}" for n, y in zip(numbers, ys, strict=True)), series)
            for ys, series in zip(heights, panel.series, strict=True)
        ]
        marked = spots[best][:2] if panel.title == "rank" else None
        panels.append(_drawn(panel, top, lines) | {"spots": spots if attributes else [], "best": marked})
        top += panel.height
    if recalls and numbers[0] == -180:
        panels.append(_recall_panel(recalls, top, x))
        top = panels[-1]["bottom"]
    line = x(current) if current is not None and numbers[0] <= current <= numbers[-1] else None
    labels = [(x(number), swept_label(over, number)) for number in (numbers if over == "weather" else _spread(numbers))]
    return _draw("profile", width, top, _LEFT, width - _RIGHT, panels, labels, line, attributes)


def model_chart(
    points: Sequence[ModelPoint],
    title: str,
    x_title: str,
    attributes: Callable[[ModelPoint], Markup],
    joined: bool = True,
) -> Markup:
    """Draw a percentage of several models over what they differ in, in even steps.

    Args:
        attributes: HTML attributes of a model's circle; empty for one that cannot be chosen.
        joined: a line joins the models where they differ in nothing else, and no two are alike in it.
    """
    panel = _fitted(title, _CHART_HEIGHT, [_Series([point.percent for point in points])])
    numbers = sorted({point.number: point.label for point in points}.items())
    step = (_CHART_WIDTH - _LEFT - _RIGHT) / max(len(numbers), 1)
    place = {number: round(_LEFT + step * (i + 0.5), 1) for i, (number, _) in enumerate(numbers)}
    heights = _heights(panel, [point.percent for point in points], 0)
    spots = sorted(
        zip([place[point.number] for point in points], heights, points, strict=True), key=lambda spot: spot[0]
    )
    line = " ".join(f"{x},{y}" for x, y, _ in spots) if joined and len(numbers) == len(points) else ""
    ticks = list(zip(_heights(panel, [tick for tick, _ in panel.ticks], 0), panel.ticks, strict=True))
    labels = [(place[number], label) for number, label in numbers]
    right = _CHART_WIDTH - _RIGHT
    return _draw(
        "models", _CHART_WIDTH, _CHART_HEIGHT, _LEFT, right, title, x_title, ticks, line, spots, labels, attributes
    )


def _recall_panel(recalls: Sequence[TaskRecall], top: int, x: Callable[[float], float]) -> dict[str, Any]:
    """Return the panel of a whole task; its full circle ends with the turn that it begins with."""
    signed = [(one.degrees - 360 if one.degrees > 180 else one.degrees, one) for one in recalls]
    signed += [(-180.0, one) for degrees, one in signed if degrees == 180]
    signed.sort(key=lambda pair: pair[0])
    series = _Series([one.recall for _, one in signed])
    panel = _fitted("R@1 of the whole task, %", 104, [series], clickable=False, least=4.0)
    heights = _heights(panel, series.values, top)
    places = [(x(degrees), height) for (degrees, _), height in zip(signed, heights, strict=True)]
    titles = [f"{one.degrees:g}°: R@1 {one.recall:.1f} %, AP {one.ap:.1f} %" for _, one in signed]
    dots = [(*place, title) for place, title in zip(places, titles, strict=True)]
    line = " ".join(f"{place},{height}" for place, height in places)
    return _drawn(panel, top, [(line, series)]) | {"dots": dots}


def _drawn(panel: _Panel, top: int, lines: list[tuple[str, _Series]]) -> dict[str, Any]:
    """Return the template's values for a panel that begins at `top`, and add its points."""
    ticks = [(_heights(panel, [value], top)[0], label) for value, label in panel.ticks]
    return {
        **{"title": panel.title, "top": top, "bottom": top + panel.height, "ticks": ticks, "lines": lines},
        **{"spots": [], "best": None, "dots": []},
    }


def _panels(points: Sequence[SweepPoint], names: Sequence[str]) -> list[_Panel]:
    worst = max(*(point.rank for point in points), 2)
    ranks = _Series([math.log(point.rank) for point in points])
    score = _Series([point.score for point in points])
    nearest = _Series([point.top_score for point in points], "var(--chart-dim, #999)", "nearest")
    cosines = [
        _Series([float(point.cosines[part]) for point in points], part_colour(part), "part")
        for part in range(len(names))
    ]
    rank_ticks = [(math.log(rank), str(rank)) for rank in _RANKS if rank <= worst]
    panels = [_Panel("rank", 104, [ranks], math.log(worst), 0.0, rank_ticks), _fitted("score", 112, [nearest, score])]
    if len(names) > 1:  # the cosine of one vector is the score
        panels.append(_fitted("part cosines", 122, cosines, clickable=False))
    return panels


def _fitted(title: str, height: int, series: Sequence[_Series], clickable: bool = True, least: float = 0.01) -> _Panel:
    """Make a panel from the lowest to the highest value, at least `least` apart, with three or four round ticks."""
    values = [value for one in series for value in one.values]
    spare = max(least - (max(values) - min(values)), 0) / 2
    low, high = min(values) - spare, max(values) + spare
    power = 10.0 ** math.floor(math.log10(high - low))
    step = next(s for s in (power, power / 2, power / 4, power / 5) if (high - low) / s >= 2.5)
    ticks = [(i * step, f"{i * step:.3g}") for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return _Panel(title, height, series, low, high, ticks, clickable)


def _heights(panel: _Panel, values: Sequence[float], top: int) -> list[float]:
    """Return the y coordinate of each value in a panel that begins at `top`."""
    scale = (panel.height - 26) / (panel.high - panel.low)
    return [round(top + panel.height - 8 - (value - panel.low) * scale, 1) for value in values]


def _spread(numbers: Sequence[float]) -> list[float]:
    """Return at most seven of some numbers: both ends and evenly spaced ones between them."""
    count = min(len(numbers), 7)
    return list(dict.fromkeys(numbers[round(i * (len(numbers) - 1) / max(count - 1, 1))] for i in range(count)))


@cache
def _macros() -> Any:
    return environment("lpn.drawing").get_template("charts.svg.j2").module


def _draw(macro: str, *arguments: object) -> Markup:
    return Markup(getattr(_macros(), macro)(*arguments))
