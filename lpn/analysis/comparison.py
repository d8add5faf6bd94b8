"""Comparison of two tiles of one ranking, and what the part weights that swap them do to all queries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy.typing as npt

from lpn.core.arrays import Int64Array
from lpn.explain import counterfactual
from lpn.explain.counterfactual import Effect, RanksWithoutParts, Reweighting
from lpn.retrieval import Match, Ranking
from lpn.tasks.task import Task


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


def effect_on(
    task: Task, before: npt.ArrayLike | None, after: npt.ArrayLike, first: Int64Array | None = None
) -> Effect:
    """Compare two sets of part weights over all queries of a task, see `counterfactual.effect`."""
    return counterfactual.effect(
        *task.compared, before, after, task.query_labels, task.gallery_labels, task.truth, first
    )
