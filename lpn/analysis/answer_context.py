"""One answer among all answers of its task: how often those of a like gap are right, how large its lead is, which kind fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.analysis import breakdown
from lpn.analysis.breakdown import Rate
from lpn.core.arrays import BoolArray
from lpn.core.tables import Column, Table
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.query_outcomes import Outcomes, picture_columns

# So many answers of the nearest gaps, or this share of all where that is more, are alike; fewer than `_FEWEST_GRADED` have no
# neighbourhood.
_ALIKE, _ALIKE_SHARE = 50, 0.1
_FEWEST_GRADED = 2 * _ALIKE
# A share of fewer right answers says little.
_FEWEST = 20
# From each share on, the words for it.
_SHARES = (
    (0.97, "almost all"),
    (0.83, "about nine tenths"),
    (0.71, "about three quarters"),
    (0.58, "about two thirds"),
)
# Columns that tell of the answer, or of one picture alone.
_NOT_OF_A_KIND = ("latitude", "longitude", "overlap", "semi")


@dataclass(frozen=True)
class AlikeAnswers:
    """The graded answers whose gaps are nearest to that of one answer.

    Attributes:
        queries: their number.
        right: how many of them are right.
    """

    queries: int
    right: int

    @property
    def share(self) -> float:
        """The share of right ones, 0 .. 1."""
        return self.right / self.queries


def answers_alike(
    ranking: Retrieval, gap: float | None, known: BoolArray | None = None, besides: int | None = None
) -> AlikeAnswers | None:
    """Count how often the answers whose gaps are nearest to a given one are right; None where there are too few.

    The gap is d² of the second tile minus that of the answer. It needs no truth, so that it is the same for a graded query and
    for the user's own picture. The answers counted are the nearest tenth of all graded ones, at least 50, with those that are as
    near as the farthest of them. A gap above those of all graded answers has none alike.

    Args:
        ranking: of all queries under the weights that the gap is from.
        gap: in d²; None or NaN where there is no second tile.
        known: the queries whose truth is known, (Q,); None for all.
        besides: a query that is not counted: the one that was asked.
    """
    graded = np.isfinite(ranking.gap) if known is None else np.isfinite(ranking.gap) & known
    if besides is not None:
        graded[besides] = False
    rows = np.flatnonzero(graded)
    if gap is None or not np.isfinite(gap) or len(rows) < _FEWEST_GRADED:
        return None
    gaps = ranking.gap[rows]
    if gap > gaps.max():
        return None
    distance = np.abs(gaps - gap)
    count = max(_ALIKE, int(_ALIKE_SHARE * len(rows)))
    alike = rows[distance <= np.partition(distance, count - 1)[count - 1]]
    return AlikeAnswers(len(alike), int(np.count_nonzero(ranking.first[alike] == 0)))


def describe_lead(outcomes: Outcomes, lead: float) -> str:
    """Compare a right answer's lead in d² with those of all right answers; empty where there are few of them."""
    leads = outcomes.margin[outcomes.hits]
    leads = leads[np.isfinite(leads)]
    if len(leads) < _FEWEST:
        return ""
    smaller = float((leads < lead).mean())
    comparison = "larger" if smaller >= 0.5 else "smaller"
    share = _in_words(max(smaller, 1 - smaller))
    return f"A lead of {lead:.3f} is {comparison} than that of {share} of the model's {len(leads):,} right answers."


def describe_failure(outcomes: Outcomes, table: Table, query: int) -> str:
    """Say what kind of picture a query is that fails more often than all do; empty where nothing of that is known.

    Several kinds may fail more often; the sentence names the worst of them.
    """
    known = np.flatnonzero(outcomes.known)
    overall = float(outcomes.failed[known].mean()) if len(known) else 1.0
    kinds = [
        (rate, column)
        for column in picture_columns(table)
        if column.name not in _NOT_OF_A_KIND and (rate := _rate_of(outcomes, column, query)) is not None
    ]
    kinds = [kind for kind in kinds if kind[0].interval[0] > overall]
    if not kinds:
        return ""
    rate, column = max(kinds, key=lambda kind: kind[0].share)
    share, of_all = f"{100 * rate.share:.0f} %", f"({100 * overall:.0f} % of all do)"
    if (column.name, rate.name) == ("twins", "yes"):
        return f"Among pictures of buildings with a twin elsewhere, like this one, {share} fail {of_all}."
    within = "in the range " if rate.low != rate.high and column.kind == "number" and rate.known else ""
    return f"This picture's {column.name} is {within}{rate.name}; {share} of such pictures fail {of_all}."


def _rate_of(outcomes: Outcomes, column: Column, query: int) -> Rate | None:
    """Return the failure rate of a query's bin; None where its value is unknown, or the column tells no kinds apart."""
    if not column.known[query]:
        return None
    rates: Sequence[Rate] = breakdown.rates(outcomes.failed, column, rows=np.flatnonzero(outcomes.known))
    if not 1 < len(rates) <= max(len(outcomes) // 2, 2):
        return None
    return next((one for one in rates if one.holds(column)[query]), None)


def _in_words(share: float) -> str:
    return next((words for least, words in _SHARES if share >= least), "about half")
