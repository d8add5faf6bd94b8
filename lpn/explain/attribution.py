"""Exact evidence: the share of each part and of each cell in a pair's score.

Scores and cosines are those of `lpn.retrieval.scoring`. By the model's contract (`lpn.models.contract`), the raw embedding of
part i is a sum over passes p and cells x, plus a constant:

    e_i = sum_p sum_x a_pi(x) A_i F_pi(x) + c_i.

The first pass is of the picture; LPN adds a pass of its mirror image. F_pi is the map of a pass, or of a part in a pass; the
map of the mirror image is flipped back. If u_i is the tile's part i, scaled to norm one, then

    cos_i = sum_x <sum_p a_pi(x) A_i F_pi(x), u_i> / |e_i|  +  <c_i, u_i> / |e_i|,

which is a signed map and one constant. The tile's side is analogous. Quantities that the contract holds, and
the length of a subtracted mean descriptor (`Model.centring`, which joins c_i), are fixed at their values for this picture.
Evidence accounts for the actual score. `lpn.explain.occlusion` measures how the score changes without a cell.
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
        constants: the share of each part's cosine that belongs to no cell, (n,).
    """

    cells: Float64Array
    constants: Float64Array

    def score_map(self, weights: Float32Array) -> Float64Array:
        """Each cell's share of the score under part weights, (h, w)."""
        return cast(Float64Array, np.tensordot(weights.astype(np.float64), self.cells, 1))


@dataclass(frozen=True, eq=False)
class Evidence:
    """The evidence for a pair's score, on the query's and on the tile's side.

    Attributes:
        cosines: of each part, (n,).
        weights: part weights that sum to one, (n,).
        csls: CSLS's subtrahend of each part's cosine for the query and for the tile, (n,) each; None without CSLS.
    """

    cosines: Float64Array
    weights: Float32Array
    query: SideEvidence
    tile: SideEvidence
    csls: tuple[Float32Array, Float32Array] | None = None

    @property
    def weighted_cosines(self) -> Float64Array:
        """w_i cos_i, each part's share of the score, (n,)."""
        return self.cosines * self.weights

    @property
    def csls_shares(self) -> tuple[float, ...]:
        """The shares of the score that CSLS subtracts for query and tile; they belong to no cell. Empty without CSLS."""
        return () if self.csls is None else tuple(-float(terms @ self.weights) for terms in self.csls)

    @property
    def contributions(self) -> Float64Array:
        """Each part's exact share of the squared distance, (n,), including its share of both terms of CSLS."""
        terms = 0.0 if self.csls is None else self.csls[0].astype(np.float64) + self.csls[1]
        return 2 * self.weights * (1 - self.cosines + terms)

    @property
    def part_sums(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """The sum of each part's positive cells, the sum of its negative cells, and its constant, (n,) each.

        All are shares of the score on the query's side.
        """
        cells = self.query.cells
        gains, losses = (clip(cells, 0.0).sum(axis=(1, 2)) * self.weights for clip in (np.maximum, np.minimum))
        return gains, losses, self.query.constants * self.weights

    @property
    def score(self) -> float:
        """Weighted mean cosine, -1 .. 1; under CSLS, less both of its terms."""
        return float(self.weighted_cosines.sum()) + sum(self.csls_shares)

    @property
    def distance2(self) -> float:
        """Squared distance, 0 .. 4."""
        return 2.0 - 2.0 * self.score

    def cell_maps(self, part: int | None = None) -> tuple[Float64Array, Float64Array]:
        """Return each cell's share of the score, for all parts or for one: (h, w) of the query and (h, w) of the tile."""
        if part is None:
            return self.query.score_map(self.weights), self.tile.score_map(self.weights)
        weight = float(self.weights[part])
        return weight * self.query.cells[part], weight * self.tile.cells[part]

    def to_dict(self, names: Sequence[str], level: str = "exact") -> dict[str, Any]:
        """Return the evidence as JSON values, the format of `lpn explain`.

        Args:
            names: of the parts.
            level: exactness of the numbers, see `Contract.claim`.

        A part's `weighted_cosine` is its weight times its cosine; all parts add up to the score. The query's `cells` (a list of
        rows) and `constant` add up to the part's cosine, and so do the tile's in `match`.
        """
        parts = part_values(names, self.cosines, self.weights)
        for row, part in enumerate(parts):
            query, tile = (
                {"constant": float(side.constants[row]), "cells": side.cells[row].tolist()}
                for side in (self.query, self.tile)
            )
            part |= query | {"match": tile}
        values = {"level": level, "score": self.score, "distance2": self.distance2, "parts": parts}
        csls = {} if self.csls is None else {"csls": dict(zip(("query", "tile"), self.csls_shares, strict=True))}
        return values | csls


def part_values(names: Sequence[str], cosines: FloatingArray, weights: Float32Array) -> list[dict[str, Any]]:
    """Return the name, cosine, weight, and share of the score of each part, as JSON values."""
    keys = "name", "cosine", "weight", "weighted_cosine"
    columns = names, cosines.tolist(), weights.tolist(), (cosines * weights).tolist()
    return [dict(zip(keys, values, strict=True)) for values in zip(*columns, strict=True)]


def side_evidence(trace: Trace, other: FloatingArray) -> SideEvidence:
    """Split each part's cosine with another picture into shares of this picture's cells and a constant.

    Args:
        other: the other picture's descriptor or embedding, (n, D).
    """
    units = other / np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-12)
    norms = np.maximum(np.linalg.norm(trace.embedding.astype(np.float64), axis=1), 1e-12)
    cells, constants = trace.along(units)
    return SideEvidence(cells / norms[:, None, None], constants / norms)


