"""The messages of the panel Parts; none of them is trusted."""

from __future__ import annotations

from typing import Annotated

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
