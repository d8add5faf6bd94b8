"""Starts the server and gives every browser its own session, worker, stage, and panels."""

from __future__ import annotations

import gc
import io
import logging
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import viser

from explorer import session_state
from explorer.compute.inference_scheduler import RETRY_AFTER, BusyError
from explorer.compute.ranking_progress import RankingProgress
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import DelayedCall, Worker
from explorer.explain_window import comparison, evidence, model_comparison, region, sweep_page
from explorer.explain_window.window import ExplainWindow
from explorer.failure_lab.service import Laboratory
from explorer.failure_lab.window import Lab
from explorer.opening import open_model, open_saved
from explorer.panels import shortcuts, tour
from explorer.panels.panels import Panels
from explorer.panels.query_panel import PAGE_SIZE
from explorer.panels.viewport import Viewport
from explorer.reports import Reporter
from explorer.server import viser_compat
from explorer.server.auth import Authenticator, authenticator, is_loopback
from explorer.server.gateway import Gateway
from explorer.session_state import SessionState, StateChange
from explorer.stage.cards import SHOWN
from explorer.stage.scene import SCENE, Stage
from explorer.url_state import UrlState
from explorer.web import style
from explorer.web.bridge import PageBridge
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core import images
from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.core.log import conceal
from lpn.core.resources import pool_memory, port_taken, return_memory
from lpn.core.shutdown import writes_finished
from lpn.retrieval.published_results import load_saved

log = logging.getLogger(__name__)

STYLES = "".join(
    (
        style.STYLE,
        evidence.STYLE,
        comparison.STYLE,
        sweep_page.STYLE,
        region.STYLE,
        model_comparison.STYLE,
    )
)
"""Of all panels, the later over the earlier."""
GREETING = 3.0
"""Seconds that a page has to say what its address asks for, before it is shown what every page is."""
CLOSING = 1.5
"""Seconds that an app has to close."""
SLOW = 0.5
"""Seconds that an answer may take before the page says that it is being computed."""


