"""Many browsers at one server: each gets its own right answer or a busy line, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import gc
import itertools
import re
import socket
import sys
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import viser
from viser import GuiApi, SceneApi
from websockets.exceptions import ConnectionClosed

import explorer.app
import lpn
from explorer import session_state, uploads
from explorer.app import App
from explorer.client import address, views
from explorer.client.session import ClientSession
from explorer.compute import request_context
from explorer.compute.request_context import RequestContext
from explorer.explain_window.sweep_request import SweepRequest
from explorer.explain_window.window import ExplainWindow
from explorer.failure_lab.window import FailureLabWindow
from explorer.layout import ScreenLayout
from explorer.opening import open_model, open_source
from explorer.panels.panels import Panels
from explorer.server import gateway
from explorer.server.gateway import _Connection
from explorer.server.message_filter import MessageFilter
from explorer.server.viser_compat import SendBuffer
from explorer.session_state import SessionState
from explorer.stage import scene
from explorer.stage.scene import Stage
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn import retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import ModelFileError
from lpn.core.views import View
from lpn.library.analyser import OwnPicture
from lpn.models.base import Model
from lpn.models.contract import ForwardPass
from lpn.retrieval import scoring
from lpn.sources import SourceOptions
from tools.fixtures import small_worlds
from tools.fixtures.published_results import save_result
from tools.fixtures.waiting import TIMEOUT, wait_until
from tools.fixtures.websocket_client import CHUNK, WebSocketClient

TASK = "drone-to-satellite"
# Classes of which each browser has its own instances.
PER_BROWSER = (
    ClientSession, StateAnalyser, Stage, Panels, ExplainWindow, FailureLabWindow, RequestContext,
    OwnPicture, SweepRequest, MessageFilter, WebSocketClient, _Connection,
    viser.ClientHandle, GuiApi, SceneApi, SendBuffer,
)  # fmt: skip


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
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.map_dataset(
        small_worlds.make_dataset(tmp_path_factory.mktemp("many") / "places", train=1, test=9)
    )


@pytest.fixture(scope="module")
def workspace(places: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("cache")))
        return open_model(places, model_file)


@pytest.fixture(scope="module")
def app(workspace: Workspace) -> Iterator[App]:
    served = App(workspace, "127.0.0.1", 0)
    yield served
    served.close()


@pytest.fixture(scope="module")
def module_gate(workspace: Workspace) -> Gate:
    assert workspace.model is not None
    return Gate(workspace.model.model)


@pytest.fixture
def gate(module_gate: Gate) -> Iterator[Gate]:
    yield module_gate
    module_gate.open.set()
    module_gate.broken = False


def url(app: App) -> str:
    return f"http://127.0.0.1:{app.server.get_port()}"


class Browser(WebSocketClient):
    """A page that records the states that it was shown, in order."""

    def __init__(self, url: str, **options: Any) -> None:
        self.shown: list[tuple[int, float]] = []
        super().__init__(url, **options)

    def _take(self, data: bytes | str) -> None:
        super()._take(data)
        if query := self.status("query"):
            state = int(query), float(self.status("angle") or 0)
            if state not in self.shown[-1:]:
                self.shown.append(state)

    def turn(self, angle: int) -> None:
        """Turn the query, and wait for the answer."""
        self.set("Rotate", angle)
        self.wait(lambda: self.status("angle") == str(angle))


def session_of(app: App, browser: WebSocketClient) -> ClientSession:
    """Return the server's side of a browser."""
    slider = browser.find("Rotate")
    return next(
        one
        for one in app._sessions.values()
        if one.views.panels.controls._bindings["angle"].handle._impl.uuid == slider
    )


