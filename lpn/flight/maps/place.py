"""The place of a map beyond its georeference: its name, the day of its pictures, and their author."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date

import msgspec

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.numbers import upper_bound
from lpn.core.texts import listed

SEASONS = ("spring", "summer", "autumn", "winter")
_DAY = re.compile(r"\d{4}-\d{2}-\d{2}")
_LONGEST = 120
# The beginning of the note that GPS tags place a map.
_PLACING = "Place and scale are those of the GPS tags"


class MapPlace(msgspec.Struct, frozen=True, omit_defaults=True):
    """A map's place, as its maker named it.

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

    @property
    def day(self) -> date | None:
        """The day of the map's pictures; None if it is not known."""
        return date.fromisoformat(self.photographed) if _DAY.fullmatch(self.photographed) else None

    @property
    def season(self) -> str:
        """The season of the map's pictures if no day is known; else ""."""
        return "" if self.day is not None else self.photographed


def checked_place(place: MapPlace) -> MapPlace:
    """Return a place whose texts can be shown.

    Raises:
        InputError: for a text that is too long or not printable, or a time that is neither a day nor a season.
    """
    for text in (place.name, place.photographed, place.credit, place.source):
        if len(text) > _LONGEST or text != printable(text):
            raise InputError(
                f"The place of a map has the text {printable(text[:_LONGEST])!r}; expected printable text of at most {_LONGEST} "
                "characters."
            )
    if place.source and not place.source.startswith("https://"):
        raise InputError(f"The source of a map is {place.source!r}; expected an address that begins with https://.")
    if place.photographed and place.photographed not in SEASONS:
        try:
            known = place.day
        except ValueError:
            known = None
        if known is None:
            raise InputError(
                f"The map's pictures are said to be of {place.photographed!r}; expected a day such as 2014-10-19, or "
                f"{listed(SEASONS, 'or')}."
            )
    return place


def describe_placing(median: float, largest: float) -> str:
    """State that GPS tags place a map, and how many metres they lie from the middles of its photos."""
    return (
        f"{_PLACING}, which lie {median:.1f} m from the photos' middles on it in the median, {upper_bound(largest)} m at "
        "most."
    )


def placing_sentence(notes: Iterable[str]) -> str:
    """Return the sentence of a map's notes from `describe_placing`; "" without one."""
    note = next((note for note in notes if _PLACING in note), "")
    return note[note.find(_PLACING) :]
