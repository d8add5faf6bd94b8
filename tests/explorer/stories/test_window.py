"""The window of stories without a browser."""

from __future__ import annotations

import html
import json
import re
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import msgspec
import pytest

from explorer.failure_lab.service import FailureLab
from explorer.flight_window.service import FlightService
from explorer.lab_choices import LabChoices, Selection
from explorer.session_state import SessionState
from explorer.stage.viewport import Viewport
from explorer.stories import library
from explorer.stories.messages import StoryMessage
from explorer.stories.story import Step, Story, StoryDraft
from explorer.stories.window import LONGEST_DRAFT, StoryWindow
from explorer.stories.windows import WindowSources
from explorer.url_state import UrlState
from explorer.web.html import Html
from explorer.web.messages import Receivers
from explorer.workspace import StateAnalyser, Workspace
from tests.explorer.stories.conftest import TASK


class Page:
    """A window of stories whose page and state the test plays."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.url_state = workspace, UrlState(workspace)
        self.state = SessionState(TASK, 4)
        self.elements: list[Any] = []
        client = MagicMock()
        client.gui.add_html.side_effect = self._element
        self.calls: list[tuple[object, ...]] = []
        self.went: list[str] = []
        self.restored: list[SessionState] = []
        self.reporter = MagicMock()
        self.window = StoryWindow(
            client,
            workspace,
            self.url_state,
            Html(client.gui),
            lambda: self.state,
            self._go,
            self.restored.append,
            lambda *call: self.calls.append(call),
            Viewport(),
            self.reporter,
            WindowSources(workspace, FailureLab(workspace), FlightService(workspace)),
        )

    def send(self, kind: str, value: object = None) -> None:
        Receivers({StoryMessage: self.window.receive}).hand_on(f"story-{kind}", value)

    @property
    def draft(self) -> Story:
        return self.window._draft.story

    @property
    def text(self) -> str:
        return html.unescape(" ".join(re.sub(r"\s+", " ", element.content) for element in self.elements))

    @property
    def kept(self) -> Any:
        """The copy of the draft that the browser keeps, and sends when its page is loaded again."""
        script = re.search(r"Function\((.*lpn\.keepDraft.*)\)\(\)", html.unescape(self.window._keeping._content))
        assert script is not None
        return json.loads(json.loads(script[1]).removeprefix("lpn.keepDraft(").removesuffix(")"))

    def _go(self, address: str) -> list[str]:
        self.went.append(address)
        return ["query=x: there is no such query."] if "query=x" in address else []

    def _element(self, content: str = "", **_: Any) -> Any:
        self.elements.append(SimpleNamespace(content=content))
        return self.elements[-1]


@pytest.fixture
def page(workspace: Workspace) -> Page:
    return Page(workspace)


def test_what_is_shown_is_recorded_with_the_verdict_as_its_caption(page: Page) -> None:
    page.state = replace(page.state, query=2, why=True, dark=False)
    analysis = StateAnalyser(page.workspace).analyse(page.state, 5)
    page.window.show(analysis)
    page.send("record")
    (step,) = page.draft.steps
    assert step.shows == f"task={TASK}&query={analysis.name}&why=1"
    assert re.fullmatch(rf"{analysis.name}\. (Found|Wrong): the t.*\.", step.caption)
    page.state = replace(page.state, why_tab="comparison")
    page.send("record")
    assert page.draft.steps[1].caption == step.caption, "another tab of the explanation keeps the verdict"
    page.state = replace(page.state, why_tab="evidence", angle=30.0)
    page.send("record")
    assert page.draft.steps[2] == Step(f"task={TASK}&query={analysis.name}&angle=30&why=1"), (
        "the verdict on another state is no caption"
    )
    assert page.calls[-1][0] == "say"
    assert not (page.workspace.root / "stories.json").exists()


def test_a_step_is_told_in_the_words_of_the_page_unless_it_names_its_own(page: Page) -> None:
    for plain, shows, went in (
        (True, "query=0010", "query=0010&words=plain"),
        (True, "query=0010&words=expert", "query=0010&words=expert"),
        (False, "query=0010", "query=0010"),
    ):
        page.state = replace(page.state, first_screen=True, plain=plain)
        page.send("step", [0, shows])
        assert page.went[-1] == went
        assert page.url_state.read(page.went[-1], SessionState(TASK, 4))[0].plain is ("plain" in went)


def test_a_step_keeps_what_the_laboratory_shows_or_says_what_it_loses(page: Page) -> None:
    choices = LabChoices(
        "maps", "failed", "rank > 3", colour="rank", selections=(Selection("in pca", "lasso", (0, 2, 3)),)
    )
    page.window.show(StateAnalyser(page.workspace).analyse(page.state, 5))
    page.state = replace(page.state, lab=True, laboratory=choices)
    page.send("record")
    page.state = replace(page.state, lab=False)
    page.send("record")
    kept, problems = page.url_state.read(page.draft.steps[0].shows, SessionState(TASK, 4))
    assert (kept.laboratory, problems) == (choices, [])
    assert "without them" not in str(page.calls)
    too_many = Selection("in pca", "lasso", tuple(range(0, 9000, 2)))
    page.state = replace(page.state, lab=True, laboratory=LabChoices(selections=(too_many,)))
    page.send("record")
    assert "too many for an address: the step is without them" in str(page.calls[-1])
    assert page.draft.steps[1].caption, "the laboratory is no part of the verdict"


def test_the_end_of_a_story_brings_back_what_was_shown_before(page: Page) -> None:
    before = page.state = replace(page.state, query=3, upload=MagicMock(), first_screen=True)
    page.send("end", False)
    assert not page.restored, "no story was told"
    page.send("step", [0, f"task={TASK}&off=1"])
    page.state = SessionState(TASK, 4, query=1, dark=False)
    page.send("step", [1, f"task={TASK}&off=2"])
    page.send("end", False)
    assert page.restored == [replace(before, dark=False)]
    page.send("step", [0, f"task={TASK}&off=1"])
    page.send("end", True)
    page.send("end", False)
    assert len(page.restored) == 1, "the person stays"


def test_a_story_without_steps_is_deleted_but_the_tour_stays(page: Page) -> None:
    page.send("record")
    page.send("name", "Mine")
    page.send("save")
    page.send("remove", 0)
    page.send("save")
    assert "Deleted from " in page.text
    assert "stays" not in page.text
    page.send("open", "Tour")
    for _ in page.draft.steps:
        page.send("remove", 0)
    page.send("save")
    assert "The story 'Tour' comes with the explorer, and stays." in page.text
    assert "Tour" in page.window.names


def test_ones_own_picture_is_not_recorded(page: Page) -> None:
    page.state = replace(page.state, upload=MagicMock())
    page.send("record")
    assert not page.draft.steps
    assert "stays in the memory of the computer that runs this page ({computer})" in str(page.calls)


def test_a_story_is_edited_saved_and_told(page: Page) -> None:
    for query in (0, 3):
        page.state = replace(page.state, query=query)
        page.send("record")
    page.send("caption", [1, "<b>second</b>"])
    page.send("notes", [1, "say it"])
    page.send("name", "Mine")
    page.send("move", [1, -1])
    page.send("window")
    assert "<b>second" not in " ".join(element.content for element in page.elements)
    assert "Not saved yet" in page.text
    page.send("save")
    saved = library.read_all(page.workspace.root).by_name["Mine"]
    assert [(step.caption, step.notes) for step in saved.steps] == [("<b>second</b>", "say it"), ("", "")]
    assert "Saved in stories.json, beside the data, on the computer that runs this page." in page.text
    assert "Not saved yet" not in page.text
    assert "Tell this story" in page.text

    other = Page(page.workspace)
    assert any(label == "Tell the story: Mine" for label, _, _ in other.window.commands())
    other.send("play", "Mine")
    name, told = other.calls[-1]
    assert (name, told) == ("tell", {"name": "Mine", "steps": tuple(_plain(step) for step in saved.steps)})
    other.send("step", [1, saved.steps[1].shows])
    other.send("step", 1)
    Page(page.workspace).send("step", [1, "query=1"])
    assert other.went == [saved.steps[1].shows]


def test_the_tour_is_a_story_that_can_be_told_copied_and_replaced(page: Page) -> None:
    assert page.window.names == ["Tour"]
    page.send("play", "Tour")
    name, told = page.calls[-1]
    assert (name, told) == ("tell", msgspec.to_builtins(page.window.tour))
    page.send("open", "Tour")
    page.send("point", [1, "tile"])
    page.send("point", [0, "anywhere else"])
    page.send("copy")
    page.send("save")
    saved = library.read_all(page.workspace.root).by_name["Tour (copy)"]
    assert [step.points_at for step in saved.steps] == ["query", "tile", "ranking", "verdict", "controls"]
    library.save(page.workspace.root, StoryDraft(Story("Tour", (Step("query=a"),))))
    page.send("play", "Tour")
    assert page.calls[-1][1] == {"name": "Tour", "steps": (_plain(Step("query=a")),)}


def test_a_step_of_a_picture_that_is_gone_is_said(page: Page) -> None:
    library.save(page.workspace.root, StoryDraft(Story("Old", (Step("query=x", "gone"),))))
    page.send("play", "Old")
    page.send("step", [0, "query=x"])
    assert page.calls[-1] == ("say", "Not all of step 1 can be shown. query=x: there is no such query.", 12)
    page.send("play", "None")
    assert "There is no story 'None' any more." in page.text


def test_a_damaged_file_is_said_and_does_not_hinder_a_draft(page: Page) -> None:
    (page.workspace.root / "stories.json").write_text("[")
    page.send("record")
    page.send("window")
    assert "is not a file of stories" in page.text
    page.send("save")
    assert "Not saved. " in page.text
    assert len(page.draft.steps) == 1
    page.send("tell")
    assert page.calls[-1][0] == "tell"
    page.send("export")
    assert page.reporter.make.call_count == 1


def test_an_empty_story_is_not_told(page: Page) -> None:
    page.send("tell")
    page.send("export")
    assert [call[0] for call in page.calls] == ["say", "say"]
    assert not page.reporter.make.called


def test_the_browser_keeps_a_draft_and_brings_it_back(page: Page) -> None:
    page.send("record")
    assert "lpn.keepDraft" in page.text
    again = Page(page.workspace)
    again.send("draft", [{"name": page.draft.name, "steps": [_plain(step) for step in page.draft.steps]}, None])
    assert again.draft == page.draft
    again.send("remove", 0)
    assert "lpn.keepDraft(null)" in again.text


def test_a_changed_story_of_most_of_a_message_is_kept_once_and_still_knows_what_was_opened(page: Page) -> None:
    step = Step("query=a", "c", "n" * 1900)
    library.save(page.workspace.root, StoryDraft(Story("Long", (step,) * 20)))
    page.send("open", "Long")
    page.send("caption", [3, "changed"])
    assert len(json.dumps(page.kept)) < 45_000
    again = Page(page.workspace)
    again.send("draft", page.kept)
    assert again.window._draft == page.window._draft
    again.send("save")
    assert "Saved in" in again.text
    page.send("save")
    assert "was changed by somebody else" in page.text
    late = Page(page.workspace)
    late.send("draft", page.kept)
    late.send("save")
    assert "was changed by somebody else" in late.text


def test_a_draft_that_is_too_long_to_be_kept_is_told(page: Page) -> None:
    long = Story("Long", (Step("query=a", "", "n" * 2000),) * 30)
    library.save(page.workspace.root, StoryDraft(long))
    page.send("open", "Long")
    assert "save the story before" not in page.text
    page.send("caption", [3, "changed"])
    assert page.kept is None
    too_long = (
        f"characters, and the browser keeps up to {LONGEST_DRAFT:,}: save the story before the page is loaded again."
    )
    assert too_long in page.text
    page.send("move", [3, 1])
    assert too_long in page.text
    page.send("record")
    assert too_long in str(page.calls[-1])
    page.send("save")
    assert "save the story before" not in page.text
    for _ in range(3):
        page.send("remove", 0)
    assert page.kept is not None
    assert "save the story before" not in page.text


def test_a_copy_does_not_replace_what_was_opened(page: Page) -> None:
    library.save(page.workspace.root, StoryDraft(Story("A", (Step("query=a"),))))
    page.send("open", "A")
    page.send("copy")
    page.send("save")
    assert list(library.read_all(page.workspace.root).by_name) == ["A", "A (copy)"]
    page.send("new")
    assert page.draft == Story("Story 1")


def _plain(step: Step) -> dict[str, str]:
    plain: dict[str, str] = msgspec.to_builtins(step)
    return plain


def test_escape_closes_the_window_of_stories_first(workspace: Workspace) -> None:
    page = Page(workspace)
    assert not page.window.close()
    page.send("window")
    assert page.window.close()
    assert not page.window.close()


def test_closing_waits_for_no_work_of_the_window(page: Page) -> None:
    page.send("window")
    with page.window._lock:  # a step that is kept meanwhile
        closing = threading.Thread(target=page.window.close, daemon=True)
        closing.start()
        closing.join(30)
        assert not closing.is_alive()
    assert not page.window.close()
