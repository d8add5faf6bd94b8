"""The messages of the page of a flight that goes on, beside those of the flight window; none of them is trusted."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta

from explorer.stage.viewport import MAX_SIDE
from explorer.web.messages import Message

_Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]


class LivePageMessage(Message):
    """A message of the page."""


class GreetLive(LivePageMessage, tag="hello"):
    greeting: dict[str, Any]


class ResizeLive(LivePageMessage, tag="viewport"):
    width: _Side
    height: _Side
