"""The window in which one browser records, orders, and edits a story, and the telling of stories in its page."""

from __future__ import annotations

import json
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
from explorer.server.message_filter import MAX_TEXT
from explorer.session_state import SessionState
from explorer.stage.viewport import EDGE, Viewport
from explorer.stories import exported, library, messages, story, tour
from explorer.stories.messages import StoryMessage
from explorer.stories.story import Story, StoryDraft
from explorer.stories.windows import WindowSources
from explorer.url_state import UrlState
from explorer.web.html import Html
from explorer.web.render import call, render, run
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.errors import LPNError

_MAX_SIZE = (560, 900)
_LOST = "The pictures or columns that you chose in the table are too many for an address: the step is without them."
# Characters of a draft that the browser keeps; it comes back in one message.
LONGEST_DRAFT = MAX_TEXT - 1000


class StoryWindow:
    """One browser's stories: the row of their names, the window, and what is told.

    Args:
        row: the page's element for the names of the stories.
        state: returns the newest state.
        go: shows the state of a query string; returns a sentence about each value that is invalid.
        restore: shows a former state.
        call: calls a function of the page's script.
        sources: what exported windows are drawn from.

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
        viewport: Viewport,
        reporter: Reporter,
        sources: WindowSources,
    ) -> None:
        self._sources = sources
        self._client, self._workspace, self._url_state, self._row = client, workspace, url_state, row
        self._state, self._go, self._restore, self._call = state, go, restore, call
        # The state before the first step of the story that is told; None while none is.
        self._before: SessionState | None = None
        self._viewport, self._reporter = viewport, reporter
        self._lock = threading.RLock()
        self._analysis: StateAnalysis | None = None
        self._open = False
        self._revision = 0
        self.tour = tour.story(workspace)
        self._stories = self._read()
        self._draft = self._new_draft()
        # Why the browser does not keep the draft, empty if it does.
        self._unkept = ""
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Stories", viser.Icon.PRESENTATION):
            self._head, self._message, self._steps = (Html(gui) for _ in range(3))
        self._keeping = Html(gui)
        viewport.watch(self._place)
        self._show_row()

    def commands(self) -> list[tuple[str, str | None, Callable[[], None]]]:
        """Return the commands for the palette: label, hotkey, and function."""
        tell_commands = [
            (f"Tell the story: {name}", None, partial(self.receive, messages.PlayStory(name)))
            for name in self._stories.by_name
        ]
        return [
            ("Keep what is shown as a step of a story", "S", partial(self.receive, messages.RecordStep())),
            ("Stories: order, edit, save", None, partial(self.receive, messages.ShowWindow())),
            ("Tell the story that is edited", None, partial(self.receive, messages.Tell())),
            ("Export the story as one HTML file", None, partial(self.receive, messages.ExportStory())),
            *tell_commands,
        ]

    @property
    def names(self) -> list[str]:
        """The names of the stories."""
        return list(self._stories.by_name)

    def close(self) -> bool:
        """Close the window; return True if it was open. It takes no lock, as its caller may hold that of the session."""
        was_open = self._open
        self._set_open(False)
        return was_open

    def show(self, analysis: StateAnalysis) -> None:
        """Remember what the page shows, for the caption of the next step."""
        self._analysis = analysis

    def receive(self, message: StoryMessage) -> None:
        """Do what a message of the window's HTML, or of the page's script, asks for."""
        with self._lock:
            match message:
                case messages.ShowWindow():
                    self._stories = self._read()
                    self._set_open(True)
                case messages.CloseWindow():
                    self._set_open(False)
                case messages.OpenStory(name) | messages.PlayStory(name):
                    self._choose(name, tell=isinstance(message, messages.PlayStory))
                case messages.Tell():
                    self._tell(self._draft.story)
                case messages.ToldStep(index, shows):
                    self._before = self._before or self._state()
                    self._show_step(index, shows)
                case messages.EndStory(stay):
                    before, self._before = self._before, None
                    if before is not None and not stay:
                        self._restore(replace(before, dark=self._state().dark))
                case messages.ShowStep(index) if index < len(self._draft.story.steps):
                    self._show_step(index, self._draft.story.steps[index].shows)
                case messages.SaveStory():
                    self._save()
                case messages.ExportStory():
                    self._export()
                case messages.RestoreDraft(kept, opened):
                    self._edit(StoryDraft(kept, opened and self._opened(*opened)))
                case messages.RecordStep():
                    self._record()
                case messages.NewStory():
                    self._edit(self._new_draft())
                case messages.CopyStory():
                    name = self._draft.story.name[: story.LONGEST_NAME - 7]
                    self._edit(StoryDraft(story.rename(self._draft.story, f"{name} (copy)")))
                case messages.EditCaption(index, caption):
                    self._edit_text(story.edit(self._draft.story, index, caption=caption))
                case messages.EditNotes(index, notes):
                    self._edit_text(story.edit(self._draft.story, index, notes=notes))
                case messages.Rename(name):
                    self._edit_text(story.rename(self._draft.story, name[: story.LONGEST_NAME]))
                case messages.PointAt(index, place):
                    self._edit_text(story.point(self._draft.story, index, place))
                case messages.MoveStep(index, by):
                    self._edit(replace(self._draft, story=story.move(self._draft.story, index, by)))
                case messages.RemoveStep(index):
                    self._edit(replace(self._draft, story=story.remove(self._draft.story, index)))

    def _read(self) -> library.Stories:
        return library.stories_of(self._workspace)

    def _new_draft(self) -> StoryDraft:
        return StoryDraft(Story(story.new_name(list(self._stories.by_name))))

    def _edit(self, draft: StoryDraft, text: str = "", good: bool = True) -> None:
        """Replace the draft and draw it; a message stands below it."""
        self._draft = draft
        self._revision += 1  # otherwise text that was typed would stay where the same content is drawn again
        self._keep()
        self._draw(f"{text} {self._unkept}".strip(), good and not self._unkept)

    def _edit_text(self, edited: Story) -> None:
        """Replace texts of the draft without drawing the boxes, which have them already."""
        self._draft = replace(self._draft, story=edited)
        self._keep()
        good = not self._unkept
        self._message.show(render("stories/message", text=self._unkept, good=good, changed=self._draft.changed))

    def _keep(self) -> None:
        """Let the browser keep the draft, so that loading the page again does not lose it, unless it is too long."""
        draft, opened, kept = self._draft.story, self._draft.opened, None
        if self._draft.changed:
            kept = [msgspec.to_builtins(draft), opened and [opened.name, story.checksum(opened)]]
        letters, self._unkept = len(json.dumps(kept, ensure_ascii=False)), ""
        if letters > LONGEST_DRAFT:
            kept = None
            self._unkept = (
                f"This draft has {letters:,} characters, and the browser keeps up to {LONGEST_DRAFT:,}: save the story before "
                "the page is loaded again."
            )
        self._keeping.show(run(call("keepDraft", kept)))

    def _opened(self, name: str, checksum: str) -> Story:
        """Return a saved story, or one that no saved story equals if it was changed or deleted since; see `library.save`."""
        saved = self._stories.by_name.get(name)
        return saved if saved is not None and story.checksum(saved) == checksum else Story(name)

    def _record(self) -> None:
        state, draft, analysis = self._state(), self._draft, self._analysis
        if state.upload is not None:
            self._call("say", f"{answer_text.OWN_KEPT} A story shows pictures of the data set.")
            return
        if len(draft.story.steps) >= story.MOST_STEPS:
            self._call("say", f"A story has {story.MOST_STEPS} steps at most: begin another one.")
            return
        caption = ""
        if analysis is not None and session_state.with_windows(analysis.state, state) == state:
            _, headline, _ = answer_text.verdict(analysis, self._workspace)
            caption = f"{analysis.name}. {headline}."
        address = self._url_state.write(state)
        recorded = story.add(draft.story, story.step_of(address, caption))
        self._edit(replace(draft, story=recorded))
        said = f"Step {len(recorded.steps)} of {recorded.name!r} is kept. Not saved yet: open Stories."
        kept = not state.lab or self._url_state.read(address, state)[0].laboratory == state.laboratory
        lost = "" if kept else _LOST
        self._call("say", " ".join(filter(None, (said, lost, self._unkept))), 12 if lost or self._unkept else 4)

    def _choose(self, name: str, tell: bool) -> None:
        self._stories = self._read()
        chosen = self._stories.by_name.get(name)
        if chosen is None:
            self._draw(f"There is no story {name!r} any more.", False)
            return
        if tell:
            self._tell(chosen)
        else:
            self._edit(StoryDraft(chosen, chosen))

    def _tell(self, chosen: Story) -> None:
        if not chosen.steps:
            self._call("say", "The story has no step yet: S keeps what is shown.")
            return
        self._set_open(False)
        self._client.gui.main_panel.expand()  # its content, by which the page sends messages, is removed while it is folded
        self._call("tell", msgspec.to_builtins(chosen))

    def _show_step(self, index: int, shows: str) -> None:
        """Show what a step shows; one that names no words has plain ones where the page has."""
        if self._state().plain and "words" not in parse_qs(shows):
            shows += "&words=plain"
        if problems := self._go(shows):
            self._call("say", f"Not all of step {index + 1} can be shown. {' '.join(problems)}", 12)

    def _save(self) -> None:
        try:
            saved = library.save(self._workspace.root, self._draft)
        except LPNError as error:
            self._draw(f"Not saved. {error}", False)
            return
        self._stories = self._read()
        if not saved.story.steps:
            built_in = saved.story.name in self._stories.by_name  # of no file, so it cannot be deleted
            kept = f" The story {saved.story.name!r} comes with the explorer, and stays." if built_in else ""
            self._edit(self._new_draft(), f"Deleted from {library.place(self._workspace.root)}.{kept}")
        else:
            self._edit(saved, f"Saved in {library.place(self._workspace.root)}.")

    def _export(self) -> None:
        draft = self._draft.story
        if not draft.steps:
            self._call("say", "The story has no step yet: S keeps what is shown.")
            return
        dark = self._analysis is None or self._analysis.state.dark
        self._reporter.make(
            lambda progress, model: exported.export(self._sources, self._url_state, draft, dark, progress, model),
            "story",
            "Export as one HTML file",
        )

    def _set_open(self, is_open: bool) -> None:
        if is_open:
            self._draw()
        self._open = is_open
        self._place()
        self._panel.visible = self._open  # another thread may have closed it meanwhile

    def _place(self) -> None:
        if self._open:
            width, height = self._viewport.window(_MAX_SIZE)
            self._panel.float(x=-EDGE, y=EDGE, width=width, height=height)
            self._panel.expand()

    def _show_row(self) -> None:
        # The tour is at the top of the page.
        self._row.show(render("stories/row", names=[name for name in self.names if name != tour.NAME]))

    def _draw(self, text: str = "", good: bool = True) -> None:
        self._show_row()
        if not text and self._stories.errors:
            text, good = " ".join(self._stories.errors), False
        draft = self._draft.story
        opened = None if self._draft.opened is None else self._draft.opened.name
        self._head.show(
            render("stories/head", story=draft, opened=opened, names=list(self._stories.by_name), limits=story)
        )
        self._steps.show(
            render(
                "stories/steps",
                story=draft,
                revision=self._revision,
                limits=story,
                places=tour.PLACES,
                summaries=[self._url_state.summary(step.shows) for step in draft.steps],
            )
        )
        self._message.show(render("stories/message", text=text, good=good, changed=self._draft.changed))
