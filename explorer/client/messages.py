"""The messages of the page itself, which belong to none of its windows; none of them is trusted."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from explorer.session_state import Alteration
from explorer.stage.viewport import MAX_SIDE
from explorer.web.messages import Message
from lpn.tasks.task import Scoring

_Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]


class PageMessage(Message):
    """A message of the page."""


class Greeting(msgspec.Struct, frozen=True):
    """A new page, as it describes itself.

    Attributes:
        search: the query string of its address.
        small: its window has room for one panel only.
        plain: it reads plain words.
        start_plain: its first screen does; otherwise the person chose expert words.
        light: its theme is the light one: the choice in its browser, else that of its address, else the system's.
        viewport: width and height of its stage, any numbers; None while it has none.
    """

    search: str
    small: bool = False
    plain: bool = False
    start_plain: bool = True
    light: bool = False
    viewport: tuple[float, float] | None = None


class Greet(PageMessage, tag="hello"):
    greeting: Greeting


class ResizeStage(PageMessage, tag="viewport"):
    width: _Side
    height: _Side


class FitPanels(PageMessage, tag="small"):
    small: bool


class ShowTask(PageMessage, tag="task"):
    task: str


class ShowScoring(PageMessage, tag="scoring"):
    scoring: Scoring


class CancelScoring(PageMessage, tag="scoring-stop"):
    """Prepare a scoring no longer for this page."""


class ShowOther(PageMessage, tag="show"):
    """Show another workspace."""

    key: str


class ConfirmPreview(PageMessage, tag="previewed"):
    """The first screen of another workspace is shown."""


class GoBack(PageMessage, tag="back"):
    """Show what an earlier address of the page's history shows."""

    search: str


class UndoAlteration(PageMessage, tag="undo"):
    alteration: Alteration


class ActOnFirstScreen(PageMessage, tag="screen"):
    action: str


class FlipTheme(PageMessage, tag="dark"): ...


class FlipWords(PageMessage, tag="words"): ...


class ShowGlossary(PageMessage, tag="glossary"): ...


class StraightenStage(PageMessage, tag="straighten"): ...


class CloseMap(PageMessage, tag="map-close"): ...
