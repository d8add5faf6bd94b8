"""The outcome of each query: its rank, average precision, and nearest tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.csv_cells import csv_bytes
from lpn.datasets import Truth
from lpn.retrieval.field_metrics import nearest
from lpn.retrieval.metrics import JUNK, Retrieval


@dataclass(frozen=True, eq=False)
class PerQuery:
    """The outcome of each query.

    Attributes:
        rank: 1-based rank of its first true match, 0 without one, (Q,).
        ap: average precision in percent, NaN where the truth is not known, (Q,).
        nearest: gallery positions of its nearest tiles without junk, -1 where no tile is left, (Q, K).
        scores: their scores, NaN where no tile is left, (Q, K).
    """

    rank: Int64Array
    ap: Float64Array
    nearest: Int64Array
    scores: Float64Array

    @classmethod
    def of(
        cls,
        retrieval: Retrieval,
        query: Float32Array,
        gallery: Float32Array,
        gallery_labels: Int64Array,
        truth: Sequence[Truth] | None,
        depth: int,
    ) -> Self:
        """Rank the nearest tiles of each query.

        Args:
            retrieval: of the same descriptors.
            query, gallery: descriptors, (Q, n, D) and (G, n, D).
            gallery_labels: -1 for junk unless there are lists, (G,).
            truth: lists of true matches and junk; None if labels tell them.
            depth: K.
        """
        common = gallery_labels == JUNK if truth is None else None
        junk = [np.zeros(0, np.int64)] * len(query) if truth is None else [lists.junk for lists in truth]
        order = nearest(query, gallery, depth + max(map(len, junk)), common)
        tiles, scores = np.full((len(query), depth), -1), np.full((len(query), depth), np.nan)
        for row, (positions, left_out) in enumerate(zip(order, junk, strict=True)):
            kept = positions[~np.isin(positions, left_out)][:depth]
            tiles[row, : len(kept)] = kept
            scores[row, : len(kept)] = np.tensordot(gallery[kept].astype(np.float64), query[row], 2)
        known = np.array([truth is None or truth[row].known for row in range(len(query))])
        ap = np.where(known, 100 * retrieval.precision, np.nan)
        return cls(np.where(known, retrieval.first + 1, 0), ap, tiles, scores)

    def to_csv(self, queries: Sequence[str], gallery: Sequence[str]) -> bytes:
        """Return a line for each query: name, rank, AP, and the names and scores of its nearest tiles; unknown cells are empty.

        Args:
            queries, gallery: the names.
        """
        places = range(1, self.nearest.shape[1] + 1)
        rows: list[list[object]] = [
            ["query", "rank", "ap", *(f"top {k}" for k in places), *(f"score {k}" for k in places)]
        ]
        for name, rank, ap, tiles, scores in zip(
            queries, self.rank.tolist(), self.ap.tolist(), self.nearest.tolist(), self.scores.tolist(), strict=True
        ):
            found = [None if tile < 0 else gallery[tile] for tile in tiles]
            figures = [None if np.isnan(value) else round(value, 6) for value in (ap, *scores)]
            rows.append([name, rank or None, figures[0], *found, *figures[1:]])
        return csv_bytes(rows)
