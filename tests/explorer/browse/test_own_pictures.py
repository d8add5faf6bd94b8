from __future__ import annotations

import io
import json
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from explorer import session_state, uploads
from explorer.browse import own_pictures
from explorer.browse.feeds import Feeds
from explorer.browse.messages import MOST, BrowseMessage
from explorer.browse.own_pictures import OwnPictures
from explorer.compute.background_jobs import BackgroundJob
from explorer.opening import open_model
from explorer.panels import answer_text
from explorer.panels.navigation import Navigation
from explorer.server.picture_route import PREFIX
from explorer.session_state import SessionState, StateChange
from explorer.web.messages import Receivers
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.errors import PictureError
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.library.analyser import OwnPicture
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    data = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path_factory.mktemp("own") / "places"))
    return open_model(data, model_file)


def photo(number: int, place: tuple[float, float] | None = None) -> bytes:
    """A JPEG of a place, with the camera's position in its EXIF."""
    file, picture = io.BytesIO(), Image.fromarray(small_worlds.place(number))
    exif = Image.Exif()
    if place is not None:
        latitude, longitude = place
        exif[0x8825] = {1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0)}
    picture.save(file, "JPEG", exif=exif)
    return file.getvalue()


class Page:
    """One browser's own pictures, its state, and what its page shows."""

    def __init__(self, workspace: Workspace, place: str = "data") -> None:
        self.contents: list[SimpleNamespace] = []
        self.errors: list[tuple[str, str]] = []
        self.state = SessionState(TASK, 4)
        self.feeds = Feeds(workspace)
        gui = SimpleNamespace(add_html=self._add)
        self.own = OwnPictures(gui, self.feeds, self.change, lambda *error: self.errors.append(error), place)  # type: ignore[arg-type]
        self.send = Receivers({BrowseMessage: self.own.receive}).hand_on

    def _add(self, content: str) -> SimpleNamespace:
        self.contents.append(SimpleNamespace(content=content))
        return self.contents[-1]

    def change(self, change: StateChange) -> None:
        self.state = change(self.state) or self.state
        self.own.show(self.state)

    @property
    def shell(self) -> str:
        return " ".join(self.contents[0].content.split())

    @property
    def asked(self) -> str:
        """The last call that asks the page for a file."""
        return str(self.contents[2].content)


@pytest.fixture
def page(workspace: Workspace) -> Page:
    return Page(workspace)


def test_one_picture_is_a_query_at_once(page: Page) -> None:
    page.own.take("a.jpg", photo(3))
    assert page.state.upload is not None
    assert page.state.upload.name == "a.jpg"
    assert page.own.index_of(page.state.upload) == 0
    assert "1 of your own" in page.shell
    assert "chosen&#34;: 0" in page.contents[1].content.replace("\\", "")
    page.change(lambda state: session_state.choose_query(state, 2, 14))
    assert "chosen&#34;: -1" in page.contents[1].content.replace("\\", ""), "a query of the data set is shown"
    page.own.take("b.txt", b"no picture")
    assert page.errors == [
        ("Upload failed", "b.txt is not a picture that can be read; expected a JPEG, PNG, or WebP file.")
    ]
    assert "1 of your own" in page.shell


def test_many_pictures_are_asked_for_one_by_one_and_all_bad_files_are_in_one_list(page: Page) -> None:
    page.send("own-begin", [3, [["big.jpg", "large"], ["notes.txt", "kind"]], 4])
    assert "own.go(0,3,1)" in page.asked
    page.own.take("a.jpg", photo(3))
    assert "own.go(1,3,2)" in page.asked
    page.own.take("broken.jpg", photo(3)[:200])
    assert page.state.upload is None
    page.own.take("c.jpg", photo(5, (46, 7)))
    assert page.state.upload is not None
    assert page.state.upload.name == "a.jpg"
    assert "2 of your own" in page.shell
    assert "1 with a position" in page.shell
    for said in ("4 left out", "big.jpg has more than 30 MB", "notes.txt is not a JPEG", "4 further", "broken.jpg"):
        assert said in page.shell
    assert "2 pictures of your own are read: N and P step. 4 left out: Show everything lists them." in page.asked
    assert not page.errors
    again = page.own.step(page.state, 1)
    assert again is not None
    assert again.upload is not None
    assert (again.upload.name, again.upload.place) == ("c.jpg", (46, 7))
    page.send("own-pick", ["own", 0])
    assert page.state.upload.name == "a.jpg"
    feed = page.feeds.find(f"/{page.feeds.address}{page.own._feed[1]}0".removeprefix(PREFIX))
    assert feed is not None
    assert json.loads(feed().data) == [[0, "a.jpg", None], [1, "c.jpg", None]]
    page.send("own-close", None)
    assert page.state.upload is None
    assert page.shell == ""


