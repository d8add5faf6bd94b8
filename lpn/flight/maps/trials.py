"""Trials of single photos on a map: how many of its place were placed by their details alone, and how many of other places."""

from __future__ import annotations

import msgspec


class SinglePhotoTrials(msgspec.Struct, frozen=True):
    """The counts of trials on a map, as map.json keeps them; `python -m tools.bench.single_photos` writes them.

    Attributes:
        here, placed: photos of the place, and those that were accepted.
        elsewhere, misplaced: photos of other places, and those that were accepted all the same.
        matchers: names of those that matched them; empty where that is not recorded.
    """

    here: int
    placed: int
    elsewhere: int
    misplaced: int
    matchers: list[str] = []

    @property
    def possible(self) -> bool:
        """True unless more photos were accepted than were tried."""
        return 0 <= self.placed <= self.here and 0 <= self.misplaced <= self.elsewhere
