"""Recall@K, Recall@Top1%, and AP by the published protocols, from the ranks of the true matches.

Labels (University-1652, CVUSA) or lists (Oxford5k, Paris6k) give a query's true matches; both take one pass over the queries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.models.base import as_array
from lpn.retrieval import ranks
from lpn.retrieval.ranks import JUNK as JUNK
from lpn.retrieval.ranks import GroundTruth, Ranked, Scores

# Rows whose norms are computed at a time.
_ROWS = 1024


@dataclass(frozen=True, eq=False)
class Retrieval(Ranked):
    """The rankings of all queries, (Q,) each.

    Attributes:
        gallery: number of gallery pictures, junk included. For the rest see `lpn.retrieval.ranks.Ranked`.
    """

    gallery: int

    @property
    def best(self) -> Int64Array:
        """Gallery position of each query's nearest picture that is not junk, on ties the first; -1 if all are junk, (Q,)."""
        return np.where(self.first == 0, self.true, self.false)

    def metrics(self, known: BoolArray | None = None) -> dict[str, float]:
        """Return the metrics of `evaluate` over the queries that are `known`, (Q,), or over all."""
        if known is not None and not known.all():
            kept = self.first[known], self.true[known], self.false[known], self.precision[known], self.gap[known]
            return Retrieval(*kept, self.gallery).metrics()
        return {
            "recall@1": self.recall(1),
            "recall@5": self.recall(5),
            "recall@10": self.recall(10),
            "recall@1%": self.recall(round(0.01 * self.gallery) + 1),
            "ap": 100.0 * float(np.mean(self.precision)) if len(self.first) else math.nan,
            "queries": len(self.first),
            "gallery": self.gallery,
        }

    def recall(self, within: int) -> float:
        """Percentage of queries whose first true match is among the nearest `within`; NaN without queries."""
        if not len(self.first):
            return math.nan
        return 100.0 * int(np.count_nonzero((self.first >= 0) & (self.first < within))) / len(self.first)


def evaluate(
    query: npt.ArrayLike,
    query_labels: npt.ArrayLike | None,
    gallery: npt.ArrayLike,
    gallery_labels: npt.ArrayLike | None,
    truth: Sequence[Truth] | None = None,
) -> dict[str, float]:
    """Score a retrieval.

    A query without a true match counts as missed; a query of unknown truth does not count. AP is the trapezoid rule over the
    precision-recall points, as in the Oxford protocol. Recall@Top1% is Recall@K with K = round(0.01 G) + 1, where G includes
    junk.

    Args:
        query, gallery: descriptors, (Q, n, D) or (Q, F) and (G, n, D) or (G, F), compared by inner product.
        query_labels, gallery_labels: integers, (Q,) and (G,); gallery pictures labelled -1 are dropped.
        truth: for each query its true matches and its junk, used instead of labels.

    Returns:
        `recall@1, recall@5, recall@10, recall@1%, ap` in percent, and the numbers `queries` and `gallery`.

    Raises:
        InputError: when shapes do not fit, a value is not finite, a side is empty, or a list names an unknown tile.
    """
    return retrieve(query, query_labels, gallery, gallery_labels, truth).metrics(known_queries(truth))


def without_distractors(gallery_labels: Int64Array, query_labels: Int64Array) -> Int64Array:
    """Return the gallery's labels (G,) with -1 for places that no query shows, as in Sample4Geo, DAC, and CAMP."""
    return np.where(np.isin(gallery_labels, query_labels), gallery_labels, JUNK)


def known_queries(truth: Sequence[Truth] | None) -> BoolArray | None:
    """Return the mask of queries with a known truth, (Q,); None for all."""
    return None if truth is None else np.array([lists.known for lists in truth], bool)


