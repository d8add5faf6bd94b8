"""A short soak on drawn places: several clients and a real page at once, and every answer checked. Nothing here is timed."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from explorer.app import App
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, StateAnalysis
from lpn.core.files import write_atomic
from tools.fixtures import small_worlds
from tools.soak.asked import Asked
from tools.soak.chromium import Tab
from tools.soak.hand import FaultError, StoppedError
from tools.soak.record import Record
from tools.soak.reference import Reference
from tools.soak.run import Soak
from tools.soak.script import Client


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Places that are seen in both directions."""
    return small_worlds.map_dataset(small_worlds.make_dataset(tmp_path_factory.mktemp("soak") / "places"))


def test_many_at_once_are_each_answered_rightly_and_leave_nothing_behind(
    places: Path, model_file: Path, tmp_path: Path
) -> None:
    options = ["--data", str(places), "--model", str(model_file)]
    said: list[str] = []
    soak = Soak(places, model_file, options, clients=8, pages=1, seed=0, alone=5, together=55, say=said.append)
    figures = soak.run()
    assert not figures.faults, figures.faults
    assert not figures.tracebacks
    assert figures.wrong == 0
    assert figures.unchecked == 0
    assert {time.who for time in figures.times} == {f"client {i}" for i in range(9)} | {"page 1"}
    assert figures.checked >= 3 * 9
    left, (threads, handles) = figures.memory.left, figures.memory.most()
    if left is not None:
        assert left.threads <= threads, figures.memory
        assert left.handles <= handles, figures.memory
    write_atomic(tmp_path / "soak.json", figures.json())
    assert json.loads((tmp_path / "soak.json").read_text())["checked"] == figures.checked


@contextmanager
def page_of(places: Path, model_file: Path, browser: Browser, stop: threading.Event) -> Iterator[tuple[Tab, Reference]]:
    """A page of an app in this process."""
    served, reference = App(open_model(places, model_file), "127.0.0.1", 0), Reference(places, model_file)
    tab = Tab(browser, f"http://127.0.0.1:{served.server.get_port()}", reference, stop)
    try:
        yield tab, reference
    finally:
        tab.leave("close")
        served.close()


def entered(tab: Tab, reference: Reference) -> Asked:
    asked = replace(reference.first(), query=3, angle=20.0)
    tab.enter(f"task={asked.task}&query=~3&angle=20")
    tab.settle(asked, [reference.first()])
    return asked


def test_a_page_notices_anothers_state_even_when_the_right_one_follows(
    places: Path, model_file: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page_of(places, model_file, browser, threading.Event()) as (tab, reference):
        asked = entered(tab, reference)
        tab.fill("Rotate", 30.0)
        asked = replace(asked, angle=30.0)
        assert reference.flaws(asked, tab.settle(asked).shown) == []
        right, seen = StateAnalyser.analyse, []

        def another(self: StateAnalyser, state: SessionState, k: int) -> StateAnalysis:
            seen.append(state)
            if len(seen) > 1:
                time.sleep(2)  # what is replaced before the page has drawn it is not shown
                return right(self, state, k)
            return right(self, replace(state, weights=(0.5, 1.0, 1.0, 1.0)), k)

        monkeypatch.setattr(StateAnalyser, "analyse", another)
        tab.fill("Rotate", 31.0)
        tab.fill("Rotate", 40.0)
        asked = replace(asked, angle=40.0)
        with pytest.raises(FaultError, match=r"foreign state.*weights=0.5,1,1,1"):
            tab.settle(asked, [replace(asked, angle=31.0)])


def test_an_answer_in_a_page_is_timed_from_the_last_move_of_the_mouse(
    places: Path, model_file: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page_of(places, model_file, browser, threading.Event()) as (tab, reference):
        asked = entered(tab, reference)
        monkeypatch.setattr("tools.soak.chromium.RATE", 2.0)  # it rests half a second where the drag ends
        left = tab.drag("Rotate", [90.0])
        passed = [replace(asked, angle=float(angle)) for angle in range(-180, 181)]
        assert tab.settle(replace(asked, angle=left), passed).seconds > 0.45


def test_a_page_waits_at_the_end_of_a_soak_for_what_it_asked(places: Path, model_file: Path, browser: Browser) -> None:
    stop = threading.Event()
    with page_of(places, model_file, browser, stop) as (tab, reference):
        asked = entered(tab, reference)
        tab.fill("Rotate", 40.0)
        stop.set()
        asked = replace(asked, angle=40.0)
        assert reference.flaws(asked, tab.settle(asked).shown) == []
        record = Record(reference)
        with pytest.raises(StoppedError):
            Client("page 1", 0, tab, reference, record, stop, stays=False)._act()
        record.close()
