"""The flight window without a browser."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from explorer.flight_window import window as window_module
from explorer.flight_window.messages import FlightMessage
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService
from explorer.flight_window.window import FlightWindow
from explorer.session_state import SessionState
from explorer.stage.viewport import Viewport
from explorer.web.messages import Receivers
from lpn.locate.belief import FlightVerdicts
from lpn.locate.located import LocatedFlight

SQUARE = [[0, 30], [40, 30], [40, 0], [0, 0]]


class WindowOf:
    """A flight window whose work the test runs; `shown` has the calls that each element of the page got last."""

    def __init__(self, flight: LocatedFlight, service: FlightService, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.woken, self.service = 0.0, 0, service
        self.client = MagicMock()
        self.elements: list[Any] = []
        self.client.gui.add_html.side_effect = self._element
        workspace: Any = SimpleNamespace(
            flight=flight, has_flight=True, registration=None, part_names=["1", "2"], tasks={}, spec=None
        )
        monkeypatch.setattr(window_module, "Worker", lambda *_: SimpleNamespace(wake=self._wake, stop=lambda: None))
        monkeypatch.setattr(window_module, "time", SimpleNamespace(monotonic=lambda: self.clock))
        self.viewport = Viewport()
        self.window = FlightWindow(
            self.client,
            workspace,
            service,
            FlightPictures(workspace),
            lambda _: None,
            self.viewport,
            lambda _: None,
        )
        self.show(0)

    def show(self, frame: int) -> None:
        """Choose a frame, as the stage does."""
        state = SessionState("drone-to-satellite", 2, query=frame, flight=True)
        chosen = SimpleNamespace(index=0, true=False)
        self.window.show(SimpleNamespace(state=state, chosen=chosen, matches=[chosen]))  # type: ignore[arg-type]
        self.work()

    def send(self, kind: str, value: Any) -> None:
        """Send a message of the page."""
        Receivers({FlightMessage: self.window.receive}).hand_on(kind, value)
        self.work()

    def work(self) -> float | None:
        return self.window._work()

    @property
    def text(self) -> str:
        """All that the page got last."""
        return html.unescape("".join(str(element.content) for element in self.elements))

    def _element(self, content: str = "", **_: Any) -> Any:
        self.elements.append(SimpleNamespace(content=content))
        return self.elements[-1]

    def _wake(self) -> None:
        self.woken += 1


@pytest.fixture
def service(flight: LocatedFlight, tmp_path: Path) -> FlightService:
    return FlightService(SimpleNamespace(flight=flight, root=tmp_path, verdicts_of=FlightVerdicts.of))  # type: ignore[arg-type]


@pytest.fixture
def make(flight: LocatedFlight, service: FlightService, monkeypatch: pytest.MonkeyPatch) -> Callable[[], WindowOf]:
    return lambda: WindowOf(flight, service, monkeypatch)


def saves(page: WindowOf) -> int:
    """Return how many corrections are saved, as the page is told with the chosen frame."""
    found = re.search(r"\bsaves\W+(\d+)", page.text)
    assert found is not None
    return int(found[1])


def test_the_page_is_told_of_corrections_that_are_saved_and_of_others_why_not(make: Callable[[], WindowOf]) -> None:
    page = make()
    assert saves(page) == 0
    page.send("flight-correct", [0, SQUARE[::-1]])
    assert "Not saved. The tie points turn the photo over" in page.text
    page.send("flight-correct", [0, [*SQUARE[:3], [1e7, 0]]])
    assert "Not saved. A corner of the photo would lie more than 1,000 km away" in page.text
    page.send("flight-correct", [0, [*SQUARE[:3], [None, 0]]])
    assert saves(page) == 0
    page.send("flight-correct", [0, SQUARE])
    assert "Saved in corrections.csv" in page.text
    assert saves(page) == 1


def test_what_a_correction_led_to_is_told_for_some_seconds_or_until_the_next_frame(
    make: Callable[[], WindowOf],
) -> None:
    page = make()
    page.send("flight-correct", [0, SQUARE])
    left = page.work()
    assert left is not None
    page.clock += 15.0
    assert page.work() is None
    assert "Saved in" not in page.text
    page.send("flight-correct", [0, SQUARE])
    page.show(1)
    assert "Saved in" not in page.text
    page.show(0)
    assert "Saved in" not in page.text


def test_a_correction_wakes_the_windows_of_all_browsers_that_are_there(make: Callable[[], WindowOf]) -> None:
    first, second, gone = make(), make(), make()
    gone.window.leave()
    before = first.woken, second.woken, gone.woken
    first.send("flight-correct", [0, SQUARE])
    assert (first.woken > before[0], second.woken > before[1], gone.woken > before[2]) == (True, True, False)


def test_positions_are_saved_as_a_file_named_for_the_flight(make: Callable[[], WindowOf]) -> None:
    page = make()
    page.send("flight-save", ".geojson")
    name, contents = page.client.send_file_download.call_args.args
    assert name == "monday-positions.geojson"
    assert b"FeatureCollection" in contents


def test_a_resize_while_the_window_is_placed_is_followed(make: Callable[[], WindowOf]) -> None:
    page = make()
    panel = page.client.gui.add_panel.return_value
    page.viewport.resize(800, 700)
    panel.expand.side_effect = lambda: page.viewport.resize(1000, 900)
    page.work()
    panel.expand.side_effect = None
    page.work()
    assert panel.float.call_args.kwargs["width"] > 900
    count = panel.float.call_count
    page.work()
    assert panel.float.call_count == count


def test_a_wrong_answer_of_retrieval_is_told_apart_from_that_of_the_registration(make: Callable[[], WindowOf]) -> None:
    assert "Retrieval alone is wrong." in make().text
