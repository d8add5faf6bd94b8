from __future__ import annotations

import math
from typing import Any

import pytest

from explorer.flight_window.messages import (
    ChooseFrame,
    CloseFlight,
    CorrectFrame,
    FlightMessage,
    ForgetCorrection,
    PaintScores,
    SavePositions,
    ShowSpot,
)
from explorer.web.messages import decode


def test_messages_are_what_the_page_sends() -> None:
    assert decode(FlightMessage, "flight-frame", 7) == ChooseFrame(7)
    assert decode(FlightMessage, "flight-paint", "all") == PaintScores("all")
    assert decode(FlightMessage, "flight-paint", 2) == PaintScores(2)
    assert decode(FlightMessage, "flight-spot", [1.5, -2]) == ShowSpot((1.5, -2.0))
    assert decode(FlightMessage, "flight-close", None) == CloseFlight()
    square = [[0, 1], [1, 1], [1, 0], [0, 0]]
    assert decode(FlightMessage, "flight-correct", [3, square]) == CorrectFrame(3, ((0, 1), (1, 1), (1, 0), (0, 0)))
    assert decode(FlightMessage, "flight-forget", 3) == ForgetCorrection(3)
    assert decode(FlightMessage, "flight-save", ".csv") == SavePositions(".csv")


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("flight-frame", -1),
        ("flight-frame", 1e9),
        ("flight-frame", "1"),
        ("flight-frame", None),
        ("flight-paint", "none"),
        ("flight-save", ".exe"),
        ("flight-paint", -1),
        ("flight-spot", [1.0]),
        ("flight-spot", [math.inf, 0.0]),
        ("flight-spot", ["a", 0.0]),
        ("flight-spot", {"x": 1}),
        ("flight-correct", 3),
        ("flight-correct", [3, [[0, 1], [1, 1], [1, 0]]]),
        ("flight-correct", [3, [[0, 1], [1, 1], [1, 0], [0, "0"]]]),
    ],
)
def test_anything_else_is_dropped(kind: str, value: Any) -> None:
    assert decode(FlightMessage, kind, value) is None


@pytest.mark.parametrize("corner", [(0.0, 1e9), (None, 0.0)])
def test_corners_beyond_the_map_have_no_place(corner: tuple[float | None, float | None]) -> None:
    near = ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0))
    assert CorrectFrame(3, (*near, corner)).spots() is None
    assert CorrectFrame(3, (*near, (0.0, 0.0))).spots() == [*near, (0.0, 0.0)]
