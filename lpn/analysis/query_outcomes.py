"""What became of every query of a task: rank and margin of its truth, and the parts that decided, in one pass.

With part weights w_i that sum to one, the nearest true tile t and the best false tile f of a query q:

    margin = score(q, t) - score(q, f) = sum_i w_i (cos_i(q, t) - cos_i(q, f))

so the margin is a sum over the parts, and exact: a part's term is what it does for the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column, Table, number_column, text_column
from lpn.datasets import Picture, Truth, geo, metadata
from lpn.datasets.metadata import NOTE, TAGS
from lpn.retrieval import metrics, scoring
from lpn.retrieval.metrics import Retrieval

_CHUNK_BYTES = 64_000_000
OUTCOME = ("name", "rank", "margin", "part", "truth", "answer", "false", "distance")
"""Columns of every table, beside `margin_1` .. `margin_n`; `distance` where there is a geo.csv."""


@dataclass(frozen=True, eq=False)
class Outcomes:
    """The outcome of each query of a task, as columns; tiles are positions in the gallery.

    Attributes:
        rank: 0-based rank of the first true match, junk left out; -1 where the query has none, (Q,).
        first: the tile that came first, -1 where all is junk, (Q,).
        true: the nearest true match, the first of equals; -1 where there is none, (Q,).
        false: the best tile that is neither a true match nor junk; -1 where there is none, (Q,).
        parts: each part's term of the margin, (Q, n) float64, NaN where `true` or `false` is -1.
        margin: score of `true` minus score of `false`, the sum of `parts`, -2 .. 2; positive where the truth was found and
            0 where the two are equal, (Q,).
        decides: the part that decides, 0-based: in a failure the one with the lowest term, which costs the truth most,
            in a success the one with the highest; -1 where there is no margin, (Q,).
        weights: the part weights, summing to one, (n,).
    """

    rank: Int64Array
    first: Int64Array
    true: Int64Array
    false: Int64Array
    parts: Float64Array
    margin: Float64Array
    decides: Int64Array
    weights: Float64Array

    @property
    def failed(self) -> BoolArray:
        """Which queries missed, those without a true match included, as Recall@1 counts them, (Q,)."""
        return np.asarray(self.rank != 0)

    def __len__(self) -> int:
        return len(self.rank)


def build(
    queries: Float32Array,
    gallery: Float32Array,
    query_labels: npt.ArrayLike | None,
    labels: npt.ArrayLike | None,
    truth: Sequence[Truth] | None = None,
    weights: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Outcomes:
    """Find the outcome of every query; ranks are those of `metrics.retrieve`.

    Memory: blocks of 160 MB beside the descriptors, whatever the number of queries.

    Args:
        queries, gallery: descriptors with parts of norm 1/sqrt(n), (Q, n, D) and (G, n, D).
        query_labels, labels: the place of each, (Q,) and (G,), -1 for junk; not read where there is `truth`.
        truth: for each query its true matches and its junk, in place of labels.
        weights: of the parts, (n,), see `scoring.part_weights`; equal by default.
        progress: told after each block how many queries are done, and of how many; what it raises ends the work.

    Raises:
        InputError: when shapes do not fit, a value is not finite, a side is empty, or a list names what is not there.
    """
    if queries.ndim != 3 or gallery.ndim != 3 or queries.shape[1:] != gallery.shape[1:]:
        raise InputError(
            f"The descriptors are {queries.shape} and {gallery.shape}; expected (Q, n, D) and (G, n, D) with the same parts."
        )
    n, size = queries.shape[1:]
    used = scoring.part_weights(n, weights).astype(np.float64)
    used /= used.sum()
    # Equal weights scale no score, so that ranks are those of the published protocol to the last tie.
    factors = None if weights is None else np.repeat(n * used, size)
    found = metrics.retrieve(queries, query_labels, gallery, labels, truth, factors, progress)
    return outcomes_of(found, queries, gallery, weights)


def outcomes_of(
    found: Retrieval, queries: Float32Array, gallery: Float32Array, weights: npt.ArrayLike | None = None
) -> Outcomes:
    """The outcomes of queries (Q, n, D) that have been ranked already, under the same part weights (n,)."""
    used = scoring.part_weights(queries.shape[1], weights).astype(np.float64)
    used /= used.sum()
    rank, true, false = found.first, found.true, found.false
    parts = _part_margins(queries, gallery, true, false, len(used) * used)
    margin = parts.sum(axis=1)
    decides = np.where(rank == 0, np.argmax(parts, axis=1), np.argmin(parts, axis=1))
    return Outcomes(rank, found.best, true, false, parts, margin, np.where(np.isnan(margin), -1, decides), used)


def table(
    root: Path,
    queries: Sequence[Picture],
    gallery: Sequence[Picture],
    outcomes: Outcomes,
    part_names: Sequence[str] | None = None,
) -> Table:
    """One row for each query: its outcome, and whatever the data set's folder says of its picture (`lpn.datasets.metadata`).

    Columns: `name`, `rank` (from 1, unknown without a true match), `margin`, `part` (that decides), `truth`, `answer`,
    and `false` (names of tiles), `distance` (metres from what the query shows to the answer, where there is a geo.csv),
    `margin_1` .. `margin_n` (the parts' terms), then metadata.

    Args:
        root: the data set's folder.
        queries, gallery: the pictures behind the rows of the descriptors.
        part_names: of the parts, "1" .. "n" by default.

    Raises:
        InputError: when there are not as many pictures as outcomes.
        DataError: when a file of metadata cannot be used.
    """
    if len(queries) != len(outcomes):
        raise InputError(f"There are {len(queries)} queries and {len(outcomes)} outcomes; give those of one task.")
    n = outcomes.parts.shape[1]
    parts = np.array([*(part_names or [str(i + 1) for i in range(n)]), ""], object)
    tiles = np.array([*(tile.name for tile in gallery), ""], object)
    columns = [
        text_column("name", [query.name for query in queries]),
        number_column("rank", np.where(outcomes.rank < 0, np.nan, outcomes.rank + 1.0)),
        number_column("margin", outcomes.margin),
        Column("part", "text", parts[outcomes.decides]),
        Column("truth", "text", tiles[outcomes.true]),
        Column("answer", "text", tiles[outcomes.first]),
        Column("false", "text", tiles[outcomes.false]),
        *_distance(root, queries, gallery, outcomes),
        *(number_column(f"margin_{i + 1}", outcomes.parts[:, i]) for i in range(n)),
    ]
    paths = metadata.relative(root, queries)
    return Table(paths, columns).with_columns(metadata.columns(root, paths, [column.name for column in columns]))


def described_by(table: Table) -> list[Column]:
    """The columns that describe a query's picture, rather than its outcome or what a person said of it."""
    return [
        c
        for c in table.columns.values()
        if c.name not in (*OUTCOME, TAGS, NOTE) and c.name.rstrip("0123456789") != "margin_"
    ]


def labels_of(pictures: Sequence[Picture]) -> Int64Array:
    """The label of each picture, (N,)."""
    return np.array([picture.label for picture in pictures], np.int64)


def _distance(root: Path, queries: Sequence[Picture], gallery: Sequence[Picture], outcomes: Outcomes) -> list[Column]:
    where = geo.positions(root)
    if where is None:
        return []
    shown, tiles = where.of(queries), where.of(gallery)
    metres = geo.metres(shown, [tiles[index] for index in outcomes.first])
    return [number_column("distance", np.where(outcomes.first < 0, np.nan, metres), "m")]


def _part_margins(
    queries: Float32Array, gallery: Float32Array, true: Int64Array, false: Int64Array, factors: Float64Array
) -> Float64Array:
    """Each part's n w_i <q_i, t_i - f_i>: (Q, n), NaN where one of the tiles is -1."""
    terms = np.full(queries.shape[:2], np.nan)
    pairs = np.flatnonzero((true >= 0) & (false >= 0))
    step = max(1, _CHUNK_BYTES // (8 * queries[0].size))
    for start in range(0, len(pairs), step):
        rows = pairs[start : start + step]
        apart = gallery[true[rows]].astype(np.float64) - gallery[false[rows]]
        terms[rows] = factors * np.einsum("qnd,qnd->qn", queries[rows].astype(np.float64), apart)
    return terms
