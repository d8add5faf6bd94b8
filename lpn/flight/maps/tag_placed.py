"""The sentence in a map's notes that GPS tags place it, as it is written and read."""

from __future__ import annotations

from collections.abc import Iterable

from lpn.core.numbers import upper_bound

_BEGINNING = "Place and scale are those of the GPS tags"


def describe_placing(median: float, largest: float) -> str:
    """Say that GPS tags place a map, and how many metres they lie from the middles of its photos."""
    return (
        f"{_BEGINNING}, which lie {median:.1f} m from the photos' middles on it in the median, {upper_bound(largest)} m at "
        "most."
    )


def placing_sentence(notes: Iterable[str]) -> str:
    """Return the sentence of a map's notes from `describe_placing`; "" without one."""
    note = next((note for note in notes if _BEGINNING in note), "")
    return note[note.find(_BEGINNING) :]