class Direct:
    """Computes answers without the explorer, with its own model."""

    def __init__(self, workspace: Workspace, model_file: Path) -> None:
        self.model, self.task = lpn.load(model_file), workspace.tasks[TASK]
        tiles = [images.load_picture(entry.path) for entry in self.task.gallery]
        described = [retrieval.describe_picture(self.model, tile, "satellite").descriptor for tile in tiles]
        self.gallery = np.stack(described)

    def check(self, browser: WebSocketClient) -> None:
        """Check the top match that the page shows, and its score to three places."""
        query, angle, top = (float(browser.status(name) or "nan") for name in ("query", "angle", "top"))
        picture = images.load_picture(self.task.queries[int(query)].path)
        descriptor = retrieval.describe_picture(self.model, picture, "drone", angle).descriptor
        ranking = retrieval.rank(scoring.part_cosines(descriptor, self.gallery), np.full(4, 0.25, np.float32))
        assert ranking.scores[int(top)] == pytest.approx(ranking.scores.max(), abs=1e-5)
        found = re.search(r"<td>sum</td><td>100 %</td><td>([+−][\d.]+)</td>", browser.html())
        assert found is not None
        assert float(found[1].replace("−", "-")) == pytest.approx(ranking.scores[int(top)], abs=6e-4)


