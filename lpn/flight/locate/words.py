"""Texts of verdicts, and of refusals by code; braces contain a number's name and format."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from lpn.core.numbers import SIGMA

Code = Literal[
    "", "unread", "no tag", "too large", "no detail", "no match", "support", "rival", "anywhere", "turned far", "cells",
    "off the map", "wide", "unsure", "beyond", "unproven", "few", "turned", "unreachable",
]  # fmt: skip

# The summary of a verdict by the stage whose position counts, and the evidence against this position.
DECIDED: Mapping[str | None, str] = {
    "registration": "Placed by its details",
    "sequence": "Placed by its neighbours only",
    "retrieval": "Not placed, a best guess only",
    None: "Not located",
}
AGAINST: Mapping[str, str] = {
    "tag": "its GPS tag disagrees",
    "map": "away from its middle it does not fit the map",
    "sequence": "its neighbours disagree",
}

_EQUAL = "this may be another building that looks the same."
_WORDS: Mapping[Code, str] = {
    "no tag": "The photo has no GPS tag to search around; leave --prior out to search the whole map.",
    "too large": "More than {blocks:.0f} blocks of the map would have to be searched for this photo; give --model, or --prior "
    "with the metres around the GPS tag.",
    "no detail": "The map has no detail where the photo may be.",
    "no match": "Fewer than four features of the photo match the map.",
    "support": "Only {support:.0f} of {matches:.0f} matches agree on a place beyond chance, and {needed:.0f} are needed.",
    "rival": "Two places of the map fit the photo, so neither counts: beyond chance, {support:.0f} details agree with one, "
    "and {other:.0f} with the second, {metres:,.0f} m away.",
    "anywhere": "Its best place has a support of {support:.0f}, and a photo of unknown place needs {needed:.0f}.",
    "turned far": "The picture would be turned by {degrees:.0f} degrees against its heading, which needs a support of "
    "{needed:.0f}, and this place has {support:.0f}.",
    "cells": "All {inliers:.0f} agreeing matches lie in {cells:.0f} of {all:.0f} cells of the photo, too few to trust its "
    "centre.",
    "off the map": "The centre of the photo would lie off the map.",
    "wide": f"Its radius of {{radius:.0f}} m ({SIGMA}) is larger than a piece of the map, {{side:.0f}} m wide.",
    "unsure": "The frame lies within {metres:.0f} m of this place with a probability of {probability:.2f}, and {needed:.2f} are "
    "needed.",
    "beyond": "Where the drone can have been, the map resembles this photo and its neighbours too little. By these scores it was "
    "beyond the map's edge, or so near it that no piece of the map shows the photo whole, with a probability of "
    "{probability:.2f}.",
    "unproven": "Nothing shows that the map is of this place. Proof would be a path that follows the headings better than by "
    "chance, or registrations that agree with the sequence more often than by chance.",
    "few": "Only {photos:.0f} of {all:.0f} photos fit this map (different views: {views:.0f}). So few may fit a map of another "
    "place by chance, and nothing else confirms this map.",
    "turned": f"The photo fits the map here, but turned by {{degrees:.1f}}° from the direction that its heading and the other "
    f"frames imply: {_EQUAL}",
    "unreachable": "The photo fits the map here, but the drone can hardly have flown here since the last registered frame: "
    f"{_EQUAL}",
}


class Reason(NamedTuple):
    """The reason of a refusal.

    Attributes:
        code: of the reason.
        numbers: the figures in its words, by name.
    """

    code: Code
    numbers: Mapping[str, float] = {}

    @property
    def sentence(self) -> str:
        """The reason in words; "" for a code without words."""
        return _WORDS.get(self.code, "").format(**self.numbers)
