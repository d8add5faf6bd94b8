"""Recall@K, Recall@Top1% and AP by the published University-1652 protocol, from ranks of the true matches alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lpn.errors import InputError
from lpn.model import as_array

JUNK = -1
"""Label of gallery pictures that are ignored."""

_BLOCK_BYTES = 128_000_000


def evaluate(
    query: npt.ArrayLike, query_labels: npt.ArrayLike, gallery: npt.ArrayLike, gallery_labels: npt.ArrayLike
) -> dict[str, float]:
    """Score a retrieval.

    A query without a true match counts as missed. AP is the trapezoid rule over the precision-recall points.
    Recall@Top1% reads the recall curve at index round(0.01 G), G with junk, so within that number plus one.

    Args:
        query, gallery: descriptors, (Q, n, D) or (Q, F) and (G, n, D) or (G, F), compared by inner product.
        query_labels, gallery_labels: integers, (Q,) and (G,); gallery pictures labelled -1 are dropped.

    Returns:
        `recall@1, recall@5, recall@10, recall@1%, ap` in percent, and the numbers `queries` and `gallery`.

    Raises:
        InputError: when shapes do not fit, a value is not finite, or a side is empty.
    """
    first: list[int] = []
    precision: list[float] = []
    for ranks_of_true in _true_ranks(query, query_labels, gallery, gallery_labels):
        first.append(int(ranks_of_true[0]) if len(ranks_of_true) else -1)
        precision.append(_average_precision(ranks_of_true))
    found = np.array(first)
    size = len(as_array(gallery_labels))

    def recall(within: int) -> float:
        return 100.0 * int(np.count_nonzero((found >= 0) & (found < within))) / len(found)

    return {
        "recall@1": recall(1),
        "recall@5": recall(5),
        "recall@10": recall(10),
        "recall@1%": recall(round(0.01 * size) + 1),
        "ap": 100.0 * float(np.mean(precision)),
        "queries": len(found),
        "gallery": size,
    }


def ranks(
    query: npt.ArrayLike, query_labels: npt.ArrayLike, gallery: npt.ArrayLike, gallery_labels: npt.ArrayLike
) -> npt.NDArray[np.int64]:
    """The 0-based rank of each query's first true match, -1 where it has none: (Q,). Arguments as for `evaluate`."""
    lists = _true_ranks(query, query_labels, gallery, gallery_labels)
    return np.array([r[0] if len(r) else -1 for r in lists], dtype=np.int64)


def best(query: npt.ArrayLike, gallery: npt.ArrayLike, gallery_labels: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """The gallery position of each query's nearest picture that is not junk, the first of equals: (Q,).

    Arguments and errors as for `evaluate`; InputError too when all of the gallery is junk.
    """
    queries, tiles = _flat(query, "query"), _flat(gallery, "gallery")
    kept = np.flatnonzero(_labels(gallery_labels, tiles, "gallery") != JUNK)
    if queries.shape[1] != tiles.shape[1] or len(kept) == 0:
        raise InputError(
            f"There are {len(kept)} gallery pictures that are not junk, of {tiles.shape[1]} numbers, and queries of "
            f"{queries.shape[1]}; expected at least one, and equal numbers."
        )
    tiles = tiles[kept].astype(np.float64)
    block = max(1, _BLOCK_BYTES // (8 * len(tiles)))
    found = [
        np.argmax(queries[start : start + block].astype(np.float64) @ tiles.T, axis=1)
        for start in range(0, len(queries), block)
    ]
    return cast("npt.NDArray[np.int64]", kept[np.concatenate(found)])


def _true_ranks(query: Any, query_labels: Any, gallery: Any, gallery_labels: Any) -> Iterator[npt.NDArray[np.int64]]:
    """For each query, the ascending 0-based ranks of its true matches among the gallery without junk."""
    queries, tiles = _flat(query, "query"), _flat(gallery, "gallery")
    of_query, of_tile = _labels(query_labels, queries, "query"), _labels(gallery_labels, tiles, "gallery")
    if queries.shape[1] != tiles.shape[1]:
        raise InputError(
            f"Query descriptors have {queries.shape[1]} numbers and gallery descriptors {tiles.shape[1]}; "
            "describe both with the same model and parts."
        )
    kept = np.flatnonzero(of_tile != JUNK)
    if len(kept) < len(of_tile):
        tiles, of_tile = tiles[kept], of_tile[kept]
    by_label = np.argsort(of_tile, kind="stable")
    in_order = of_tile[by_label]
    # In single precision, tiles closer than its rounding change places with the order of summation.
    tiles = tiles.astype(np.float64)
    block = max(1, _BLOCK_BYTES // (8 * max(len(tiles), 1)))
    for start in range(0, len(queries), block):
        scores = queries[start : start + block].astype(np.float64) @ tiles.T
        begins = np.searchsorted(in_order, of_query[start : start + block], "left")
        ends = np.searchsorted(in_order, of_query[start : start + block], "right")
        for row, begin, end in zip(scores, begins, ends, strict=True):
            yield _ranks_in_row(row, by_label[begin:end])


def _ranks_in_row(scores: npt.NDArray[Any], true: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
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


def _ranks_by_sorting(scores: npt.NDArray[Any], true: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The same where a true score equals another, which only the gallery's order tells apart."""
    position = np.empty(len(scores), np.int64)
    position[np.argsort(-scores, kind="stable")] = np.arange(len(scores))
    return np.sort(position[true])


def _average_precision(true_ranks: npt.NDArray[np.int64]) -> float:
    if len(true_ranks) == 0:
        return 0.0
    hits = np.arange(len(true_ranks))
    after = (hits + 1) / (true_ranks + 1)
    before = np.where(true_ranks == 0, 1.0, hits / np.maximum(true_ranks, 1))
    return float(np.mean((after + before) / 2))


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


def _labels(values: Any, rows: npt.NDArray[Any], side: str) -> npt.NDArray[np.int64]:
    labels = as_array(values)
    if labels.shape != (len(rows),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"The {side} labels are {labels.dtype} of shape {labels.shape}; expected one integer for each of {len(rows)} "
            "descriptors."
        )
    return labels.astype(np.int64)
