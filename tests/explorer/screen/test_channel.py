"""The page and its channel, as a browser and as somebody else reaches them."""

from __future__ import annotations

import asyncio
import gzip
import http.client
import json
import threading
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from explorer.app import App
from explorer.screen import route
from explorer.screen.channel import Outbox
from explorer.server.auth import Authenticator
from explorer.web.terms import term
from explorer.workspace import Workspace
from lpn.core import images
from lpn.explain.occlusion import occlude
from tests.explorer.screen.conftest import TAB, Tab
from tools.fixtures.waiting import TIMEOUT, wait_until

PAGE = Path(route.__file__).parent / "page"


def get(app: App, path: str, **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", app.server.get_port(), timeout=TIMEOUT)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def test_the_page_and_its_files_are_served_with_a_policy_that_runs_only_its_own_scripts(app: App) -> None:
    status, headers, body = get(app, "/?query=0003")
    assert status == 200
    assert b"viser" not in body
    assert "script-src 'self';" in headers["Content-Security-Policy"]
    assert b"<script>" not in body
    assert b"onclick" not in body
    for name in [file.name for file in PAGE.iterdir() if file.suffix != ".html"]:  # the browser asks for all at once
        assert f"screen/page/{name}".encode() in body
        assert get(app, f"/screen/page/{name}")[0] == 200
    assert get(app, "/screen/page/nothing.js")[0] == 404
    assert get(app, "/screen/page/../session.py")[0] == 404
    assert b"viser" in get(app, "/classic/")[2].lower()


def test_the_page_gets_the_meanings_of_terms_and_panels_name_no_others(app: App) -> None:
    status, headers, body = get(app, "/screen/terms.json")
    assert (status, headers.get_content_type()) == (200, "application/json")
    assert json.loads(body)["distance"].startswith("How far two descriptors lie apart")
    assert term("margin", "Lead <1>") == '<span class="term" tabindex="0" data-term="margin">Lead &lt;1&gt;</span>'
    with pytest.raises(KeyError):
        term("no such term")


def test_a_browser_gets_a_file_again_only_if_it_has_changed(app: App) -> None:
    _, headers, packed = get(app, "/screen/page/app.js", Accept_Encoding="gzip")
    assert headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(packed) == get(app, "/screen/page/app.js")[2]
    assert get(app, "/screen/page/app.js", If_None_Match=headers["ETag"])[0] == 304


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
    tab.send({"set": {"angle": 30.04}})
    assert tab.result(angle=30.04)["angle"] == 30.04
    tab.act("step", by=1)
    assert tab.result(query=1)["angle"] == 0
    tab.act("step", by=-1)
    tab.result(query=0)
    tab.act("random")
    assert tab.until(lambda last: last["result"]["state"]["query"] > 0)
    tab.send({"set": {"angle": "x", "theme": "light"}})
    assert "Angle: expected a number" in tab.until(lambda last: "error" in last)["error"]
    assert tab.last["state"]["theme"] == "light"
    tab.send({"set": {"model": "1"}})
    assert len(tab.result(model="1")["rows"]) == 1
    assert tab.last["page"]["parts"] == 1


def test_the_missed_queries_stand_worst_first(app: App, tab: Tab, workspace: Workspace) -> None:
    tab.open()
    tab.send({"set": {"filter": "missed"}})
    rail = tab.until(lambda last: last["state"]["filter"] == "missed" and last["rail"]["total"] < 8)["rail"]
    entries = json.loads(get(app, "/" + rail["address"] + rail["feed"] + "0")[2])
    ranks = [entry[2] for entry in entries]
    assert ranks == sorted(ranks, reverse=True)
    assert len(ranks) == int(workspace.rankings["drone-to-satellite"].failed.sum()) == rail["missed"]


def test_the_curve_has_the_rank_of_each_angle_as_its_result_has(tab: Tab) -> None:
    tab.open("?query=0003")
    curve = tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)["curve"]
    assert curve["sequence"] == tab.last["result"]["curve"]
    for angle in (-180, 45):
        tab.send({"set": {"angle": angle}})
        result = tab.result(angle=angle)
        point = next(one for one in curve["points"] if one[0] == angle)
        assert point == [angle, result["rank"], result["nearest"]]


def test_occlusion_is_measured_square_by_square_and_shown_again_at_once(tab: Tab, workspace: Workspace) -> None:
    result = tab.open("?query=0005&shows=occlusion")
    assert result["tiles"][str(result["answer"])]["heat"] is None, "the photo alone is covered"
    shown = tab.until(lambda last: last.get("occlusion", {}).get("done") == 64)["occlusion"]
    assert shown["number"] == result["number"]
    task, model = workspace.tasks["drone-to-satellite"], workspace.model
    assert model is not None
    tile = workspace.tile(task, result["answer"])
    picture = images.load_picture(task.queries[3].path)
    losses = list(occlude(model.for_task(*task.views), picture, "drone", tile.descriptor))[-1][1]
    lost = losses.mean(axis=0)
    photo = shown["photo"]
    size = photo["parts"]["rows"], photo["parts"]["columns"]
    cells = (np.frombuffer(b64decode(photo["heat"]), np.uint8).astype(float).reshape(size) - 128) / 127
    assert np.abs(cells - images.enlarge(lost, *size) / np.abs(lost).max()).max() < 0.02
    del tab.last["occlusion"]
    tab.send({"set": {"compare": result["strip"][2]}})
    again = tab.until(lambda last: "occlusion" in last)["occlusion"]
    assert again["done"] == 64
    assert again["photo"]["heat"] == photo["heat"]


