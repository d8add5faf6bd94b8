"""A browser's session: what a change of its state does to what is told."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from explorer.client.session import ClientSession
from explorer.compute.watchers import Watchers
from explorer.compute.worker import Worker
from explorer.flight_window.window import FlightWindow
from explorer.session_state import SessionState
from explorer.workspace import Workspace


@pytest.mark.parametrize(
    ("shown", "failed", "forgotten"),
    [(False, False, False), (False, True, True), (True, False, True)],
    ids=["an error of the address", "an error of the first picture", "an error of a later picture"],
)
def test_an_error_goes_with_the_next_picture_and_that_of_an_address_stays_until_the_first(
    shown: bool, failed: bool, forgotten: bool
) -> None:
    session: Any = MagicMock(
        _lock=nullcontext(), _state=SessionState("drone-to-satellite", 4), _shown=object() if shown else None
    )
    session._workspace.supported_state.side_effect = lambda state: state
    session._worker.failed = failed
    ClientSession.change(session, lambda state: replace(state, query=1))
    assert session._state.query == 1
    assert session.views.panels.forget_error.called == forgotten


def test_the_first_screen_of_another_place_starts_at_its_first_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = SessionState("drone-to-satellite", 4, query=2, first_screen=True, why=True)
    session: Any = MagicMock(_state=shown, _left={"there": ("drone-to-satellite", 5)})
    session._opening_state = lambda *arguments: ClientSession._opening_state(session, *arguments)
    services: Any = MagicMock()
    services.workspace.key, services.workspace.tasks, services.workspace.first_query = "there", {shown.task: None}, 1
    services.workspace.contract.n_parts = 4
    services.workspace.supported_state.side_effect = lambda state: state
    services.url_state.read.side_effect = lambda _, state: (state, [])
    analysed: list[SessionState] = []
    analyser = MagicMock(analyse=lambda state, _: analysed.append(state))
    monkeypatch.setattr("explorer.client.session.StateAnalyser", lambda *_, **__: analyser)
    ClientSession.preview(session, services, "?show=there&screen=first")
    assert [(state.query, state.why) for state in analysed] == [(1, False)]


def test_a_page_is_drawn_again_when_the_registration_of_its_flight_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ClientViews", "Worker", "PageAddress", "StateAnalyser", "RankingProgress", "OwnPhotoComparisons"):
        monkeypatch.setattr(f"explorer.client.session.{name}", MagicMock())
    monkeypatch.setattr(ClientSession, "_opening_state", lambda *_: SessionState("drone-to-satellite", 4))
    flight: Any = object()
    workspace: Any = SimpleNamespace(
        flight=None, watchers=Watchers(), inference=MagicMock(), model=MagicMock(), own_photos=None
    )
    services: Any = MagicMock(workspace=workspace)
    session = ClientSession(MagicMock(), services, MagicMock())
    wake: Any = session._worker.wake
    wake.reset_mock()
    wake.side_effect = lambda: drawn.append(workspace.flight)
    drawn = list[Any]()
    assert Workspace.register_flight(workspace, lambda _: flight).wait(60)
    assert drawn == [flight]
    session.leave()
    assert Workspace.register_flight(workspace, lambda _: flight).wait(60)
    assert drawn == [flight]


def test_a_session_that_ends_waits_for_what_its_flight_window_draws() -> None:
    begun, may_end, drawn = threading.Event(), threading.Event(), list[bool]()

    def draw() -> None:
        begun.set()
        drawn.append(may_end.wait(60))

    worker = Worker(draw, lambda _: None)
    session: Any = MagicMock()
    session.leave.side_effect = worker.stop
    session.views.flight.join.side_effect = lambda seconds: FlightWindow.join(MagicMock(_worker=worker), seconds)
    worker.wake()
    assert begun.wait(60)
    threading.Timer(0.2, may_end.set).start()
    ClientSession.end(session)
    assert drawn == [True]
