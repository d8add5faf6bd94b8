"""Stories and changes of them; no viser here.

    [{"name": "A twin", "steps": [{"shows": "task=drone-to-satellite&query=0447/07", "caption": "...", "notes": "..."}]}]

A step may point at a place of the page, `points_at`: it is then told in a card beside the place, and the panels stay. One that
shows nothing leaves the page as it is.

`shows` is the query string of the page's address. It lacks the workspace, as a story belongs to one data set, the theme, which
is the presenter's choice, and the first screen, which would cover the stage and the caption. A step that names no words is told
in those of the page.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from lpn.core.errors import InputError

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


def new_name(taken: Collection[str]) -> str:
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
    """Append a step.

    Raises:
        InputError: when the story has `MOST_STEPS` already.
    """
    if len(story.steps) >= MOST_STEPS:
        raise InputError(f"A story has {MOST_STEPS} steps at most: begin another one.")
    return replace(story, steps=(*story.steps, step))
