"""Score, rank, and part cosines of one query over a turn, shift, or zoom, drawn as svg while they are computed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape

from explorer.session_state import SessionState
from explorer.web.render import send
from explorer.workspace import StateAnalysis
from lpn.drawing import overlays, verdicts
from lpn.drawing.verdicts import ordinal
from lpn.explain import sweeps
from lpn.explain.sweeps import UNITS, Over, Point, Profile

CHOICES: dict[Over, str] = {"rotation": "Turn", "shift": "Shift right", "shift-down": "Shift down", "zoom": "Zoom"}
_WIDTH, _LEFT, _RIGHT = 720, 52, 14
_GREY, _BRIGHT = "rgba(128,128,128,.45)", "rgba(150,150,150,.95)"


def page(
    analysis: StateAnalysis,
    over: Over | None,
    profile: Profile | None,
    of: int,
    names: Sequence[str],
    stopped: bool = False,
) -> str:
    """The whole tab.

    Args:
        over: what is swept, None before anything was asked for.
        profile: what is known so far.
        of: points that it will have.
        stopped: it was cancelled or failed before it had them.
    """
    chips = "".join(
        f"<a class='{'chosen' if key == over else ''}' {send('sweep', key)}>{said}</a>" for key, said in CHOICES.items()
    )
    head = f"<div class='chips'>Sweep {chips}"
    if over is None or profile is None:
        hint = "Choose what to change: the query is described again at each step, which takes a while."
        if over:
            hint = "Stopped before the first step; choose again what to change." if stopped else "computing …"
        return f"<div class='lpn' id='lpn-profile'>{head}</div><div class='dim'>{hint}</div></div>"
    done = len(profile.points)
    region = "<div>⚠ This is of the whole query, not of its painted cells.</div>" if analysis.state.region else ""
    if stopped:
        head += f"<span>stopped at <span class='num'>{done} of {of}</span>: what follows is of these alone</span>"
    elif done < of:
        head += f"<span class='dim num'>{done} of {of}</span><a {send('cancel')}>Cancel</a>"
    return (
        f"<div class='lpn' id='lpn-profile' data-done='{done}' data-of='{of}'>{head}</div>"
        f"{region}{_charts(profile, analysis.state, names)}"
        f"<div class='said'>{_said(profile, analysis)}</div></div>"
    )


def _said(profile: Profile, analysis: StateAnalysis) -> str:
    over, best, blind = profile.over, profile.best, profile.best_blind
    known = best.true is not None
    who = "the true tile" if best.true else "the compared tile"
    lines = [f"Best for {who}: {_at(over, best)}, score {best.score:.3f}, {ordinal(best.rank)}{_gain(profile, best)}."]
    if profile.best_rank.rank < best.rank:
        ranked = profile.best_rank
        lines.append(f"Its best rank is elsewhere: {ordinal(ranked.rank)} at {_at(over, ranked)}.")
    if known and over != "rotation":
        lines.append(
            f"Without knowing it, the highest score of any tile is at {_at(over, blind)} ({blind.top_score:.3f})."
        )
    if guess := verdicts.heading(profile, (analysis.task.query_view, analysis.task.gallery_view)):
        lines.append(f"{guess}{_known_heading(analysis)}")
    if over in ("shift", "shift-down"):
        lines.append(
            "LPN assumes that the target is in the middle: its rings stay where they are while the target moves."
        )
    return "<br>".join(escape(line) for line in lines)


def _at(over: Over, point: Point) -> str:
    number = sweeps.value(over, point.change)
    if over == "rotation" and number > 180:
        number -= 360
    return f"{number:.3g}{UNITS[over]}"


def _gain(profile: Profile, point: Point) -> str:
    gain = profile.gain(point)
    before = profile.unchanged
    if gain is None or before is None or point is before:
        return ", as it is" if point is before else ""
    return f" ({ordinal(before.rank)} with {before.score:.3f} as it is)"


def _known_heading(analysis: StateAnalysis) -> str:
    places = analysis.task.geometry
    heading = None if places is None else places.queries[analysis.state.query].heading
    return "" if heading is None or analysis.state.upload else f" It is known to be {heading:.0f}°."


def _charts(profile: Profile, state: SessionState, names: Sequence[str]) -> str:
    over, points = profile.over, list(profile.points)
    numbers = [sweeps.value(over, point.change) for point in points]
    if over == "rotation":
        # The upright query in the middle, and both ends are the same picture.
        numbers = [number - 360 if number > 180 else number for number in numbers]
        order = sorted(range(len(points)), key=lambda i: numbers[i])
        points, numbers = [points[i] for i in order], [numbers[i] for i in order]
    place: Callable[[float], float] = (lambda x: math.log(x)) if over == "zoom" else (lambda x: x)
    low, high = place(numbers[0]), place(numbers[-1])
    span = max(high - low, 1e-9)

    now = sweeps.value(over, state.change)
    now = now - 360 if over == "rotation" and now > 180 else now
    here = now if numbers[0] <= now <= numbers[-1] else None

    def x(number: float) -> float:
        return _LEFT + (place(number) - low) / span * (_WIDTH - _LEFT - _RIGHT)

    worst = max(*(point.rank for point in points), 2)
    scores = _bounds([point.score for point in points] + [point.top_score for point in points])
    cosines = _bounds([float(c) for point in points for c in point.cosines])
    parts = [
        _chart(
            "rank", 110, x, numbers, here, points, [([math.log(p.rank) for p in points], "currentColor", "")],
            (math.log(worst), 0.0), [(math.log(rank), str(rank)) for rank in _ranks(worst)],
        ),
        _chart(
            "score", 120, x, numbers, here, points,
            [([p.top_score for p in points], _BRIGHT, "5 4"), ([p.score for p in points], "currentColor", "")],
            scores, _ticks(*scores),
        ),
        _chart(
            "part cosines", 130, x, numbers, here, None,
            [
                ([float(p.cosines[i]) for p in points], overlays.css(overlays.part_colour(i)), "")
                for i in range(len(names))
            ],
            cosines, _ticks(*cosines),
        ),
    ]  # fmt: skip
    labels = "".join(f"<text x='{x(n):.0f}' y='12'>{n:.3g}{UNITS[over]}</text>" for n in _spread(numbers))
    axis = f"<svg class='axis' viewBox='0 0 {_WIDTH} 16'>{labels}</svg>"
    who = "the true tile" if profile.best.true else "the compared tile"
    lines = f"Solid: {who}; dashed: the nearest tile of all; blue: as it is now."
    note = f"<div class='dim'>{lines} Click a point to change the query so.</div>"
    return f"<div class='charts'>{''.join(parts)}{axis}</div>{note}"


def _chart(
    title: str,
    height: int,
    x: Callable[[float], float],
    numbers: Sequence[float],
    here: float | None,
    points: Sequence[Point] | None,
    lines: Sequence[tuple[list[float], str, str]],
    bounds: tuple[float, float],
    ticks: Sequence[tuple[float, str]],
) -> str:
    bottom, top = bounds
    room = (top - bottom) or 1.0

    def y(value: float) -> float:
        return height - 8 - (value - bottom) / room * (height - 26)

    drawn = "".join(
        f"<line x1='{_LEFT}' x2='{_WIDTH - _RIGHT}' y1='{y(value):.1f}' y2='{y(value):.1f}' stroke='{_GREY}' stroke-width='.6'/>"
        f"<text x='{_LEFT - 6}' y='{y(value) + 3.5:.1f}' class='end'>{said}</text>"
        for value, said in ticks
    )
    if here is not None:
        drawn += f"<line x1='{x(here):.1f}' x2='{x(here):.1f}' y1='16' y2='{height - 6}' stroke='#56b4e9' stroke-width='1.5'/>"
    for values, colour, dashes in lines:
        at = " ".join(f"{x(number):.1f},{y(value):.1f}" for number, value in zip(numbers, values, strict=True))
        drawn += (
            f"<polyline points='{at}' fill='none' stroke='{colour}' stroke-width='1.8' stroke-dasharray='{dashes}'/>"
        )
    values, colour, _ = lines[-1]
    for number, value, point in zip(numbers, values, points or (), strict=points is not None):
        change = point.change
        drawn += (
            f"<circle cx='{x(number):.1f}' cy='{y(value):.1f}' r='3.6' fill='{colour}' class='point' "
            f"{send('take', [change.rotate, change.shift, change.down, change.scale])}><title>{ordinal(point.rank)}, "
            f"score {point.score:.3f}</title></circle>"
        )
    return f"<svg viewBox='0 0 {_WIDTH} {height}'><text x='{_LEFT}' y='11' class='title'>{title}</text>{drawn}</svg>"


def _ranks(worst: int) -> list[int]:
    return [rank for rank in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 10_000, 100_000) if rank <= worst]


def _bounds(values: Sequence[float]) -> tuple[float, float]:
    """Lowest and highest, a little apart where they are the same."""
    low, high = min(values), max(values)
    spare = max(0.01 - (high - low), 0) / 2
    return low - spare, high + spare


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Three or four round numbers between two."""
    step = 10 ** math.floor(math.log10(high - low))
    step = next(s for s in (step, step / 2, step / 4, step / 5) if (high - low) / s >= 2.5)
    first = math.ceil(low / step)
    return [(i * step, f"{i * step:.3g}") for i in range(first, math.floor(high / step) + 1)]


def _spread(numbers: Sequence[float]) -> list[float]:
    """Seven of some numbers at most, both ends and what lies evenly between."""
    count = min(len(numbers), 7)
    return list(dict.fromkeys(numbers[round(i * (len(numbers) - 1) / max(count - 1, 1))] for i in range(count)))


STYLE = """<style>
.lpn .charts svg{width:100%;display:block}
.lpn .charts text{font-size:11px;fill:currentColor;opacity:.75}
.lpn .charts .end{text-anchor:end}
.lpn .charts .axis text{text-anchor:middle}
.lpn .charts .title{opacity:1}
.lpn .charts .point{cursor:pointer}
.lpn .charts .point:hover{stroke:currentColor;stroke-width:3px}
</style>"""
