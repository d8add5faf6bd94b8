from __future__ import annotations

import math
from typing import Any

import pytest

from explorer.flight_window import messages
from explorer.flight_window.messages import (
    ChooseFrame,
    CloseFlight,
    CorrectFrame,
    ForgetCorrection,
    PaintScores,
    ShowSpot,
)


def test_messages_are_what_the_page_sends() -> None:
    assert messages.decode("flight-frame", 7) == ChooseFrame(7)
    assert messages.decode("flight-paint", "all") == PaintScores("all")
    assert messages.decode("flight-paint", 2) == PaintScores(2)
    assert messages.decode("flight-spot", [1.5, -2]) == ShowSpot((1.5, -2.0))
    assert messages.decode("flight-close", None) == CloseFlight()
    square = [[0, 1], [1, 1], [1, 0], [0, 0]]
    assert messages.decode("flight-correct", [3, square]) == CorrectFrame(3, ((0, 1), (1, 1), (1, 0), (0, 0)))
    assert messages.decode("flight-forget", 3) == ForgetCorrection(3)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("flight-frame", -1),
        ("flight-frame", 1e9),
        ("flight-frame", "1"),
        ("flight-frame", None),
        ("flight-paint", "none"),
        ("flight-paint", -1),
        ("flight-spot", [1.0]),
        ("flight-spot", [math.inf, 0.0]),
        ("flight-spot", ["a", 0.0]),
        ("flight-spot", {"x": 1}),
        ("flight-correct", 3),
        ("flight-correct", [3, [[0, 1], [1, 1], [1, 0]]]),
        ("flight-correct", [3, [[0, 1], [1, 1], [1, 0], [0, 1e9]]]),
    ],
)
def test_anything_else_is_dropped(kind: str, value: Any) -> None:
    assert messages.decode(kind, value) is None