def retrieve(
    query: npt.ArrayLike,
    query_labels: npt.ArrayLike | None,
    gallery: npt.ArrayLike,
    gallery_labels: npt.ArrayLike | None,
    truth: Sequence[Truth] | None = None,
    factors: Float64Array | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Retrieval:
    """Rank the gallery for every query; arguments and errors as for `evaluate`.

    Ranks equal those of double-precision scores, although most scores are computed in single precision. Equal scores rank in
    gallery order. Memory: one block of 160 MB besides the descriptors, for any number of queries.

    Args:
        factors: multiplied into each query first, (F,).
        progress: called after each block with the numbers of ranked and of all queries; an exception stops the work.
    """
    (queries, tiles), lengths = checked_sides(query, gallery)
    if truth is None:
        of_query = _checked_labels(query_labels, queries, "query")
        ground_truth = GroundTruth.by_labels(of_query, _checked_labels(gallery_labels, tiles, "gallery"))
    else:
        _check_truth(truth, len(queries), len(tiles))
        ground_truth = GroundTruth.by_lists(truth)
    scores, blocks = Scores(queries, tiles, lengths, factors), []
    for rows, block, errors in scores.blocks():
        blocks.append(ranks.rank(scores, ground_truth, rows, block, errors))
        if progress is not None:
            progress(rows.stop, len(queries))
    first, true, false, precision, gap = (
        np.concatenate([getattr(block, column.name) for block in blocks]) for column in fields(Ranked)
    )
    return Retrieval(first, true, false, precision, gap, len(tiles))


def _check_truth(truth: Sequence[Truth], queries: int, gallery: int) -> None:
    """Raise InputError unless each query has one list, and each list names gallery pictures once."""
    if len(truth) != queries:
        raise InputError(f"There are {len(truth)} lists of true matches for {queries} queries; expected one for each.")
    for i, lists in enumerate(truth):
        named = np.concatenate([lists.good, lists.junk])
        tiles = named if lists.among is None else np.concatenate([named, lists.among])
        if len(tiles) and not (tiles.min() >= 0 and tiles.max() < gallery):
            raise InputError(
                f"The lists of query {i} name gallery positions {tiles.min()} to {tiles.max()}; expected 0 to {gallery - 1}."
            )
        if len(np.unique(named)) < len(named):
            raise InputError(
                f"A gallery picture is twice in the lists of query {i}; expected it once, as good or as junk."
            )


def checked_sides(
    query: npt.ArrayLike, gallery: npt.ArrayLike
) -> tuple[tuple[AnyArray, AnyArray], tuple[Float64Array, Float64Array]]:
    """Return the descriptors of both sides as (Q, F) and (G, F), and bounds on the norms of the rows.

    Raises:
        InputError: if `evaluate` would refuse them.
    """
    (queries, of_query), (tiles, of_tile) = _flat(query, "query"), _flat(gallery, "gallery")
    if queries.shape[1] != tiles.shape[1]:
        raise InputError(
            f"Query descriptors have {queries.shape[1]} numbers and gallery descriptors {tiles.shape[1]}; "
            "describe both with the same model and parts."
        )
    return (queries, tiles), (of_query, of_tile)


def _flat(values: Any, side: str) -> tuple[AnyArray, Float64Array]:
    array = as_array(values)
    if array.ndim not in (2, 3) or len(array) == 0 or not np.issubdtype(array.dtype, np.floating):
        raise InputError(
            f"The {side} descriptors are {array.dtype} of shape {array.shape}; expected at least one row of floats, "
            "(N, n, D) or (N, F)."
        )
    flat = array.reshape(len(array), -1)
    lengths = norms(flat)
    # The norm of finite numbers may overflow, so check the numbers themselves.
    if not np.isfinite(flat[~np.isfinite(lengths)]).all():
        raise InputError(
            f"The {side} descriptors hold values that are not finite; delete their store, and describe the pictures again."
        )
    return flat, lengths


def norms(rows: AnyArray) -> Float64Array:
    """Return upper bounds on the norms of rows (N, F), at most 0.1 % too large; not finite for rows that are not, (N,)."""
    bounds = np.empty(len(rows))
    for start in range(0, len(rows), _ROWS):
        block = rows[start : start + _ROWS]
        with np.errstate(over="ignore", invalid="ignore"):
            some = block.astype(np.float32, copy=False)
            found = np.sqrt(np.einsum("nf,nf->n", some, some).astype(np.float64))
            # Norms near the limits of single precision, and norms of many numbers, are recomputed.
            unsure = np.flatnonzero(~((found > 1e-10) & (found < 1e15)) | (rows.shape[1] > 10_000))
            if len(unsure):
                wide = block[unsure].astype(np.float64)
                largest = np.abs(wide).max(axis=1, keepdims=True)
                shares = np.divide(wide, largest, out=np.zeros_like(wide), where=largest != 0)
                found[unsure] = largest[:, 0] * np.linalg.norm(shares, axis=1)
        bounds[start : start + _ROWS] = 1.001 * found
    return bounds


def _checked_labels(values: Any, rows: AnyArray, side: str) -> Int64Array:
    """Return labels as int64; InputError unless there is one integer per row of descriptors."""
    labels = as_array(values)
    if labels.shape != (len(rows),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"The {side} labels are {labels.dtype} of shape {labels.shape}; expected one integer for each of {len(rows)} "
            "descriptors."
        )
    return labels.astype(np.int64)