def spread_constants(side: SideEvidence, trace: Trace) -> Float64Array:
    """Return the cells of a side with each part's constant spread over them by their pooling weights, (n, h, w).

    If the pooling weights add up to one, a cell then adds a_i(x) <A_i F_i(x) + c_i, u_i> / |e_i|: the share of a part that shows
    nothing but this cell. The cells of a part add up to its cosine. The constant of a part without cells has no place.

    Args:
        trace: of the side's picture.
    """
    weights = trace.cells.sum(axis=0, dtype=np.float64)
    totals = weights.sum(axis=(1, 2), keepdims=True)
    shares = np.divide(weights, totals, out=np.zeros_like(weights), where=totals > 0)
    return cast(Float64Array, side.cells + side.constants[:, None, None] * shares)


def lead_cells(trace: Trace, weights: Float32Array, leader: FloatingArray, follower: FloatingArray) -> Float64Array:
    """Return each cell's share of the lead of one tile over another in d², (h, w); positive cells speak for the leader.

    The constants of both tiles are spread over the cells of their parts, see `spread_constants`, so that the cells of a part
    add up to its term of the lead. Parts without cells, and the terms of CSLS, have no place.

    Args:
        trace: of the query.
        weights: part weights that sum to one, (n,).
        leader, follower: descriptors of the tiles, (n, D).
    """
    ahead, behind = (spread_constants(side_evidence(trace, tile), trace) for tile in (leader, follower))
    return cast(Float64Array, np.tensordot(2 * weights.astype(np.float64), ahead - behind, 1))


def evidence(
    query: Trace,
    tile: Trace,
    weights: Float32Array | None = None,
    csls: tuple[Float32Array, Float32Array] | None = None,
) -> Evidence:
    """Account for the score of a pair, cell by cell, on both sides.

    Args:
        csls: see `Evidence`.
        weights: part weights with sum one, see `part_weights`; equal by default.

    Raises:
        InputError: when two models described the two pictures.
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
        csls,
    )


def cell_similarities(query: Trace, tile: Trace, part: int) -> Float32Array:
    """Return the share of each pair of cells in a part's cosine, (h w, h' w'): query cells by tile cells.

    The constants have no row or column. A row's sum and the share of the tile's constant add up to the query cell's value in
    `Evidence.query`.
    """
    norms = float(np.linalg.norm(query.embedding[part]) * np.linalg.norm(tile.embedding[part]))
    return cast(Float32Array, query.vectors(part) @ tile.vectors(part).T / np.float32(max(norms, 1e-12)))


@dataclass(frozen=True, eq=False)
class Correspondences:
    """The best match in the other picture for each cell of one picture: the pair with the largest share of the score.

    Cells are numbered row by row.

    Attributes:
        cells: the matched cell of the other picture, (h w,); -1 for a cell outside all parts of positive weight.
        terms: the pair's term of the score, (h w,).
    """

    cells: Int64Array
    terms: Float32Array


def correspondences(query: Trace, tile: Trace, weights: Float32Array) -> tuple[Correspondences, Correspondences]:
    """Return the correspondences of the query's cells and of the tile's, among cells of one part.

    Args:
        weights: part weights that sum to one, (n,); a part of weight 0 does not count.
    """
    of_query, of_tile = (
        Correspondences(np.full(cells, -1, np.int64), np.zeros(cells, np.float32))
        for cells in (trace.size[0] * trace.size[1] for trace in (query, tile))
    )
    for part in np.flatnonzero(weights):
        query_cells, tile_cells = (_part_cells(trace, int(part)) for trace in (query, tile))
        shares = cell_similarities(query, tile, int(part)) * weights[part]
        _take_best(of_query, shares, query_cells, tile_cells)
        _take_best(of_tile, shares.T, tile_cells, query_cells)
    return of_query, of_tile


def _take_best(correspondences: Correspondences, shares: Float32Array, rows: BoolArray, columns: BoolArray) -> None:
    """Update correspondences with one part's shares; a cell of several parts takes its largest share."""
    candidates = np.where(columns, shares, -np.inf)
    best = candidates.argmax(axis=1)
    largest = candidates[np.arange(len(best)), best]
    better = rows & ((correspondences.cells < 0) | (largest > correspondences.terms))
    correspondences.cells[better], correspondences.terms[better] = best[better], largest[better]


def _part_cells(trace: Trace, part: int) -> BoolArray:
    """Return the mask of a part's cells, (h w,)."""
    return cast(BoolArray, (trace.cells[:, part] != 0).any(axis=0).reshape(-1))
