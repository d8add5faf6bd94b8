"""Tests of the charts: what they show is to scale, adds up, and escapes what it is given."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from markupsafe import Markup

from lpn.descriptors.transforms import Change
from lpn.drawing import charts
from lpn.explain.sweeps import SweepPoint, SweepResult


def rectangles(svg: str) -> list[tuple[float, float]]:
    """Return start and width of each bar in percent."""
    return [(float(x), float(w)) for x, w in re.findall(r'<rect x="([\d.]+)%"[^>]*? width="([\d.]+)%"', svg)]


def points(*ranks: int) -> tuple[SweepPoint, ...]:
    step = 360 / len(ranks)
    cosines = np.zeros(2, np.float32)
    return tuple(SweepPoint(Change(rotate=i * step), 0, True, 0.3, r, cosines, 1, 0.4) for i, r in enumerate(ranks))


def test_shares_fill_their_part_of_the_bar() -> None:
    svg = charts.share_bar(np.array([0.5, 0.25, -0.01]), 1.0, ["a", "<b>", "c"])
    assert rectangles(svg) == [(0.0, 50.0), (50.0, 25.0), (75.0, 0.0)]
    assert "part &lt;b&gt;: 0.2500" in svg
    assert "<b>" not in svg


def test_evidence_is_stacked_from_zero_and_its_sum_is_marked() -> None:
    sums = np.array([[0.4, 0.1], [-0.1, -0.3], [-0.1, 0.2]])
    evidence = cast(Any, SimpleNamespace(part_sums=sums, weighted_cosines=sums.sum(axis=0), cosines=np.zeros(2)))
    assert charts.evidence_segments(evidence, 0) == [
        ("cells for", 0.0, 0.4),
        ("cells against", 0.0, -0.1),
        ("constant", -0.1, -0.2),
    ]
    low, high = charts.evidence_span([evidence])
    assert (low, high) == pytest.approx((-0.3, 0.4))
    first = charts.evidence_bars(evidence, (low, high))[0]
    zero = 100 * 0.3 / 0.7
    assert rectangles(first)[0] == pytest.approx((zero, 100 * 0.4 / 0.7), abs=0.01)
    assert float(re.findall(r'x1="([\d.]+)%"[^>]*class="mark"', first)[0]) == pytest.approx(zero + 20 / 0.7, abs=0.01)


def test_the_waterfall_ends_at_the_margin() -> None:
    steps = charts.waterfall(np.array([0.2, -0.6, 0.1]))
    assert [re.findall(r">([+−][\d.]+)<", step)[0] for step in steps] == ["+0.200", "−0.600", "+0.100", "−0.300"]
    bars = [rectangles(step.replace(' y="6"', ""))[0] for step in steps]
    zero = bars[0][0]
    # The first step goes right from zero, the second left from its end, and the sum from the end of the last to zero.
    assert sum(bars[1]) == pytest.approx(sum(bars[0]), abs=0.02)
    assert bars[2][0] == pytest.approx(bars[1][0], abs=0.02)
    assert bars[3][0] == pytest.approx(sum(bars[2]), abs=0.02)
    assert sum(bars[3]) == pytest.approx(zero, abs=0.02)


def test_a_full_turn_ends_with_the_picture_that_it_begins_with() -> None:
    svg = charts.profile_charts(SweepResult("rotation", points(5, 2, 9, 4)), ["a", "b"], 720)
    rank = re.findall(r'<polyline points="([^"]*)"', svg)[0].split()
    assert len(rank) == 5
    assert rank[0].split(",")[1] == rank[-1].split(",")[1]
    assert all(label in svg for label in ("-180°", "0°", "90°", "180°"))
    # The upper end of the rank's axis is rank 1, and the ring is around the best rank, at 90 degrees.
    heights = [float(spot.split(",")[1]) for spot in rank]
    ring = re.findall(r'cx="([\d.]+)" cy="([\d.]+)" r="6"', svg)
    assert ring == [tuple(rank[int(np.argmin(heights))].split(","))]


def test_a_whole_task_has_a_panel_once_the_full_circle_is_there() -> None:
    recalls = [charts.TaskRecall(degrees, recall, 50.0) for degrees, recall in ((0, 70.0), (180, 60.0), (270, 66.0))]
    svg = charts.profile_charts(SweepResult("rotation", points(5, 2, 9, 4)), ["a"], 720, recalls=recalls)
    assert "R@1 of the whole task, %" in svg
    dots = re.findall(r'cx="([\d.]+)" cy="([\d.]+)" r="3.6" class="task-point"><title>([^<]*)', svg)
    assert [title.split(":")[0] for *_, title in dots] == ["180°", "270°", "0°", "180°"]
    assert [float(x) for x, *_ in dots] == sorted(float(x) for x, *_ in dots)
    heights = [float(y) for _, y, _ in dots]
    assert heights[0] == heights[-1] > heights[1] > heights[2]  # a higher recall is further up
    begun = charts.profile_charts(SweepResult("rotation", points(5, 2, 9, 4)[:1]), ["a"], 720, recalls=recalls)
    assert "whole task" not in begun


def test_points_carry_the_attributes_that_are_passed_in() -> None:
    profile = SweepResult(
        "zoom", tuple(SweepPoint(Change(scale=s), 0, None, 0.1, 1, np.zeros(2), 0, 0.1) for s in (0.5, 1, 2))
    )
    plain = charts.profile_charts(profile, ["a", "b"], 720, current=3.0)
    assert 'class="point"' not in plain
    assert 'class="current"' not in plain
    svg = charts.profile_charts(
        profile, ["a", "b"], 720, 1.0, lambda point: Markup('data-scale="{}"').format(point.change.scale)
    )
    assert [float(scale) for scale in re.findall(r'data-scale="([\d.]+)"', svg)] == 2 * [0.5, 1, 2]
    # Equal factors are equally far apart.
    places = [float(x) for x in re.findall(r'cx="([\d.]+)" cy="[\d.]+" r="3.6"', svg)][:3]
    assert places[1] - places[0] == pytest.approx(places[2] - places[1], abs=0.2)
    assert svg.count('class="current"') == 3
