"""Comparison of two tiles of one ranking: the positive, and a tile that is mistaken for it or could be."""

from __future__ import annotations

from dataclasses import dataclass

from lpn.explain import counterfactual
from lpn.explain.counterfactual import RanksWithoutParts, Reweighting
from lpn.retrieval import Match, Ranking


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two tiles of a ranking: one that should be first, and another one.

    Attributes:
        followed: the positive, or the chosen tile if the positive is not known.
        other: the chosen tile, or the hardest negative if the chosen tile is `followed` or another positive.
        without: the ranks of `followed` without each part.
        change: the nearest part weights that put `followed` first; None if no weights do.
    """

    followed: Match
    other: Match
    without: RanksWithoutParts | None
    change: Reweighting | None

    @classmethod
    def of(cls, ranking: Ranking, chosen: Match) -> Comparison | None:
        """Compare a chosen tile; None if the ranking has no tile to compare it with."""
        positive = ranking.positive()
        followed = positive or chosen
        other = chosen
        if chosen.index == followed.index or chosen.true:
            nearest = ranking.hardest_negative(followed.index)
            if nearest is None:
                return None
            other = nearest
        index = None if positive else followed.index
        return cls(
            followed,
            other,
            counterfactual.ranks_without_parts(ranking, index),
            counterfactual.smallest_change(ranking, index),
        )
