"""The flight window in an exported step."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from explorer.flight_window import page
from explorer.flight_window.service import FlightService
from explorer.session_state import SessionState
from explorer.stories.windows import WindowSources, draw_flight
from lpn.locate.belief import FlightVerdicts
from lpn.locate.located import LocatedFlight


@pytest.fixture
def sources(flight: LocatedFlight) -> WindowSources:
    workspace: Any = SimpleNamespace(
        flight=flight, root=flight.frames[0].frame.file.parent, verdicts_of=FlightVerdicts.of
    )
    lab: Any = None
    return WindowSources(workspace, lab, FlightService(workspace))


def shown(frame: int) -> Any:
    return SimpleNamespace(state=SessionState("drone-to-satellite", 2, query=frame, flight=True))


def test_a_frame_has_its_verdict_its_pictures_and_every_plot(sources: WindowSources) -> None:
    html = str(sources.flight_window(shown(0)))
    assert sources.flight.view().beliefs[0].headline in html
    assert "photo0.png" in html
    images = re.findall(r'<img src="([^"]{40})', html)
    assert len(images) == 3
    assert all(re.match(r"data:image/(jpeg|webp);base64,", image) for image in images)
    assert len(re.findall("<svg", html)) == 3
    error, radius, height = html.split("<svg")[1:]
    assert "Error" in error
    assert radius.count("<circle") == 3 + 2, "the sequence knows three, the registration two"
    assert height.count("<circle") == 3
    assert "GPS tags" in html
    assert not re.findall(r"onclick=|lpn\.flight|https?:", html)


def test_a_frame_without_an_answer_and_a_nasty_name_does_no_harm(sources: WindowSources) -> None:
    html = str(sources.flight_window(shown(2)))
    assert "<b>photo2" not in html
    assert "&lt;b&gt;photo2" in html
    assert len(re.findall("<svg", str(sources.flight_window(shown(9))))) == 3
    assert 'alt="The frame"' not in str(sources.flight_window(shown(9)))


def test_the_map_has_every_track_over_the_ground(sources: WindowSources) -> None:
    view = sources.flight.view()
    drawn = draw_flight(view, page.data(view, ""), 0)

    def places(name: str) -> np.ndarray:
        return np.argwhere((drawn == page.COLOURS[name]).all(axis=2))

    assert all(len(places(name)) > 30 for name in ("tag", "sequence", "registration"))
    # The registration puts the second frame far east of its tag; the sequence lies north of both.
    assert places("registration")[:, 1].max() > places("sequence")[:, 1].max() + 50
    assert np.median(places("sequence")[:, 0]) < np.median(places("registration")[:, 0])
    assert drawn[100:500, -150:].std() > 10, "the ground is in sight"
