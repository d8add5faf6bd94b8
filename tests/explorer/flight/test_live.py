"""What the page of a flight that goes on gets: frames, photos, and sentences, with bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from explorer.flight import live
from explorer.flight.live import LiveRecord
from explorer.server.picture_route import PREFIX
from lpn.flight.live.run import LiveFix, live_answer
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from tools.fixtures.waiting import wait_until


@pytest.fixture
def record(flight: LocatedFlight) -> Iterator[LiveRecord]:
    made = LiveRecord("live", flight.basemap)
    yield made
    made.forget()


def fix(located: LocatedFrame, colour: int = 200) -> LiveFix:
    pixels = np.full((60, 80, 3), colour, np.uint8)
    return LiveFix(located, live_answer(located), 47.0, 8.0, 1e9, 0.25, 2, None, pixels)


def served(record: LiveRecord, frame: int) -> Any:
    compute = record.feeds.find(f"{record.sight.addresses['photo'].removeprefix(PREFIX.lstrip('/'))}{frame}")
    return cv2.imdecode(np.frombuffer(compute().data, np.uint8), cv2.IMREAD_COLOR)


def test_frames_are_shown_as_they_come_with_their_photos(record: LiveRecord, flight: LocatedFlight) -> None:
    woken: list[int] = []
    record.watchers.watch(lambda: woken.append(1))
    assert record.sight.seen is None
    record.count_windows(128, 3000)
    assert record.sight.status == "128 of 3,000 windows of the map are described"
    first, refused = flight.frames[0], flight.frames[2]
    record.send(fix(first))
    before = record.sight.seen
    record.send(fix(refused, 90))
    record.note("Frames come again.")
    view = record.sight.seen
    assert (len(before.flight.frames), len(view.flight.frames)) == (1, 2)
    assert view.verdicts[0].stage == "registration"
    assert view.flight.notes == ["Frames come again."]
    assert record.sight.status == "Answered in 0.25 s, 2 frames dropped"
    assert [round(served(record, i).mean(), -1) for i in (0, 1)] == [200, 90]
    assert served(record, 2) is None
    assert len(woken) == 4


def test_old_frames_are_forgotten_and_photos_get_other_addresses(
    record: LiveRecord, flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "MOST", 4)
    for i in range(4):
        record.send(fix(flight.frames[0], 40 * i))
    address = record.sight.addresses["photo"]
    old = record.sight.seen.flight.frames[0].frame.file
    record.send(fix(flight.frames[0], 160))
    view = record.sight.seen
    assert len(view.flight.frames) == 3
    assert record.sight.addresses["photo"] != address
    assert not old.exists()
    assert round(served(record, 2).mean(), -1) == 160


def test_a_frame_that_is_kept_does_not_change_the_one_that_was_located(
    record: LiveRecord, flight: LocatedFlight
) -> None:
    located = replace(flight.frames[0])
    file = located.frame.file
    record.send(fix(located))
    assert located.frame.file == file


class Page:
    """A tab's end: the newest message of each kind."""

    def __init__(self, record: LiveRecord) -> None:
        self.last: dict[str, Any] = {}
        self.session = record.session(self.take)

    def take(self, message: dict[str, Any]) -> None:
        self.last |= message.get("panel", {}).get("message", message)

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> None:
        wait_until(lambda: holds(self.last))


def test_a_tab_follows_the_newest_frame_until_a_person_chooses_another(
    record: LiveRecord, flight: LocatedFlight
) -> None:
    page = Page(record)
    page.session.receive({"do": "open", "args": {}})
    page.until(lambda last: last.get("progress") == "No frame has come yet")
    assert page.last["page"]["panels"][0]["name"] == "flight"
    assert page.last["state"]["flight_over"] == "swipe"
    assert "flight" not in page.last
    for number in range(3):
        record.send(fix(flight.frames[0]))
        page.until(lambda last, newest=number: last.get("photo", {}).get("frame") == newest)
    page.session.receive({"do": "step", "args": {"by": -1}})
    page.until(lambda last: last["photo"]["frame"] == 1)
    record.send(fix(flight.frames[0]))
    page.until(lambda last: len(last["flight"]["names"]) == 4)
    assert page.last["photo"]["frame"] == 1
    page.session.receive({"set": {"query": 3}})
    record.send(fix(flight.frames[0]))
    page.until(lambda last: last["photo"]["frame"] == 4)
    page.session.receive({"set": {"flight_over": "off", "flight_spot": [-20, 0]}})
    page.until(lambda last: (last.get("spot") or {}).get("frames") == [0, 1, 2, 3, 4])
    assert page.last["state"]["flight_over"] == "off"
    page.session.receive({"set": {"flight_over": "sideways"}})
    page.until(lambda last: "sideways" not in str(last["state"]) and "flight_over" in last.get("error", ""))
    page.session.leave()
