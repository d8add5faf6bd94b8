"""The page and its channel, for a browser and for other clients."""

from __future__ import annotations

import asyncio
import gzip
import json
import re
import threading
from base64 import b64decode
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from explorer.app import App
from explorer.compute.background_jobs import BackgroundJob
from explorer.screen import route
from explorer.screen.channel import Outbox
from explorer.screen.own import OwnPhotoBytes
from explorer.screen.scene.tab import TabScene
from explorer.screen.session import ScreenSession
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.errors import DataError
from lpn.explain.occlusion import occlude
from lpn.library.analyser import OwnPicture
from tests.explorer.conftest import TAB, Tab, get
from tools.fixtures.waiting import TIMEOUT, wait_until

PAGE = Path(route.__file__).parent / "page"


def test_the_page_and_its_files_are_served_with_a_policy_that_runs_only_its_own_scripts(app: App) -> None:
    status, headers, body = get(app, "/?query=0003")
    assert status == 200
    assert b"viser" not in body
    assert "script-src 'self';" in headers["Content-Security-Policy"]
    assert b"<script>" not in body
    assert b"onclick" not in body
    for name in (b"screen/page/screen.css", b"screen/page/bundle.js"):
        assert name in body
        assert get(app, f"/{name.decode()}")[0] == 200
    assert get(app, "/screen/page/nothing.js")[0] == 404
    assert get(app, "/screen/page/../session.py")[0] == 404
    assert b"viser" in get(app, f"/scene/{TAB}/")[2].lower()
    assert b"viser" not in get(app, "/classic/")[2].lower()


def test_the_bundle_has_each_module_once_and_no_name_twice(app: App) -> None:
    bundle = get(app, "/screen/page/bundle.js")[2].decode()
    assert not re.findall("^import ", bundle, re.MULTILINE)
    for file in PAGE.glob("*.js"):
        text = file.read_text("utf-8")
        within = bundle.count(text.partition("\n")[0])
        shown = 'export * from "./bundle.js";' if within else text
        assert within <= 1, file.name
        assert get(app, f"/screen/page/{file.name}")[2].decode() == shown, file.name
    named = re.findall(r"^(?:export )?(?:const|let|class) (\w+|\[[^\]]*\]|\{[^}]*\})", bundle, re.MULTILINE)
    names = [name for group in named for name in re.findall(r"\w+", group)]
    assert {name for name in names if names.count(name) > 1} == set()
    assert {"find", "tip", "Panels", "press"} <= set(names)


def test_the_page_gets_the_meanings_of_terms_and_panels_name_no_others(app: App) -> None:
    status, headers, body = get(app, "/screen/terms.json")
    assert (status, headers.get_content_type()) == (200, "application/json")
    meanings = json.loads(body)
    assert meanings["distance"].startswith("d², the squared distance of two descriptors")
    sources = "".join(file.read_text("utf-8") for file in PAGE.parents[1].rglob("*") if file.suffix in (".js", ".py"))
    named = set(re.findall(r'\bterm(?:\(|=)"([^"]+)"', sources))
    assert {"part"} <= named - {"{}"} <= set(meanings)


def test_a_browser_gets_a_file_again_only_if_it_has_changed(app: App) -> None:
    _, headers, packed = get(app, "/screen/page/bundle.js", Accept_Encoding="gzip")
    assert headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(packed) == get(app, "/screen/page/bundle.js")[2]
    assert get(app, "/screen/page/bundle.js", If_None_Match=headers["ETag"])[0] == 304


def test_a_page_opens_with_all_that_it_shows(app: App, tab: Tab, workspace: Workspace) -> None:
    result = tab.open("?query=0004&angle=15")
    assert (result["state"]["query"], result["angle"]) == (2, 15)
    assert tab.last["page"]["parts"] == 4
    assert tab.last["page"]["models"][1] == "the baseline (n = 1)"
    rail = tab.until(lambda last: "rail" in last)["rail"]
    assert (rail["total"], rail["chosen"]) == (8, 2)
    status, _, body = get(app, "/" + rail["address"] + rail["feed"] + "0")
    entries = json.loads(body)
    ranks = workspace.rankings["drone-to-satellite"].ranks + 1
    assert status == 200
    assert [entry[2] for entry in entries] == ranks.tolist()
    for address in (result["photo"]["src"], result["tiles"][str(result["answer"])]["src"], rail["thumbnails"] + "0"):
        status, headers, picture = get(app, "/" + address)
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        assert images.decode_picture(picture, "it").ndim == 3


