"""Comparison of two tiles of one ranking, and the effect of other part weights on all queries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array
from lpn.explain import counterfactual
from lpn.explain.counterfactual import Effect, RanksWithoutParts
from lpn.retrieval import Match, Ranking
from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two tiles of a ranking: one that should be first, and another one.

    Attributes:
        followed: the positive, or the chosen tile if the positive is not known.
        other: the chosen tile, or the hardest negative if the chosen tile is `followed` or another positive.
        without: the ranks of `followed` without each part.
        weights: the nearest part weights that put `followed` first; None if no weights do.
    """

    followed: Match
    other: Match
    without: RanksWithoutParts | None
    weights: Float32Array | None

    @classmethod
    def of(cls, ranking: Ranking, chosen: Match) -> Comparison | None:
        """Compare a chosen tile; None if the ranking has no other tile to compare."""
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


def effect_on(task: Task, weights: npt.ArrayLike) -> Effect:
    """Compare other part weights with the task's weights over all queries; InputError if their number or values are wrong."""
    old, new = (one.retrieved.first == 0 for one in (task, task.with_fields(weights=weights)))
    counted = np.ones(len(old), bool) if task.known is None else task.known
    before, after = (100.0 * float(hits[counted].mean()) for hits in (old, new))
    return Effect(before, after, np.flatnonzero(new & ~old), np.flatnonzero(old & ~new), int(counted.sum()))