def test_a_place_that_cannot_be_opened_is_named_and_the_page_stays(tab: Tab) -> None:
    tab.open()
    tab.send({"set": {"place": "broken"}})
    assert "The map is not there; give another." in tab.until(lambda last: "error" in last)["error"]
    tab.send({"set": {"angle": 5}})
    assert tab.result(angle=5)["state"]["place"] == "data"
    other = tab.open("?show=broken&query=0003")
    assert other["state"]["place"] == "data"


def test_an_own_photo_is_ranked_and_forgotten(app: App, tab: Tab, workspace: Workspace) -> None:
    tab.open()
    file = workspace.tasks["drone-to-satellite"].queries[3].path.read_bytes()
    tab.act("upload", name="mine.png", size=len(file))
    tab.socket.send(file[:1000])
    tab.socket.send(file[1000:])
    result = tab.until(lambda last: last["result"]["state"]["own"])["result"]
    assert result["photo"]["own"]
    assert result["headline"]["found"] is None
    assert get(app, "/" + result["photo"]["src"])[0] == 200
    assert "query" not in tab.last["state"]["address"]
    tab.act("forget")
    tab.result(own="")


def test_a_file_that_is_no_picture_or_too_large_is_refused_in_a_sentence(tab: Tab) -> None:
    tab.open()
    tab.act("upload", name="notes.txt", size=5)
    tab.socket.send(b"words")
    assert "notes.txt is not a picture" in tab.until(lambda last: "error" in last)["error"]
    del tab.last["error"]
    tab.act("upload", name="large.jpg", size=40_000_000)
    assert "large.jpg has 40 MB; up to 30 MB" in tab.until(lambda last: "error" in last)["error"]
    tab.socket.send(b"these bytes belong to nothing")
    tab.send({"set": {"angle": 9}})
    tab.result(angle=9)


def test_the_server_holds_a_bounded_number_of_own_photos(
    app: App, tab: Tab, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app._channel._screens, "own", threading.BoundedSemaphore(1))
    file = workspace.tasks["drone-to-satellite"].queries[3].path.read_bytes()
    other = Tab(app, TAB[::-1])
    for one in (tab, other):
        one.open()
        one.act("upload", name="mine.png", size=len(file))
        one.socket.send(file)
        one.until(lambda last: last["result"]["state"]["own"] or "error" in last)
    assert "which is the most" in other.last["error"]
    tab.act("forget")
    tab.result(own="")
    other.act("upload", name="mine.png", size=len(file))
    other.socket.send(file)
    other.until(lambda last: last["result"]["state"]["own"])
    other.socket.close()


@pytest.mark.parametrize(
    "message", ["no JSON", "[" * 5000, "7", '{"set": 3}', '{"do": "fly", "args": {}}', '{"do": "step"}', "x" * 30_000]
)
def test_a_message_that_means_nothing_changes_nothing(tab: Tab, message: str) -> None:
    tab.open()
    tab.socket.send(message)
    tab.send({"set": {"angle": 3}})
    assert tab.result(angle=3)["state"]["query"] == 0


def test_nothing_is_done_before_a_page_has_opened(tab: Tab) -> None:
    tab.send({"set": {"angle": 3}})
    tab.act("step", by=1)
    tab.act("upload", name="a.png", size=3)
    tab.socket.send(b"abc")
    assert tab.open()["angle"] == 0


def test_another_site_a_wrong_tab_and_somebody_without_the_token_reach_no_channel(app: App) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        Tab(app, origin="http://evil.example")
    assert Tab(app, "no-tab!").closed()
    locked = Authenticator("127.0.0.1", "correct horse battery")
    before, app.gateway.authenticator = app.gateway.authenticator, locked
    try:
        with pytest.raises(InvalidStatus, match="401"):
            Tab(app)
        assert get(app, "/")[0] == 401
        assert get(app, "/screen/page/app.js")[0] == 401
    finally:
        app.gateway.authenticator = before


def test_a_session_ends_with_its_connection(app: App) -> None:
    tab = Tab(app, "fedcba9876543210")
    tab.open()
    session = app._channel.sessions["fedcba9876543210"]
    contexts = [opened.requests for opened in session._opened.values()]
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


def test_saved_descriptors_take_no_photo(tab: Tab, workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    tab.open()
    monkeypatch.setattr(workspace, "model", None)
    tab.act("upload", name="a.png", size=3)
    tab.socket.send(b"abc")
    assert "cannot describe a photo" in tab.until(lambda last: "error" in last)["error"]
