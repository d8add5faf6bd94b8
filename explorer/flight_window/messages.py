"""The messages of the flight window's html, validated by msgspec; none of them is trusted."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from explorer.web import messages

FrameIndex = Annotated[int, Meta(ge=0, le=10**7)]
Metres = Annotated[float, Meta(ge=-1e6, le=1e6)]
Spot = tuple[Metres, Metres]


class FlightMessage(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """A message of the flight window's HTML."""


class ChooseFrame(FlightMessage):
    frame: FrameIndex


class PaintScores(FlightMessage):
    """Paint the scores of all parts, of one part, or none."""

    part: FrameIndex | Literal["all", "off"]


class ShowSpot(FlightMessage):
    """List the frames that show a spot, in metres of the map's frame."""

    spot: Spot


class CorrectFrame(FlightMessage):
    """Keep the corners of a frame's picture, in metres of the map's frame, as a person has placed them."""

    frame: FrameIndex
    corners: tuple[Spot, Spot, Spot, Spot]


class ForgetCorrection(FlightMessage):
    frame: FrameIndex


class ToggleHeight(FlightMessage): ...


class CloseFlight(FlightMessage): ...


MESSAGES: dict[str, type[FlightMessage]] = {
    "flight-frame": ChooseFrame,
    "flight-paint": PaintScores,
    "flight-spot": ShowSpot,
    "flight-correct": CorrectFrame,
    "flight-forget": ForgetCorrection,
    "flight-tall": ToggleHeight,
    "flight-close": CloseFlight,
}


def decode(kind: str, value: Any) -> FlightMessage | None:
    """Return the message that a JSON value holds, None if it holds none of this kind."""
    return messages.decode(MESSAGES, kind, value)
