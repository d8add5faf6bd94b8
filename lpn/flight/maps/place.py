"""The place of a map beyond its georeference: its name, the day of its pictures, and their author."""

from __future__ import annotations

import re
from datetime import date

import msgspec

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.texts import listed

SEASONS = ("spring", "summer", "autumn", "winter")
_DAY = re.compile(r"\d{4}-\d{2}-\d{2}")
_LONGEST = 120


class MapPlace(msgspec.Struct, frozen=True, omit_defaults=True):
    """A map's place, as its maker named it.

    Raises:
        InputError: for a text that is too long or not printable, or a time that is neither a day nor a season.

    Attributes:
        name: such as "Dripping Springs, Texas"; "" if it is not known.
        photographed: the day of the map's pictures, "2014-10-19", or their season, "spring"; "" if neither is known.
        credit: author and licence of the pictures; "" if they are not known.
        source: web address of the pictures; "" if there is none.
    """

    name: str = ""
    photographed: str = ""
    credit: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        for text in (self.name, self.photographed, self.credit, self.source):
            if len(text) > _LONGEST or text != printable(text):
                raise InputError(
                    f"The place of a map has the text {printable(text[:_LONGEST])!r}; expected printable text of at most "
                    f"{_LONGEST} characters."
                )
        if self.source and not self.source.startswith("https://"):
            raise InputError(f"The source of a map is {self.source!r}; expected an address that begins with https://.")
        try:
            known = self.photographed in ("", *SEASONS) or self.day is not None
        except ValueError:
            known = False
        if not known:
            raise InputError(
                f"The map's pictures are said to be of {self.photographed!r}; expected a day such as 2014-10-19, or "
                f"{listed(SEASONS, 'or')}."
            )

    @property
    def day(self) -> date | None:
        """The day of the map's pictures; None if it is not known."""
        return date.fromisoformat(self.photographed) if _DAY.fullmatch(self.photographed) else None

    @property
    def season(self) -> str:
        """The season of the map's pictures if no day is known; else ""."""
        return "" if self.day is not None else self.photographed