def test_fields_are_set_and_actions_done(tab: Tab) -> None:
    tab.open()
    tab.set(angle=30.04)
    assert tab.result(angle=30.04)["angle"] == 30.04
    tab.act("step", by=1)
    assert tab.result(query=1)["angle"] == 0
    tab.act("step", by=-1)
    tab.result(query=0)
    tab.act("random")
    assert tab.until(lambda last: last["result"]["state"]["query"] > 0)
    tab.set(angle="x", theme="light")
    tab.error("Angle: expected a number")
    assert tab.last["state"]["theme"] == "light"
    tab.set(model="1")
    assert len(tab.result(model="1")["rows"]) == 1
    assert tab.last["page"]["parts"] == 1


def test_the_worst_missed_query_is_shown_once_a_long_ranking_knows_it(
    tab: Tab, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranking, done = workspace.rankings["drone-to-satellite"], threading.Event()
    result, worst = ranking.result, int(ranking.ranks.argmax())
    found = int(np.flatnonzero(ranking.ranks == 0)[0])

    def wait(seconds: float) -> bool:
        if done.wait(seconds):
            monkeypatch.setattr(ranking, "result", result)
        return done.is_set()

    monkeypatch.setattr(ranking, "result", None)
    monkeypatch.setattr(ranking, "join", lambda _: SimpleNamespace(wait=wait))
    tab.open(f"?query=~{found}")
    tab.set(filter="missed")
    rail = tab.until(lambda last: "rail" in last and last["rail"]["worst_first"])["rail"]
    assert (rail["total"], tab.last["state"]["query"]) == (0, found)
    done.set()
    tab.result(query=worst)


def test_the_curve_has_the_rank_of_each_angle_as_its_result_has(tab: Tab) -> None:
    tab.open("?query=0003")
    curve = tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)["curve"]
    assert curve["sequence"] == tab.last["result"]["curve"]
    for angle in (-180, 45):
        tab.set(angle=angle)
        result = tab.result(angle=angle)
        point = next(one for one in curve["points"] if one[0] == angle)
        assert point == [angle, result["rank"], result["nearest"]]


def test_occlusion_is_measured_square_by_square_and_shown_again_at_once(tab: Tab, workspace: Workspace) -> None:
    result = tab.open("?query=0005&shows=occlusion")
    assert result["tiles"][str(result["answer"])]["heat"] is None, "the photo alone is covered"
    shown = tab.until(lambda last: last.get("occlusion", {}).get("done") == 64)["occlusion"]
    assert shown["number"] == result["number"]
    task, model = workspace.tasks["drone-to-satellite"], workspace.model
    tile = workspace.tile(task, result["answer"])
    picture = images.load_picture(task.queries[3].path)
    losses = list(occlude(model.for_task(*task.views), picture, "drone", tile.descriptor))[-1][1]
    lost = losses.mean(axis=0)
    photo = shown["photo"]
    size = photo["parts"]["rows"], photo["parts"]["columns"]
    cells = (np.frombuffer(b64decode(photo["heat"]), np.uint8).astype(float).reshape(size) - 128) / 127
    assert np.abs(cells - images.enlarge(lost, *size) / np.abs(lost).max()).max() < 0.02
    del tab.last["occlusion"]
    tab.set(compare=result["strip"][2])
    again = tab.until(lambda last: "occlusion" in last)["occlusion"]
    assert again["done"] == 64
    assert again["photo"]["heat"] == photo["heat"]


def test_a_place_that_cannot_be_opened_is_named_and_the_page_stays(tab: Tab) -> None:
    tab.open()
    tab.set(place="broken")
    tab.error("The map is not there; give another.")
    tab.set(angle=5)
    assert tab.result(angle=5)["state"]["place"] == "data"
    other = tab.open("?show=broken&query=0003")
    assert other["state"]["place"] == "data"


def test_beside_a_baseline_stands_the_rank_of_the_other_model(tab: Tab, workspace: Workspace) -> None:
    ranks = workspace.rankings["drone-to-satellite"].ranks + 1
    for query in range(3):
        result = tab.open(f"?model=1&query=~{query}")
        assert result["beside"] == [[workspace.model_name, ranks[query]]]
    tab.set(angle=30)
    assert tab.result(angle=30)["beside"] == [], "the ranks are those of upright photos"


