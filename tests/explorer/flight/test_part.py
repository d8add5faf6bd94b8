"""The flight panel through the page's channel, on a flight that is opened over its map."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from explorer.app import App
from explorer.compute import own_photos
from explorer.opening import open_flight_over
from lpn.flight.files import write_flight
from lpn.flight.locate.corrections import NAME, read_corrections
from lpn.flight.locate.matchers import SiftMatcher
from lpn.sources import ModelOptions
from tests.explorer.conftest import Tab
from tests.lpn.flight.locate.scenery import land, small_flight, write_map
from tools.fixtures.waiting import TIMEOUT


class PanelTab(Tab):
    """A page with the flight panel: `last` has the panel's newest message of each kind, too."""

    def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        deadline = time.monotonic() + TIMEOUT
        while not holds(self.last):
            assert time.monotonic() < deadline, f"only {list(self.last)} came"
            message = json.loads(self.socket.recv(TIMEOUT))
            self.last |= message.get("panel", {}).get("message", message)
        return self.last

    def photo(self, frame: int) -> dict[str, Any]:
        """Wait for the drawing of a frame, and return it."""
        photo: dict[str, Any] = self.until(lambda last: last.get("photo", {}).get("frame") == frame)["photo"]
        return photo


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Iterator[tuple[App, Path]]:
    """The app on a flight over a map, and the flight's folder."""
    pytest.importorskip("rasterio")
    folder = tmp_path_factory.mktemp("flown")
    town = write_map(folder / "town.tif", land()[::2, ::2])
    (folder / "monday").mkdir()
    write_flight(small_flight(folder / "monday", town), folder / "monday")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        patch.setattr(own_photos, "open_matchers", lambda: [SiftMatcher()])
        workspace = open_flight_over(
            folder / "town.tif", folder / "monday", ModelOptions(model=model_file), query="05.png", register=False
        )
        served = App(workspace, "127.0.0.1", 0)
        yield served, folder / "monday"
        served.close()


@pytest.fixture
def tab(flown: tuple[App, Path]) -> Iterator[PanelTab]:
    connected = PanelTab(flown[0])
    yield connected
    connected.socket.close()


def test_the_panel_shows_the_flight_and_follows_the_photo(tab: PanelTab) -> None:
    tab.act("open", search="?panel=flight&flight_paint=all&flight_spot=0,0")
    first = tab.until(lambda last: last.get("scores") and "answer" in last and "spot" in last and "photo" in last)
    assert [one["name"] for one in first["page"]["panels"] if one["name"] == "flight"] == ["flight"]
    assert first["photo"]["frame"] == first["state"]["query"]
    assert first["flight"]["names"][first["photo"]["frame"]] == "05.png"
    assert first["scores"]["label"].endswith(", score")
    assert len(first["answer"]) == 3
    assert first["spot"]["spot"] == [0.0, 0.0]
    tab.send({"set": {"query": 3}})
    assert tab.photo(3)["card"]["name"] == first["flight"]["names"][3]
    tab.send({"set": {"flight_paint": "off", "flight_spot": ""}})
    tab.until(lambda last: last["scores"] is None and last["spot"] is None)
    tab.send({"set": {"flight_paint": "99"}})
    tab.until(lambda last: "flight_paint" in last.get("error", "").lower())
    assert tab.last["state"]["flight_paint"] == "off"


def test_a_result_has_the_mark_of_registration(tab: PanelTab) -> None:
    result = tab.open()
    (mark,) = [one for one in result["marks"] if one is not None]
    assert (mark["sign"], mark["text"]) == (None, "photo not placed"), "nothing is registered"


def test_a_correction_is_kept_for_all_tabs_and_forgotten(tab: PanelTab, flown: tuple[App, Path]) -> None:
    tab.act("open", search="?panel=flight")
    tab.send({"set": {"query": 4}})
    before = tab.photo(4)
    assert (before["corrected"], before["saves"]) == (False, 0)
    corners = [[0, 30], [40, 30], [40, 0], [0, 0]]
    for bad in (corners[:3], [*corners[:3], [None, 0]], [*corners[:3], [2e6, 0]], "corners", corners[::-1]):
        tab.act("flight.correct", frame=4, corners=bad)
        tab.until(lambda last: last.pop("error", "").startswith("Not saved."))
    assert not (flown[1] / NAME).exists()
    tab.act("flight.correct", frame=4, corners=corners)
    after = tab.until(lambda last: last["photo"]["corrected"])["photo"]
    assert after["saves"] == 1
    assert list(read_corrections(flown[1] / NAME)) == [tab.last["flight"]["names"][4]]
    tab.until(lambda last: "corrected" in last["flight"]["tracks"])
    tab.act("flight.forget", frame=4)
    tab.until(lambda last: not last["photo"]["corrected"])
    assert not read_corrections(flown[1] / NAME)
    tab.act("flight.forget", frame=4000)
    tab.act("flight.positions", suffix=".csv")
    tab.until(lambda last: "download" in last)
    assert tab.last["download"]["name"] == "monday-positions.csv"
    find = flown[0]._workspace(tab.last["state"]["place"]).feeds.find
    content = find(tab.last["download"]["address"].removeprefix("pictures/"))
    assert content().data.decode("utf-8-sig").startswith("frame,")


def test_an_own_photo_is_registered_over_the_map(tab: PanelTab) -> None:
    tab.act("open", search="?panel=flight")
    tab.photo(tab.until(lambda last: "result" in last)["state"]["query"])
    content = cv2.imencode(".png", land(3)[:120, :160])[1].tobytes()
    tab.act("upload", name="mine.png", size=len(content))
    tab.socket.send(content)
    waits = tab.until(lambda last: last.get("photo", {}).get("frame") == -1 and last["photo"]["own"])["photo"]
    assert waits["card"]["name"] == "mine.png"
    ended = tab.until(lambda last: "Being compared" not in last["photo"]["card"]["headline"])["photo"]
    assert ended["own"]["place"] is None, "it shows another land"
    assert ended["card"]["mark"] == "✗"
    tab.send({"set": {"own": ""}})
    tab.photo(tab.last["state"]["query"])