@pytest.mark.slow
def test_twenty_browsers_at_once_each_get_their_own_right_answer(
    app: App, workspace: Workspace, model_file: Path
) -> None:
    direct, count, errors = Direct(workspace, model_file), 20, []

    def drag(number: int) -> None:
        try:
            rng = Random(number)
            with Browser(url(app)) as browser:
                browser.greet()
                # No two browsers request the same angle.
                angles = [count * turns + number + 1 for turns in rng.sample(range(-9, 9), 5)]
                queries = rng.sample(range(1, 9), 2)
                for query in queries:
                    browser.tell("query", query)
                    browser.wait(lambda query=query: browser.status("query") == str(query))
                    for angle in angles:
                        browser.set("Rotate", angle)
                        time.sleep(rng.random() * 0.02)
                browser.wait(lambda: browser.status("angle") == str(angles[-1]), TIMEOUT)
                direct.check(browser)
                # The shown states are requested ones in their order; states may be skipped.
                asked = iter([(0, 0.0), *((query, float(angle)) for query in queries for angle in (0, *angles))])
                assert all(state in asked for state in browser.shown), browser.shown
        except BaseException as error:
            errors.append((number, error))

    threads = [threading.Thread(target=drag, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(2 * TIMEOUT)
    assert not any(thread.is_alive() for thread in threads)
    assert not errors, errors


def test_a_full_queue_shows_busy_and_later_the_newest_answer(
    app: App, workspace: Workspace, gate: Gate, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace.inference, "_max_queued", 1)
    with Browser(url(app)) as one, Browser(url(app)) as two, Browser(url(app)) as three:
        for browser in (one, two, three):
            browser.greet()
        gate.close()
        one.set("Rotate", 31)
        assert gate.began.wait(TIMEOUT)
        two.set("Rotate", 32)
        wait_until(lambda: workspace.inference.queue_length == 1)
        three.set("Rotate", 33)
        three.wait(lambda: "Busy: too many people" in three.html())
        assert three.status("angle") == "0", "what it showed stays"
        assert "lpn-verdict" in three.html()
        three.set("Rotate", 34)
        wait_until(lambda: session_of(app, three)._state.angle == 34)
        assert "Busy: too many people" in three.html()
        assert "No answer" not in str(three.controls)
        gate.open.set()
        for browser, angle in ((one, "31"), (two, "32"), (three, "34")):
            browser.wait(lambda browser=browser, angle=angle: browser.status("angle") == angle)
            assert "Busy" not in browser.html()
            Direct(workspace, model_file).check(browser)


def test_the_first_answer_of_a_browser_may_be_refused_too(
    app: App, workspace: Workspace, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace.inference, "_max_queued", 0)
    gate.close()
    with Browser(url(app)) as browser:
        browser.camera()
        browser.wait(lambda: browser.find("page") is not None)
        browser.tell("hello", {"search": "?screen=all", "small": False})
        browser.wait(lambda: "Busy: too many people" in browser.html())
        assert browser.status("seq") == "0"
        gate.open.set()
        monkeypatch.setattr(workspace.inference, "_max_queued", 1)
        browser.wait(lambda: browser.status("seq") == "1")


def test_nothing_is_drawn_before_a_page_sends_its_address(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    analysed = threading.Event()
    analyse = StateAnalyser.analyse

    def observed(analyser: StateAnalyser, state: SessionState, k: int) -> StateAnalysis:
        analysis = analyse(analyser, state, k)
        analysed.set()
        return analysis

    monkeypatch.setattr(StateAnalyser, "analyse", observed)
    with Browser(url(app)) as browser:
        browser.camera()
        browser.wait(lambda: browser.find("page") is not None)
        assert analysed.wait(TIMEOUT), "the state that most pages open with is analysed meanwhile"
        browser.tell("hello", {"search": "?angle=30", "small": False, "viewport": [12000, 0]})
        browser.wait(lambda: browser.status("angle") == "30")
        assert {angle for _, angle in browser.shown} == {30.0}


def test_a_size_that_arrives_while_the_first_answer_is_drawn_is_drawn_for(
    app: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, resized, show = threading.Event(), threading.Event(), Stage.show

    def slow(stage: Stage, analysis: StateAnalysis) -> None:
        show(stage, analysis)
        drawn.set()
        assert resized.wait(TIMEOUT)

    monkeypatch.setattr(Stage, "show", slow)
    with Browser(url(app)) as browser:
        browser.camera()
        browser.wait(lambda: browser.find("page") is not None)
        browser.tell("hello", {"search": "?screen=all", "small": False, "viewport": [1200, 800]})
        assert drawn.wait(TIMEOUT)
        shown = session_of(app, browser).views
        browser.tell("viewport", [390, 500])
        wait_until(lambda: shown.viewport.width == 390)
        assert shown.stage.outgrown
        resized.set()
        wait_until(lambda: not shown.stage.outgrown)


def test_a_size_that_comes_back_while_the_stage_is_drawn_for_another_is_drawn_for(
    app: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, told, back, computed = itertools.count(1), threading.Event(), threading.Event(), scene.layout_for

    def slow(input_size: tuple[int, int], n_parts: int, stage: tuple[int, int]) -> ScreenLayout:
        layout = computed(input_size, n_parts, stage)
        # The worker looks first at the size alone, then draws for it.
        if stage == (390, 500) and threading.current_thread().name == "explorer-worker" and next(looks) == 2:
            told.clear()
            browser.tell("viewport", [1200, 800])
            assert told.wait(TIMEOUT)
            back.set()
        return layout

    with Browser(url(app)) as browser:
        browser.camera()
        browser.wait(lambda: browser.find("page") is not None)
        browser.tell("hello", {"search": "?screen=all", "small": False, "viewport": [1200, 800]})
        browser.wait(lambda: browser.link is not None)
        shown = session_of(app, browser).views
        shown.viewport.watch(told.set)  # after the session's own watcher
        monkeypatch.setattr(scene, "layout_for", slow)
        browser.tell("viewport", [390, 500])
        assert back.wait(TIMEOUT)
        wait_until(lambda: not shown.stage.outgrown)


def test_a_page_that_loads_slowly_keeps_the_state_of_its_address(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address, "_ADDRESS_TIMEOUT", 0.0)
    with Browser(url(app)) as browser:
        browser.camera()
        browser.wait(lambda: browser.status("seq") not in (None, "0") and browser.find("page") is not None)
        browser.tell("hello", {"search": "?angle=30", "small": False})
        browser.wait(lambda: browser.status("angle") == "30")
        browser.wait(lambda: browser.link is not None)
        assert "angle=30" in browser.links[0], "the page stops sending its address when it gets another"


def test_a_value_that_arrives_while_controls_are_read_is_not_lost(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        session = session_of(app, browser)
        slider = session.views.panels.controls._bindings["angle"].handle

        def taken(state: SessionState) -> SessionState:
            read = session.views.panels.controls.read(state)
            slider._impl.value = 12  # as viser's own thread does meanwhile
            return read

        slider._impl.value = 10
        session.change(taken)
        assert (session._state.angle, slider.value) == (10, 12)
        session.change(session.views.panels.controls.read)  # what the value itself brings about
        assert session._state.angle == 12
        session.change(lambda state: session_state.turn(state, 5))
        assert slider.value == 17
        session.change(lambda state: session_state.turn(state, -5))
        assert slider.value == 12


def test_a_ranking_that_ends_while_an_own_picture_is_registered_is_shown(app: App) -> None:
    drawing, may_draw = threading.Event(), threading.Event()

    def draw(_: StateAnalysis) -> None:
        drawing.set()
        assert may_draw.wait(TIMEOUT)

    with Browser(url(app)) as browser:
        browser.greet()
        session = session_of(app, browser)
        before = session.views.sequence
        session.views.show_own_photo = draw  # type: ignore[method-assign]
        session._follow_own_photo()
        assert drawing.wait(TIMEOUT)
        session._ranking_progress._on_done()
        session._follow_own_photo()
        may_draw.set()
        wait_until(lambda: session.views.sequence > before)


def test_an_upload_that_waits_to_be_decoded_does_not_block_controls(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    reading = threading.BoundedSemaphore(1)
    monkeypatch.setattr(uploads, "_READING", reading)
    with Browser(url(app)) as browser, ThreadPoolExecutor(1) as pool:
        browser.greet()
        # In place of the threads that viser has for all browsers' callbacks.
        monkeypatch.setattr(session_of(app, browser).client.gui, "_thread_executor", pool)
        with reading:
            browser.upload("mine.png", picture(90))
            wait_until(lambda: any(thread.name == "explorer-upload" for thread in threading.enumerate()))
            browser.turn(7)
            assert browser.status("name") != "mine.png"
        browser.wait(lambda: browser.status("name") == "mine.png")


def test_an_error_is_not_shown_as_busy(app: App, gate: Gate) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        gate.broken = True
        browser.set("Rotate", 51)
        browser.wait(lambda: "The model is damaged." in str(browser.controls))
        assert "No answer" in str(browser.controls)
        assert "Busy" not in browser.html()
        gate.broken = False
        browser.set("Rotate", 52)


def test_a_failed_sweep_is_not_repeated(app: App, gate: Gate) -> None:
    def sweep_passes(browser: Browser) -> int:
        before = gate.passes
        browser.tell("sweep", "zoom")
        browser.wait(lambda: re.search(r'id="lpn-profile" data-done="(\d+)" data-of="\1"', browser.html()) is not None)
        return gate.passes - before

    with Browser(url(app)) as browser:
        browser.greet()
        session_of(app, browser).change(lambda state: replace(state, why=True))
        for query in range(9):  # one whose answer is wrong, and might be helped by other weights
            browser.tell("query", query)
            browser.wait(lambda query=query: browser.status("query") == str(query))
            if "Does it help over all queries?" in browser.html():
                break
        whole = sweep_passes(browser)
        assert whole > 2
        gate.broken = True
        browser.tell("sweep", "rotation")
        browser.wait(lambda: "The model is damaged." in str(browser.controls))
        browser.wait(lambda: "Stopped before the first step" in browser.html())
        gate.broken = False
        # The effect wakes the worker of the sweep once more, and is computed by it.
        before = gate.passes
        browser.tell("effect", None)
        browser.wait(lambda: "Does it help over all queries?" not in browser.html())
        browser.wait(lambda: "computing over all queries" not in browser.html())
        assert sweep_passes(browser) == whole
        assert gate.passes == before + whole


def test_a_superseded_request_is_computed_once(
    app: App, workspace: Workspace, gate: Gate, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert workspace.model is not None
    monkeypatch.setattr(request_context, "MIN_WAIT", 0.0)
    monkeypatch.setattr(workspace.model.model, "batch", 2)
    with Browser(url(app)) as one, Browser(url(app)) as other:
        for browser in (one, other):
            browser.greet()
        gate.close()
        one.set("Rotate", 31)
        assert gate.began.wait(TIMEOUT)
        other.set("Rotate", 32)
        wait_until(lambda: workspace.inference.queue_length == 1)
        one.set("Rotate", 41)
        other.set("Rotate", 42)
        wait_until(lambda: [session_of(app, one)._state.angle, session_of(app, other)._state.angle] == [41, 42])
        gate.open.set()
        for browser, angle in ((one, "41"), (other, "42")):
            browser.wait(lambda browser=browser, angle=angle: browser.status("angle") == angle)
            Direct(workspace, model_file).check(browser)
        assert not workspace.inference._kept_positions


def test_a_saved_result_without_a_network_serves_several_browsers(
    places: Path, model_file: Path, tmp_path: Path
) -> None:
    save_result(tmp_path / "r.mat", places, model_file)
    served = App(open_source(SourceOptions(source=str(tmp_path / "r.mat"), data=places, n_parts=4)), "127.0.0.1", 0)
    try:
        with Browser(url(served)) as one, Browser(url(served)) as other:
            for browser, query in ((one, 3), (other, 5)):
                browser.greet()
                browser.tell("query", query)
            for browser, query in ((one, "3"), (other, "5")):
                browser.wait(lambda browser=browser, query=query: browser.status("query") == query)
            assert one.find("Use my own picture") is None
    finally:
        served.close()


# Clean-up after browsers that leave.


def at_work() -> bool:
    """Return whether a thread works for a browser."""
    return any(re.match("explorer-(worker|job|ranking|upload)", thread.name) for thread in threading.enumerate())


def held() -> Counter[str]:
    """Count objects of browsers, threads, and open files, after all work for browsers has ended.

    `gc.get_objects` may return a tuple that another thread is creating, which raises an error in that thread.
    """
    wait_until(lambda: not at_work())
    gc.collect()
    counts = Counter(type(one).__name__ for one in gc.get_objects() if type(one) in PER_BROWSER)
    # viser's thread pool grows to 32 threads and stays.
    counts["threads"] = sum(not thread.name.startswith("ThreadPool") for thread in threading.enumerate())
    if sys.platform == "linux":
        counts["files"] = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return counts


def settled() -> Counter[str]:
    """Count the same after all browsers have left."""
    wait_until(lambda: not held()["ClientSession"], held)
    return held()


def picture(size: int = 700) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (size, size, 3), np.uint8)
    return cv2.imencode(".png", noise)[1].tobytes()


class DeafBrowser(Browser):
    """A page that stops reading when `deaf` is set, while its socket takes next to nothing."""

    def __init__(self, url: str) -> None:
        self.deaf, self.hears = threading.Event(), threading.Event()
        own = socket.socket()
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        own.connect(("127.0.0.1", int(url.rpartition(":")[2])))
        super().__init__(url, sock=own, ping_interval=None)

    def _take(self, data: bytes | str) -> None:
        if self.deaf.is_set():
            self.hears.wait(TIMEOUT)
        super()._take(data)


@pytest.mark.slow
def test_a_browser_that_never_reads_is_bounded_and_let_go_while_others_are_answered(
    app: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gateway, "READ_TIMEOUT", 5.0)
    clients = app.server._websock_server._client_state_from_id
    with Browser(url(app)) as other, DeafBrowser(url(app)) as deaf:
        other.greet()
        deaf.greet()
        number = max(clients)
        buffer = clients[number].message_buffer
        deaf.deaf.set()

        def gone() -> bool:
            with contextlib.suppress(ConnectionClosed):
                for angle in range(-9, 9):
                    deaf.set("Rotate", angle)
                deaf.upload("mine.svg", b"<svg>", transfer=f"{time.monotonic()}")
            assert len(buffer.message_from_id) < 300
            other.turn(-int(other.status("angle") or 0) or 7)
            return number not in clients

        wait_until(gone)
        wait_until(lambda: number not in app._sessions)
        other.turn(33)
        deaf.hears.set()


def leave_after_an_answer(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()


def leave_during_an_answer(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        browser.set("Rotate", 77)


def leave_during_a_second_upload(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        browser.upload("mine.png", picture(90), transfer="one")
        browser.wait(lambda: browser.status("name") == "mine.png")
        button, content = browser.find("Use my own picture"), picture()
        browser.send(
            "FileTransferStartUpload",
            source_component_uuid=button,
            transfer_uuid="two",
            filename="b.png",
            mime_type="image/png",
            part_count=3,
            size_bytes=len(content),
        )
        browser.part(0, content[:CHUNK], "two")


def leave_while_a_picture_is_decoded(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        browser.upload("mine.png", picture(500))


def leave_during_a_sweep_and_a_report(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.greet()
        session = session_of(app, browser)
        session.change(lambda state: replace(state, why=True, lab=True))
        browser.wait(lambda: 'id="lpn-why"' in browser.html())
        browser.tell("sweep", "rotation")
        wait_until(lambda: (sweep := session.views.explain_window._content.sweep) is not None and sweep.total)
        browser.tell("report", None)
        wait_until(lambda: session.views.reporter._job is not None)


def leave_before_the_first_message(app: App) -> None:
    with Browser(url(app)):
        pass


def leave_before_the_page_is_built(app: App) -> None:
    with Browser(url(app)) as browser:
        browser.camera()


@pytest.mark.slow
def test_browsers_that_leave_at_any_time_leave_nothing_behind(app: App) -> None:
    ways = (
        leave_after_an_answer,
        leave_during_an_answer,
        leave_during_a_second_upload,
        leave_while_a_picture_is_decoded,
        leave_during_a_sweep_and_a_report,
        leave_before_the_first_message,
        leave_before_the_page_is_built,
    )
    for way in ways:  # creates what stays for the process: threads of pools, files of shared libraries
        way(app)
    before = settled()
    for _ in range(2):
        threads = [threading.Thread(target=way, args=(app,)) for way in ways]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(TIMEOUT)
    wait_until(lambda: not (held() - before), lambda: held() - before)
    assert not app._sessions
    assert not app.server.get_clients()
    assert not app.server.gui._current_file_upload_states
    assert not app.server._websock_server._client_state_from_id
    assert not app.server._websock_server._live_connections


def test_nothing_is_computed_for_a_browser_that_left(app: App, workspace: Workspace, gate: Gate) -> None:
    with Browser(url(app)) as stays:
        stays.greet()
        with Browser(url(app)) as goes:
            goes.greet()
            gate.close()
            stays.set("Rotate", 61)
            assert gate.began.wait(TIMEOUT)
            goes.set("Rotate", 62)
            wait_until(lambda: workspace.inference.queue_length == 1)
            session = weakref.ref(session_of(app, goes))
            passes = gate.passes
        wait_until(lambda: workspace.inference.queue_length == 0)
        wait_until(lambda: (gc.collect(), session() is None)[1])
        gate.open.set()
        stays.wait(lambda: stays.status("angle") == "61")
        assert gate.passes <= passes + 1, "the tile's, at most"


def test_a_page_built_after_its_browser_left_is_removed(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    building, go = threading.Event(), threading.Event()

    class Late(Stage):
        def __init__(self, *given: object) -> None:
            building.set()
            assert go.wait(TIMEOUT)
            super().__init__(*given)  # type: ignore[arg-type]

    leave_after_an_answer(app)  # the thread of the network and the file of icons stay
    before = settled()
    with monkeypatch.context() as patched:
        patched.setattr(views, "Stage", Late)
        with Browser(url(app)) as browser:
            browser.camera()
            browser.wait(lambda: browser.find("page") is not None)
            browser.tell("hello", {"search": "?screen=all", "small": False})
            assert building.wait(TIMEOUT)
        wait_until(lambda: not app.server.get_clients())
        go.set()
        wait_until(lambda: not (held() - before), lambda: held() - before)
    assert not app._sessions


def test_a_session_that_is_built_for_a_browser_that_has_left_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    built = Mock()
    monkeypatch.setattr(explorer.app, "ClientSession", lambda *_: built)
    # The page was changing its workspace: the session to replace is no longer listed.
    app = Mock(_lock=threading.Lock(), _sessions={}, server=Mock(get_clients=dict))
    assert App._begin(app, Mock(client_id=3), Mock(), "", Mock()) is built
    built.leave.assert_called()
    assert app._sessions == {}
