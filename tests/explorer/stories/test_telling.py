"""Keeping and telling stories, without a browser."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import msgspec
import pytest

from explorer.lab_choices import LabChoices, Selection
from explorer.session_state import SessionState
from explorer.stories import exported, library
from explorer.stories.messages import StoryMessage
from explorer.stories.story import Step, Story
from explorer.stories.telling import StoryTeller
from explorer.url_state import UrlState
from explorer.web.html import Html
from explorer.web.messages import Receivers
from explorer.workspace import StateAnalyser, Workspace
from tests.explorer.stories.conftest import TASK


class Page:
    """The stories of a page whose script and state the test plays."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.url_state = workspace, UrlState(workspace)
        self.state = SessionState(TASK, 4)
        client = MagicMock()
        self.row = SimpleNamespace(content="")
        client.gui.add_html.return_value = self.row
        self.calls: list[tuple[object, ...]] = []
        self.went: list[str] = []
        self.restored: list[SessionState] = []
        self.reporter = MagicMock()
        self.teller = StoryTeller(
            client,
            workspace,
            self.url_state,
            Html(client.gui),
            lambda: self.state,
            self._go,
            self.restored.append,
            lambda *call: self.calls.append(call),
            self.reporter,
        )

    def send(self, kind: str, value: object = None) -> None:
        Receivers({StoryMessage: self.teller.receive}).hand_on(f"story-{kind}", value)

    def command(self, label: str) -> None:
        (call,) = (call for name, _, call in self.teller.commands() if name == label)
        call()

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that were kept, all in one story."""
        (kept,) = library.read_all(self.workspace.root).by_name.values()
        return kept.steps

    def _go(self, address: str) -> list[str]:
        self.went.append(address)
        return ["query=x: there is no such query."] if "query=x" in address else []


@pytest.fixture
def page(workspace: Workspace) -> Page:
    return Page(workspace)


def test_what_is_shown_is_recorded_with_the_verdict_as_its_caption(page: Page) -> None:
    page.state = replace(page.state, query=2, why=True, dark=False)
    analysis = StateAnalyser(page.workspace).analyse(page.state, 5)
    page.teller.show(analysis)
    page.send("record")
    (step,) = page.steps
    assert step.shows == f"task={TASK}&query={analysis.name}&why=1"
    assert step.caption == f"{analysis.name}. {analysis.verdict.headline}."
    page.state = replace(page.state, why_tab="comparison")
    page.send("record")
    assert page.steps[1].caption == step.caption, "another tab of the explanation keeps the verdict"
    page.state = replace(page.state, why_tab="evidence", angle=30.0)
    page.send("record")
    assert page.steps[2] == Step(f"task={TASK}&query={analysis.name}&angle=30&why=1"), (
        "the verdict on another state is no caption"
    )
    assert page.calls[-1][:2] == (
        "say",
        "Step 3 of 'Story 1' is kept in stories.json, beside the data, on the computer that runs this page. Captions and notes "
        "are edited there.",
    )
    assert "Tell this story" in page.row.content


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
    page.teller.show(StateAnalyser(page.workspace).analyse(page.state, 5))
    page.state = replace(page.state, lab=True, laboratory=choices)
    page.send("record")
    page.state = replace(page.state, lab=False)
    page.send("record")
    kept, problems = page.url_state.read(page.steps[0].shows, SessionState(TASK, 4))
    assert (kept.laboratory, problems) == (choices, [])
    assert "without them" not in str(page.calls)
    too_many = Selection("in pca", "lasso", tuple(range(0, 9000, 2)))
    page.state = replace(page.state, lab=True, laboratory=LabChoices(selections=(too_many,)))
    page.send("record")
    assert "too many for an address: the step is without them" in str(page.calls[-1])
    assert page.steps[1].caption, "the laboratory is no part of the verdict"


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


def test_ones_own_picture_is_not_recorded(page: Page) -> None:
    page.state = replace(page.state, upload=MagicMock())
    page.send("record")
    assert not (page.workspace.root / "stories.json").exists()
    assert "stays in the memory of the computer that runs this page ({computer})" in str(page.calls)


def write(page: Page, *stories: Story) -> None:
    (page.workspace.root / "stories.json").write_bytes(msgspec.json.encode(stories))


def test_another_story_is_begun_and_a_second_page_keeps_its_own(page: Page) -> None:
    other = Page(page.workspace)
    page.send("record")
    other.send("record")
    page.send("record")
    page.command("Begin another story")
    page.send("record")
    kept = library.read_all(page.workspace.root).by_name
    assert {name: len(story.steps) for name, story in kept.items()} == {"Story 1": 2, "Story 2": 1, "Story 3": 1}


def test_steps_are_kept_in_a_story_that_was_renamed_in_its_file(page: Page) -> None:
    page.send("record")
    write(page, Story("Mine", page.steps))
    page.state = replace(page.state, query=2)
    page.send("record")
    write(page, Story("Ours", page.steps))
    page.send("record")
    assert len(page.steps) == 3
    assert "Step 3 of 'Ours' is kept" in str(page.calls[-1])


def test_a_kept_story_is_told_as_its_file_has_it(page: Page) -> None:
    page.send("record")
    edited = Story("Mine", (Step("query=a", "<b>first</b>", "say it"), Step("query=b")))
    write(page, edited)
    other = Page(page.workspace)
    other.command("Tell the story: Mine")
    name, told = other.calls[-1]
    assert (name, told) == ("tell", {"name": "Mine", "steps": tuple(_plain(step) for step in edited.steps)})
    assert "<b>first" not in other.row.content
    other.send("step", [1, edited.steps[1].shows])
    other.send("step", 1)
    Page(page.workspace).send("step", [1, "query=1"])
    assert other.went == [edited.steps[1].shows]


def test_the_tour_is_a_story_that_can_be_told_and_replaced(page: Page) -> None:
    assert page.teller.names == ["Tour"]
    page.send("play", "Tour")
    name, told = page.calls[-1]
    assert (name, told) == ("tell", msgspec.to_builtins(page.teller.tour))
    write(page, Story("Tour", (Step("query=a"),)))
    page.send("play", "Tour")
    assert page.calls[-1][1] == {"name": "Tour", "steps": (_plain(Step("query=a")),)}


def test_a_step_of_a_picture_that_is_gone_is_said(page: Page) -> None:
    write(page, Story("Old", (Step("query=x", "gone"),)))
    page.send("play", "Old")
    page.send("step", [0, "query=x"])
    assert page.calls[-1] == ("say", "Not all of step 1 can be shown. query=x: there is no such query.", 12)
    page.send("play", "None")
    assert page.calls[-1] == ("say", "There is no story 'None' any more.")


def test_a_damaged_file_is_said_and_not_changed(page: Page) -> None:
    (page.workspace.root / "stories.json").write_text("[")
    page.send("record")
    assert str(page.calls[-1][1]).startswith("Not saved. ")
    assert "is not a file of stories" in str(page.calls[-1])
    assert (page.workspace.root / "stories.json").read_text() == "["
    assert "is not a file of stories" in Page(page.workspace).row.content
    page.send("play", "Story 1")
    assert "is not a file of stories" in str(page.calls[-1])


def test_a_story_without_steps_is_not_told(page: Page) -> None:
    write(page, Story("Empty"))
    page.send("play", "Empty")
    assert page.calls[-1] == ("say", "The story 'Empty' has no step.")


def test_the_story_that_was_told_or_kept_last_is_exported(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Story] = []
    monkeypatch.setattr(exported, "export", lambda _, __, story, *___: told.append(story))
    page.command("Export the story as one HTML file")
    assert page.calls[-1][0] == "say"
    assert not page.reporter.make.called
    write(page, Story("Mine", (Step("query=a"),)))
    page.send("play", "Mine")
    page.command("Export the story as one HTML file")
    page.send("record")
    page.command("Export the story as one HTML file")
    for call in page.reporter.make.call_args_list:
        call.args[0](None, None)
    assert [story.name for story in told] == ["Mine", "Story 1"]


def test_a_story_is_exported_as_its_file_has_it(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Story] = []
    monkeypatch.setattr(exported, "export", lambda _, __, story, *___: told.append(story))
    page.send("record")
    edited = Story("Story 1", (Step(page.steps[0].shows, "An edited caption"),))
    write(page, edited)
    page.command("Export the story as one HTML file")
    page.reporter.make.call_args.args[0](None, None)
    assert told == [edited]
    write(page, Story("Another", edited.steps))
    page.command("Export the story as one HTML file")
    assert page.calls[-1] == ("say", "There is no story 'Story 1' any more.")
    assert page.reporter.make.call_count == 1


def _plain(step: Step) -> dict[str, str]:
    plain: dict[str, str] = msgspec.to_builtins(step)
    return plain
