"""The drawings of a report as inline SVG; texts in them are escaped, colours follow the page's."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from lpn.core.arrays import FloatingArray
from lpn.core.files import printable
from lpn.drawing import overlays
from lpn.explain import Evidence
from lpn.explain.counterfactual import Margin
from lpn.explain.sweeps import Profile

FOR, AGAINST = overlays.css(overlays.FOR), overlays.css(overlays.AGAINST)


def text(value: object) -> str:
    """Anything as html text: whatever comes from a file goes through here."""
    return escape(printable(" ".join(str(value).split())))


def colour(part: int) -> str:
    """A part's colour for a style sheet."""
    return overlays.css(overlays.part_colour(part))


def shares(values: FloatingArray, full: float, names: Sequence[str]) -> str:
    """A bar of the parts' shares of a squared distance, from 0 to `full`, with each share written where it fits."""
    width, at, drawn = 400.0, 0.0, []
    for part, value in enumerate(values):
        length = max(float(value), 0.0) / max(full, 1e-9) * width
        said = f"<title>part {text(names[part])}: {value:.4f}</title>"
        drawn.append(f'<rect x="{at:.1f}" y="3" width="{length:.1f}" height="16" fill="{colour(part)}">{said}</rect>')
        if length > 30:
            drawn.append(f'<text x="{at + length / 2:.1f}" y="15" class="on" text-anchor="middle">{value:.2f}</text>')
        at += length
    return _svg(
        width, 22, "shares of the squared distance", ['<rect y="3" width="400" height="16" class="ground"/>', *drawn]
    )


def evidence_span(found: Sequence[Evidence]) -> tuple[float, float]:
    """The least and the largest number that `evidence_bars` draws for some pairs, so that all are to one scale."""
    low = high = 0.0
    for one in found:
        drawn = np.concatenate([*one.sums, one.contributions])
        low, high = min(low, float(drawn.min())), max(high, float(drawn.max()))
    return low, max(high, low + 1e-9)


def evidence_bars(found: Evidence, names: Sequence[str], span: tuple[float, float]) -> str:
    """For each part what its cells add and take, below it the constant, and their sum as a mark, on the query's side."""
    gains, losses, constants = found.sums
    left, right, row, top = 78.0, 366.0, 30, 4
    low, high = span
    scale = (right - left) / (high - low)
    zero = left - low * scale

    def bar(value: float, y: float, height: float, fill: str, said: str) -> str:
        end = zero + value * scale
        where = f'x="{min(zero, end):.1f}" y="{y:.1f}" width="{abs(end - zero):.1f}" height="{height}"'
        return f"<rect {where} {fill}><title>{said}: {value:+.4f}</title></rect>"

    drawn = []
    for part, name in enumerate(names):
        y, added = top + row * part, float(found.contributions[part])
        mark = zero + added * scale
        drawn += [
            f'<rect x="0" y="{y + 3}" width="9" height="9" fill="{colour(part)}"/>',
            f'<text x="14" y="{y + 12}">{text(name)}</text>',
            bar(gains[part], y, 13, f'fill="{FOR}"', "cells for"),
            bar(losses[part], y, 13, f'fill="{AGAINST}"', "cells against"),
            bar(constants[part], y + 15, 6, 'class="constant"', "constant"),
            f'<path d="M{mark:.1f} {y - 2}v26" class="mark"/>',
            f'<text x="420" y="{y + 12}" text-anchor="end" class="strong">{added:+.3f}</text>',
        ]
    height = top + row * len(names)
    drawn.append(f'<path d="M{zero:.1f} 0V{height - 4}" class="axis"/>')
    return _svg(420, height, "evidence by part", drawn)


def waterfall(margin: Margin) -> list[str]:
    """The margin as steps, one drawing for each part and a last one for the sum; set one below the other, they join.

    In squared distance: to the right of the line what speaks for the true tile, to the left what speaks for the wrong one.
    """
    steps = margin.distance2
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    low, high = float(ends.min()), float(ends.max())
    width, room = 400.0, 52.0
    scale = (width - 2 * room) / max(high - low, 1e-9)
    zero = room - low * scale
    drawn = []
    for part, step in enumerate(steps):
        begin, end = zero + ends[part] * scale, zero + ends[part + 1] * scale
        joined = f'<path d="M{begin:.1f} 0v7M{end:.1f} 19v7" class="join"/>'
        drawn.append(_step(begin, end, f'fill="{colour(part)}"', float(step), zero, joined))
    total = float(steps.sum())
    kind = "true" if total >= 0 else "false"
    joined = f'<path d="M{zero + total * scale:.1f} 0v7" class="join"/>'
    return [*drawn, _step(zero, zero + total * scale, f'class="{kind}"', total, zero, joined)]


