"""Rank, margin, and deciding part of every query of a task, in one pass.

For a query q, p is its nearest positive, g its hardest negative, and w_i are part weights with sum one:

    margin = d^2(q, g) - d^2(q, p) = sum_i 2 w_i (cos_i(q, p) - cos_i(q, g)),

an exact sum over the parts, which is positive when the query is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column, Table, number_column, text_column
from lpn.datasets import Truth, geo, metadata
from lpn.datasets.metadata import NOTE, TAGS
from lpn.retrieval import scoring
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.gallery_geometry import GalleryGeometry

if TYPE_CHECKING:
    from lpn.tasks.task import Task

_CHUNK_BYTES = 64_000_000
# Columns of a table that compares two models: A is the model of the table.
RANK_A, RANK_B = "rank A", "rank B"
# Columns of every table besides `margin_1` .. `margin_n`. A model of one part has neither these nor `part`. A task has `distance`
# only with positions, `overlap` only with measured footprints, and `semi` only with semi-positives. Only a table of two models
# has `rank A` and `rank B`.
OUTCOME_COLUMNS = (
    *("name", "rank", RANK_A, RANK_B, "margin", "part"),
    *("truth", "answer", "false", "distance", "overlap", "semi"),
)


@dataclass(frozen=True, eq=False)
class Outcomes:
    """The outcomes of all queries as columns; tiles are gallery positions.

    Attributes:
        rank: 0-based rank of the first true match, not counting junk, (Q,); -1 for a query without a true match.
        answer: the nearest tile, -1 if all are junk, (Q,).
        true: the nearest positive, on ties the first in gallery order; -1 if there is none, (Q,).
        false: the hardest negative; -1 if there is none, (Q,).
        parts: each part's term of the margin in d², (Q, n); NaN if `true` or `false` is -1.
        margin: the sum of `parts`, -4 .. 4; positive if `true` is nearer than `false`, (Q,).
        deciding_part: the part, from 0, with the highest term if `rank` is 0, else the part with the lowest term;
            -1 without a margin, (Q,).
        weights: the part weights, with sum one, (n,).
        known: the queries with a known truth, (Q,).
    """

    rank: Int64Array
    answer: Int64Array
    true: Int64Array
    false: Int64Array
    parts: Float64Array
    margin: Float64Array
    deciding_part: Int64Array
    weights: Float64Array
    known: BoolArray

    @property
    def failed(self) -> BoolArray:
        """The queries that Recall@1 counts as missed, including those without a true match, (Q,).

        A query of unknown truth is no failure.
        """
        return np.asarray(self.known & (self.rank != 0))

    @property
    def hits(self) -> BoolArray:
        """The queries whose true match is first, (Q,)."""
        return np.asarray(self.known & (self.rank == 0))

    def verdict(self, query: int) -> bool | None:
        """Return whether a query is found; None if its truth is unknown."""
        return bool(self.hits[query]) if self.known[query] else None

    def __len__(self) -> int:
        return len(self.rank)


def weight_factors(descriptors: Float32Array, weights: npt.ArrayLike | None) -> Float64Array | None:
    """Return the factors of descriptors (Q, n, D) under part weights, (n D,), for `metrics.retrieve`.

    None without weights: scores are then not scaled, so that even ties rank as in the published protocol.
    """
    n, size = descriptors.shape[1:]
    return None if weights is None else np.repeat(n * _normalised(n, weights), size)


def outcomes_of(task: Task, ranking: Retrieval) -> Outcomes:
    """Return the outcomes of a task's queries, which are already ranked under its part weights."""
    queries, gallery = task.compared
    n = queries.shape[1]
    used = _normalised(n, task.weights)
    parts = _part_margins(queries, gallery, ranking.true, ranking.false, 2 * n * used)
    margin = parts.sum(axis=1)
    deciding_part = np.where(ranking.first == 0, np.argmax(parts, axis=1), np.argmin(parts, axis=1))
    deciding_part = np.where(np.isnan(margin), -1, deciding_part)
    known = np.ones(len(parts), bool) if task.known is None else task.known
    ranks = ranking.first, ranking.best, ranking.true, ranking.false
    return Outcomes(*ranks, parts, margin, deciding_part, used, known)


