"""Recall@K, Recall@Top1% and AP by the published protocols, from ranks of the true matches alone.

Labels (University-1652, CVUSA) or lists (Oxford5k, Paris6k) give a query's true matches; both take one pass over the queries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.models.base import as_array
from lpn.retrieval import ranks
from lpn.retrieval.inner_products import Scores, norms
from lpn.retrieval.ranks import JUNK, Marks, Ranked

__all__ = ["JUNK", "Retrieval", "check_truth", "checked_labels", "evaluate", "flat_sides", "retrieve"]


@dataclass(frozen=True, eq=False)
class Retrieval(Ranked):
    """The rankings of all queries, (Q,) each.

    `gallery` is the number of gallery pictures, junk included; for the rest see `lpn.retrieval.ranks.Ranked`.
    """

    gallery: int

    @property
    def best(self) -> Int64Array:
        """Gallery position of each query's nearest picture that is not junk, the first of equals; -1 where all is, (Q,)."""
        return np.where(self.first == 0, self.true, self.false)

    def figures(self) -> dict[str, float]:
        """See `evaluate`."""
        return {
            "recall@1": self.recall(1),
            "recall@5": self.recall(5),
            "recall@10": self.recall(10),
            "recall@1%": self.recall(round(0.01 * self.gallery) + 1),
            "ap": 100.0 * float(np.mean(self.precision)),
            "queries": len(self.first),
            "gallery": self.gallery,
        }

    def recall(self, within: int) -> float:
        """Percentage of queries whose first true match is among the nearest `within`."""
        return 100.0 * int(np.count_nonzero((self.first >= 0) & (self.first < within))) / len(self.first)


def evaluate(
    query: npt.ArrayLike,
    query_labels: npt.ArrayLike | None,
    gallery: npt.ArrayLike,
    gallery_labels: npt.ArrayLike | None,
    truth: Sequence[Truth] | None = None,
) -> dict[str, float]:
    """Score a retrieval.

    A query without a true match counts as missed. AP is the trapezoid rule over the precision-recall points, which is the
    Oxford protocol's too. Recall@Top1% reads the recall curve at index round(0.01 G), G with junk, so within that number
    plus one.

    Args:
        query, gallery: descriptors, (Q, n, D) or (Q, F) and (G, n, D) or (G, F), compared by inner product.
        query_labels, gallery_labels: integers, (Q,) and (G,); gallery pictures labelled -1 are dropped.
        truth: for each query its true matches and its junk, in place of labels, which are then not read.

    Returns:
        `recall@1, recall@5, recall@10, recall@1%, ap` in percent, and the numbers `queries` and `gallery`.

    Raises:
        InputError: when shapes do not fit, a value is not finite, a side is empty, or a list names what is not there.
    """
    return retrieve(query, query_labels, gallery, gallery_labels, truth).figures()


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

    Ranks are those of scores in double precision, equal scores in gallery order, whatever the precision that most are
    computed in. Memory: blocks of 160 MB beside the descriptors, whatever the number of queries.

    Args:
        factors: multiply each number of a query first, (F,).
        progress: called after each block with the numbers of ranked and of all queries; an exception stops the work.
    """
    (queries, tiles), lengths = _sides(query, gallery)
    if truth is None:
        of_query = checked_labels(query_labels, queries, "query")
        marks = Marks.by_labels(of_query, checked_labels(gallery_labels, tiles, "gallery"))
    else:
        check_truth(truth, len(queries), len(tiles))
        marks = Marks.by_lists(truth)
    scores, found = Scores(queries, tiles, lengths, factors), []
    for rows, block, errors in scores.blocks():
        found.append(ranks.rank(scores, marks, rows, block, errors))
        if progress is not None:
            progress(rows.stop, len(queries))
    return joined(found, len(tiles))


def joined(parts: Sequence[Ranked], gallery: int) -> Retrieval:
    """Join the rankings of consecutive queries; `gallery` is the number of tiles, junk included."""
    first, true, false, precision = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("first", "true", "false", "precision")
    )
    return Retrieval(first, true, false, precision, gallery)


def check_truth(truth: Sequence[Truth], queries: int, gallery: int) -> None:
    """Raise InputError unless there is one list for each query, and each names gallery pictures once."""
    if len(truth) != queries:
        raise InputError(f"There are {len(truth)} lists of true matches for {queries} queries; expected one for each.")
    for i, of in enumerate(truth):
        named = np.concatenate([of.good, of.junk])
        if len(named) and not (named.min() >= 0 and named.max() < gallery):
            raise InputError(
                f"The lists of query {i} name gallery positions {named.min()} to {named.max()}; expected 0 to {gallery - 1}."
            )
        if len(np.unique(named)) < len(named):
            raise InputError(
                f"A gallery picture is twice in the lists of query {i}; expected it once, as good or as junk."
            )


def flat_sides(query: npt.ArrayLike, gallery: npt.ArrayLike) -> tuple[AnyArray, AnyArray]:
    """Descriptors of both sides as (Q, F) and (G, F); InputError when `evaluate` would not take them."""
    return _sides(query, gallery)[0]


def _sides(
    query: npt.ArrayLike, gallery: npt.ArrayLike
) -> tuple[tuple[AnyArray, AnyArray], tuple[Float64Array, Float64Array]]:
    """The same, and bounds on the norms of their rows."""
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
    if not np.isfinite(flat[~np.isfinite(lengths)]).all():  # a sound number's square may be too large
        raise InputError(
            f"The {side} descriptors hold values that are not finite; delete their store, and describe the pictures again."
        )
    return flat, lengths


def checked_labels(values: Any, rows: AnyArray, side: str) -> Int64Array:
    """Labels as int64, one per row of descriptors; InputError when they are not whole numbers, or not as many."""
    labels = as_array(values)
    if labels.shape != (len(rows),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"The {side} labels are {labels.dtype} of shape {labels.shape}; expected one integer for each of {len(rows)} "
            "descriptors."
        )
    return labels.astype(np.int64)
