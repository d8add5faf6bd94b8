"""The messages of the stories' html."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from explorer.stories.story import MOST_STEPS, Caption, Focus, Name, Notes, Shows, Story
from explorer.web.messages import Message

StepIndex = Annotated[int, Meta(ge=0, lt=MOST_STEPS)]


class StoryMessage(Message):
    """A message of the window, of the row of names, or of a story that is told. Its effect is in the window."""


class ShowWindow(StoryMessage, tag="story-window"):
    """Open the window."""


class CloseWindow(StoryMessage, tag="story-close"):
    """Close the window."""


class OpenStory(StoryMessage, tag="story-open"):
    """Edit a saved story."""

    name: Name


class NewStory(StoryMessage, tag="story-new"):
    """Begin a story."""


class CopyStory(StoryMessage, tag="story-copy"):
    """Go on with a copy, which does not replace what was opened."""


class RecordStep(StoryMessage, tag="story-record"):
    """Keep what is shown as a step."""


class Rename(StoryMessage, tag="story-name"):
    """Name the story."""

    name: Annotated[str, Meta(max_length=400)]


class EditCaption(StoryMessage, tag="story-caption"):
    """Replace a step's caption."""

    index: StepIndex
    caption: Caption


class EditNotes(StoryMessage, tag="story-notes"):
    """Replace a step's notes."""

    index: StepIndex
    notes: Notes


class PointAt(StoryMessage, tag="story-point"):
    """Let a step point at a place of the page."""

    index: StepIndex
    place: Focus


class MoveStep(StoryMessage, tag="story-move"):
    """Move a step up or down."""

    index: StepIndex
    by: Annotated[int, Meta(ge=-1, le=1)]


class RemoveStep(StoryMessage, tag="story-remove"):
    """Delete a step."""

    index: StepIndex


class ShowStep(StoryMessage, tag="story-show"):
    """Show what a step of the edited story shows."""

    index: StepIndex


class PlayStory(StoryMessage, tag="story-play"):
    """Tell a saved story."""

    name: Name


class Tell(StoryMessage, tag="story-tell"):
    """Tell the edited story."""


class ToldStep(StoryMessage, tag="story-step"):
    """Show what a step of the story that is told shows; the page has the story, as it outlives a lost connection."""

    index: StepIndex
    shows: Shows


class EndStory(StoryMessage, tag="story-end"):
    """The story that is told has ended.

    Attributes:
        stay: go on with what the story shows, in place of what was shown before it.
    """

    stay: bool


class SaveStory(StoryMessage, tag="story-save"):
    """Save the edited story."""


class ExportStory(StoryMessage, tag="story-export"):
    """Save the edited story as a file that needs no server."""


class RestoreDraft(StoryMessage, tag="story-draft"):
    """Go on with the draft that the browser had kept when its page was loaded again.

    Attributes:
        opened: name and checksum of the story as it was opened or last saved; None for one that was never saved.
    """

    story: Story
    opened: tuple[Name, Annotated[str, Meta(max_length=16)]] | None
