"""The messages of the panel Parts, and of the controls over the stage; none of them is trusted."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from explorer.web.messages import Message

_Part = Annotated[int, Meta(ge=1)]
_Column = Annotated[int, Meta(ge=0)]


class PartsMessage(Message):
    """A message of the panel Parts."""


class TryCombinations(PartsMessage, tag="parts-all"): ...


class StopCombinations(PartsMessage, tag="parts-stop"): ...


class SaveCombinations(PartsMessage, tag="parts-save"): ...


class SortCombinations(PartsMessage, tag="parts-sort"):
    """Sort the table of combinations by a column of figures, best first; by parts without one."""

    column: _Column | None


class TakeParts(PartsMessage, tag="parts-take"):
    """Switch on these parts and no others, with equal weights."""

    parts: list[_Part]


class StageMessage(Message):
    """A message of the controls over the stage."""


class StepQuery(StageMessage, tag="stage-step"):
    step: Literal["previous", "next", "random", "failure"]


class FlipLook(StageMessage, tag="stage-flip"):
    """Show or hide the rings, take them apart or put them together, show or close the map."""

    look: Literal["rings", "exploded", "map"]


class LookThrough(StageMessage, tag="stage-through"):
    """Look at the map through the camera of the photo."""


class LookAway(StageMessage, tag="stage-away"):
    """A person has moved the view that looked through a photo's camera."""


class ShowHeat(StageMessage, tag="stage-heat"):
    kind: Literal["off", "activation", "evidence"]


class SetOpacity(StageMessage, tag="stage-opacity"):
    opacity: Annotated[float, Meta(ge=0, le=1)]


class TurnQuery(StageMessage, tag="stage-turn"):
    """Turn the query to an angle in degrees counter-clockwise."""

    angle: Annotated[float, Meta(ge=-180, le=180)]


class FlipPart(StageMessage, tag="stage-part"):
    """Switch a part, from 1, on or off."""

    part: _Part
