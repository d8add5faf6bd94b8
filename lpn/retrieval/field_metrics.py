"""Metrics of the field that use positions or lists of true tiles, by their papers' formulas.

Two metrics are called SDM@K, and their values do not compare:

    DenseUAV    sum over i < K of (K - i) exp(-5000 d_i) / sum of (K - i),    d_i in degrees, in single precision
    GTA-UAV     sum over i < K of (K - i) exp(-0.001 d_i) / sum of (K - i),   d_i in metres

where d_i is the distance from the query to the tile of rank i. Near the equator 5000 per degree is about 0.045 per metre, so
DenseUAV's SDM decays 45 times as fast. Distances are (Q, R): from each query to its R nearest tiles, highest score first.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.datasets import geo
from lpn.datasets.base import PositionProtocol
from lpn.retrieval.metrics import checked_sides
from lpn.retrieval.ranks import Scores

# Decay of DenseUAV's SDM, per degree, and of GTA-UAV's, per metre.
DENSEUAV_DECAY = 5000.0
GTA_UAV_DECAY = 0.001
# DenseUAV's evaluation takes this equatorial radius of WGS 84, in metres, as the radius of a sphere.
_EQUATOR = 6_378_137.0


def recall_at(hits: npt.ArrayLike, k: int) -> float:
    """Return Recall@K: the share in percent of queries with a hit among their first k tiles, 1 .. R; hits: (Q, R) bool."""
    values: BoolArray = np.asarray(hits, bool)
    return float(100 * values[:, :k].any(axis=1).mean()) if len(values) else 0.0


def sdm(distances: npt.ArrayLike, k: int, decay: float) -> Float64Array:
    """Return SDM@K of each query, 0 .. 1, see this module, (Q,).

    Args:
        distances: by `degree_distances` for `DENSEUAV_DECAY`, in metres for `GTA_UAV_DECAY`, (Q, R).
        k: 1 .. R.
    """
    values = np.asarray(distances, np.float64)
    weights = np.arange(k, 0, -1, dtype=np.float64)
    return cast(Float64Array, np.exp(-decay * values[:, :k]) @ weights / weights.sum())


def distance_at(metres: npt.ArrayLike, k: int) -> Float64Array:
    """Return Dis@K of each query: the mean distance of its first k tiles, 1 .. R, (Q,)."""
    values = np.asarray(metres, np.float64)
    return cast(Float64Array, values[:, :k].mean(axis=1))


def accuracy_within(top_distances: npt.ArrayLike, metres: float) -> float:
    """Return DenseUAV's MA@m: the share in percent of queries whose top answer is nearer than m metres; top_distances: (Q,)."""
    values = np.asarray(top_distances, np.float64)
    return float(100 * (values < metres).mean()) if len(values) else 0.0


def degree_distances(queries: npt.ArrayLike, tiles: npt.ArrayLike) -> Float64Array:
    """Return DenseUAV's distance in degrees between latitude and longitude (..., 2), in single precision as released."""
    a, b = np.asarray(queries, np.float32), np.asarray(tiles, np.float32)
    return cast(Float64Array, np.sqrt(((a - b) ** 2).sum(axis=-1)).astype(np.float64))


def great_circle(queries: npt.ArrayLike, tiles: npt.ArrayLike) -> Float64Array:
    """Return the haversine distance in metres between latitude and longitude in degrees (..., 2), as in DenseUAV's MA@m."""
    a, b = np.radians(np.asarray(queries, np.float64)), np.radians(np.asarray(tiles, np.float64))
    half = np.sin((b - a) / 2) ** 2
    chord = half[..., 0] + np.cos(a[..., 0]) * np.cos(b[..., 0]) * half[..., 1]
    return cast(Float64Array, 2 * _EQUATOR * np.arcsin(np.sqrt(np.clip(chord, 0, 1))))


def nearest(query: npt.ArrayLike, gallery: npt.ArrayLike, k: int, junk: BoolArray | None = None) -> Int64Array:
    """Return the gallery positions of each query's k nearest tiles in the order of exact scores, ties in gallery order.

    Args:
        query, gallery: descriptors, (Q, n, D) or (Q, F) and (G, n, D) or (G, F), compared by inner product.
        junk: gallery pictures that are dropped, (G,).

    Returns:
        (Q, K) with K the smaller of k and the number of tiles that are not junk.

    Raises:
        InputError: for descriptors that `metrics.evaluate` refuses, or when no tile is left.
    """
    (queries, tiles), lengths = checked_sides(query, gallery)
    kept = len(tiles) - (0 if junk is None else int(junk.sum()))
    depth = min(k, kept)
    if depth < 1:
        raise InputError(f"{kept} gallery pictures are not junk, and K is {k}; expected at least one of both.")
    nearest_first = np.empty((len(queries), depth), np.int64)
    scores = Scores(queries, tiles, lengths)
    for rows, block, errors in scores.blocks():
        if junk is not None:
            block[:, junk] = -np.inf
        limit = np.partition(block, -depth, axis=1)[:, -depth].astype(np.float64) - 2 * errors
        for row, query_index in enumerate(range(rows.start, rows.stop)):
            close = block[row] >= limit[row]
            if junk is not None:
                close &= ~junk
            candidates = np.flatnonzero(close)
            order = np.argsort(-scores.exact(query_index, candidates), kind="stable")
            nearest_first[query_index] = candidates[order[:depth]]
    return nearest_first


def field_figures(
    measured_by: PositionProtocol,
    query: Float32Array,
    gallery: Float32Array,
    query_places: Float64Array,
    places: Float64Array,
) -> dict[str, float]:
    """Return the metrics of a published evaluation by positions, as means over the queries.

    Keys: for DenseUAV `sdm_denseuav@K` (0 .. 1) for K = 1, 3, 5, 10 and `ma@m` in percent for m = 5, 10, 20, 50, 100 metres; for
    GTA-UAV and UAV-VisLoc `sdm_gta_uav@K` (0 .. 1) and `dis@K` in metres for K = 1, 3, 5. K above the size of the gallery is left
    out.

    Args:
        query, gallery: descriptors, (Q, n, D) and (G, n, D).
        query_places, places: see `Dataset.coordinates`, (Q, 2) and (G, 2).
    """
    order = nearest(query, gallery, 10)
    starts, ends = query_places[:, None], places[order]
    if measured_by == "DenseUAV":
        degrees = degree_distances(starts, ends)
        top = great_circle(query_places, ends[:, 0])
        depths = [k for k in (1, 3, 5, 10) if k <= order.shape[1]]
        figures = {f"sdm_denseuav@{k}": float(sdm(degrees, k, DENSEUAV_DECAY).mean()) for k in depths}
        return figures | {f"ma@{metres}": accuracy_within(top, metres) for metres in (5, 10, 20, 50, 100)}
    metres = geo.geodesic(starts, ends) if measured_by == "UAV-VisLoc" else np.linalg.norm(starts - ends, axis=2)
    depths = [k for k in (1, 3, 5) if k <= order.shape[1]]
    figures = {f"sdm_gta_uav@{k}": float(sdm(metres, k, GTA_UAV_DECAY).mean()) for k in depths}
    return figures | {f"dis@{k}": float(distance_at(metres, k).mean()) for k in depths}
