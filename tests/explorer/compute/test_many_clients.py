"""Many tabs at one server: each gets its own right result or a busy line, and leaves nothing behind."""

from __future__ import annotations

import gc
import json
import re
import socket
import sys
import threading
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from random import Random

import cv2
import numpy as np
import pytest
from websockets.frames import Frame, Opcode

import lpn
from explorer import uploads
from explorer.app import App
from explorer.compute.request_context import RequestContext
from explorer.opening import open_model
from explorer.screen.session import ScreenSession
from explorer.server import gateway
from explorer.workspace import Workspace
from lpn import retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import ModelFileError
from lpn.core.views import View
from lpn.library.analyser import OwnPicture
from lpn.models.base import Model
from lpn.models.contract import ForwardPass
from lpn.retrieval import scoring
from tests.explorer.conftest import TASK
from tools.fixtures import small_worlds
from tools.fixtures.screen_tab import PART, ScreenTab, scene_socket
from tools.fixtures.waiting import TIMEOUT, n_queued, wait_until

# Classes of which each tab has its own instances.
PER_TAB = (ScreenSession, RequestContext, OwnPicture)


class Gate:
    """Controls a model's forward passes: they wait while it is closed, and fail while it is broken."""

    def __init__(self, model: Model) -> None:
        self._run, self.passes, self.broken = model.run, 0, False
        self.open, self.began = threading.Event(), threading.Event()
        self.open.set()
        model.run = self.run  # type: ignore[method-assign]

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Compute a forward pass once the gate is open."""
        self.passes += 1
        self.began.set()
        assert self.open.wait(TIMEOUT)
        if self.broken:
            raise ModelFileError("The model is damaged.")
        return self._run(images, view)

    def close(self) -> None:
        """Make further passes wait."""
        self.began.clear()
        self.open.clear()


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    folder = tmp_path_factory.mktemp("many")
    places = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        return open_model(places, model_file)


@pytest.fixture(scope="module")
def app(workspace: Workspace) -> Iterator[App]:
    with closing(App(workspace, "127.0.0.1", 0)) as served:
        yield served


@pytest.fixture(scope="module")
def module_gate(workspace: Workspace) -> Gate:
    assert workspace.model is not None
    return Gate(workspace.model.model)


@pytest.fixture
def gate(module_gate: Gate) -> Iterator[Gate]:
    yield module_gate
    module_gate.open.set()
    module_gate.broken = False


def at_rest(tab: ScreenTab) -> ScreenTab:
    """Wait until the curve of the tab is complete, after which nothing is computed for it."""
    tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)
    return tab


class Direct:
    """Computes answers without the explorer, with its own model."""

    def __init__(self, workspace: Workspace, model_file: Path) -> None:
        self.model, self.task = lpn.load(model_file), workspace.tasks[TASK]
        tiles = [images.load_picture(entry.path) for entry in self.task.gallery]
        described = [retrieval.describe_picture(self.model, tile, "satellite").descriptor for tile in tiles]
        self.gallery = np.stack(described)

    def check(self, tab: ScreenTab) -> None:
        """Check the nearest tile that the page shows, and its distance to three places."""
        result = tab.last["result"]
        picture = images.load_picture(self.task.queries[result["state"]["query"]].path)
        descriptor = retrieval.describe_picture(self.model, picture, "drone", result["angle"]).descriptor
        ranking = retrieval.rank(scoring.part_cosines(descriptor, self.gallery), np.full(4, 0.25, np.float32))
        match = ranking.find(result["answer"])
        assert match.score == pytest.approx(ranking.scores.max(), abs=1e-5)
        assert float(result["tiles"][str(result["answer"])]["distance"]) == pytest.approx(match.distance2, abs=1.1e-3)


@pytest.mark.slow
def test_twenty_tabs_at_once_each_get_their_own_right_answer(app: App, workspace: Workspace, model_file: Path) -> None:
    direct, count, errors = Direct(workspace, model_file), 20, []

    def drag(number: int) -> None:
        try:
            rng = Random(number)
            with ScreenTab(app.link) as tab:
                tab.open()
                # No two tabs ask for the same angle.
                angles = [count * turns + number + 1 for turns in rng.sample(range(-9, 9), 5)]
                queries = rng.sample(range(1, 9), 2)
                for query in queries:
                    tab.set(query=query)
                    tab.result(query=query)
                    for angle in angles:
                        tab.set(angle=angle)
                        tab.receive(rng.random() * 0.02)
                tab.result(angle=angles[-1])
                direct.check(tab)
                # The shown states are requested ones in their order; states may be skipped.
                asked = iter([(0, 0), *((query, angle) for query in queries for angle in (0, *angles))])
                shown = [(state["query"], state["angle"]) for state in tab.results]
                assert all(state in asked for state in shown), shown
        except BaseException as error:
            errors.append((number, error))

    threads = [threading.Thread(target=drag, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(4 * TIMEOUT)
    assert not any(thread.is_alive() for thread in threads)
    assert not errors, errors


def test_a_full_queue_is_said_and_later_the_newest_state_is_answered(
    app: App, workspace: Workspace, gate: Gate, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace.inference, "_max_queued", 1)
    with ScreenTab(app.link) as one, ScreenTab(app.link) as two, ScreenTab(app.link) as three:
        for tab in (one, two, three):
            tab.open()
            at_rest(tab)
        gate.close()
        one.set(angle=31)
        assert gate.began.wait(TIMEOUT)
        two.set(angle=32)
        wait_until(lambda: n_queued(workspace.inference) == 1)
        three.set(angle=33)
        three.until(lambda last: "The server is busy" in last.get("busy", ""))
        assert three.last["result"]["angle"] == 0, "what it showed stays"
        three.set(angle=34)
        gate.open.set()
        for tab, angle in ((one, 31), (two, 32), (three, 34)):
            tab.result(angle=angle)
            Direct(workspace, model_file).check(tab)
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


def leave_after_an_answer(app: App) -> None:
    with ScreenTab(app.link) as tab:
        tab.open()


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
        leave_after_an_answer,
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


def test_nothing_is_computed_for_a_tab_that_left(app: App, workspace: Workspace, gate: Gate) -> None:
    with ScreenTab(app.link) as stays:
        stays.open()
        at_rest(stays)
        with ScreenTab(app.link, "00112233445566bb") as goes:
            goes.open()
            at_rest(goes)
            gate.close()
            stays.set(angle=61)
            assert gate.began.wait(TIMEOUT)
            goes.set(angle=62)
            wait_until(lambda: n_queued(workspace.inference) == 1)
            session = weakref.ref(app._channel.sessions["00112233445566bb"])
            passes = gate.passes
        wait_until(lambda: n_queued(workspace.inference) == 0)
        wait_until(lambda: (gc.collect(), session() is None)[1])
        gate.open.set()
        stays.result(angle=61)
        assert gate.passes <= passes + 1, "the tile's, at most"


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
