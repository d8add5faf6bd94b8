"""Why a tile is where it is in the ranking: each part's exact share, and which cells of either picture it comes from.

With parts q_i, g_i of norm 1/sqrt(n) and part weights w_i that sum to one, cos_i = n q_i . g_i and

    score = sum_i w_i cos_i,        distance^2 = 2 - 2 score = sum_i 2 w_i (1 - cos_i).

A test-time head is affine, so a part's raw embedding is a sum over the cells x of the feature maps F_p of the picture (and
of its mirror, folded back) and one constant: e_i = sum_p sum_x a_pi(x) A_i F_p(x) + c_i. Hence, with the tile's part u_i of
norm one,

    cos_i = sum_x <sum_p a_pi(x) A_i F_p(x), u_i> / |e_i|  +  <c_i, u_i> / |e_i|,

a signed map and one constant; and the same on the tile's side. Where a head ends in a LeakyReLU its slopes, and with SAFA the
weights of the cells, are held as they are for this picture. It accounts for the score; it does not say what the score would be
were a cell not there, which `lpn.explain.occlusion` measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray, Int64Array
from lpn.core.errors import InputError
from lpn.models.base import normalise
from lpn.models.trace import Trace
from lpn.retrieval.scoring import part_weights


@dataclass(frozen=True, eq=False)
class SideEvidence:
    """Each part's cosine as a sum over one picture's cells and one constant.

    Attributes:
        cells: signed share of each cell in each part's cosine, (n, h, w); 0 where a cell does not belong to the part.
        constants: what comes from no cell, (n,).
    """

    cells: Float64Array
    constants: Float64Array

    def total(self, weights: Float32Array) -> Float64Array:
        """Each cell's share of the score under part weights, (h, w)."""
        return cast(Float64Array, np.tensordot(weights.astype(np.float64), self.cells, 1))


@dataclass(frozen=True, eq=False)
class Evidence:
    """The score of a pair, accounted for on the side of the query and on that of the tile.

    Attributes:
        cosines: of each part, (n,).
        weights: part weights that sum to one, (n,).
    """

    cosines: Float64Array
    weights: Float32Array
    query: SideEvidence
    tile: SideEvidence

    @property
    def contributions(self) -> Float64Array:
        """What each part adds to the score, (n,)."""
        return self.cosines * self.weights

    @property
    def sums(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """What each part's cells add to the score, what they take from it, and its constant, on the query's side: (n,) each."""
        cells = self.query.cells
        gains, losses = (side(cells, 0.0).sum(axis=(1, 2)) * self.weights for side in (np.maximum, np.minimum))
        return gains, losses, self.query.constants * self.weights

    @property
    def score(self) -> float:
        """Weighted mean cosine, -1 .. 1."""
        return float(self.contributions.sum())

    @property
    def distance2(self) -> float:
        """Squared distance, 0 .. 4."""
        return 2.0 - 2.0 * self.score

    def cell_maps(self, part: int | None = None) -> tuple[Float64Array, Float64Array]:
        """Return each cell's share of the score, for all parts or for one: (h, w) of the query and (h, w) of the tile."""
        if part is None:
            return self.query.total(self.weights), self.tile.total(self.weights)
        weight = float(self.weights[part])
        return weight * self.query.cells[part], weight * self.tile.cells[part]

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Everything, as a JSON file has it, so that anyone can add it up.

        A part's `contribution` is its weight times its cosine, and their sum the score; the `cells`, row by row, and the
        `constant` add up to the cosine, on the query's side and, under `match`, on the tile's.
        """
        parts = [
            {
                "name": name,
                "cosine": float(self.cosines[part]),
                "weight": float(self.weights[part]),
                "contribution": float(self.contributions[part]),
                "constant": float(self.query.constants[part]),
                "cells": self.query.cells[part].tolist(),
                "match": {"constant": float(self.tile.constants[part]), "cells": self.tile.cells[part].tolist()},
            }
            for part, name in enumerate(names)
        ]
        return {"exact": True, "score": self.score, "distance2": self.distance2, "parts": parts}


def side_evidence(trace: Trace, other: FloatingArray) -> SideEvidence:
    """A picture's cells, each with its share in the cosines with another picture's descriptor or embedding (n, D)."""
    units = other / np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-12)
    norms = np.maximum(np.linalg.norm(trace.embedding.astype(np.float64), axis=1), 1e-12)
    cells, constants = trace.along(units)
    return SideEvidence(cells / norms[:, None, None], constants / norms)


def evidence(query: Trace, tile: Trace, weights: Float32Array | None = None) -> Evidence:
    """Account for the score of a pair, cell by cell, on both sides.

    Args:
        weights: part weights that sum to one, see `part_weights`; equal by default.

    Raises:
        InputError: when the two are not of one model.
    """
    if query.embedding.shape != tile.embedding.shape:
        raise InputError(
            f"The query has parts of shape {query.embedding.shape}, the tile {tile.embedding.shape}; describe both with one "
            "model."
        )
    n = len(query.embedding)
    weights = part_weights(n) if weights is None else weights
    first, second = (normalise(trace.embedding).astype(np.float64) for trace in (query, tile))
    return Evidence(
        n * (first * second).sum(axis=1),
        weights,
        side_evidence(query, tile.embedding),
        side_evidence(tile, query.embedding),
    )


def cell_similarities(query: Trace, tile: Trace, part: int) -> Float32Array:
    """How much of a part's cosine each cell of the query shares with each of the tile: (h w, h' w'), both row by row.

    A row's sum, and what the query's cell shares with the tile's constant, is that cell's share in `Evidence.query`.
    """
    norms = float(np.linalg.norm(query.embedding[part]) * np.linalg.norm(tile.embedding[part]))
    return cast(Float32Array, query.vectors(part) @ tile.vectors(part).T / np.float32(max(norms, 1e-12)))


@dataclass(frozen=True, eq=False)
class Correspondences:
    """For each cell of one picture, row by row, the cell of the other that it shares most of the score with.

    Attributes:
        cells: the other picture's cell, (h w,); -1 for a cell that belongs to no part that counts.
        shares: what the two add to the score together, (h w,).
    """

    cells: Int64Array
    shares: Float32Array


def correspondences(query: Trace, tile: Trace, weights: Float32Array) -> tuple[Correspondences, Correspondences]:
    """The correspondences of the query's cells and those of the tile's, among cells of the same part.

    Args:
        weights: part weights that sum to one, (n,); a part of weight 0 does not count.
    """
    found = [_no_correspondences(trace) for trace in (query, tile)]
    for part in np.flatnonzero(weights):
        inside = [_within(trace, int(part)) for trace in (query, tile)]
        shared = cell_similarities(query, tile, int(part)) * weights[part]
        for correspondences, values, own, other in (
            (found[0], shared, *inside),
            (found[1], shared.T, *reversed(inside)),
        ):
            candidates = np.where(other, values, -np.inf)
            best = candidates.argmax(axis=1)
            shares = candidates[np.arange(len(best)), best]
            # A cell of several parts has its correspondence in the one where they share most.
            better = own & ((correspondences.cells < 0) | (shares > correspondences.shares))
            correspondences.cells[better], correspondences.shares[better] = best[better], shares[better]
    return found[0], found[1]


def _no_correspondences(trace: Trace) -> Correspondences:
    cells = trace.size[0] * trace.size[1]
    return Correspondences(np.full(cells, -1, np.int64), np.zeros(cells, np.float32))


def _within(trace: Trace, part: int) -> BoolArray:
    return cast(BoolArray, (trace.cells[:, part] != 0).any(axis=(0, 1)).reshape(-1))
