"""The messages of the stories' html, validated by msgspec."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from explorer.stories.story import MOST_STEPS, Caption, Focus, Name, Notes, Shows, Story

StepIndex = Annotated[int, Meta(ge=0, lt=MOST_STEPS)]


class StoryMessage(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """A message of the window, of the row of names, or of a story that is told. Its effect is in the window."""


class ShowWindow(StoryMessage):
    """Open the window."""


class CloseWindow(StoryMessage):
    """Close the window."""


class OpenStory(StoryMessage):
    """Edit a saved story."""

    name: Name


class NewStory(StoryMessage):
    """Begin a story."""


class CopyStory(StoryMessage):
    """Go on with a copy, which does not replace what was opened."""


class RecordStep(StoryMessage):
    """Keep what is shown as a step."""


class Rename(StoryMessage):
    """Name the story."""

    name: Annotated[str, Meta(max_length=400)]


class EditCaption(StoryMessage):
    """Replace a step's caption."""

    index: StepIndex
    caption: Caption


class EditNotes(StoryMessage):
    """Replace a step's notes."""

    index: StepIndex
    notes: Notes


class PointAt(StoryMessage):
    """Let a step point at a place of the page."""

    index: StepIndex
    place: Focus


class MoveStep(StoryMessage):
    """Move a step up or down."""

    index: StepIndex
    by: Annotated[int, Meta(ge=-1, le=1)]


class RemoveStep(StoryMessage):
    """Delete a step."""

    index: StepIndex


class ShowStep(StoryMessage):
    """Show what a step of the edited story shows."""

    index: StepIndex


class PlayStory(StoryMessage):
    """Tell a saved story."""

    name: Name


class Tell(StoryMessage):
    """Tell the edited story."""


class ToldStep(StoryMessage):
    """Show what a step of the story that is told shows; the page has the story, as it outlives a lost connection."""

    index: StepIndex
    shows: Shows


class EndStory(StoryMessage):
    """The story that is told has ended.

    Attributes:
        stay: go on with what the story shows, in place of what was shown before it.
    """

    stay: bool


class SaveStory(StoryMessage):
    """Save the edited story."""


class ExportStory(StoryMessage):
    """Save the edited story as a file that needs no server."""


class RestoreDraft(StoryMessage):
    """Go on with the draft that the browser had kept when its page was loaded again.

    Attributes:
        opened: name and checksum of the story as it was opened or last saved; None for one that was never saved.
    """

    story: Story
    opened: tuple[Name, Annotated[str, Meta(max_length=16)]] | None


MESSAGES: dict[str, type[StoryMessage]] = {
    "story-window": ShowWindow,
    "story-close": CloseWindow,
    "story-open": OpenStory,
    "story-new": NewStory,
    "story-copy": CopyStory,
    "story-record": RecordStep,
    "story-name": Rename,
    "story-caption": EditCaption,
    "story-notes": EditNotes,
    "story-point": PointAt,
    "story-move": MoveStep,
    "story-remove": RemoveStep,
    "story-show": ShowStep,
    "story-play": PlayStory,
    "story-tell": Tell,
    "story-step": ToldStep,
    "story-end": EndStory,
    "story-save": SaveStory,
    "story-export": ExportStory,
    "story-draft": RestoreDraft,
}