def test_the_word_missed_lists_the_missed_queries_that_a_text_names(tab: Tab, workspace: Workspace) -> None:
    tab.open()
    ranking = workspace.rankings["drone-to-satellite"]
    missed = [name for name, rank in zip(ranking.task.query_names, ranking.ranks, strict=True) if rank > 0]
    assert 0 < len(missed) < len(ranking.ranks)
    tab.set(find="Missed")
    tab.until(lambda last: last.get("rail", {"total": 0})["total"] == len(missed))
    tab.set(find=f"missed {missed[0]}")
    tab.until(lambda last: last["rail"]["total"] == 1)


def test_an_angle_of_the_curve_needs_no_further_pass_in_any_tab(
    app: App, tab: Tab, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    tab.open("?query=0006")
    tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)
    other = Tab(app, TAB[::-1])
    with monkeypatch.context() as patch:
        patch.setattr(workspace.inference, "run", lambda *_: pytest.fail("a pass"))
        for one in (tab, other):
            result = one.open("?query=0006&angle=45")
            assert result["angle"] == 45
            assert result["photo"]["heat"]
    tab.set(angle=46)
    assert tab.result(angle=46)["photo"]["heat"] != result["photo"]["heat"]
    other.socket.close()


def send_file(tab: Tab, name: str, content: bytes, first: bool = True) -> int:
    """Send a file as the page does, wait for the server to take it or leave it out, and return the number of such files."""
    before = tab.until(lambda last: "yours" in last)["yours"]["taken"]
    tab.act("upload", name=name, size=len(content), first=first)
    for start in range(0, len(content), 5000):
        tab.socket.send(content[start : start + 5000])
    taken: int = tab.until(lambda last: last["yours"]["taken"] > before)["yours"]["taken"]
    return taken


def test_own_photos_are_listed_ranked_stepped_through_and_forgotten(app: App, tab: Tab, workspace: Workspace) -> None:
    tab.open()
    queries = workspace.tasks["drone-to-satellite"].queries
    assert send_file(tab, "one.png", queries[3].path.read_bytes()) == 1
    first = tab.until(lambda last: last["result"]["state"]["own"])["result"]
    assert first["photo"]["own"]
    assert first["headline"]["found"] is None
    assert get(app, "/" + first["photo"]["src"])[0] == 200
    assert "query" not in tab.last["state"]["address"]
    assert send_file(tab, "notes.txt", b"words", first=False) == 2
    tab.error("notes.txt is not a picture")
    assert send_file(tab, "two.png", queries[5].path.read_bytes(), first=False) == 3
    yours = tab.last["yours"]
    assert [name for _, _, name in yours["photos"]] == ["one.png", "two.png"]
    for number, _, _ in yours["photos"]:
        status, headers, _ = get(app, f"/{yours['thumbnails']}{number}")
        assert (status, headers.get_content_type()) == (200, "image/jpeg")
    (_, one, _), (_, two, _) = yours["photos"]
    assert tab.last["state"]["own"] == one, "the first of several is shown"
    tab.act("step", by=1)
    second = tab.result(own=two)
    tab.act("step", by=-1)
    again = tab.result(own=one)
    assert again["photo"]["heat"] == first["photo"]["heat"]
    assert [again["tiles"][str(index)]["distance"] for index in again["strip"]] == [
        first["tiles"][str(index)]["distance"] for index in first["strip"]
    ]
    assert second["photo"]["heat"] != first["photo"]["heat"]
    tab.act("step", by=-1)
    tab.set(own=two)
    tab.result(own=two)
    tab.act("step", by=1)
    tab.result(own="", query=0)
    tab.act("forget")
    tab.until(lambda last: not last["yours"]["photos"])
    tab.set(own=two, angle=7)
    tab.result(own="", angle=7)


def test_files_that_are_no_pictures_or_too_large_are_refused_in_one_sentence(tab: Tab) -> None:
    tab.open()
    send_file(tab, "notes.txt", b"words")
    tab.error("notes.txt is not a picture")
    tab.act("upload", name="large.jpg", size=40_000_000, first=False)
    assert tab.error() == "2 files are no photos that can be read: notes.txt, large.jpg."
    tab.act("upload", name="large.jpg", size=40_000_000)
    tab.error("large.jpg has 40 MB; up to 30 MB")
    tab.act("upload", name="none.jpg", size=0)
    assert tab.error() == "none.jpg is empty; choose another file."
    tab.socket.send(b"these bytes belong to nothing")
    tab.set(angle=9)
    tab.result(angle=9)


