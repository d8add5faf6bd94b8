"""What the page of a flight that goes on gets: frames, photos, and sentences, with bounded memory; and its messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from explorer.live_window import record as record_module
from explorer.live_window.messages import GreetLive, LivePageMessage, ResizeLive
from explorer.live_window.record import LiveRecord
from explorer.server.picture_route import PREFIX
from explorer.web.messages import decode
from lpn.live.outputs import LiveFix
from lpn.live.run import live_answer
from lpn.locate.located import LocatedFlight, LocatedFrame
from tests.explorer.flight_window.conftest import flight as flight


@pytest.fixture
def record(flight: LocatedFlight) -> Iterator[LiveRecord]:
    made = LiveRecord("live", flight.basemap)
    yield made
    made.forget()


def fix(located: LocatedFrame, colour: int = 200) -> LiveFix:
    pixels = np.full((60, 80, 3), colour, np.uint8)
    return LiveFix(located, live_answer(located), 47.0, 8.0, 1e9, 0.25, 2, None, pixels)


def served(record: LiveRecord, frame: int) -> Any:
    path = record.sight.pictures.address.removeprefix(PREFIX.lstrip("/")) + f"photo/{frame}"
    compute = record.find_picture(path)
    return None if compute is None else cv2.imdecode(np.frombuffer(compute().data, np.uint8), cv2.IMREAD_COLOR)


def test_frames_are_shown_as_they_come_with_their_photos(record: LiveRecord, flight: LocatedFlight) -> None:
    woken: list[int] = []
    record.watchers.watch(lambda: woken.append(1))
    assert record.sight.view is None
    record.count_windows(128, 3000)
    assert record.sight.status == "128 of 3,000 windows of the map are described"
    assert record.sight.described == (128, 3000)
    first, refused = flight.frames[0], flight.frames[2]
    record.send(fix(first))
    before = record.sight.view
    record.send(fix(refused, 90))
    record.note("Frames come again.")
    view = record.sight.view
    assert before is not None
    assert view is not None
    assert (len(before.flight.frames), len(view.flight.frames)) == (1, 2)
    assert view.beliefs[0].stage == "registration"
    assert view.flight.notes == ["Frames come again."]
    assert record.sight.status == "Answered in 0.25 s, 2 frames dropped"
    assert record.sight.described == (0, 0)
    assert [round(served(record, i).mean(), -1) for i in (0, 1)] == [200, 90]
    assert served(record, 2) is None
    assert len(woken) == 4


def test_old_frames_are_forgotten_and_photos_get_other_addresses(
    record: LiveRecord, flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_module, "MOST", 4)
    for i in range(4):
        record.send(fix(flight.frames[0], 40 * i))
    address = record.sight.pictures.address
    old = record.sight.view.flight.frames[0].frame.file  # type: ignore[union-attr]
    record.send(fix(flight.frames[0], 160))
    view = record.sight.view
    assert view is not None
    assert len(view.flight.frames) == 3
    assert record.sight.pictures.address != address
    assert not old.exists()
    assert round(served(record, 2).mean(), -1) == 160


def test_a_frame_that_is_kept_does_not_change_the_one_that_was_located(
    record: LiveRecord, flight: LocatedFlight
) -> None:
    located = replace(flight.frames[0])
    file = located.frame.file
    record.send(fix(located))
    assert located.frame.file == file


def test_messages_of_the_page_are_checked() -> None:
    assert decode(LivePageMessage, "viewport", [800, 600]) == ResizeLive(800, 600)
    assert decode(LivePageMessage, "viewport", [0, 600]) is None
    assert isinstance(decode(LivePageMessage, "hello", {"viewport": None}), GreetLive)
    assert decode(LivePageMessage, "hello", "text") is None
