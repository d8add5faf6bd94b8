"""The context of one answer in its task: how often similar answers are right, their distances, and which pictures fail."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from lpn.analysis import breakdown
from lpn.analysis.breakdown import Rate
from lpn.core.arrays import BoolArray, Float32Array, FloatingArray, Int64Array
from lpn.core.tables import Table
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.query_outcomes import Outcomes, picture_columns

# An answer's neighbourhood: this number of answers with the nearest gaps, or this share of all if that is more. Fewer graded
# answers than `FEWEST_GRADED` have none.
_ALIKE, _ALIKE_SHARE = 50, 0.1
FEWEST_GRADED = 2 * _ALIKE
# Minimum number of answers whose share is stated.
_FEWEST = 20
# Significance level of a difference.
_BY_CHANCE = 0.05
# Queries whose distances are computed at once.
_BLOCK = 4096
# Words for a share, from each lower bound on.
_SHARES = (
    (0.97, "almost all"),
    (0.83, "about nine tenths"),
    (0.71, "about three quarters"),
    (0.58, "about two thirds"),
)
# Columns that describe the answer, or one picture alone.
_NOT_OF_A_KIND = ("latitude", "longitude", "overlap", "semi")


@dataclass(frozen=True, eq=False)
class AnswerDistances:
    """Distances of the nearest tiles from the queries of a task, under equal part weights and before CSLS.

    Attributes:
        right: d² of each right answer, (H,).
        absent: d² of each graded query's nearest wrong tile, (Q,), as if its place were not in the gallery.
    """

    right: FloatingArray
    absent: FloatingArray

    def farther(self, distance2: float) -> tuple[float, float] | None:
        """Return the share of `right` below a squared distance, and the share of `absent` at or above it, each 0 .. 1.

        None if there are too few of either.
        """
        if min(len(self.right), len(self.absent)) < _FEWEST:
            return None
        return float((self.right < distance2).mean()), float((self.absent >= distance2).mean())


@dataclass(frozen=True)
class AlikeAnswers:
    """The graded answers whose gaps are nearest to one answer's gap.

    Attributes:
        queries: number of these answers.
        right: number of right ones.
    """

    queries: int
    right: int


@dataclass(frozen=True)
class LeadGroup:
    """Queries of similar leads.

    Attributes:
        lead: their median lead over the second tile, in d².
        queries: number of queries.
        found: number of found queries.
    """

    lead: float
    queries: int
    found: int


def answers_alike(
    ranking: Retrieval, gap: float | None, known: BoolArray | None = None, besides: int | None = None
) -> AlikeAnswers | None:
    """Count how many answers with similar gaps are right; None if there are too few.

    The gap is d² of the second tile minus d² of the answer. It needs no truth, so it is defined for a user's own picture, too.
    The neighbourhood is the tenth of all graded answers with the nearest gaps, at least 50 answers, with ties. A gap above all
    graded gaps has no neighbourhood.

    Args:
        ranking: of all queries, under the same part weights as the gap.
        gap: in d²; None or NaN without a second tile.
        known: the queries whose truth is known, (Q,); None for all.
        besides: the query of the gap, which is not counted; None outside the task.
    """
    rows = _graded(ranking, known)
    rows = rows[rows != besides] if besides is not None else rows
    if gap is None or not np.isfinite(gap) or len(rows) < FEWEST_GRADED:
        return None
    gaps = ranking.gap[rows]
    if gap > gaps.max():
        return None
    distance = np.abs(gaps - gap)
    count = max(_ALIKE, int(_ALIKE_SHARE * len(rows)))
    alike = rows[distance <= np.partition(distance, count - 1)[count - 1]]
    return AlikeAnswers(len(alike), int(np.count_nonzero(ranking.first[alike] == 0)))


def found_by_lead(ranking: Retrieval, known: BoolArray | None = None) -> list[LeadGroup]:
    """Count the found queries in ten equal groups of queries, from the smallest lead; none if queries are few.

    Args:
        ranking: of all queries.
        known: the queries whose truth is known, (Q,); None for all.
    """
    rows = _graded(ranking, known)
    if len(rows) < FEWEST_GRADED:
        return []
    parts = np.array_split(rows[np.argsort(ranking.gap[rows], kind="stable")], 10)
    found = ranking.first == 0
    return [LeadGroup(float(np.median(ranking.gap[of])), len(of), int(np.count_nonzero(found[of]))) for of in parts]


def _graded(ranking: Retrieval, known: BoolArray | None) -> Int64Array:
    """Return the queries whose truth and gap are known."""
    return np.flatnonzero(np.isfinite(ranking.gap) if known is None else np.isfinite(ranking.gap) & known)


def answer_distances(
    queries: Float32Array, gallery: Float32Array, ranking: Retrieval, known: BoolArray | None = None
) -> AnswerDistances:
    """Measure the distances of right answers, and of each query's nearest wrong tile.

    Args:
        queries, gallery: descriptors with parts of norm 1/sqrt(n), (Q, n, D) and (G, n, D).
        ranking: of all queries.
        known: the queries whose truth is known, (Q,); None for all.
    """
    graded = np.ones(len(queries), bool) if known is None else known
    hits = np.flatnonzero(graded & (ranking.first == 0))
    others = np.flatnonzero(graded & (ranking.false >= 0))

    def distances(rows: Int64Array, tiles: Int64Array) -> FloatingArray:
        blocks = np.split(np.arange(len(rows)), range(_BLOCK, len(rows), _BLOCK))
        scores = [np.einsum("qnd,qnd->q", queries[rows[block]], gallery[tiles[block]]) for block in blocks]
        return 2.0 - 2.0 * np.concatenate(scores)

    return AnswerDistances(distances(hits, ranking.true[hits]), distances(others, ranking.false[others]))


def describe_lead(outcomes: Outcomes, lead: float) -> str:
    """Compare a right answer's lead in d² with all right answers' leads; empty if there are few."""
    leads = outcomes.margin[outcomes.hits]
    leads = leads[np.isfinite(leads)]
    if len(leads) < _FEWEST:
        return ""
    smaller = float((leads < lead).mean())
    comparison = "larger" if smaller >= 0.5 else "smaller"
    share = next((words for least, words in _SHARES if max(smaller, 1 - smaller) >= least), "about half")
    return f"A lead of {lead:.3f} is {comparison} than that of {share} of the model's {len(leads):,} right answers."


def describe_failures(outcomes: Outcomes, table: Table, query_labels: Int64Array, besides: Collection[str] = ()) -> str:
    """Say in one or two sentences how many queries fail, and which kind of picture fails more often than by chance, if any.

    Chance is the hypergeometric tail of a kind's failures among all (Fisher's exact test, one-sided), times the number of tested
    kinds (Bonferroni). Pictures of one place fail together, so their numbers are divided by `breakdown.design_effect`.

    Args:
        query_labels: the place of each query, (Q,).
        besides: columns that are not properties of a picture, such as the answers of other stages.
    """
    known = np.flatnonzero(outcomes.known)
    failures, queries = int(outcomes.failed[known].sum()), len(known)
    if not queries:
        return ""
    wrong = f"The first answer is wrong for {failures:,} of {queries:,} pictures"
    kinds: list[tuple[float, str, Rate]] = []
    alike = breakdown.design_effect(outcomes.failed[known], query_labels[known])
    for column in picture_columns(table) if 0 < failures < queries else ():
        rates = breakdown.rates(outcomes.failed, column, rows=known)
        if column.name in _NOT_OF_A_KIND or column.name in besides or not 1 < len(rates) <= max(queries // 2, 2):
            continue
        for rate in rates:
            counts = (int(count / alike) for count in (rate.failures, rate.queries, failures, queries))
            kinds.append((breakdown.chance(*counts), column.name, rate))
    if not kinds:
        return f"{wrong}."
    chance, name, most = min(kinds, key=lambda kind: kind[0])
    if chance * len(kinds) >= _BY_CHANCE:
        few = "with so few, " if failures < _FEWEST else ""
        return f"{wrong}; {few}no kind of picture fails more often than by chance."
    kind = f"pictures whose {name} is {most.name}"
    if (name, most.name) == ("twins", "yes"):
        kind = "pictures of buildings with a twin elsewhere"
    others = f"{failures - most.failures:,} of {queries - most.queries:,} others"
    return f"{wrong}. It fails most for {kind}: {most.failures:,} of {most.queries:,} are wrong, against {others}."
