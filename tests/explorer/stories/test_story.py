from __future__ import annotations

import pytest

from explorer.stories import messages, story
from explorer.stories.story import MOST_STEPS, Step, Story
from explorer.web.messages import decode
from lpn.core.errors import InputError

THREE = Story("Three", tuple(Step(f"query={letter}", letter) for letter in "abc"))


def test_a_recorded_step_has_no_theme_no_workspace_and_no_first_screen() -> None:
    step = story.step_of("show=flight&task=a-to-b&query=0394/06&why=1&screen=first&theme=light", "x" * 999)
    assert step == Step("task=a-to-b&query=0394/06&why=1", "x" * story.LONGEST_CAPTION)
    assert story.add(THREE, step).steps[-1] == step


def test_a_story_has_a_greatest_length() -> None:
    long = THREE
    for _ in range(MOST_STEPS - 3):
        long = story.add(long, Step("query=z"))
    with pytest.raises(InputError, match="A story has 60 steps at most: begin another one"):
        story.add(long, Step("query=z"))


def test_a_new_story_has_the_first_free_number() -> None:
    assert story.new_name(["Story 1", "Story 3"]) == "Story 2"


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("story-play", ""),
        ("story-play", {"name": "x"}),
        ("story-step", [0, 3]),
        ("story-end", "stay"),
        ("story-step", [MOST_STEPS, "query=a"]),
    ],
)
def test_a_message_that_the_page_does_not_send_is_dropped(kind: str, value: object) -> None:
    assert decode(messages.StoryMessage, kind, value) is None
