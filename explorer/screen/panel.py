"""Panels, which open beside or over the rings. Each is a folder: Python, a style sheet, and perhaps a module."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.screen.downloads import MakeFile
from explorer.screen.fields import PanelField, ScreenState
from explorer.screen.loop import ScreenMessage
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace
from lpn.core.arrays import Float64Array
from lpn.drawing.theme import Colour

# Line segments (N, 2, 3) and their colour.
SceneLines = tuple[Float64Array, Colour]
Action = Callable[[Mapping[str, Any]], None]


class Tab(Protocol):
    """The interface of a tab for its panels. Any thread may use all of it."""

    @property
    def state(self) -> ScreenState:
        """The newest state."""
        ...

    @property
    def result(self) -> ScreenResult | None:
        """The newest result for the state's place, task, and model, perhaps of an older state; None before the first."""
        ...

    @property
    def base(self) -> Workspace:
        """The workspace of the state's place, whose feeds serve lists and pictures."""
        ...

    @property
    def workspace(self) -> Workspace:
        """The workspace of the state's model."""
        ...

    @property
    def ranking(self) -> RankingJob:
        """The ranking of the state's task, model, and scoring."""
        ...

    @property
    def background(self) -> RequestContext:
        """The request context for background work."""
        ...

    def set(self, values: Mapping[str, object]) -> None:
        """Set fields of the state as the page does."""
        ...

    def send(self, message: ScreenMessage) -> None:
        """Send a message to the open panel's module in place of a waiting one; see `append`."""
        ...

    def append(self, kind: str, message: ScreenMessage) -> None:
        """Send a message; it replaces a waiting message of the same kind only."""
        ...

    def say(self, text: str) -> None:
        """Show a sentence in the headline's place; the result fades."""
        ...

    def note(self, text: str) -> None:
        """Show a sentence for some seconds in place of the headline's reason."""
        ...

    def download(self, title: str, make: MakeFile) -> None:
        """Make a file on a thread of its own, with notes of its progress; the browser saves it, see `Downloads`."""
        ...


class PanelPart:
    """A panel's part of one tab while the panel is open.

    Attributes:
        actions: functions by name; the panel's module calls them by `context.act`.
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.actions: Mapping[str, Action] = {}

    def show(self) -> float | None:
        """Send the panel's contents: after it opened, after each change of the state, and after each result.

        One thread makes the calls one by one; several changes lead to one more call. The message of an LPNError is shown in the
        headline's place.

        Returns:
            Seconds until the next call, for a panel that waits or computes step by step; None to wait for a change.
        """
        return None

    def close(self) -> None:
        """Stop the work for the panel."""


@dataclass(frozen=True)
class Command:
    """A user's action by the palette or a key, whether the panel is open or not.

    Attributes:
        name: name of the action, requested as `PANEL.NAME`; it takes precedence over an action of the panel's part.
        title: title in the palette.
        act: acts on a tab within a moment; the message of an LPNError is shown in the headline's place.
        key: its key in lower case; empty for none.
        offered: whether a workspace has it.
    """

    name: str
    title: str
    act: Callable[[Tab], None]
    key: str = ""
    offered: Callable[[Workspace], bool] = lambda workspace: True  # noqa: ARG005


@dataclass(frozen=True)
class Panel:
    """A panel, which its folder's `__init__.py` calls `PANEL`.

    Attributes:
        name: name in the address, and of its folder, its style sheet `NAME.css`, and its module `NAME.js` if there is one.
        title: title of its command, and its heading.
        part: makes its part of a tab; None for a panel of commands alone, which never opens.
        key: opens and closes it, in lower case; empty for none.
        place: "beside" the rings in the rail's place, a "page" over them until the photo changes, or the "full" window.
        fields: its fields of the state; their names begin with the panel's name and "_".
        offered: whether a workspace has it, and its commands.
        commands: its commands in the palette and by keys.
        mark: its remark on a query in the head of the tile, as a `sign` and a `text`; None for no remark.
        lines: its lines for a query in the scene of the place, in metres from the origin of `GalleryGeometry`.
    """

    name: str
    title: str
    part: Callable[[Tab], PanelPart] | None = None
    key: str = ""
    place: Literal["beside", "page", "full"] = "page"
    fields: Sequence[PanelField[Any]] = ()
    offered: Callable[[Workspace], bool] = lambda workspace: True  # noqa: ARG005
    commands: Sequence[Command] = ()
    mark: Callable[[Workspace, int], Mapping[str, Any] | None] = lambda workspace, query: None  # noqa: ARG005
    lines: Callable[[Workspace, int], Sequence[SceneLines]] = lambda workspace, query: ()  # noqa: ARG005
