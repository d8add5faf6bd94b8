"""The stories of a workspace, in `stories.json` beside the data; what a user makes on the demo is kept where notes on it are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from explorer.stories import tour
from explorer.stories.story import Step, Story, add, new_name
from explorer.workspace import Workspace
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import DataError, LPNError, OutputError
from lpn.core.files import printable
from lpn.core.own_files import OwnFileFormat

NAME = "stories.json"


@dataclass(frozen=True)
class Stories:
    """The stories of a data set.

    Attributes:
        by_name: in the order of the files; a person's story replaces a shipped one of the same name.
        errors: one sentence about each file that cannot be used.
    """

    by_name: dict[str, Story]
    errors: tuple[str, ...] = ()


def read_stories(file: Path) -> list[Story]:
    """Read a file of stories; empty if it does not exist.

    Raises:
        DataError: when the file is damaged, or two stories in it have one name.
    """
    return _FORMAT.read(file)


def read_all(root: Path, built_in: Sequence[Story] = (), shipped: bool = True) -> Stories:
    """Read the stories that lie beside a data set, and those that its user made.

    Args:
        built_in: come last, unless another story has the name.
        shipped: with those of the demo, whose captions are of its own model.
    """
    stories: dict[str, Story] = {}
    errors = []
    files = [root / NAME] if shipped else []
    try:
        files = list(dict.fromkeys([*files, own_file(root, NAME)]))
    except OutputError as error:
        errors.append(str(error))
    for file in files:
        try:
            stories |= {story.name: story for story in read_stories(file)}
        except LPNError as error:
            errors.append(str(error))
    return Stories(stories | {story.name: story for story in built_in if story.name not in stories}, tuple(errors))


def stories_of(workspace: Workspace) -> Stories:
    """Read the stories of a workspace, the tour last; the demo's own are left out where its ranking is another."""
    calibrated = any(task.calibration for task in workspace.tasks.values())
    return read_all(workspace.root, [tour.story(workspace)], shipped=not calibrated)


def keep(root: Path, step: Step, name: str | None, taken: Collection[str] = (), begun: Sequence[Step] = ()) -> Story:
    """Append a step to a story beside the data, and return the story; captions and order are edited in the file itself.

    Args:
        name: of the story, which begins with this step where the file lacks it; None begins one under a free name.
        taken: names of other stories, which the free one is not.
        begun: steps that the story had. If the file lacks its name, and one story begins by showing the same, it was renamed.

    Raises:
        InputError: when the story has the most steps, or the file would be too large.
        DataError: when the existing file is damaged; it is not changed.
        OutputError: when the file cannot be written.
    """

    def change(stories: list[Story]) -> list[Story]:
        names = [stored.name for stored in stories]
        chosen = new_name([*names, *taken]) if name is None else name
        shown = [former.shows for former in begun]
        renamed = [told.name for told in stories if [former.shows for former in told.steps[: len(shown)]] == shown]
        if name not in (None, *names) and shown and len(renamed) == 1:
            chosen = renamed[0]
        at = names.index(chosen) if chosen in names else len(stories)
        kept.append(add(stories[at] if at < len(stories) else Story(chosen), step))
        return [*stories[:at], kept[-1], *stories[at + 1 :]]

    kept: list[Story] = []
    _FORMAT.change(own_file(root, NAME), change)
    return kept[-1]


def place(root: Path) -> str:
    """Return where stories are saved, in words and without the server's folders."""
    return own_file_place(root, NAME, "data")


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
