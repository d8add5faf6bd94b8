"""One connected browser: its state, and the worker that analyses its state."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import viser

from explorer import session_state
from explorer.browse.own_pictures import HandedOver
from explorer.client import messages
from explorer.client.address import PageAddress, as_before, opened_alone
from explorer.client.messages import PageMessage
from explorer.client.services import WorkspaceServices
from explorer.client.views import ClientViews
from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.batching import SupersededError
from explorer.compute.inference_scheduler import RETRY_AFTER, BusyError
from explorer.compute.own_photos import OwnPhotoComparisons
from explorer.compute.ranking_progress import RankingProgress
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import DelayedCall, Worker
from explorer.panels import answer_text
from explorer.session_state import SessionState, StateChange
from explorer.stage.cards import SHOWN
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.tasks.task import Scoring, scored_key

log = logging.getLogger(__name__)

# Seconds of an analysis after which the page says that it is being computed.
_SLOW = 0.5
# Seconds that a page may take to show the first screen of another workspace.
_PREVIEWED = 3.0
# Seconds that a drawing may take to end on a busy machine.
_DRAWN = 60.0
# Seconds between looks at the preparation of a scoring.
_POLL = 0.5


class ClientSession:
    """Connects one browser's state, worker, and views.

    Callbacks replace the state (`change`) and wake the worker; the worker analyses the newest state and draws it.

    Args:
        services: the workspace to show.
        show_other: replaces this session by one of another workspace, given its key and the query string of its address.
        search: a query string in place of that of the page's address.
        on_shown: called when the first answer is shown.
        ready: the analysis of a state that the page may open with, see `preview`.
        own: the pictures that the page's session before this one handed over.
        left: the task and the query at which the page left each workspace, by its key.
        before: what the page showed before, see `kept`.

    Attributes:
        views: all that the page shows.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        services: WorkspaceServices,
        show_other: Callable[[ClientSession, str, str], None],
        search: str | None = None,
        on_shown: Callable[[], None] = lambda: None,
        ready: StateAnalysis | None = None,
        own: HandedOver | None = None,
        left: Mapping[str, tuple[str, int]] | None = None,
        before: SessionState | None = None,
    ) -> None:
        workspace = services.workspace
        self._on_shown, self._ready, self._previewed = on_shown, ready, threading.Event()
        self.client, self._workspace = client, workspace
        self._lock = threading.RLock()
        self._shown: StateAnalysis | None = None
        # The scoring that this page waits for.
        self._preparing: BackgroundJob[None] | None = None
        self._left = left or {}
        # The first screen's button of a place starts it anew; the workbench's goes on.
        starts = before is not None and before.first_screen
        self._state = self._opening_state(workspace, {} if starts else self._left)
        self._requests = RequestContext(workspace.inference)
        self._analyser = StateAnalyser(workspace, self._requests.queued(workspace.model))
        with self._lock:  # a control works as soon as it is in the page; its callback waits here for the rest
            self.views = ClientViews(
                client,
                services,
                self._requests,
                lambda: self._state,
                self.change,
                lambda search: self._built_address.show(search),
                self._on_select,
                lambda scoring: self._receive(messages.ShowScoring(scoring)),
                {PageMessage: self._receive},
            )
            self.views.panels.query.take_over(own)
            self._worker = Worker(self._work, self.views.fail)
            self.views.viewport.watch(self._refit)
            workspace.watchers.watch(self._worker.wake)
            self._comparisons = OwnPhotoComparisons() if own is None else own.comparisons
            self._own_photo = self._comparisons.of(workspace.own_photos, self._follow_own_photo)
            self._ranking_progress = RankingProgress(self.views.panels.answer.show_results, self._worker.wake)
            self._address = PageAddress(
                workspace,
                services.url_state,
                self.views,
                self._lock,
                lambda: self._state,
                lambda key, search: show_other(self, key, search),
                search,
                self._worker.wake,
                before,
            )
            self._worker.wake()  # most pages open with this state: it is analysed while the browser draws the controls

    def change(self, change: StateChange) -> None:
        """Replace the state by a pure function's result; if it differs, update the controls and wake the worker."""
        with self._lock:
            before, state = self._state, change(self._state)
            if state is None:
                return
            state = session_state.leave_first_screen(before, self._workspace.supported_state(state))
            if state == before:
                return
            moved = (state.screen, state.query, state.upload) != (before.screen, before.query, before.upload)
            # An error of the address is told before the first picture, and stays when that comes.
            if moved and (self._shown is not None or self._worker.failed):
                self.views.panels.forget_error()
            self.views.follow(before, state)
            if change is session_state.flip_dark:  # a person's choice, unlike the theme of an address
                self.views.bridge.call("keepTheme", "dark" if state.dark else "light")
            if change is session_state.flip_words:
                self.views.bridge.call("keepWords", "plain" if state.plain else "expert")
            elif change is session_state.show_everything and before.plain:
                self.views.bridge.call("tellWords")
            only_windows = state == session_state.with_windows(before, state)
            self._state = state
            if only_windows:  # nothing to analyse
                self._address.write(state)
                return
            self._requests.supersede()
            self.views.panels.write(state)
        self._worker.wake()

    def fit_camera(self) -> None:
        """Fit the stage to the page's window, whose camera has changed."""
        self.views.fit_camera()

    def _refit(self) -> None:
        """Draw the stage for its new size; the worker does it, as it does all drawing."""
        if self._shown is not None and self.views.outgrown(self._shown):
            self._worker.wake("size")

    def _follow_own_photo(self) -> None:
        """Have the worker show what has become of the own picture's registration."""
        self._worker.wake("own photo")

    def hand_over(self) -> HandedOver | None:
        """Return the user's own pictures, whose comparisons go on, for the session that is to replace this one."""
        own = self.views.panels.query.hand_over()
        if own is None:
            return None
        self._own_photo.follow(None)
        self._own_photo.attach(lambda: None)
        own, self._comparisons = replace(own, comparisons=self._comparisons), OwnPhotoComparisons()
        return own

    def leave(self) -> None:
        """Stop all threads and computations of this browser; it has disconnected."""
        self._address.leave()
        self._ranking_progress.close()
        self._comparisons.close()
        self._workspace.watchers.unwatch(self._worker.wake)
        self._worker.stop()
        self.views.leave()
        self._requests.close()

    def end(self) -> None:
        """Leave, and wait for drawings that go on: the page would show them over what the next session draws."""
        self.leave()
        self._worker.join(_DRAWN)
        self.views.flight.join(_DRAWN)

    def preview(self, services: WorkspaceServices, search: str) -> StateAnalysis | None:
        """Show the first screen of another workspace, whose session is to replace this one, and return its analysis.

        Building that session takes the page seconds. None if either of the two is not on its first screen.
        """
        workspace, shown = services.workspace, self._state
        if not shown.first_screen:
            return None
        read = services.url_state.read(search, self._opening_state(workspace, {}))[0]
        state = as_before(opened_alone(services.url_state, workspace, search, read), shown)
        if not state.first_screen:
            return None
        requests = RequestContext(workspace.inference)
        try:
            analysis = StateAnalyser(workspace, requests.queued(workspace.model), cancellable=False).analyse(
                state, SHOWN
            )
        except LPNError:  # the other session will say it
            return None
        finally:
            requests.close()
        self.views.preview(analysis, workspace)
        self._previewed.wait(_PREVIEWED)
        return analysis

    @property
    def left(self) -> Mapping[str, tuple[str, int]]:
        """The task and the query at which the page left each workspace, by its key, with those that it shows now."""
        return {**self._left, self._workspace.key: (self._state.task, self._state.query)}

    @property
    def kept(self) -> SessionState | None:
        """The state that hands its theme and words on to another workspace; None if the page's address has opened that one."""
        return None if self._built_address.leads_elsewhere else self._state

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
        self._built_address.stay()
        self._worker.wake()
        self.views.panels.notify_error(f"Not opened: {label}", error)

    @property
    def _built_address(self) -> PageAddress:
        """The page's address, once all is built; a message may come before."""
        with self._lock:
            return self._address

    def _receive(self, message: PageMessage) -> None:
        address = self._built_address
        match message:
            case messages.Greet(greeting):
                address.greet(greeting)
            case messages.GoBack(search):
                address.go_back(search)
            case messages.ShowOther(key):
                address.show_other(key)
            case messages.ConfirmPreview():
                self._previewed.set()
            case messages.ResizeStage(width, height):
                self.views.viewport.resize(width, height)
            case messages.FitPanels(small):
                self.views.fit(small)
            case messages.ShowTask(task):
                self.change(self.views.panels.navigation.choose_task(task))
            case messages.ShowScoring(scoring):
                self._show_scoring(scoring)
            case messages.CancelScoring():
                self._preparing = None
            case messages.UndoAlteration(alteration):
                self.change(lambda state: session_state.undo(state, alteration))
            case messages.ActOnFirstScreen(action):
                self.views.first_screen.act(action)
            case messages.FlipTheme():
                self.change(session_state.flip_dark)
            case messages.FlipWords():
                self.change(session_state.flip_words)
            case messages.ShowGlossary():
                self.views.glossary.show()
            case messages.StraightenStage():
                self.views.stage.straighten()
            case messages.CloseMap():
                self.change(lambda state: replace(state, map=False))

    def _show_scoring(self, scoring: Scoring) -> None:
        """Rank by a scoring; one that is not ready is prepared first, while the page goes on."""
        if scored_key(self._state.task, scoring) in self._workspace.rankings:
            self.change(lambda state: replace(state, scoring=scoring))
        elif (job := self._workspace.scorings.prepare(self)) is not None:
            self._preparing = job
            threading.Thread(
                target=self._await_scoring, args=(job, scoring), name="explorer-scoring", daemon=True
            ).start()

    def _await_scoring(self, job: BackgroundJob[None], scoring: Scoring) -> None:
        answer = self.views.panels.answer
        while not job.wait(_POLL):
            if self._requests.closed or self._preparing is not job:
                job.leave(self)
                break
            answer.show_preparation(job, self._workspace.rankings[self._state.ranking_key])
        if self._requests.closed:
            return
        chosen = self._preparing is job
        if chosen:
            self._preparing = None
        if self._preparing is None:
            answer.show_preparation(None, self._workspace.rankings[self._state.ranking_key])
        if not chosen:
            return
        if job.error is not None:
            self.views.panels.notify_error("Not calibrated", job.error)
        else:
            self.change(lambda state: replace(state, scoring=scoring))

    def _on_select(self, drawn_state: SessionState, index: int) -> None:
        self.change(lambda state: session_state.compare(state, drawn_state, index))

    def _work(self) -> float | None:
        """Analyse and draw the newest state; returns the seconds after which to try again when the server is overloaded."""
        if self._address.waiting and self._ready is not None:
            return None
        if self._address.waiting:
            # An error is said when this state is to be drawn, and a newer state has woken the worker.
            with contextlib.suppress(LPNError, SupersededError), self._requests.answering():
                self._analyser.analyse(self._state, SHOWN)
            return None
        shown, reasons = self._shown, self._worker.reasons
        if shown is not None and shown.state == self._state and reasons <= {"size", "own photo"}:
            if "size" in reasons and self.views.outgrown(shown):
                self.views.refit(shown)
                self._refit()
            if "own photo" in reasons:
                self.views.show_own_photo(shown)
            return None
        slow = DelayedCall(_SLOW, self.views.panels.answer.show_busy)
        try:
            ready, self._ready = self._ready, None
            if ready is not None and ready.state == self._state:
                analysis = ready
            else:
                with self._requests.answering():
                    try:
                        analysis = self._analyser.analyse(self._state, SHOWN)
                    except SupersededError:
                        analysis = self._analyser.analyse(self._state, SHOWN)
            started = time.perf_counter()
            analysis = self._with_own_photo(analysis)
            self.views.show(analysis, slow.cancel)
            if self._shown is None:
                self._on_shown()
            self._shown = analysis
            self._refit()  # the size may have changed while it was drawn
        except BusyError:
            slow.cancel()
            self.views.panels.answer.show_overloaded()
            return RETRY_AFTER
        finally:
            slow.cancel()
        second, task = self._workspace.compared(analysis.state), analysis.task
        other = None if second is None or second.workspace is None else second.workspace.ranked_as(task)
        # The switch of scorings tells what each brings.
        main, *scored = self._workspace.scored_rankings(task)
        self._ranking_progress.follow(main, *([] if other is None else [other]), figures=scored)
        self._address.write(analysis.state)
        if log.isEnabledFor(logging.DEBUG):
            log.debug("%s", self._log_line(analysis, time.perf_counter() - started))
        return None

    def _with_own_photo(self, analysis: StateAnalysis) -> StateAnalysis:
        """Begin to register the own picture of an analysis, wherever its tag lies; all are forgotten with the last picture."""
        picture = analysis.state.upload
        windows = [] if picture is None else answer_text.own_windows(analysis)
        own = self.views.panels.query.own
        if picture is None and (own is None or not own.held):
            self._comparisons.forget()
        return replace(analysis, own_photo=self._own_photo.follow(picture, windows))

    def _opening_state(self, workspace: Workspace, left: Mapping[str, tuple[str, int]]) -> SessionState:
        """Return the state that a page of a workspace has before its address is read.

        Args:
            left: task and picture that the page showed last in each workspace, with which it goes on.
        """
        task, query = left.get(workspace.key, (next(iter(workspace.tasks)), workspace.first_query))
        scoring = workspace.default_scoring(task)
        return workspace.supported_state(SessionState(task, workspace.contract.n_parts, query=query, scoring=scoring))

    def _log_line(self, analysis: StateAnalysis, drawing: float) -> str:
        state = analysis.state
        query = f"own picture {printable(analysis.name)}" if state.upload else f"query {printable(analysis.name)}"
        change = f"turn {state.angle:g}, shift {state.shift} {state.down}, zoom {state.zoom:g}"
        change += f", {state.change.weather.describe()}" if state.change.weather else ""
        times = f"computed in {1000 * analysis.seconds:.0f} ms, shown in {1000 * drawing:.0f} ms"
        return (
            f"Browser {self.client.client_id}: answer {self.views.sequence}: {state.task}, {query}, {change}: {times}"
        )