def test_the_server_holds_a_bounded_number_of_bytes_of_own_photos(
    app: App, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = workspace.tasks["drone-to-satellite"].queries[3].path.read_bytes()
    monkeypatch.setattr(app._channel._screens, "own", OwnPhotoBytes(len(file) + 20_000))
    one, other = (Tab(app, name * 16) for name in "ab")
    one.open()
    other.open()
    send_file(one, "mine.png", file)
    one.until(lambda last: last["result"]["state"]["own"])
    send_file(other, "mine.png", file)
    other.error("mine.png finds no room")
    one.act("forget")
    one.result(own="")
    send_file(other, "mine.png", file)
    other.until(lambda last: last["result"]["state"]["own"])
    for tab_ in (one, other):
        tab_.socket.close()


class _Checked:
    """A map's jobs, each of them the test's."""

    def __init__(self, job: Any) -> None:
        self.job, self.shown = job, True

    def join(self, picture: OwnPicture, windows: Sequence[object], client: object) -> Any:  # noqa: ARG002
        assert picture.picture.size
        return self.job

    def show_none(self, client: object) -> None:  # noqa: ARG002
        self.shown = False


def test_the_check_of_an_own_photo_comes_as_a_mark(
    tab: Tab, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def work(report: Callable[[int, int], None]) -> object:
        report(1, 8)
        go_on.wait(TIMEOUT)
        raise DataError("The map cannot be read.")

    jobs = _Checked(BackgroundJob(work, tab))
    monkeypatch.setattr(workspace, "own_photos", jobs)
    tab.open()
    send_file(tab, "one.png", workspace.tasks["drone-to-satellite"].queries[3].path.read_bytes())
    key = tab.until(lambda last: last["result"]["state"]["own"])["result"]["state"]["own"]
    going = tab.until(lambda last: "1 of 8" in last.get("mark", {}).get("text", ""))["mark"]
    assert (going["own"], going["sign"]) == (key, None)
    go_on.set()
    ended = tab.until(lambda last: last["mark"]["text"] == "not checked")["mark"]
    assert ended["why"] == "The map cannot be read."
    tab.set(query=2, own="")
    tab.result(own="", query=2)
    wait_until(lambda: not jobs.shown)


def test_a_page_gets_what_follows_a_message_that_is_no_json(
    app: App, tab: Tab, caplog: pytest.LogCaptureFixture
) -> None:
    tab.open()
    session: Any = app._channel.sessions[TAB]
    session._send({"wrong": float("nan")})
    session.note("It goes on.")
    tab.until(lambda last: last.get("note") == "It goes on.")
    assert "A message to a page is no JSON: wrong" in caplog.text


def test_another_place_opens_a_panel_of_its_own(app: App, tab: Tab) -> None:
    tab.open("?panel=compare")
    session: Any = app._channel.sessions[TAB]
    before = session._panel[1]
    session._leave_place()
    tab.set(query=1)
    tab.result(query=1)
    assert session._panel[0] == "compare"
    assert session._panel[1] is not before


def test_nothing_is_done_before_a_page_has_opened(tab: Tab) -> None:
    tab.set(angle=3)
    tab.act("step", by=1)
    tab.act("upload", name="a.png", size=3)
    tab.socket.send(b"abc")
    assert tab.open()["angle"] == 0


def test_a_session_ends_with_its_connection(app: App) -> None:
    tab = Tab(app, "fedcba9876543210")
    tab.open()
    session: Any = app._channel.sessions["fedcba9876543210"]
    contexts = [opened.requests for opened in session._access._opened.values()]
    tab.socket.close()
    wait_until(lambda: "fedcba9876543210" not in app._channel.sessions and all(one.closed for one in contexts))


def test_a_page_that_connects_again_takes_its_place(app: App, tab: Tab) -> None:
    tab.open()
    former = app._channel.sessions[TAB]
    again = Tab(app)
    again.open()
    assert app._channel.sessions[TAB] is not former
    again.socket.close()


def test_a_slow_page_has_only_the_newest_message_of_each_kind_to_read() -> None:
    async def exchange() -> list[dict[str, object]]:
        outbox = Outbox(asyncio.get_running_loop())
        for number in range(100):
            outbox.put({"result": number})
            outbox.put({"curve": number})
        await asyncio.sleep(0)
        return [await outbox.take() for _ in range(2)]

    assert asyncio.run(exchange()) == [{"result": 99}, {"curve": 99}]


def test_a_page_comes_with_its_state_and_after_no_newer_one() -> None:
    async def exchange() -> list[dict[str, object]]:
        outbox = Outbox(asyncio.get_running_loop())
        outbox.put({"page": 1, "state": 1})
        outbox.put({"state": 2})
        outbox.put({"panel": "a", "kind": "x"})
        outbox.put({"panel": "b", "kind": "y"})
        await asyncio.sleep(0)
        first = [await outbox.take()]
        outbox.put({"page": 3, "state": 3})
        await asyncio.sleep(0)
        return first + [await outbox.take() for _ in range(3)]

    assert asyncio.run(exchange()) == [{"page": 1, "state": 1}, {"panel": "a"}, {"panel": "b"}, {"page": 3, "state": 3}]


def test_another_model_begins_with_equal_weights_and_takes_its_own(tab: Tab) -> None:
    tab.open("?weights=1,2,1,0.5")
    assert tab.last["state"]["weights"] == [1, 2, 1, 0.5]
    tab.set(model="1")
    assert tab.result(model="1")["weights"] == []
    tab.set(weights=[1, 2, 1, 0.5])
    assert "expected 1 numbers" in tab.error()
    tab.open("?model=1&weights=1,2,1,0.5")
    assert "expected 1 numbers" in tab.error()
    assert tab.last["result"]["state"]["model"] == "1"


def test_a_panel_gets_no_result_of_another_model(app: App, tab: Tab, monkeypatch: pytest.MonkeyPatch) -> None:
    tab.open()
    session = app._channel.sessions[TAB]
    assert isinstance(session, ScreenSession)
    assert session.result is not None
    with monkeypatch.context() as patch:
        patch.setattr(session._loop, "show", lambda _: None)
        tab.set(model="1")
        tab.until(lambda last: last["state"]["model"] == "1")
        assert tab.last["page"]["parts"] == 1
        assert session.result is None
    tab.set(model="0")
    wait_until(lambda: session.result is not None)


def test_a_click_in_the_scene_is_told_from_a_hover(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict[str, Any]] = []
    scene = TabScene(sent.append)
    monkeypatch.setattr(scene, "drawn", SimpleNamespace(pick=lambda *_: {"tile": 3}))
    scene.pick({"x": 0.5, "y": 0.5, "why": "click"})
    scene.pick({"x": 0.5, "y": 0.5})
    assert [one["picked"] for one in sent] == [{"tile": 3, "why": "click"}, {"tile": 3, "why": "hover"}]
    assert [one["kind"] for one in sent] == ["click", "hover"], "a page that is slow gets both"


class _Slow:
    """A job that runs until a test ends it."""

    def __init__(self) -> None:
        self.begun, self._end = threading.Event(), threading.Event()
        self.job: BackgroundJob[Any] = BackgroundJob(self._work, self)

    def _work(self, report: Callable[[int, int], None]) -> None:
        report(3, 9)
        self.begun.set()
        self._end.wait(TIMEOUT)

    def end(self) -> None:
        self._end.set()
        assert self.job.wait(TIMEOUT)


def test_while_a_model_opens_photos_are_answered_and_the_newest_wish_wins(
    app: App, tab: Tab, monkeypatch: pytest.MonkeyPatch
) -> None:
    tab.open()
    session = app._channel.sessions[TAB]
    assert isinstance(session, ScreenSession)
    first, second = _Slow(), _Slow()
    with monkeypatch.context() as patch:
        patch.setattr(session._access, "opening", lambda _: first.job)
        tab.set(model="1")
        tab.until(lambda last: last.get("busy", "").endswith(": 3 of 9 pictures"))
        assert tab.turn(12)["state"]["model"] == "0"
        patch.setattr(session._access, "opening", lambda _: second.job)
        tab.set(model="1")
        wait_until(lambda: session._awaited is not None and session._awaited[0] is second.job)
    first.end()
    tab.turn(14)
    assert tab.last["state"]["model"] == "0", "it is waited for no longer"
    second.end()
    assert tab.result(model="1")["angle"] == 14


def test_a_tab_that_leaves_waits_for_no_model(app: App, tab: Tab, monkeypatch: pytest.MonkeyPatch) -> None:
    tab.open()
    session = app._channel.sessions[TAB]
    assert isinstance(session, ScreenSession)
    slow = _Slow()
    monkeypatch.setattr(session._access, "opening", lambda _: slow.job)
    tab.set(model="1")
    wait_until(lambda: session._awaited is not None)
    tab.socket.close()
    wait_until(lambda: session._awaited is None)
    slow.end()