def table(task: Task, outcomes: Outcomes, part_names: Sequence[str]) -> Table:
    """Return a row for each query of a task: its outcome, and the metadata of its picture (`lpn.datasets.metadata`).

    Columns, followed by those of `Task.columns`, `listed_columns`, and the metadata:
        name: of the query.
        rank: from 1; unknown without a true match.
        margin: in d².
        part: the deciding part.
        truth, answer, false: names of the nearest positive, the nearest tile, and the hardest negative.
        distance: metres from the query's place to the answer; only with positions.
        margin_1 .. margin_n: each part's term of the margin, in d².

    Raises:
        DataError: when a metadata file is damaged.
    """
    n = outcomes.parts.shape[1]
    # Position -1 stands for none. It indexes the last entry, which is empty.
    parts = np.array([*part_names, ""], object)
    tiles = np.array([*(tile.name for tile in task.gallery), ""], object)
    columns = [
        text_column("name", task.query_names),
        _rank_column("rank", outcomes.rank),
        number_column("margin", outcomes.margin),
        *([] if n == 1 else [Column("part", "text", parts[outcomes.deciding_part])]),
        Column("truth", "text", tiles[outcomes.true]),
        Column("answer", "text", tiles[outcomes.answer]),
        Column("false", "text", tiles[outcomes.false]),
        *([] if task.geometry is None else [_distance(task.geometry, outcomes)]),
        *(number_column(f"margin_{i + 1}", outcomes.parts[:, i]) for i in range(n) if n > 1),
        *task.columns,
        *listed_columns(outcomes, task.truth),
    ]
    paths = geo.names_below(task.root, task.queries)
    taken = [*(column.name for column in columns), RANK_A, RANK_B]
    return Table(paths, columns).with_columns(metadata.columns(task.root, paths, taken))


def compared_ranks(table: Table, rank: Int64Array) -> list[Column]:
    """Return the columns `rank A` and `rank B` of a table: the ranks in the table, and the ranks of a second model.

    Args:
        rank: the second model's ranks of these queries, see `Outcomes`.

    Raises:
        InputError: when the numbers of ranks and of rows differ.
    """
    if len(rank) != len(table):
        raise InputError(
            f"There are {len(table)} queries and {len(rank)} ranks of the second model; give two models on the same queries."
        )
    return [replace(table.columns["rank"], name=RANK_A), _rank_column(RANK_B, rank)]


def listed_columns(outcomes: Outcomes, truth: Sequence[Truth] | None) -> list[Column]:
    """Return the columns `overlap` and `semi`, each only if the data set lists it.

    Columns:
        overlap: of the answer with the query's footprint, 0 .. 1.
        semi: "yes" if the answer is half-true (a semi-positive), else "no".
    """
    answers = list(zip(truth or (), outcomes.answer.tolist(), strict=truth is not None))
    columns = []
    if any(lists.overlaps is not None for lists, _ in answers):
        columns.append(number_column("overlap", [lists.overlap(answer) for lists, answer in answers]))
    if any(len(lists.semi) for lists, _ in answers):
        columns.append(text_column("semi", ["yes" if answer in lists.semi else "no" for lists, answer in answers]))
    return columns


def picture_columns(table: Table) -> list[Column]:
    """Return the columns that describe a query's picture, not its outcome or a user's annotation."""
    return [
        column
        for column in table.columns.values()
        if column.name not in (*OUTCOME_COLUMNS, TAGS, NOTE) and column.name.rstrip("0123456789") != "margin_"
    ]


def _normalised(n: int, weights: npt.ArrayLike | None) -> Float64Array:
    """Return part weights (n,) with sum one in double precision."""
    used = scoring.part_weights(n, weights).astype(np.float64)
    used /= used.sum()
    return used


def _rank_column(name: str, rank: Int64Array) -> Column:
    return number_column(name, np.where(rank < 0, np.nan, rank + 1.0))


def _distance(geometry: GalleryGeometry, outcomes: Outcomes) -> Column:
    metres = geometry.answer_errors_m(outcomes.answer)
    return number_column("distance", np.where(outcomes.answer < 0, np.nan, metres), "m")


def _part_margins(
    queries: Float32Array, gallery: Float32Array, true: Int64Array, false: Int64Array, factors: Float64Array
) -> Float64Array:
    """Return each part's factor_i <q_i, true_i - false_i>: (Q, n), NaN if one of the tiles is -1."""
    terms = np.full(queries.shape[:2], np.nan)
    pairs = np.flatnonzero((true >= 0) & (false >= 0))
    step = max(1, _CHUNK_BYTES // (8 * queries[0].size))
    for start in range(0, len(pairs), step):
        rows = pairs[start : start + step]
        difference = gallery[true[rows]].astype(np.float64) - gallery[false[rows]]
        terms[rows] = factors * np.einsum("qnd,qnd->qn", queries[rows].astype(np.float64), difference)
    return terms
