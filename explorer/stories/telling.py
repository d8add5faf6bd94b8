"""One browser's stories: the steps that it keeps, and the telling of stories in its page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from urllib.parse import parse_qs

import msgspec
import viser

from explorer import session_state
from explorer.panels import answer_text
from explorer.reports import Reporter
from explorer.session_state import SessionState
from explorer.stories import exported, library, messages, story, tour
from explorer.stories.messages import StoryMessage
from explorer.stories.story import Story
from explorer.url_state import UrlState
from explorer.web.html import Html
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.errors import LPNError

_EXPORT = "Export the story as one HTML file"
_LOST = "The pictures or columns that you chose in the table are too many for an address: the step is without them."


class StoryTeller:
    """One browser's stories: the row of their names, the steps that it keeps, and what is told.

    Args:
        row: the page's element for the names of the stories.
        state: returns the newest state.
        go: shows the state of a query string; returns a sentence about each value that is invalid.
        restore: shows a former state.
        call: calls a function of the page's script.

    Attributes:
        tour: the built-in story, which a new visitor is told.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        url_state: UrlState,
        row: Html,
        state: Callable[[], SessionState],
        go: Callable[[str], list[str]],
        restore: Callable[[SessionState], None],
        call: Callable[..., None],
        reporter: Reporter,
    ) -> None:
        self._client, self._workspace, self._url_state, self._row = client, workspace, url_state, row
        self._state, self._go, self._restore, self._call = state, go, restore, call
        # The state before the first step of the story that is told; None while none is.
        self._before: SessionState | None = None
        self._reporter = reporter
        self._lock = threading.RLock()
        self._analysis: StateAnalysis | None = None
        self.tour = tour.story(workspace)
        # The story to which S adds a step, and the name of the one that was told or kept last, which is exported.
        self._kept: Story | None = None
        self._last: str | None = None
        self._read()

    def commands(self) -> list[tuple[str, str | None, Callable[[], None]]]:
        """Return the commands for the palette: label, hotkey, and function."""
        tell_commands = [
            (f"Tell the story: {name}", None, partial(self.receive, messages.PlayStory(name))) for name in self.names
        ]
        return [
            ("Keep what is shown as a step of a story", "S", partial(self.receive, messages.RecordStep())),
            ("Begin another story", None, self._begin),
            (_EXPORT, None, self._export),
            *tell_commands,
        ]

    @property
    def names(self) -> list[str]:
        """The names of the stories."""
        return list(self._stories.by_name)

    def show(self, analysis: StateAnalysis) -> None:
        """Remember what the page shows, for the caption of the next step."""
        self._analysis = analysis

    def receive(self, message: StoryMessage) -> None:
        """Do what a message of the row, or of the page's script, asks for."""
        with self._lock:
            match message:
                case messages.RecordStep():
                    self._record()
                case messages.PlayStory(name):
                    self._tell(name)
                case messages.ToldStep(index, shows):
                    self._before = self._before or self._state()
                    self._show_step(index, shows)
                case messages.EndStory(stay):
                    before, self._before = self._before, None
                    if before is not None and not stay:
                        self._restore(replace(before, dark=self._state().dark))

    def _read(self) -> None:
        """Read the stories, and show their names; the tour is at the top of the page."""
        self._stories = library.stories_of(self._workspace)
        names = [name for name in self.names if name != tour.NAME]
        self._row.show(render("stories/row", names=names, errors=self._stories.errors))

    def _begin(self) -> None:
        with self._lock:
            self._kept = None
        self._call("say", "The next step that S keeps begins another story.")

    def _record(self) -> None:
        state, analysis = self._state(), self._analysis
        if state.upload is not None:
            self._call("say", f"{answer_text.OWN_KEPT} A story shows pictures of the data set.")
            return
        caption = ""
        if analysis is not None and session_state.with_windows(analysis.state, state) == state:
            _, headline, _ = answer_text.verdict(analysis, self._workspace)
            caption = f"{analysis.name}. {headline}."
        address = self._url_state.write(state)
        try:
            name, begun = (None, ()) if self._kept is None else (self._kept.name, self._kept.steps)
            kept = library.keep(self._workspace.root, story.step_of(address, caption), name, self.names, begun)
        except LPNError as error:
            self._call("say", f"Not saved. {error}", 12)
            return
        self._kept, self._last = kept, kept.name
        self._read()
        place = library.place(self._workspace.root)
        said = f"Step {len(kept.steps)} of {kept.name!r} is kept in {place}. Captions and notes are edited there."
        whole = not state.lab or self._url_state.read(address, state)[0].laboratory == state.laboratory
        self._call("say", said if whole else f"{said} {_LOST}", 6 if whole else 12)

    def _found(self, name: str) -> Story | None:
        """Return a story as its file has it now, or say that it is gone or empty."""
        self._read()
        chosen = self._stories.by_name.get(name)
        if chosen is None or not chosen.steps:
            missing = f"There is no story {name!r} any more." if chosen is None else f"The story {name!r} has no step."
            self._call("say", " ".join((missing, *self._stories.errors)))
            return None
        return chosen

    def _tell(self, name: str) -> None:
        if (chosen := self._found(name)) is None:
            return
        self._last = name
        self._client.gui.main_panel.expand()  # its content, by which the page sends messages, is removed while it is folded
        self._call("tell", msgspec.to_builtins(chosen))

    def _show_step(self, index: int, shows: str) -> None:
        """Show what a step shows; one that names no words has plain ones where the page has."""
        if self._state().plain and "words" not in parse_qs(shows):
            shows += "&words=plain"
        if problems := self._go(shows):
            self._call("say", f"Not all of step {index + 1} can be shown. {' '.join(problems)}", 12)

    def _export(self) -> None:
        """Export the story that was told or kept last."""
        with self._lock:
            if self._last is None:
                self._call("say", "Tell a story first, or keep a step by S: that story is exported.")
                return
            chosen = self._found(self._last)
        if chosen is None:
            return
        self._reporter.make(
            lambda progress, model: exported.export(self._workspace, self._url_state, chosen, progress, model),
            "story",
            _EXPORT,
        )
