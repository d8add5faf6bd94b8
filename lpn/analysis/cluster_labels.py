"""Labels of the clusters of a map of descriptors, from the columns of the data alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array

# The number of clusters, and the number of queries that a cluster has on average at least.
MOST, LEAST_QUERIES = 8, 12
_ROUNDS, _ATTEMPTS = 60, 4
# The number of points that the middles of clusters are computed from.
_SAMPLE = 4000


@dataclass(frozen=True)
class ClusterLabel:
    """The most frequent value of a column in one cluster.

    Attributes:
        middle: the median of the cluster's points, in the units of the map.
        column, value: the column's name, and the value in words.
        share: of the cluster's queries that have the value, 0 .. 1.
        overall: the same share of all queries of the map.
        queries: of the cluster.
    """

    middle: tuple[float, float]
    column: str
    value: str
    share: float
    overall: float
    queries: int


def clusters_of(points: Float64Array, most: int = MOST) -> Int64Array:
    """Return the cluster of each point by k-means, (Q,); -1 for a point without a place.

    The same points always give the same clusters.

    Args:
        points: (Q, 2); NaN where a place is unknown.
        most: the number of clusters; there are fewer if they had less than `LEAST_QUERIES` points on average.
    """
    which = np.full(len(points), -1)
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    count = min(most, len(known) // LEAST_QUERIES)
    if count < 2:
        return which
    cv2.setRNGSeed(0)
    placed = points[known]
    scaled = ((placed - placed.mean(axis=0)) / max(float(placed.std()), 1e-12)).astype(np.float32)
    stop = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, _ROUNDS, 1e-3
    sample = scaled[:: -(-len(scaled) // _SAMPLE)]
    _, _, middles = cv2.kmeans(sample, count, np.empty(0, np.int32), stop, _ATTEMPTS, cv2.KMEANS_PP_CENTERS)
    which[known] = np.linalg.norm(scaled[:, None] - middles, axis=2).argmin(axis=1)
    return which


def cluster_labels(
    points: Float64Array, columns: Mapping[str, Sequence[tuple[str, BoolArray]]], most: int = MOST
) -> list[ClusterLabel]:
    """Name each cluster of a map by one column: by that whose most frequent values stand out most from all queries.

    A column stands out by the mean of `share - overall`, weighted by the clusters' sizes. Clusters whose most frequent value is
    no more frequent than elsewhere get no label.

    Args:
        points: (Q, 2); NaN where a place is unknown.
        columns: of each column, its values in words with masks of the queries that have them, each (Q,).
        most: see `clusters_of`.

    Returns:
        The largest cluster first; empty without columns, or with too few points.
    """
    which = clusters_of(points, most)
    labels = [_labels(points, which, name, values) for name, values in columns.items() if len(values) > 1]
    return max(labels, key=lambda named: sum(one.queries * (one.share - one.overall) for one in named), default=[])


def _labels(
    points: Float64Array, which: Int64Array, column: str, values: Sequence[tuple[str, BoolArray]]
) -> list[ClusterLabel]:
    masks = np.stack([mask for _, mask in values])
    overall = masks[:, which >= 0].mean(axis=1) if (which >= 0).any() else np.zeros(len(values))
    labels = []
    for cluster in range(int(which.max(initial=-1)) + 1):
        members = np.flatnonzero(which == cluster)
        shares = masks[:, members].mean(axis=1)
        best = int(shares.argmax())
        if shares[best] > overall[best]:
            x, y = np.median(points[members], axis=0)
            share = float(shares[best])
            labels.append(
                ClusterLabel((float(x), float(y)), column, values[best][0], share, float(overall[best]), len(members))
            )
    return sorted(labels, key=lambda label: -label.queries)
