"""The address of one page: what it names is shown, and it names what is shown."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from explorer import lab_choices, session_state
from explorer.client.messages import Greeting
from explorer.client.views import ClientViews
from explorer.compute.worker import DelayedCall
from explorer.session_state import SessionState, in_words
from explorer.stage.viewport import MAX_SIDE
from explorer.url_state import UrlState
from explorer.workspace import Workspace

# Seconds that a new page has to send its address, before the default state is analysed. A busy machine loads pages slowly.
_ADDRESS_TIMEOUT = 30.0


class PageAddress:
    """Reads and writes the address of one page.

    Args:
        lock: the session's, which guards its state.
        state: returns the newest state, at first the one that addresses leave out.
        show_other: replaces the session by one of another workspace, given its key and the query string of its address.
        search: a query string in place of that of the page's address.
        wake: wakes the session's worker.
        before: what the page showed of another workspace, which this one replaces; None for a page that is opened.

    Attributes:
        waiting: the page has yet to send its address, or that is yet to be read.
        leads_elsewhere: the page's address names another workspace, which is being opened.
    """

    def __init__(
        self,
        workspace: Workspace,
        url_state: UrlState,
        views: ClientViews,
        lock: AbstractContextManager[object],
        state: Callable[[], SessionState],
        show_other: Callable[[str, str], None],
        search: str | None,
        wake: Callable[[], None],
        before: SessionState | None = None,
    ) -> None:
        self._workspace, self._url_state, self._views = workspace, url_state, views
        self._lock, self._state = lock, state
        # An address without a scoring means the one that the task was opened with.
        opened = workspace.tasks[state().task].scoring
        self._plain = replace(state(), scoring=opened)
        self._show_other, self._search, self._wake, self._before = show_other, search, wake, before
        self._greeted, self.waiting, self.leads_elsewhere = False, True, False
        self._timeout = DelayedCall(_ADDRESS_TIMEOUT, self._stop_waiting)

    def greet(self, greeting: Greeting) -> None:
        """Show what a new page's address names; the page sends its greeting until it gets an answer."""
        with self._lock:
            if self._greeted:
                return
            self._greeted = True
            self._timeout.cancel()
            if (stage := greeting.viewport) is not None and all(1 <= side <= MAX_SIDE for side in stage):
                self._views.viewport.resize(*map(int, stage))
            self._views.fit(greeting.small)
            if self._before is None:  # else the page has its theme, and keeps it
                self._views.set_theme(replace(self._state(), dark=not greeting.light))
            search = greeting.search if self._search is None else self._search
            if (other := self._url_state.other_workspace(search)) is not None:
                self.leads_elsewhere, self.waiting = True, False
                self._show_other(other, search)
                return
            before, self._before = self._before, None  # it may hold an own picture
        start = self._start(search)
        if before is None:
            start = in_words(start, greeting.plain, greeting.start_plain)
        try:
            state, problems = self._read(search, start)
        except BaseException:
            self._stop_waiting()
            raise
        if before is not None:
            state = as_before(state, before)
        else:
            state = replace(state, dark=not greeting.light)
            # The words that a link asks for are those of what it opens.
            state = in_words(state, state.plain, state.start_plain if state.first_screen else greeting.start_plain)
        with self._lock:
            now = self._state()
            self.waiting = False  # the worker may have been woken meanwhile, and would have drawn another state first
            self._views.show_state(state)
            if self._state() is now:  # otherwise the change has woken the worker
                self._wake()
        if problems:
            self._views.panels.notify_error("Not all of the link can be shown", " ".join(problems))

    def go_back(self, search: str) -> None:
        """Show what an earlier address of the page's history shows."""
        key = self._url_state.workspace_key(search)
        if key != self._workspace.key and key in self._workspace.choices:
            self._show_other(key, search)
        elif problems := self.show(search):
            self._views.panels.notify_error("Not all of what was shown can be shown again", " ".join(problems))

    def show(self, search: str) -> list[str]:
        """Show what an address of this workspace shows, with the page's theme, words, filter, and own pictures.

        Returns a sentence about each value that is invalid, see `UrlState.read`.
        """
        before = self._state()
        kept = {name: getattr(before, name) for name in ("dark", "find", "laboratory")}
        state, problems = self._url_state.read(search, replace(self._plain, **kept), self._views.panels.query.find_own)
        if state.task != before.task and not state.lab:  # filter, columns, and rows are those of the other task
            state = replace(state, laboratory=lab_choices.for_any_task(before.laboratory))
        self._views.show_state(as_before(state, before))
        return problems

    def show_other(self, key: str) -> None:
        """Show another workspace, if there is one of this key."""
        state = self._state()
        if key in self._workspace.choices and key != self._workspace.key:
            self._show_other(key, f"?show={key}{'&screen=first' if state.first_screen else ''}")

    def write(self, state: SessionState) -> None:
        """Let the page's address name a state, with what the windows show by now."""
        if not self._greeted or self.leads_elsewhere:  # the page would lose its own address
            return
        with self._lock:  # otherwise the worker could replace a newer address of the laboratory by an older one
            whole_state = session_state.with_windows(state, self._state())
            self._views.bridge.set_address(self._url_state.write(whole_state), self._url_state.keys)

    def stay(self) -> None:
        """Let the address name this workspace; the one that it named cannot be opened."""
        self.leads_elsewhere = False

    def leave(self) -> None:
        """Wait no more for a page that has left."""
        self._timeout.cancel()

    def _start(self, search: str) -> SessionState:
        """Return the state of which an address names the differences."""
        return self._plain if self._url_state.names_a_state(search) else self._state()

    def _read(self, search: str, start: SessionState) -> tuple[SessionState, list[str]]:
        """Return what an address shows, and a sentence about each of its values that is invalid."""
        # A page that comes back from another workspace holds its own pictures still.
        state, problems = self._url_state.read(search, start, self._views.panels.query.find_own)
        return opened_alone(self._url_state, self._workspace, search, state), problems

    def _stop_waiting(self) -> None:
        try:
            # Another workspace was asked for by its address, and the page has a theme and words already.
            if (before := self._before) is not None and (search := self._search) is not None and not self._greeted:
                state = as_before(self._read(search, self._start(search))[0], before)
                with self._lock:
                    if not self._greeted:
                        self._views.show_state(state)
        finally:
            self.waiting = False
            self._wake()


def opened_alone(url_state: UrlState, workspace: Workspace, search: str, state: SessionState) -> SessionState:
    """Return what an address shows that names a workspace alone, of a flight its window or the first screen, or nothing."""
    if url_state.names_nothing(search):
        return replace(state, first_screen=True)
    if not workspace.has_flight or not url_state.names_only_a_workspace(search):
        return state
    first = bool(workspace.about) or state.first_screen
    return replace(state, flight=not first, first_screen=first)


def as_before(state: SessionState, before: SessionState) -> SessionState:
    """Return what an address shows in the theme and the words of what the page showed before.

    The words of a workbench are its address's if the first screen was shown before: that has words of its own.
    """
    plain = state.plain if before.first_screen else before.plain
    return in_words(replace(state, dark=before.dark), plain, before.start_plain)
