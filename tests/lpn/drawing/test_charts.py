"""Tests of the charts: what they show is to scale, adds up, and escapes what it is given."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from lpn.drawing import charts


def rectangles(svg: str) -> list[tuple[float, float]]:
    """Return start and width of each bar in percent."""
    return [(float(x), float(w)) for x, w in re.findall(r'<rect x="([\d.]+)%"[^>]*? width="([\d.]+)%"', svg)]


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
