"""Projections of descriptors to the plane: PCA, and UMAP if the extra is installed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.errors import InputError, MissingPackageError
from lpn.retrieval.metrics import checked_sides

# Maximum number of pictures from which the axes are computed.
SAMPLE = 2000
# UMAP runs in a process with a copy of all descriptors: 0.4 GB more for 50,000 of 4 x 512 numbers.
MOST_FOR_UMAP = 50_000
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class Projection:
    """Queries and tiles of a task, projected to a plane.

    Attributes:
        queries, tiles: (Q, 2) and (G, 2) float64.
        variance: each axis' share of the variance, 0 .. 1, (2,); None for UMAP.
    """

    queries: Float64Array
    tiles: Float64Array
    variance: Float64Array | None


def pca(queries: npt.ArrayLike, gallery: npt.ArrayLike) -> Projection:
    """Project descriptors to their two principal components, computed from queries and tiles together.

    The components are computed from all rows, or from an evenly spaced sample of `SAMPLE` if there are more. The largest number
    of each component is positive, so that equal descriptors always give equal maps.

    Args:
        queries, gallery: (Q, n, D) and (G, n, D), or flattened.

    Raises:
        InputError: as for `metrics.evaluate`.
    """
    sides, _ = checked_sides(queries, gallery)
    total = len(sides[0]) + len(sides[1])
    chosen = np.unique(np.linspace(0, total - 1, min(SAMPLE, total)).astype(np.int64))
    split = np.searchsorted(chosen, len(sides[0]))
    drawn = np.concatenate([sides[0][chosen[:split]], sides[1][chosen[split:] - len(sides[0])]]).astype(np.float64)
    middle = drawn.mean(axis=0)
    drawn -= middle
    # The right singular vectors come from the smaller of the two Gram matrices, many times faster than from an SVD.
    if len(drawn) < drawn.shape[1]:
        values, left = np.linalg.eigh(drawn @ drawn.T)
        axes = (drawn.T @ left[:, :-3:-1]) / np.sqrt(np.maximum(values[:-3:-1], 1e-30))
    else:
        values, right = np.linalg.eigh(drawn.T @ drawn)
        axes = right[:, :-3:-1]
    variance = np.zeros(2)
    variance[: axes.shape[1]] = np.maximum(values[:-3:-1], 0) / max(float(np.maximum(values, 0).sum()), 1e-300)
    axes[:, variance[: axes.shape[1]] < 1e-12] = 0.0
    largest = np.take_along_axis(axes, np.argmax(np.abs(axes), axis=0)[None], axis=0)
    axes = np.pad(axes * np.where(largest < 0, -1.0, 1.0), ((0, 0), (0, 2 - axes.shape[1])))
    points = [
        np.concatenate([(side[i : i + _BLOCK] - middle) @ axes for i in range(0, len(side), _BLOCK)]) for side in sides
    ]
    return Projection(points[0], points[1], variance)


def umap(queries: npt.ArrayLike, gallery: npt.ArrayLike, neighbours: int = 15, seed: int = 0) -> Projection:
    """Project descriptors by UMAP with the cosine distance (McInnes et al. 2018).

    Neighbours stay together, but distances between groups mean little.

    Args:
        queries, gallery: as for `pca`.
        neighbours: number of neighbours of each picture that should stay near.
        seed: the same seed gives the same map.

    Raises:
        MissingPackageError: when umap-learn is not installed.
        InputError: as for `metrics.evaluate`, or when there are not more pictures than neighbours.
    """
    sides, _ = checked_sides(queries, gallery)
    total = len(sides[0]) + len(sides[1])
    if not 2 <= neighbours < total:
        raise InputError(
            f"The number of neighbours for UMAP is {neighbours} with {total} pictures; expected 2 to {total - 1}."
        )
    try:
        from umap import UMAP
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            "A UMAP needs the package umap-learn, which is not installed; pip install 'lpn-explorer[train]', or use the PCA."
        ) from error
    # With a seed, umap-learn uses one thread, and warns unless n_jobs is 1.
    reducer = UMAP(n_neighbors=neighbours, metric="cosine", random_state=seed, n_jobs=1)
    points = cast(Float64Array, reducer.fit_transform(np.concatenate(sides)).astype(np.float64))
    return Projection(points[: len(sides[0])], points[len(sides[0]) :], None)


def inside(points: Float64Array, corners: Float64Array) -> Int64Array:
    """Return the indices of points (N, 2) within a closed line of corners (C, 2), by the even-odd rule, (M,), ascending."""
    is_inside = np.zeros(len(points), bool)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            crossed = (y0 > y) != (y1 > y)
            is_inside ^= crossed & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return np.flatnonzero(is_inside)