def _step(begin: float, end: float, fill: str, value: float, zero: float, joined: str) -> str:
    left, right = min(begin, end), max(begin, end)
    at, anchor = (right + 4, "start") if value >= 0 else (left - 4, "end")
    return _svg(
        400,
        26,
        f"{value:+.3f}",
        [
            f'<path d="M{zero:.1f} 0v26" class="axis"/>{joined}',
            f'<rect x="{left:.1f}" y="6" width="{max(right - left, 1):.1f}" height="14" {fill}/>',
            f'<text x="{at:.1f}" y="17" text-anchor="{anchor}">{value:+.3f}</text>',
        ],
    )


def profile(found: Profile, names: Sequence[str]) -> str:
    """Score and cosines, and below them the rank, of what is followed while the query is turned once around."""
    points = [*found.points, found.points[0]]
    angles = [point.change.rotate % 360 for point in found.points] + [360.0]
    left, right, top, middle, below, bottom = 52.0, 920.0, 8.0, 176.0, 192.0, 262.0
    values = [v for p in points for v in (p.score, p.top_score, *map(float, p.cosines))]
    low, high = np.floor(10 * min(values)) / 10, np.ceil(10 * max(values)) / 10 + 1e-9

    def x(angle: float) -> float:
        return left + (right - left) * angle / 360

    def y(value: float) -> float:
        return float(middle - (middle - top) * (value - low) / (high - low))

    ranks = np.log([max(point.rank, 1) for point in points])
    depth = max(float(ranks.max()), np.log(10))

    def line(heights: Sequence[float], look: str) -> str:
        spots = " ".join(f"{x(a):.1f},{h:.1f}" for a, h in zip(angles, heights, strict=True))
        return f'<polyline points="{spots}" fill="none" {look}/>'

    drawn = [f'<path d="M{left} {y(v):.1f}H{right}" class="axis"/>' for v in _ticks(low, high)]
    drawn += [f'<text x="{left - 6}" y="{y(v) + 4:.1f}" text-anchor="end">{v:.1f}</text>' for v in _ticks(low, high)]
    for angle in range(0, 361, 45):
        drawn.append(f'<path d="M{x(angle):.1f} {top}V{middle}M{x(angle):.1f} {below}V{bottom}" class="axis"/>')
        drawn.append(f'<text x="{x(angle):.1f}" y="{bottom + 15}" text-anchor="middle">{angle}°</text>')
    cosines = np.array([point.cosines for point in points])
    for part in range(len(names)):
        drawn.append(line([y(float(v)) for v in cosines[:, part]], f'stroke="{colour(part)}" stroke-width="1.5"'))
    drawn.append(line([y(point.top_score) for point in points], 'class="rivals"'))
    drawn.append(line([y(point.score) for point in points], 'class="followed"'))
    for rank in (1, 10, 100, 1000, 10000, 100000):
        if np.log(rank) <= depth + 1e-9:
            at = below + (bottom - below) * np.log(rank) / depth
            drawn.append(f'<path d="M{left} {at:.1f}H{right}" class="axis"/>')
            drawn.append(f'<text x="{left - 6}" y="{at + 4:.1f}" text-anchor="end">{rank}</text>')
    drawn.append(line([below + (bottom - below) * r / depth for r in ranks], 'class="followed"'))
    best = found.best_rank
    spot = x(best.change.rotate % 360), below + (bottom - below) * np.log(best.rank) / depth
    drawn.append(f'<circle cx="{spot[0]:.1f}" cy="{spot[1]:.1f}" r="5" class="best"/>')
    for name, middle_of in (("score", (top + middle) / 2), ("rank", (below + bottom) / 2)):
        turned = f'transform="rotate(-90 12 {middle_of:g})"'
        drawn.append(f'<text x="12" y="{middle_of:g}" text-anchor="middle" {turned}>{name}</text>')
    return _svg(940, bottom + 18, "score and rank against the angle", drawn)


def _ticks(low: float, high: float) -> list[float]:
    step = 0.1 if high - low <= 0.6 else 0.2 if high - low <= 1.2 else 0.5
    return [float(v) for v in np.arange(np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6) + 1) * step]


def _svg(width: float, height: float, label: str, drawn: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{text(label)}">{"".join(drawn)}</svg>'
