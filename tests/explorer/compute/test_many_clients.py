"""Many tabs at one server: each gets its own result or a busy line, and leaves nothing behind; tools.soak checks answers."""

from __future__ import annotations

import gc
import json
import re
import socket
import sys
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from websockets.frames import Frame, Opcode

from explorer import uploads
from explorer.app import App
from explorer.compute.request_context import RequestContext
from explorer.screen.session import ScreenSession
from explorer.server import gateway
from explorer.workspace import Workspace
from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.library.analyser import OwnPicture
from lpn.models.contract import ForwardPass
from tools.fixtures.screen_tab import PART, ScreenTab, scene_socket
from tools.fixtures.waiting import TIMEOUT, n_queued, wait_until

# Classes of which each tab has its own instances.
PER_TAB = (ScreenSession, RequestContext, OwnPicture)


def test_a_full_queue_is_said_and_later_the_newest_state_is_answered(
    app: App, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, may_end, run = threading.Event(), threading.Event(), workspace.model.model.run

    def held_back(images: Float32Array, view: View) -> ForwardPass:
        began.set()
        assert may_end.wait(TIMEOUT)
        return run(images, view)

    monkeypatch.setattr(workspace.inference, "_max_queued", 1)
    with ScreenTab(app.link) as one, ScreenTab(app.link) as two, ScreenTab(app.link) as three:
        for tab in (one, two, three):
            tab.open()
            tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)  # nothing more is computed
        monkeypatch.setattr(workspace.model.model, "run", held_back)
        one.set(angle=31)
        assert began.wait(TIMEOUT)
        two.set(angle=32)
        wait_until(lambda: n_queued(workspace.inference) == 1)
        three.set(angle=33)
        three.until(lambda last: "The server is busy" in last.get("busy", ""))
        assert three.last["result"]["angle"] == 0, "what it showed stays"
        three.set(angle=34)
        may_end.set()
        for tab, angle in ((one, 31), (two, 32), (three, 34)):
            tab.result(angle=angle)
        assert 33 not in [state["angle"] for state in three.results]


def test_a_photo_that_waits_to_be_decoded_holds_up_its_own_tab_alone(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    reading = threading.BoundedSemaphore(1)
    monkeypatch.setattr(uploads, "_READING", reading)
    with ScreenTab(app.link) as tab, ScreenTab(app.link) as other:
        tab.open()
        other.open()
        with reading:
            tab.upload("mine.png", picture(90))
            other.turn(7)
            assert not tab.last["result"]["photo"]["own"]
        tab.until(lambda last: last["result"]["photo"]["own"])


# Clean-up after tabs that leave.


def picture(size: int = 700) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (size, size, 3), np.uint8)
    return cv2.imencode(".png", noise)[1].tobytes()


def held() -> Counter[str]:
    """Count objects of tabs, threads, and open files, after all work for tabs has ended."""
    wait_until(lambda: not any(re.match("explorer-(worker|job|ranking)", one.name) for one in threading.enumerate()))
    gc.collect()
    counts = Counter(type(one).__name__ for one in gc.get_objects() if type(one) in PER_TAB)
    # The pools of viser and of the channel grow to 32 threads and stay.
    pools = ("ThreadPool", "asyncio", "explorer-screen", "explorer-picture")
    counts["threads"] = sum(not thread.name.startswith(pools) for thread in threading.enumerate())
    if sys.platform == "linux":
        counts["files"] = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return counts


def leave_during_an_answer(app: App) -> None:
    with ScreenTab(app.link) as tab:
        tab.open()
        tab.set(angle=77)


def leave_during_a_second_upload(app: App) -> None:
    with ScreenTab(app.link) as tab:
        tab.open()
        tab.upload("mine.png", picture(90))
        tab.until(lambda last: last["result"]["photo"]["own"])
        tab.act("upload", name="b.png", size=2 * PART)
        tab.socket.send(bytes(PART))


def leave_while_a_picture_is_decoded(app: App) -> None:
    with ScreenTab(app.link) as tab:
        tab.open()
        tab.upload("mine.png", picture(500))


def leave_during_occlusion_without_a_farewell(app: App) -> None:
    tab = ScreenTab(app.link)
    tab.open("?shows=occlusion")
    tab.until(lambda last: "occlusion" in last)
    tab.abort()


def leave_before_the_first_message(app: App) -> None:
    with ScreenTab(app.link):
        pass


def leave_with_a_scene(app: App) -> None:
    name = "00112233445566aa"
    with ScreenTab(app.link, name) as tab:
        tab.open()
        with scene_socket(app.link, name):
            tab.until(lambda last: last.get("scene") == last["state"]["place"])


@pytest.mark.slow
def test_tabs_that_leave_at_any_time_leave_nothing_behind(app: App) -> None:
    ways = (
        leave_during_an_answer,
        leave_during_a_second_upload,
        leave_while_a_picture_is_decoded,
        leave_during_occlusion_without_a_farewell,
        leave_before_the_first_message,
        leave_with_a_scene,
    )
    for way in ways:  # creates resources that stay: threads of pools, files of shared libraries
        way(app)
    wait_until(lambda: not app._channel.sessions)
    wait_until(lambda: not held()["ScreenSession"], held)
    before = held()
    for _ in range(2):
        threads = [threading.Thread(target=way, args=(app,)) for way in ways]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(TIMEOUT)
    wait_until(lambda: not (held() - before), lambda: held() - before)
    assert not app._channel.sessions
    assert not app.server.get_clients()
    assert not app.server._websock_server._client_state_from_id


@pytest.mark.slow
def test_a_page_that_never_reads_is_let_go_while_others_are_answered(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway, "READ_TIMEOUT", 5.0)
    own = socket.socket()
    own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    own.connect(("127.0.0.1", app.server.get_port()))
    name = "00112233445566cc"
    with ScreenTab(app.link) as other, ScreenTab(app.link, name, sock=own, ping_interval=None) as deaf:
        other.open()
        deaf.open()
        deaf.socket.recv_messages.pause()  # as a page that is stopped

        def gone() -> bool:
            with suppress(OSError):  # past the client, which would wait for data that it does not read
                for query in range(9):
                    frame = Frame(Opcode.TEXT, json.dumps({"set": {"query": query}}).encode())
                    own.send(frame.serialize(mask=True), socket.MSG_DONTWAIT)
            other.turn(-other.last["result"]["angle"] or 7)
            return name not in app._channel.sessions

        try:
            wait_until(gone)
            other.turn(33)
        finally:
            deaf.socket.recv_messages.resume()