def test_the_bar_ends_where_the_first_picture_of_a_batch_cannot_be_opened(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise PictureError("a.jpg cannot be decoded.")

    monkeypatch.setattr(page.own, "_open", fail)
    page.send("own-begin", [2, [], 0])
    for name in ("a.jpg", "b.jpg"):
        page.own.take(name, photo(3))
    assert "work(0,0)" in page.asked
    assert page.errors == [("Not opened", "a.jpg cannot be decoded.")]
    assert page.state.upload is None


def test_the_bar_ends_where_all_pictures_are_closed_before_the_batch_does(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.own.take("before.jpg", photo(2))
    page.send("own-begin", [1, [], 0])
    after_reading = page.own._next
    monkeypatch.setattr(page.own, "_next", lambda: (page.own.close(), after_reading()))
    page.own.take("a.jpg", photo(3))
    assert "work(0,0)" in page.asked
    assert not page.errors


def test_next_and_previous_step_through_ones_own_pictures(page: Page, workspace: Workspace) -> None:
    navigation = Navigation(workspace, lambda *_: None)
    navigation.step_own = page.own.step
    page.own.take("a.jpg", photo(1))
    moved = navigation.next(page.state)
    assert moved.upload is None  # one alone is left for the data set's queries
    page.own.take("b.jpg", photo(2))
    names = []
    for step in (navigation.next, navigation.next, navigation.previous):
        page.change(step)
        assert page.state.upload is not None
        names.append(page.state.upload.name)
    assert names == ["a.jpg", "b.jpg", "a.jpg"]


def test_a_picture_is_found_by_its_key_until_it_is_closed(page: Page) -> None:
    keys = []
    for number in (1, 2):
        page.own.take(f"{number}.jpg", photo(number))
        assert page.state.upload is not None
        keys.append(page.state.upload.key)
    for number, key in enumerate(keys):
        picture = page.own.find(key)
        assert picture is not None
        assert picture.key == key
        assert page.own.position(picture) == (number, 2)
    assert page.own.find("") is None
    page.own.close()
    assert page.own.find(keys[0]) is None


@pytest.mark.parametrize(
    "value",
    [None, 3, [1], [-1, [], 0], [MOST + 1, [], 0], [1, [["a"]], 0], [1, [["a", 3]], 0], [1, [], -1], ["1", [], 0]],
)
def test_a_wrong_batch_asks_for_nothing(page: Page, value: object) -> None:
    page.send("own-begin", value)
    assert page.asked == ""
    for index in (None, 0, ["own", 0], ["own", -1], ["own", True], ["own", "0"]):
        page.send("own-pick", index)
    assert page.state.upload is None


def test_no_more_pictures_are_held_than_are_allowed(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_pictures, "MOST", 2)
    page.send("own-begin", [3, [], 0])
    assert "own.go(0,2,1)" in page.asked
    for number in range(2):
        page.own.take(f"{number}.jpg", photo(number))
    assert "1 pictures are left out: 2 are held" in page.shell
    page.own.take("late.jpg", photo(3))
    assert "late.jpg is beyond" in page.errors[0][1]


def test_the_pictures_of_all_browsers_together_are_bounded(
    page: Page, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = own_pictures.held_bytes
    before = held.total
    page.own.take("first.jpg", photo(1))
    size = held.total - before
    assert size > 1000
    monkeypatch.setattr(own_pictures, "_MOST_BYTES", before + int(1.5 * size))
    other = Page(workspace)
    other.own.take("second.jpg", photo(1))
    ((title, text),) = other.errors
    assert title == "Upload failed"
    assert text.startswith(
        "second.jpg takes 0.0 MB, and the server holds 0 MB of its visitors' pictures; up to 0 MB are held"
    )
    assert text.endswith("so close yours, or send it later.")
    assert other.state.upload is None
    other.send("own-begin", [2, [], 0])
    other.own.take("second.jpg", photo(1))
    page.send("own-close", None)
    other.own.take("third.jpg", photo(1))
    assert "1 of your own" in other.shell
    assert "second.jpg takes" in other.shell
    other.own.leave()
    assert held.total == before
    other.own.take("late.jpg", photo(1))
    assert held.total == before, "a browser that left holds nothing"


def test_a_file_that_the_page_cannot_read_is_named_and_the_next_is_asked_for(page: Page) -> None:
    page.send("own-begin", [3, [["gone folder", "unread"]], 0])
    page.own.take("a.jpg", photo(3))
    for wrong in (None, 1, [0, "early"], [2, "late"], [1], [1, 3], [True, "x"], ["1", "x"]):
        page.send("own-skip", wrong)
    assert "own.go(1,3,2)" in page.asked
    page.send("own-skip", [1, "gone.jpg"])
    assert "own.go(2,3,3)" in page.asked
    page.send("own-skip", [2, "x" * 90])
    page.send("own-skip", [3, "after the end"])
    assert page.state.upload is not None
    assert "gone folder cannot be read by the browser" in page.shell
    assert (
        "gone.jpg cannot be read by the browser; check that it is still there and that you may read it." in page.shell
    )
    assert f"{'x' * 80} cannot" in page.shell
    assert "3 left out" in page.shell
    page.send("own-begin", [1, [], 0])
    page.send("own-skip", [0, "only.jpg"])
    assert page.errors == [("No picture was taken", "1 files were left out; the list is below the button.")]


def test_a_large_file_is_held_small_and_shown_the_same(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_pictures, "_SMALL", 100)
    content = photo(4)
    for name in ("a.jpg", "b.jpg"):
        page.own.take(name, content)
    first = page.state.upload
    page.send("own-pick", ["own", 0])
    again = page.state.upload
    assert first is not None
    assert again is not None
    assert again is not first
    assert dict(again.facts)["SHA-256"] == sha256(content).hexdigest(), "it is that of the file that was sent"
    assert np.abs(again.picture.astype(int) - first.picture).mean() < 4


def test_the_next_session_of_a_page_holds_its_pictures_with_those_it_had_counted(workspace: Workspace) -> None:
    first, second, before = Page(workspace), Page(workspace, "flight"), own_pictures.held_bytes.total
    for number, name in enumerate(("a.jpg", "b.jpg", "c.jpg")):
        first.own.take(name, photo(number))
    first.send("own-pick", ["own", 1])
    assert first.state.upload is not None
    counted = own_pictures.held_bytes.total
    assert not first.own.brought
    second.own.take_over(first.own.hand_over())
    assert second.own.brought
    first.own.leave()
    assert (first.own.held, second.own.held) == (0, 3)
    assert own_pictures.held_bytes.total == counted > before
    assert "3 of your own" in second.shell
    again, found = second.own.reopen(second.state), second.own.find(first.state.upload.key)
    assert again is not None
    assert again.upload is found
    assert found is not None
    assert found.name == "b.jpg"
    back = Page(workspace)
    back.own.take_over(second.own.hand_over())
    assert not back.own.brought, "the picture was sent here"
    second.own.leave()
    back.own.leave()
    assert own_pictures.held_bytes.total == before


def test_a_picture_that_is_read_while_all_are_closed_is_not_taken(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.jpg", "b.jpg"):
        page.own.take(name, photo(1))
    page.send("own-begin", [2, [], 0])
    read = uploads.read

    def closed_meanwhile(name: str, content: bytes) -> OwnPicture:
        page.own.close()
        return read(name, content)

    monkeypatch.setattr(uploads, "read", closed_meanwhile)
    page.own.take("c.jpg", photo(2))
    page.own.take("broken.jpg", b"no picture")
    assert page.state.upload is None
    assert page.shell == ""


def test_a_small_file_of_many_pixels_is_held_as_it_is_shown(page: Page) -> None:
    file = io.BytesIO()
    Image.new("RGB", (uploads.MAX_SIDE + 400, 1000), (40, 90, 60)).save(file, "PNG")
    page.own.take("wide.png", file.getvalue())
    page.own.take("b.jpg", photo(2))
    page.send("own-pick", ["own", 0])
    assert page.state.upload is not None
    assert page.state.upload.name == "wide.png"
    assert max(page.state.upload.picture.shape) == uploads.MAX_SIDE


def test_a_position_tells_the_distance_to_each_tile(page: Page, workspace: Workspace) -> None:
    geometry = workspace.tasks[TASK].geometry
    assert geometry is not None
    page.own.take("here.jpg", photo(3, (46, 7)))
    analysis = StateAnalyser(workspace).analyse(page.state, 3)
    tile = geometry.tiles[analysis.matches[0].index]
    expected = geo.metres([Position(46, 7)], [tile])
    assert analysis.errors_m is not None
    np.testing.assert_allclose(analysis.errors_m[analysis.matches[0].index], expected)
    assert f"Its GPS tag lies {float(expected[0]):,.0f} m from" in answer_text.verdict(analysis, workspace)[2]
    page.own.take("far.jpg", photo(3, (52, 7)))
    analysis = StateAnalyser(workspace).analyse(page.state, 3)
    for said in (answer_text.verdict(analysis, workspace), answer_text.plain_verdict(analysis, workspace)):
        assert "not one of these" in said[1].lower()
        assert "km from the nearest of them, so no answer can be right" in said[2]
    may_end = threading.Event()
    job: BackgroundJob[Any] = BackgroundJob(lambda _: may_end.wait(60), None)
    said = answer_text.verdict(replace(analysis, own_photo=job), workspace)
    may_end.set()
    assert said[:2] == (None, "Being compared with the map"), "no answer is final before that"
    assert re.fullmatch(r"Your picture's GPS tag lies [\d,]+ km from this map\.", said[2]), "no piece of it is told of"
    nowhere: Callable[[], None] = lambda: page.own.take("there.jpg", photo(3))  # noqa: E731
    nowhere()
    assert StateAnalyser(workspace).analyse(page.state, 3).errors_m is None
