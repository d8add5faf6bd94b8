from __future__ import annotations

import pytest

from explorer.stories import messages, story
from explorer.stories.story import MOST_STEPS, Step, Story, StoryDraft
from explorer.web.messages import decode

THREE = Story("Three", tuple(Step(f"query={letter}", letter) for letter in "abc"))


def letters(told: Story) -> str:
    return "".join(step.caption for step in told.steps)


@pytest.mark.parametrize(
    ("index", "by", "order"),
    [(0, 1, "bac"), (2, -1, "acb"), (0, -1, "abc"), (2, 1, "abc"), (1, -1, "bac"), (7, 1, "abc")],
)
def test_a_step_is_moved_and_stops_at_the_ends(index: int, by: int, order: str) -> None:
    assert letters(story.move(THREE, index, by)) == order


def test_a_step_is_deleted_and_others_stay() -> None:
    assert letters(story.remove(THREE, 1)) == "ac"
    assert story.remove(THREE, 9) == THREE


def test_a_recorded_step_has_no_theme_no_workspace_and_no_first_screen() -> None:
    step = story.step_of("show=flight&task=a-to-b&query=0394/06&why=1&screen=first&theme=light", "x" * 999)
    assert step == Step("task=a-to-b&query=0394/06&why=1", "x" * story.LONGEST_CAPTION)
    assert story.add(THREE, step).steps[-1] == step


def test_a_story_has_a_greatest_length() -> None:
    long = THREE
    for _ in range(MOST_STEPS + 5):
        long = story.add(long, Step("query=z"))
    assert len(long.steps) == MOST_STEPS


def test_texts_are_edited_one_by_one_and_without_control_characters() -> None:
    edited = story.edit(story.edit(THREE, 1, caption=" New\x07 \r\nline "), 1, notes="Say it")
    assert edited.steps[1] == Step("query=b", "New \nline", "Say it")
    assert (edited.steps[0], edited.steps[2]) == (THREE.steps[0], THREE.steps[2])
    assert story.edit(THREE, 3, caption="none") == THREE
    assert story.rename(THREE, "  A \n B ").name == "A B"
    assert story.rename(THREE, " \x00 ") == THREE


def test_a_draft_knows_whether_there_is_something_to_save() -> None:
    assert not StoryDraft(Story("Story 1")).changed
    assert StoryDraft(THREE).changed
    assert not StoryDraft(THREE, THREE).changed
    assert StoryDraft(Story("Three"), THREE).changed, "its deletion is to be saved"
    assert story.new_name(["Story 1", "Story 3"]) == "Story 2"


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("story-move", [0, 5]),
        ("story-move", [-1, 1]),
        ("story-caption", [0, "x" * 5000]),
        ("story-caption", "x"),
        ("story-open", ""),
        ("story-open", {"name": "x"}),
        ("story-draft", [{"name": "x", "steps": [{"shows": 3}]}, None]),
        ("story-draft", [{"name": "x", "steps": [{"shows": "", "run": ""}]}, None]),
        ("story-draft", [{"name": "x"}, ["x", "0" * 17]]),
        ("story-draft", [{"name": "x"}, {"name": "x"}]),
        ("story-step", [MOST_STEPS, "query=a"]),
    ],
)
def test_a_message_that_the_page_does_not_send_is_dropped(kind: str, value: object) -> None:
    assert decode(messages.StoryMessage, kind, value) is None


def test_a_kept_draft_is_read_back() -> None:
    kept = {"name": "x", "steps": [{"shows": "query=a", "caption": "c", "notes": ""}]}
    expected = messages.RestoreDraft(Story("x", (Step("query=a", "c"),)), None)
    assert decode(messages.StoryMessage, "story-draft", [kept, None]) == expected
    opened = decode(messages.StoryMessage, "story-draft", [kept, ["x", "0" * 16]])
    assert opened == messages.RestoreDraft(expected.story, ("x", "0" * 16))
