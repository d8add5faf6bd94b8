"""The messages of the flight window's html; none of them is trusted."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from explorer.web.messages import Message

FrameIndex = Annotated[int, Meta(ge=0, le=10**7)]
_FARTHEST = 1e6
Metres = Annotated[float, Meta(ge=-_FARTHEST, le=_FARTHEST)]
Spot = tuple[Metres, Metres]
_Corner = tuple[float | None, float | None]


class FlightMessage(Message):
    """A message of the flight window's HTML."""


class ChooseFrame(FlightMessage, tag="flight-frame"):
    frame: FrameIndex


class PaintScores(FlightMessage, tag="flight-paint"):
    """Paint the scores of all parts, of one part, or none."""

    part: FrameIndex | Literal["all", "off"]


class ShowSpot(FlightMessage, tag="flight-spot"):
    """List the frames that show a spot, in metres of the map's frame."""

    spot: Spot


class CorrectFrame(FlightMessage, tag="flight-correct"):
    """Keep the corners of a frame's picture, in metres of the map's frame, as a person has placed them.

    JSON has null for a corner at infinity.
    """

    frame: FrameIndex
    corners: tuple[_Corner, _Corner, _Corner, _Corner]

    def spots(self) -> list[Spot] | None:
        """Return the corners, None if one of them is at infinity, or far beyond the map."""
        spots = [
            (x, y) for x, y in self.corners if x is not None and y is not None and max(abs(x), abs(y)) <= _FARTHEST
        ]
        return spots if len(spots) == len(self.corners) else None


class ForgetCorrection(FlightMessage, tag="flight-forget"):
    frame: FrameIndex


class ToggleHeight(FlightMessage, tag="flight-tall"): ...


class SavePositions(FlightMessage, tag="flight-save"):
    """Save one position a photo as a file with a suffix."""

    suffix: Literal[".csv", ".geojson"]


class CloseFlight(FlightMessage, tag="flight-close"): ...