class Visitor:
    """One connected browser. Its state belongs to it alone."""

    def __init__(
        self, client: viser.ClientHandle, workspace: Workspace, laboratory: Laboratory, links: UrlState
    ) -> None:
        self._client, self._workspace, self._links = client, workspace, links
        self._lock = threading.RLock()
        self._greeted = self._small = False
        self._sequence = 0
        task = next(iter(workspace.tasks))
        state = SessionState(task, workspace.spec.n_parts, query=workspace.first, page=workspace.first // PAGE_SIZE)
        self._state = workspace.possible(state)
        self._requests = RequestContext(workspace.inference)
        self._analyser = StateAnalyser(workspace, self._requests.queued(workspace.model))
        with self._lock:  # a control works as soon as it is in the page, and its change waits here for the rest
            self._dress(self._state)
            self._panels = Panels(client, workspace, self._state, self.change)
            room, self._reporter = Viewport(), Reporter(client, self._requests.queued(workspace.model, background=True))
            self._explain_window = ExplainWindow(
                client, workspace, self.change, self._failed, room, self._reporter, self._requests
            )
            self._lab = Lab(client, workspace, laboratory, self.change, room, self._reporter)
            self._panels.navigation.order = self._lab.order
            handlers = {
                "room": room.take,
                "hello": self._hello,
                "small": self._fit,
                "dark": lambda _: self.change(session_state.flip_dark),
            }
            handlers |= self._explain_window.handlers() | self._lab.handlers()
            told = {"steps": [asdict(step) for step in tour.steps(workspace)], "scene": SCENE}
            self._bridge = PageBridge(client.gui, handlers, told, STYLES)
            further = self._explain_window.commands() + self._lab.orders()
            shortcuts.add(client.gui, workspace, self._panels, self.change, self._bridge, further)
            self._stage = Stage(client, workspace, self._selected)
            self._worker = Worker(self._work, self._failed)
            self._ranking_progress = RankingProgress(self._panels.answer.show_results, self._worker.wake)
            self._opening = DelayedCall(GREETING, self._worker.wake)

    def change(self, change: StateChange) -> None:
        """Replace the state by a pure function's result, and ask for an answer when it differs."""
        with self._lock:
            changed = change(self._state)
            if changed is None:
                return
            changed = self._workspace.possible(changed)
            if changed == self._state:
                return
            if changed.dark != self._state.dark:
                self._dress(changed)
            if changed.why and not self._state.why:
                self._bridge.call("reveal", "#lpn-why")
            self._state = changed
            self._requests.supersede()
            self._panels.write(changed)
        self._worker.wake()

    def _selected(self, shown: SessionState, index: int) -> None:
        self.change(lambda state: session_state.compare(state, shown, index))

    def leave(self) -> None:
        """The browser is gone: stop its worker."""
        self._opening.cancel()
        self._ranking_progress.close()
        self._reporter.leave()
        self._explain_window.leave()
        self._worker.stop()
        self._lab.leave()
        self._requests.close()

    def _hello(self, value: Any) -> None:
        """The page says what its address asks for and how large it is; it repeats that until it is answered."""
        search = value.get("search") if isinstance(value, dict) else None
        with self._lock:
            if self._greeted or not isinstance(search, str):
                return
            self._greeted = True
            self._opening.cancel()
            self._fit(value.get("small"))
            before = self._state
            asked, said = self._links.read(search, before)
            self.change(lambda _: replace(asked, page=asked.query // PAGE_SIZE))
            if self._state is before:  # else it has been asked for already, and would be twice
                self._worker.wake()
        if said:
            self._panels.notify_error("Not all of the link can be shown", " ".join(said))

    def _fit(self, small: Any) -> None:
        if small is True or self._small:
            self._small = small is True
            self._panels.fit(self._small)

    def _dress(self, state: SessionState) -> None:
        self._client.gui.configure_theme(
            dark_mode=state.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=(86, 180, 233) if state.dark else (0, 114, 178),
        )

    def _work(self) -> float | None:
        slow = DelayedCall(SLOW, self._panels.answer.show_busy)
        try:
            analysis = self._requests.compute_newest(lambda: self._analyser.analyse(self._state, SHOWN))
            self._sequence += 1
            started = time.perf_counter()
            with self._client.atomic():  # the page takes all of it at once, and draws one frame rather than several
                self._stage.show(analysis)
                self._explain_window.show(analysis)
                self._lab.show(analysis)
                slow.cancel()
                self._panels.show(analysis, self._sequence, started)
        except BusyError:
            slow.cancel()
            self._panels.answer.show_overloaded()
            return RETRY_AFTER
        finally:
            slow.cancel()
        beside = self._workspace.beside
        name = analysis.task.name
        other = None if beside is None else beside.rankings.get(name)
        self._ranking_progress.follow(self._workspace.rankings[name], other)
        self._bridge.set_address(self._links.write(analysis.state), self._links.keys)
        if log.isEnabledFor(logging.DEBUG):
            log.debug("%s", self._line(analysis, time.perf_counter() - started))
        return None

    def _line(self, analysis: StateAnalysis, drawn: float) -> str:
        """An answer as a line of the log."""
        state = analysis.state
        query = f"own picture {printable(analysis.name)}" if state.upload else f"query {printable(analysis.name)}"
        asked = f"turn {state.angle:g}, shift {state.shift} {state.down}, zoom {state.zoom:g}"
        took = f"computed in {1000 * analysis.seconds:.0f} ms, shown in {1000 * drawn:.0f} ms"
        return f"Browser {self._client.client_id}: answer {self._sequence}: {state.task}, {query}, {asked}: {took}"

    def _failed(self, error: Exception) -> None:
        text = (
            str(error)
            if isinstance(error, LPNError)
            else f"{type(error).__name__}: try another picture, or load the page again; the server's log has the details."
        )
        self._panels.answer.show_idle()
        self._panels.notify_error("No answer", text)


class App:
    """The running server.

    Args:
        access: the access rules; by default a random token, and none on a loopback address.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """

    def __init__(self, workspace: Workspace, host: str, port: int, access: Authenticator | None = None) -> None:
        _check_free(host, port)
        self.authenticator = access or authenticator(host, None, False, ())
        conceal(self.authenticator.token)
        conceal(self.authenticator.cookie_value)
        self.gateway = Gateway(self.authenticator)
        viser_compat.use_thread_safe_buffers()
        make = partial(viser.ViserServer, host=host, port=port, label="LPN Explorer", verbose=False)
        with redirect_stdout(io.StringIO()):  # viser announces itself; people need one address, once
            self.server = self.gateway.protect(make)
        # Any page could otherwise ask for a public tunnel to this machine.
        self.server.request_share_url = _refuse_share  # type: ignore[method-assign]
        self.server.scene.world_axes.visible = False
        self._visitors: dict[int, Visitor] = {}
        laboratory, links = Laboratory(workspace), UrlState(workspace)
        self.server.on_client_connect(lambda client: self._connected(client, workspace, laboratory, links))
        self.server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        """Stop every worker and the server, and let files that are being written be finished: 1.5 seconds at most."""
        until = time.monotonic() + CLOSING
        for visitor in list(self._visitors.values()):
            visitor.leave()
        # viser waits for its connections, for up to six seconds.
        stopping = threading.Thread(target=self.server.stop, name="explorer-stop", daemon=True)
        with redirect_stdout(io.StringIO()):  # it announces its end, too
            stopping.start()
            stopping.join(CLOSING)
        if not writes_finished(max(until - time.monotonic(), 0)):
            log.warning("A file is still being written")

    def _connected(
        self, client: viser.ClientHandle, workspace: Workspace, laboratory: Laboratory, links: UrlState
    ) -> None:
        log.info("Browser %d connected", client.client_id)
        self._visitors[client.client_id] = Visitor(client, workspace, laboratory, links)
        if client.client_id not in self.server.get_clients():  # gone while its page was being built
            self._disconnected(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        visitor = self._visitors.pop(client.client_id, None)
        if visitor is not None:
            log.info("Browser %d left", client.client_id)
            visitor.leave()
            del visitor
            # Its views and what they call hold one another, pictures included, and Python would look for that in minutes only.
            gc.collect()
            return_memory()


def run(
    data: Path,
    model: Path,
    query: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    beside: Path | None = None,
    access: Authenticator | None = None,
) -> None:
    """Open a model and a data set, serve the explorer, and print its address, until KeyboardInterrupt.

    Args:
        beside: another model to compare it with.
        access: the access rules; by default those of `App`.

    Raises:
        LPNError: when model, data set, or address cannot be used.
    """
    _serve(lambda: open_model(data, model, query, beside), host, port, access)


def run_saved(
    data: Path,
    saved: Path,
    n_parts: int = 1,
    query: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    access: Authenticator | None = None,
) -> None:
    """The same for a saved `pytorch_result.mat` of descriptors of `n_parts` parts, and the pictures it is of."""
    _serve(lambda: open_saved(data, load_saved(saved, n_parts), query), host, port, access)


def _serve(opened: Callable[[], Workspace], host: str, port: int, access: Authenticator | None) -> None:
    host = host or "0.0.0.0"
    _check_free(host, port)
    pool_memory()
    images.use_all_cores()
    app = App(opened(), host, port, access)
    gc.collect()
    gc.freeze()  # what is there from the start stays, and need not be looked through whenever a browser leaves
    port = app.server.get_port()
    if not is_loopback(host):
        print(
            f"Listening on {host}: who reaches port {port} and has the token can use this. What is sent is not encrypted: "
            "docs/serving.md says how to have it so.",
            flush=True,
        )
    print(f"LPN Explorer is ready: {app.authenticator.link(port)}  (stop with Ctrl-C)", flush=True)
    try:
        while True:
            time.sleep(3600)
    finally:
        app.close()


def _check_free(host: str, port: int) -> None:
    """viser would silently take the next free port, and nobody would find the page."""
    if taken := port_taken(host, port):
        raise InputError(f"{taken}; give another with --port or --host.")


def _refuse_share(*_: Any, **__: Any) -> None:
    return None
