"""Stories and their files.

[{"name": "A twin", "steps": [{"shows": "query=0447/07&scoring=plain", "caption": "...", "notes": "..."}]}]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from explorer.workspace import Workspace
from lpn.core.demo import DEMO, DEMO_MODEL, own_file
from lpn.core.errors import DataError, InputError, LPNError
from lpn.core.files import printable
from lpn.core.own_files import OwnFileFormat

NAME = "stories.json"


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One step.

    Attributes:
        shows: the state of the page as the query string of its address, without theme and story.
        caption: for the audience.
        notes: for the presenter.
    """

    shows: Annotated[str, Meta(max_length=4000)]
    caption: Annotated[str, Meta(max_length=400)] = ""
    notes: Annotated[str, Meta(max_length=2000)] = ""


class Story(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named list of steps."""

    name: Annotated[str, Meta(min_length=1, max_length=80)]
    steps: Annotated[tuple[Step, ...], Meta(max_length=60)] = ()


@dataclass(frozen=True)
class Stories:
    """All stories that the page offers.

    Attributes:
        by_name: the shipped stories, then the user's stories, which replace shipped stories of equal names.
        own: the names of the user's stories.
        error: one sentence about a file that cannot be used.
    """

    by_name: dict[str, Story]
    own: set[str]
    error: str = ""


def read_stories(file: Path) -> list[Story]:
    """Read a file of stories; empty if it does not exist.

    Raises:
        DataError: when the file is damaged, or two of its stories have one name.
    """
    return _FORMAT.read(file)


def stories_of(workspace: Workspace) -> Stories:
    """Read the stories of a workspace. The demo's stories need the demo's model, as their captions name its figures."""
    shipped = workspace.root == DEMO and workspace.model_name == DEMO_MODEL.name
    by_name = {story.name: story for story in read_stories(DEMO / NAME)} if shipped else {}
    try:
        own = {story.name: story for story in read_stories(own_stories(workspace))}
    except LPNError as error:
        return Stories(by_name, set(), str(error))
    return Stories(by_name | own, set(own))


def change(file: Path, story: Story, edit: Callable[[Story], Story | None]) -> Story | None:
    """Change a story in a file, and return it.

    Args:
        story: the story as the page has it; the file may have another state of it, or lack it.
        edit: returns the story in its new state; None deletes it.

    Raises:
        InputError: when the changed story is too large, or its name is taken.
        DataError: when the existing file is damaged; it is not changed.
        OutputError: when the file cannot be written.
    """
    changed: list[Story | None] = []

    def replaced(stories: list[Story]) -> list[Story]:
        names = [one.name for one in stories]
        at = names.index(story.name) if story.name in names else len(names)
        made = edit(stories[at] if at < len(names) else story)
        if made is not None:
            try:
                msgspec.convert(msgspec.to_builtins(made), Story)
            except msgspec.ValidationError as error:
                raise InputError(f"The story cannot be stored ({error}); shorten it, or begin another one.") from error
            if made.name in (*names[:at], *names[at + 1 :]):
                raise InputError(f"There is a story {printable(made.name)!r} already; give another name.")
        changed.append(made)
        return [*stories[:at], *([] if made is None else [made]), *stories[at + 1 :]]

    _FORMAT.change(file, replaced)
    return changed[-1]


def own_stories(workspace: Workspace) -> Path:
    """Return the file of a user's stories; OutputError for the demo if the user has no home folder."""
    return workspace.stories or own_file(workspace.root, NAME)


def _decode(content: bytes, file: Path) -> list[Story]:
    try:
        stories = msgspec.json.decode(content, type=list[Story])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"{file} is not a file of stories ({error}); correct it, or move it away.") from error
    names = [story.name for story in stories]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{file} has two stories named {printable(twice)!r}; give one of them another name.")
    return stories


def _encode(stories: list[Story]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(stories), indent=2) + b"\n"


_FORMAT = OwnFileFormat("stories", _decode, _encode, list[Story], "delete another story first", max_bytes=20_000_000)
