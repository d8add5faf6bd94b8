"""Stories and changes of them; no viser here.

    [{"name": "A twin", "steps": [{"shows": "task=drone-to-satellite&query=0447/07", "caption": "...", "notes": "..."}]}]

A step may point at a place of the page, `points_at`: it is then told in a card beside the place, and the panels stay. One that
shows nothing leaves the page as it is.

`shows` is the query string of the page's address. It lacks the workspace, as a story belongs to one data set, the theme, which
is the presenter's choice, and the first screen, which would cover the stage and the caption. A step that names no words is told
in those of the page.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from lpn.tasks.notes import typed

LONGEST_NAME, LONGEST_CAPTION, LONGEST_NOTES, MOST_STEPS = 80, 400, 2000, 60
# Parameters of an address that a step leaves out.
_LEFT_OUT = ("show", "theme", "screen")

Shows = Annotated[str, Meta(max_length=20_000)]
Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_NAME)]
Caption = Annotated[str, Meta(max_length=LONGEST_CAPTION)]
Notes = Annotated[str, Meta(max_length=LONGEST_NOTES)]
Focus = Literal["", "query", "tile", "parts", "ranking", "verdict", "controls", "window"]


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One step.

    Attributes:
        shows: the state of the page as a query string, see `explorer.url_state`.
        caption: what the audience reads.
        notes: what only the presenter reads.
        points_at: the place of the page that the caption speaks of; empty for the whole of it.
    """

    shows: Shows
    caption: Caption = ""
    notes: Notes = ""
    points_at: Focus = ""


class Story(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named list of steps."""

    name: Name
    steps: Annotated[tuple[Step, ...], Meta(max_length=MOST_STEPS)] = ()


@dataclass(frozen=True)
class StoryDraft:
    """A story that one browser edits.

    Attributes:
        opened: the story as it was opened or last saved; None for one that was never saved.
    """

    story: Story
    opened: Story | None = None

    @property
    def changed(self) -> bool:
        """Return True if there is something to save."""
        return self.story != self.opened and bool(self.story.steps or self.opened)


def checksum(story: Story) -> str:
    """Return a text that differs for stories that differ."""
    return hashlib.sha256(msgspec.json.encode(story)).hexdigest()[:16]


def new_name(taken: list[str]) -> str:
    """Return "Story 1", or the first such name that is not taken."""
    number = 1
    while f"Story {number}" in taken:
        number += 1
    return f"Story {number}"


def step_of(address: str, caption: str) -> Step:
    """Return the step that shows what an address shows.

    Args:
        address: a query string without "?".
        caption: cut to the longest that a step may have.
    """
    pairs = [pair for pair in address.split("&") if pair.partition("=")[0] not in _LEFT_OUT]
    return Step("&".join(pairs), caption[:LONGEST_CAPTION])


def add(story: Story, step: Step) -> Story:
    """Append a step; a story of the most steps stays as it is."""
    return replace(story, steps=(*story.steps, step)[:MOST_STEPS])


def move(story: Story, index: int, by: int) -> Story:
    """Move a step up (`by` is negative) or down; it stops at the ends."""
    if not 0 <= index < len(story.steps):
        return story
    steps = list(story.steps)
    steps.insert(min(max(index + by, 0), len(steps) - 1), steps.pop(index))
    return replace(story, steps=tuple(steps))


def remove(story: Story, index: int) -> Story:
    """Delete a step."""
    return replace(story, steps=tuple(step for i, step in enumerate(story.steps) if i != index))


def edit(story: Story, index: int, caption: str | None = None, notes: str | None = None) -> Story:
    """Replace the caption or the notes of a step; None keeps them."""
    if not 0 <= index < len(story.steps):
        return story
    step = story.steps[index]
    step = replace(
        step,
        caption=step.caption if caption is None else typed(caption),
        notes=step.notes if notes is None else typed(notes),
    )
    return replace(story, steps=(*story.steps[:index], step, *story.steps[index + 1 :]))


def point(story: Story, index: int, place: Focus) -> Story:
    """Let a step point at a place of the page."""
    return replace(
        story, steps=tuple(replace(step, points_at=place) if i == index else step for i, step in enumerate(story.steps))
    )


def rename(story: Story, name: str) -> Story:
    """Give a story another name; an empty one changes nothing."""
    name = " ".join(typed(name).split())
    return replace(story, name=name) if name else story
