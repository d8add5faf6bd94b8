"""The messages of the lists of pictures, and of the user's own pictures; none of them is trusted."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from explorer.web.messages import Message

# The most own pictures that a browser may hold, and the most files that a message may name.
MOST, MOST_NAMED = 200, 300
_Name = Annotated[str, Meta(max_length=400)]


class BrowseMessage(Message):
    """A message of a list of pictures."""


class PickQuery(BrowseMessage, tag="pick"):
    """Choose a query of a task."""

    task: str
    query: int


class BeginBatch(BrowseMessage, tag="own-begin"):
    """Announce the number of files that a page is about to send, and name the refused files, each with a kind of reason."""

    files: Annotated[int, Meta(ge=0, le=MOST)]
    refused: Annotated[list[tuple[_Name, _Name]], Meta(max_length=MOST_NAMED)]
    unnamed: Annotated[int, Meta(ge=0, le=10**7)]


class SkipFile(BrowseMessage, tag="own-skip"):
    """Go on without the file that was asked for: the page cannot read it."""

    number: int
    name: str


class PickOwn(BrowseMessage, tag="own-pick"):
    """Show one of the user's own pictures; their list is the same in every task."""

    task: str
    index: Annotated[int, Meta(ge=0)]


class CloseOwn(BrowseMessage, tag="own-close"):
    """Forget all own pictures."""
