"""The messages of the stories' html and script."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from explorer.stories.story import MOST_STEPS, Name, Shows
from explorer.web.messages import Message

StepIndex = Annotated[int, Meta(ge=0, lt=MOST_STEPS)]


class StoryMessage(Message):
    """A message of the row of names, or of a story that is told."""


class RecordStep(StoryMessage, tag="story-record"):
    """Keep what is shown as a step."""


class PlayStory(StoryMessage, tag="story-play"):
    """Tell a story."""

    name: Name


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
