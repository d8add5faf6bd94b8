"""Tiles of different places that a model describes nearly alike, such as twins and repeated pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Int64Array
from lpn.retrieval.scoring import part_weights
from lpn.tasks.task import Task

# The largest gallery whose tiles are compared with one another: the cost grows with its square.
MAX_TILES = 5000
_BLOCK = 512


@dataclass(frozen=True)
class NearDuplicate:
    """Two tiles.

    Attributes:
        tiles: their gallery positions, the lower one first.
        cosine: of their descriptors under the part weights, from -1 to 1.
    """

    tiles: tuple[int, int]
    cosine: float


def near_duplicates(
    gallery: Float32Array, labels: Int64Array, count: int, weights: npt.ArrayLike | None = None
) -> list[NearDuplicate]:
    """Return the pairs of tiles of different places with the highest cosine, the nearest first.

    Tiles labelled -1 are left out.

    Args:
        gallery: (G, n, D), descriptors of a task: each part has length 1/sqrt(n).
        labels: the place of each tile, (G,).
        count: maximum number of pairs.
        weights: part weights, see `part_weights`.
    """
    total, parts = gallery.shape[:2]
    flat = (gallery * np.sqrt(parts * part_weights(parts, weights))[None, :, None]).reshape(total, -1)
    best: list[NearDuplicate] = []
    for start in range(0, total, _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, total))
        cosines = flat[rows] @ flat[start:].T
        columns = np.arange(start, total)
        allowed = (columns[None] > rows[:, None]) & (labels[rows][:, None] != labels[columns][None])
        allowed &= (labels[rows][:, None] >= 0) & (labels[columns][None] >= 0)
        cosines[~allowed] = -np.inf
        nearest = np.argpartition(cosines, -min(count, cosines.size), axis=None)[-min(count, cosines.size) :]
        one, other = np.unravel_index(nearest, cosines.shape)
        best += [
            NearDuplicate((int(rows[i]), int(columns[j])), float(cosines[i, j]))
            for i, j in zip(one, other, strict=True)
            if np.isfinite(cosines[i, j])
        ]
        best = sorted(best, key=lambda pair: (-pair.cosine, pair.tiles))[:count]
    return best


def shows_places(task: Task) -> bool:
    """Return True if tiles show the places of queries, unlike the overlapping windows of a map."""
    return task.truth is None and bool(np.isin(task.gallery_labels, task.query_labels).any())
