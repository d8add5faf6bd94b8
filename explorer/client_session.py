"""One connected browser: its state, its windows, and the worker that analyses its state."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgspec
import viser

from explorer import session_state
from explorer.browse.feeds import Feeds
from explorer.compute.inference_scheduler import RETRY_AFTER, BusyError
from explorer.compute.ranking_progress import RankingProgress
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import DelayedCall, Worker
from explorer.explain_window.window import ExplainWindow
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.window import FailureLabWindow
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService
from explorer.flight_window.window import FlightWindow
from explorer.panels import answer_text, pages, shortcuts
from explorer.panels.first_screen import FirstScreen, plain_state
from explorer.panels.glossary import Glossary
from explorer.panels.panels import Panels
from explorer.reports import Reporter
from explorer.server.picture_route import EncodedPicture
from explorer.session_state import SessionState, StateChange
from explorer.stage.cards import SHOWN
from explorer.stage.scene import SCENE, Stage
from explorer.stage.viewport import Viewport
from explorer.stories import tour
from explorer.stories.window import StoryWindow
from explorer.stories.windows import WindowSources
from explorer.url_state import UrlState
from explorer.web import style
from explorer.web.bridge import PageBridge
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.datasets.rendered import shows_rendered

log = logging.getLogger(__name__)

# Seconds that a new page has to send its address, before the default state is analysed. A busy machine loads pages slowly.
_ADDRESS_TIMEOUT = 30.0
# Seconds of an analysis after which the page says that it is being computed.
_SLOW = 0.5


@dataclass(frozen=True, eq=False)
class WorkspaceServices:
    """A workspace, and what is derived from it once for all browsers.

    Attributes:
        failure_lab: computes the failure laboratory's tables.
        url_state: converts states to addresses and back.
        feeds: serves the lists that pages scroll through, and thumbnails.
        flight: derives what flight windows show.
        flight_pictures: serves their pictures.
    """

    workspace: Workspace
    failure_lab: FailureLab
    url_state: UrlState
    feeds: Feeds
    flight: FlightService
    flight_pictures: FlightPictures

    @classmethod
    def of(cls, workspace: Workspace) -> WorkspaceServices:
        """Derive them from a workspace."""
        return cls(
            workspace,
            FailureLab(workspace),
            UrlState(workspace),
            Feeds(workspace),
            FlightService(workspace),
            FlightPictures(workspace),
        )

    def find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return what computes the picture of a path below `PREFIX`, see `PictureSource`."""
        return self.feeds.find(path) or self.flight_pictures.find(path)


