"""The panel of stories, and the command that adds a step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any
from urllib.parse import quote, urlencode

from msgspec.structs import replace

from explorer.screen import fields
from explorer.screen.fields import Line, PanelField
from explorer.screen.fragments import fragment
from explorer.screen.panel import Action, PanelPart, Tab
from explorer.screen.panels.stories import story as files
from explorer.screen.panels.stories.export import save_story
from explorer.screen.panels.stories.story import Step, Story
from lpn.core.demo import own_file_place
from lpn.core.errors import InputError

# The shown story, to which S adds a step.
STORY = PanelField("stories_chosen", Line(), "", key="story")
# Keys of an address that a step leaves out: they belong to the user, not to the story.
_LEFT_OUT = ("theme", "story", "only", "find")


def keep(tab: Tab) -> None:
    """Add the screen's state as a step to the chosen story of the user, or to a new one."""
    if tab.state.own:
        raise InputError(
            "A story shows photos of the data set, and your own photo exists in this tab alone; choose one of the list."
        )
    workspace = tab.base
    stories = files.stories_of(workspace)
    name = tab.state[STORY] if tab.state[STORY] in stories.own else _free(stories.by_name)
    step = Step(_address(tab), _caption(tab)[:400])
    kept = files.change(files.own_stories(workspace), Story(name), lambda now: replace(now, steps=(*now.steps, step)))
    assert kept is not None
    tab.set({STORY.name: name})
    tab.note(f"Step {len(kept.steps)} of {name} is saved.")


def _free(names: Collection[str]) -> str:
    return next(name for number in range(1, len(names) + 2) if (name := f"Story {number}") not in names)


def _address(tab: Tab) -> str:
    """Return the address of the screen; it names place and scoring, as their defaults may change."""
    state, workspace = tab.state, tab.base
    given = fields.parsed(fields.to_address(state, workspace))
    shown = {key: one for key, one in given.items() if key not in _LEFT_OUT and (key, one) != ("panel", "stories")}
    place = {"show": state.place} if workspace.choices else {}
    return urlencode(place | shown | {"scoring": state.scoring}, quote_via=quote, safe="/,~")


def _caption(tab: Tab) -> str:
    """Return the headline of the shown answer; empty until it is computed."""
    if tab.result is None or fields.needs_answer(tab.result.state, tab.state):
        return ""
    said = tab.result.headline
    sign = {True: "Found, ", False: "Missed, ", None: ""}[said["found"]]
    return f"{sign}{said['title']}. {said['reason']}"


class StoriesPart(PanelPart):
    """Lists the stories and the steps of the chosen one, and changes them."""

    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self.actions = {
            "step": self._changing(_stepped),
            "rename": self._changing(lambda story, given: replace(story, name=_text(given, "name").strip())),
            "delete": self._changing(lambda story, given: None),  # noqa: ARG005
            "export": lambda given: save_story(tab, self._story(given)),
        }
        self._sent: dict[str, Any] = {}
        self._pictures: dict[str, str] = {}

    def show(self) -> None:
        """Send the stories, and the steps of the chosen one."""
        workspace = self.tab.base
        stories = files.stories_of(workspace)
        chosen = self.tab.state[STORY] or next(iter(stories.by_name), "")
        story = stories.by_name.get(chosen, Story(chosen or "-"))
        steps = [
            {"shows": step.shows, "caption": step.caption, "notes": step.notes, "picture": self._picture(step.shows)}
            for step in story.steps
        ]
        message = {
            "names": list(stories.by_name),
            "new": _free(stories.by_name),
            "story": chosen if chosen in stories.by_name else "",
            "own": chosen in stories.own,
            "steps": steps,
            "place": workspace.stories.name
            if workspace.stories
            else own_file_place(workspace.root, files.NAME, "data"),
            "error": stories.error,
        }
        if message != self._sent:
            self._sent = message
            self.tab.send(message | {"html": fragment("stories/stories", **message)})

    def _story(self, given: Mapping[str, Any]) -> Story:
        story = files.stories_of(self.tab.base).by_name.get(_text(given, "story"))
        if story is None:
            raise InputError("There is no such story any more; choose another one.")
        return story

    def _changing(self, edit: Callable[[Story, Mapping[str, Any]], Story | None]) -> Action:
        """Return an action that changes a story in the file, and shows it."""

        def act(given: Mapping[str, Any]) -> None:
            file = files.own_stories(self.tab.base)
            changed = files.change(file, self._story(given), lambda now: edit(now, given))
            self.tab.set({STORY.name: "" if changed is None else changed.name})

        return act

    def _picture(self, shows: str) -> str:
        """Return the address of a step's photo; empty if it is of another place, or does not exist any more."""
        if shows not in self._pictures:
            given, workspace = fields.parsed(shows), self.tab.base
            state, problems = fields.from_values(given, workspace)
            there = not problems and given.get("show", state.place) == state.place
            task = workspace.tasks[state.task]
            self._pictures[shows] = workspace.feeds.thumbnail(task, "query", state.query) if there else ""
        return self._pictures[shows]


def _text(given: Mapping[str, Any], name: str) -> str:
    value = given.get(name)
    return value if isinstance(value, str) else ""


def _stepped(story: Story, given: Mapping[str, Any]) -> Story:
    """Return the story with a step's new texts and position; without a position, the step is removed."""
    at, to, steps = given.get("at"), given.get("to"), list(story.steps)
    if not (isinstance(at, int) and 0 <= at < len(steps) and steps[at].shows == given.get("shows")):
        raise InputError("The story has changed meanwhile; look at its steps, and try again.")
    shows = steps.pop(at).shows
    if isinstance(to, int):
        steps.insert(max(to, 0), Step(shows, _text(given, "caption"), _text(given, "notes")))
    return replace(story, steps=tuple(steps))
