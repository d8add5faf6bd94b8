"""Two tiles of one ranking: the positive, and a tile that is or could be mistaken for it."""

from __future__ import annotations

from dataclasses import dataclass

from lpn.explain import counterfactual
from lpn.explain.counterfactual import RanksWithoutParts, Reweighting
from lpn.retrieval import Match, Ranking


@dataclass(frozen=True, eq=False)
class Comparison:
    """A tile that should be first, against another one.

    Attributes:
        followed: the positive; the chosen tile where the positive is not known.
        other: the chosen tile; the nearest wrong one where the chosen tile is `followed` or another true match.
        without: the ranks of `followed` without each part.
        change: the nearest part weights that put `followed` first; None where no weights do.
    """

    followed: Match
    other: Match
    without: RanksWithoutParts | None
    change: Reweighting | None

    @classmethod
    def of(cls, ranking: Ranking, chosen: Match) -> Comparison | None:
        """Compare a chosen tile of a ranking; None where the ranking has no second tile for it."""
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