class ClientSession:
    """Connects one browser's controls, worker, and views.

    Callbacks replace the state (`change`) and wake the worker; the worker analyses the newest state and draws it.

    Args:
        services: the workspace to show.
        show_other: replaces this session by one of another workspace, given its key and the query string of its address.
        search: a query string in place of that of the page's address.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        services: WorkspaceServices,
        show_other: Callable[[ClientSession, str, str], None],
        search: str | None = None,
    ) -> None:
        workspace = services.workspace
        self.client, self._workspace, self._url_state = client, workspace, services.url_state
        self._show_other, self._search = show_other, search
        self._lock = threading.RLock()
        self._greeted = self._small = False
        self._waiting = True  # for the page's address
        self._sequence = 0
        task = next(iter(workspace.tasks))
        state = SessionState(task, workspace.contract.n_parts, query=workspace.first_query)
        self._state = self._plain = workspace.supported_state(state)
        self._requests = RequestContext(workspace.inference)
        self._analyser = StateAnalyser(workspace, self._requests.queued(workspace.model))
        with self._lock:  # a control works as soon as it is in the page; its callback waits here for the rest
            self._set_theme(self._state)
            self._panels = Panels(client, workspace, services.feeds, self._state, self.change)
            self._viewport = viewport = Viewport()
            self._reporter = Reporter(client, self._requests.queued(workspace.model, background=True))
            self._explain_window = ExplainWindow(
                client,
                workspace,
                self.change,
                self._on_error,
                viewport,
                self._reporter,
                self._requests,
                lambda name: self._bridge.open_tab(name),
            )
            self._lab = FailureLabWindow(
                client, workspace, services.failure_lab, services.feeds, self.change, viewport, self._reporter
            )
            self._flight = FlightWindow(
                client, workspace, services.flight, services.flight_pictures, self.change, viewport, self._on_error
            )
            self._stories = StoryWindow(
                client,
                workspace,
                services.url_state,
                self._panels.answer.stories,
                lambda: self._state,
                self._show_address,
                partial(self._show_state, whole=True),
                lambda function, *arguments: self._bridge.call(function, *arguments),
                viewport,
                self._reporter,
                WindowSources(workspace, services.failure_lab, services.flight),
            )
            self._panels.navigation.order = self._lab.order
            self._panels.query.compare_models = self._explain_window.compare_models
            glossary = Glossary(client.gui)
            own = self._panels.query.own
            self._first_screen = FirstScreen(
                client.gui,
                workspace,
                self._panels.navigation,
                self.change,
                self._lab.restore,
                (lambda _: None) if own is None else own.position,
            )
            handlers = {
                "viewport": viewport.update,
                "hello": self._on_greeting,
                "small": self._fit,
                "task": lambda name: self.change(self._panels.navigation.choose_task(name)),
                "dark": lambda _: self.change(session_state.flip_dark),
                "back": self._on_back,
                "undo": lambda kind: self.change(lambda state: session_state.undo(state, kind)),
                "glossary": lambda _: glossary.show(),
                "show": self._on_other,
                "straighten": self._straighten,
                "map-close": lambda _: self.change(lambda state: replace(state, map=False)),
                "screen": self._first_screen.act,
            }
            handlers |= self._explain_window.handlers() | self._lab.handlers() | self._flight.handlers()
            handlers |= self._stories.handlers() | self._panels.query.handlers()
            title = f"{workspace.data_name} · LPN Explorer"
            properties = {
                "title": title,
                "tour": msgspec.to_builtins(self._stories.tour),
                "places": tour.places(workspace.layout),
                "scene": SCENE,
                "keys": self._url_state.keys,
                "ownHint": answer_text.own_hint(workspace, shows_rendered(workspace.root)),
            }
            self._bridge = PageBridge(client.gui, handlers, properties, style.STYLE)
            windows = (self._explain_window, self._lab, self._flight)
            commands = self._stories.commands()
            commands += [(label, None, call) for window in windows for label, call in window.commands()]
            commands.append(("Glossary", None, glossary.show))
            commands.append(("First screen", None, lambda: self._first_screen.act("start")))
            shortcuts.add(client.gui, workspace, self._panels, self.change, self._bridge, commands, self._stories.close)
            background = self._requests.queued(workspace.model, background=True)
            self._stage = Stage(client, workspace, self._on_select, background, viewport)
            self._worker = Worker(self._work, self._on_failed_answer)
            viewport.watch(lambda: self._worker.wake() if self._stage.outgrown else None)
            self._ranking_progress = RankingProgress(self._panels.answer.show_results, self._worker.wake)
            self._greeting_timeout = DelayedCall(_ADDRESS_TIMEOUT, self._stop_waiting)
            self._worker.wake()  # most pages open with this state: it is analysed while the browser draws the controls

    def change(self, change: StateChange) -> None:
        """Replace the state by a pure function's result; if it differs, update the controls and wake the worker."""
        with self._lock:
            state = change(self._state)
            if state is None:
                return
            state = session_state.leave_first_screen(self._state, self._workspace.supported_state(state))
            if state == self._state:
                return
            if state.dark != self._state.dark:
                self._set_theme(state)
                if change is session_state.flip_dark:  # a person's choice, unlike the theme of an address
                    self._bridge.call("keepTheme", "dark" if state.dark else "light")
            if state.screen != self._state.screen:
                self._panels.forget_error()
            if state.shows_reasons and not self._state.shows_reasons:
                self._explain_window.announce()
                self._bridge.call("revealReasons")
            if self._state.shows_reasons and not state.shows_reasons:
                self._explain_window.close()
            if state.flight and not self._state.flight:
                self._bridge.call("reveal", "#lpn-flight")
            if state.lab and not self._state.lab:
                self._bridge.call("reveal", ".lab-bar")
            if state.shows_reasons:
                self._explain_window.show_tab(state.why_tab)
            only_windows = state == session_state.with_windows(self._state, state)
            self._state = state
            if only_windows:  # nothing to analyse
                self._write_address(state)
                return
            self._requests.supersede()
            self._panels.write(state)
        self._worker.wake()

    def fit_camera(self) -> None:
        """Fit the stage to the page's window, whose camera has changed."""
        self._stage.fit()

    def _straighten(self, _: object) -> None:
        self._stage.straighten()

    def leave(self) -> None:
        """Stop all threads and computations of this browser; it has disconnected."""
        self._greeting_timeout.cancel()
        self._ranking_progress.close()
        self._reporter.leave()
        self._explain_window.leave()
        self._worker.stop()
        self._stage.leave()
        self._lab.leave()
        self._flight.leave()
        self._panels.query.leave()
        self._requests.close()

    def wait_for(self, label: str) -> viser.NotificationHandle:
        """Say that another workspace is being opened, and show this one until then."""
        self._worker.wake()
        return self.client.add_notification(
            f"Opening {label}",
            "Its pictures are described; this page goes on until then.",
            loading=True,
            auto_close_seconds=None,
        )

    def stay(self, label: str, error: str) -> None:
        """Say why another workspace cannot be shown, and go on with this one."""
        self._worker.wake()
        self._panels.notify_error(f"Not opened: {label}", error)

    def _on_other(self, key: Any) -> None:
        if isinstance(key, str) and key in self._workspace.choices and key != self._workspace.key:
            screen = "&screen=first" if self._state.first_screen else ""
            self._show_other(self, key, f"?show={key}&theme={'dark' if self._state.dark else 'light'}{screen}")

    def _on_select(self, drawn_state: SessionState, index: int) -> None:
        self.change(lambda state: session_state.compare(state, drawn_state, index))

    def _on_back(self, search: Any) -> None:
        """Show what an earlier address of the page's history shows."""
        if not isinstance(search, str):
            return
        key = self._url_state.workspace_key(search)
        if key != self._workspace.key and key in self._workspace.choices:
            self._show_other(self, key, search)
            return
        self._show_address(search)

    def _show_address(self, search: str) -> list[str]:
        """Show what an address of this workspace shows, with the page's theme and filter; see `UrlState.read`."""
        before = self._state
        kept = {name: getattr(before, name) for name in ("dark", "find", "laboratory")}
        state, problems = self._url_state.read(search, replace(self._plain, **kept))
        if state.task != before.task and not state.lab:  # filter, columns, and rows are those of the other task
            state = replace(state, laboratory=session_state.choices_for_any_task(before.laboratory))
        self._show_state(replace(state, dark=before.dark))
        return problems

    def _show_state(self, state: SessionState, whole: bool = False) -> None:
        self._lab.restore(state, whole)
        self.change(lambda _: state)

    def _stop_waiting(self) -> None:
        self._waiting = False
        self._worker.wake()

    def _on_greeting(self, value: Any) -> None:
        """Read the page's address and size; the page sends them until it gets an answer."""
        search = value.get("search") if isinstance(value, dict) else None
        with self._lock:
            if self._greeted or not isinstance(search, str):
                return
            self._greeted, self._waiting = True, False
            self._greeting_timeout.cancel()
            self._viewport.update(value.get("viewport"))
            self._fit(value.get("small"))
            search = search if self._search is None else self._search
            if (other := self._url_state.other_workspace(search)) is not None:
                self._show_other(self, other, search)
                return
            before = self._state
        state, problems = self._url_state.read(search, replace(before, dark=value.get("light") is not True))
        if (kept := value.get("theme")) in ("dark", "light"):  # the choice of the person, before that of a link
            state = replace(state, dark=kept == "dark")
        state = plain_state(state, value.get("first"), self._url_state.names_a_state(search))
        if self._workspace.has_flight and self._url_state.names_only_a_workspace(search):
            state = replace(state, flight=True, first_screen=False)
        with self._lock:
            self._lab.restore(state)
            self.change(lambda _: state)
            if self._state is before:  # otherwise `change` has woken the worker
                self._worker.wake()
        if problems:
            self._panels.notify_error("Not all of the link can be shown", " ".join(problems))

    def _write_address(self, state: SessionState) -> None:
        """Let the page's address name a state, with what the windows show by now."""
        if not self._greeted:  # the page would lose the address that it has yet to send
            return
        with self._lock:  # otherwise the worker could replace a newer address of the laboratory by an older one
            whole_state = session_state.with_windows(state, self._state)
            self._bridge.set_address(self._url_state.write(whole_state), self._url_state.keys)

    def _fit(self, small: Any) -> None:
        if small is True or self._small:
            self._small = small is True
            self._panels.fit(self._small)

    def _set_theme(self, state: SessionState) -> None:
        self.client.gui.configure_theme(
            dark_mode=state.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=(86, 180, 233) if state.dark else (0, 114, 178),
        )

    def _work(self) -> float | None:
        """Analyse and draw the newest state; returns the seconds after which to try again when the server is overloaded."""
        if self._waiting:
            with contextlib.suppress(LPNError):  # it is said when this state is to be drawn
                self._requests.retry_superseded(lambda: self._analyser.analyse(self._state, SHOWN))
            return None
        slow = DelayedCall(_SLOW, self._panels.answer.show_busy)
        try:
            analysis = self._requests.retry_superseded(lambda: self._analyser.analyse(self._state, SHOWN))
            self._sequence += 1
            started = time.perf_counter()
            self._first_screen.show(analysis, self._stories.names)  # before the stage, which takes longer
            with self.client.atomic():  # the page draws one frame
                self._stage.show(analysis)
                self._bridge.set_ground(self._stage.ground)
                self._bridge.set_legend(pages.heat_legend(analysis, self._workspace))
                self._explain_window.show(analysis)
                self._lab.show(analysis)
                self._flight.show(analysis)
                self._stories.show(analysis)
                slow.cancel()
                self._panels.show(analysis, self._sequence, started)
        except BusyError:
            slow.cancel()
            self._panels.answer.show_overloaded()
            return RETRY_AFTER
        finally:
            slow.cancel()
        second, name = self._workspace.second, analysis.task.name
        other = None if second is None or second.workspace is None else second.workspace.rankings.get(name)
        self._ranking_progress.follow(self._workspace.rankings[name], other)
        self._write_address(analysis.state)
        if log.isEnabledFor(logging.DEBUG):
            log.debug("%s", self._log_line(analysis, time.perf_counter() - started))
        return None

    def _log_line(self, analysis: StateAnalysis, drawing: float) -> str:
        state = analysis.state
        query = f"own picture {printable(analysis.name)}" if state.upload else f"query {printable(analysis.name)}"
        change = f"turn {state.angle:g}, shift {state.shift} {state.down}, zoom {state.zoom:g}"
        times = f"computed in {1000 * analysis.seconds:.0f} ms, shown in {1000 * drawing:.0f} ms"
        return f"Browser {self.client.client_id}: answer {self._sequence}: {state.task}, {query}, {change}: {times}"

    def _on_error(self, error: Exception) -> None:
        self._panels.answer.show_idle()
        self._panels.notify_error("No answer", _in_words(error))

    def _on_failed_answer(self, error: Exception) -> None:
        self._on_error(error)
        self._explain_window.fail(_in_words(error))


def _in_words(error: Exception) -> str:
    if isinstance(error, LPNError):
        return str(error)
    return f"{type(error).__name__}: try another picture, or load the page again; the server's log has the details."
