"""Recall@K, Recall@Top1% and AP by the published protocols, from ranks of the true matches alone.

What is a true match of a query is decided by labels (University-1652, CVUSA) or by a list (Oxford5k, Paris6k); both go the
same way, in one pass over the queries.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lpn.datasets import Truth
from lpn.errors import InputError
from lpn.model import as_array

JUNK = -1
"""Label of gallery pictures that are ignored."""

IntArray = npt.NDArray[np.int64]

_BLOCK_BYTES = 64_000_000
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Retrieval:
    """What one pass of the queries over the gallery found.

    Attributes:
        first: 0-based rank of each query's first true match, junk left out; -1 where it has none, (Q,).
        best: gallery position of each query's nearest picture that is not junk, the first of equals; -1 where all is junk, (Q,).
        precision: average precision of each query, 0 .. 1, (Q,).
        gallery: number of gallery pictures, junk included.
    """

    first: IntArray
    best: IntArray
    precision: npt.NDArray[np.float64]
    gallery: int

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
) -> Retrieval:
    """Rank the gallery for every query; arguments and errors as for `evaluate`.

    Memory: two blocks of scores, 64 MB each, beside the gallery in double precision.
    """
    queries, tiles = flat_sides(query, gallery)
    kept = np.arange(len(tiles))
    truths: Iterator[Truth]
    if truth is None:
        of_query, of_tile = (
            checked_labels(query_labels, queries, "query"),
            checked_labels(gallery_labels, tiles, "gallery"),
        )
        kept = np.flatnonzero(of_tile != JUNK)
        truths = _same_label(of_query, of_tile[kept])
    else:
        check_truth(truth, len(queries), len(tiles))
        truths = iter(truth)
    first, best = (np.full(len(queries), -1, np.int64) for _ in range(2))
    precision = np.zeros(len(queries))
    blocks = score_blocks(queries, tiles if len(kept) == len(tiles) else tiles[kept])
    rows = (row for _, block in blocks for row in block)
    for i, (scores, of) in enumerate(zip(rows, truths, strict=True)):
        scores[of.junk] = -np.inf
        true_ranks = _ranks_in_row(scores, of.good)
        if len(true_ranks):
            first[i], precision[i] = true_ranks[0], _average_precision(true_ranks)
        top = int(np.argmax(scores)) if len(kept) else -1
        if top >= 0 and scores[top] > -np.inf:
            best[i] = kept[top]
    return Retrieval(first, best, precision, len(tiles))


def score_blocks(
    queries: npt.NDArray[Any], tiles: npt.NDArray[Any], factors: npt.NDArray[np.float64] | None = None
) -> Iterator[tuple[slice, npt.NDArray[np.float64]]]:
    """Inner products (B, G) of queries (Q, F) with tiles (G, F), block by block of queries, each of 64 MB at most.

    Args:
        factors: what each number of a query is multiplied by first, (F,).

    Returns:
        The rows of each block, and its products, which are the caller's to change.
    """
    # In single precision, tiles closer than its rounding change places with the order of summation.
    tiles = tiles.astype(np.float64)
    block = max(1, _BLOCK_BYTES // (8 * max(len(tiles), 1)))
    for start in range(0, len(queries), block):
        rows = slice(start, min(start + block, len(queries)))
        asked = queries[rows].astype(np.float64)
        yield rows, (asked if factors is None else asked * factors) @ tiles.T


def _same_label(of_query: IntArray, of_tile: IntArray) -> Iterator[Truth]:
    """For each query, the tiles of its label."""
    by_label = np.argsort(of_tile, kind="stable")
    in_order = of_tile[by_label]
    begins, ends = (np.searchsorted(in_order, of_query, side) for side in ("left", "right"))
    return (Truth(by_label[begin:end], _NONE) for begin, end in zip(begins, ends, strict=True))


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


def _ranks_in_row(scores: npt.NDArray[Any], true: IntArray) -> IntArray:
    """Ranks of some entries of a row of scores, highest first, equal scores in gallery order.

    Only the few true scores are sorted; every other score is counted against them.
    """
    if len(true) == 0:
        return np.zeros(0, np.int64)
    if len(true) == 1:
        score = scores[true[0]]
        above = np.count_nonzero(scores > score) + np.count_nonzero(scores[: true[0]] == score)
        return np.array([above], np.int64)
    thresholds = np.sort(scores[true])
    if (np.diff(thresholds) == 0).any():
        return _ranks_by_sorting(scores, true)
    slot = np.searchsorted(thresholds, scores, "right")
    at_least = np.cumsum(np.bincount(slot, minlength=len(true) + 1)[::-1])[::-1][1:]
    result = at_least[::-1] - 1
    exact = np.searchsorted(thresholds, scores, "left")
    if np.count_nonzero(exact != slot) != len(true):
        return _ranks_by_sorting(scores, true)
    return result.astype(np.int64)


def _ranks_by_sorting(scores: npt.NDArray[Any], true: IntArray) -> IntArray:
    """The same where a true score equals another, which only the gallery's order tells apart."""
    position = np.empty(len(scores), np.int64)
    position[np.argsort(-scores, kind="stable")] = np.arange(len(scores))
    return np.sort(position[true])


def _average_precision(true_ranks: IntArray) -> float:
    if len(true_ranks) == 0:
        return 0.0
    hits = np.arange(len(true_ranks))
    after = (hits + 1) / (true_ranks + 1)
    before = np.where(true_ranks == 0, 1.0, hits / np.maximum(true_ranks, 1))
    return float(np.mean((after + before) / 2))


def flat_sides(query: npt.ArrayLike, gallery: npt.ArrayLike) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Descriptors of both sides as (Q, F) and (G, F); InputError when they are not what `evaluate` takes."""
    queries, tiles = _flat(query, "query"), _flat(gallery, "gallery")
    if queries.shape[1] != tiles.shape[1]:
        raise InputError(
            f"Query descriptors have {queries.shape[1]} numbers and gallery descriptors {tiles.shape[1]}; "
            "describe both with the same model and parts."
        )
    return queries, tiles


def _flat(values: Any, side: str) -> npt.NDArray[Any]:
    array = as_array(values)
    if array.ndim not in (2, 3) or len(array) == 0 or not np.issubdtype(array.dtype, np.floating):
        raise InputError(
            f"The {side} descriptors are {array.dtype} of shape {array.shape}; expected at least one row of floats, "
            "(N, n, D) or (N, F)."
        )
    flat = array.reshape(len(array), -1)
    if not np.isfinite(flat).all():
        raise InputError(f"The {side} descriptors hold values that are not finite; describe the pictures again.")
    return cast("npt.NDArray[Any]", flat)


def checked_labels(values: Any, rows: npt.NDArray[Any], side: str) -> IntArray:
    """Labels as int64, one for each row of descriptors; InputError when they are something else."""
    labels = as_array(values)
    if labels.shape != (len(rows),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"The {side} labels are {labels.dtype} of shape {labels.shape}; expected one integer for each of {len(rows)} "
            "descriptors."
        )
    return labels.astype(np.int64)
