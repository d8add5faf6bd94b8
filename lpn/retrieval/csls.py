"""Cross-domain similarity local scaling (CSLS): a tile that is near to all queries counts as less near to each.

Let r(t) be the mean inner product of a tile with its K nearest queries, and r(q) that of a query with its K nearest tiles.
CSLS ranks by 2 <q, t> - r(t) - r(q) (Conneau et al., "Word translation without parallel data", 2018, section 2.3). For one
query, r(q) is constant. So with

    h_i(t) = 1/2 mean of <q_i, t_i> over the K queries nearest to t

the score is the sum over parts of <q_i, t_i> - h_i(t), and each part keeps an exact contribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError

# K by default, as chosen in docs/evaluation.md.
NEIGHBOURS = 3
# Size of a block of products, and of a block of the nearest queries' descriptors, in numbers.
_BLOCK = 2**25


@dataclass(frozen=True, eq=False)
class CslsTerms:
    """The two constants that CSLS subtracts from the cosines of a query with each tile.

    Both are in units of cosines, so that part weights w give sum_i w_i (cos_i - query_i - tile_i). The query's term is constant
    over the tiles, and changes no rank.

    Attributes:
        query: n times half of the mean of <q_i, t_i> over the K tiles nearest to the query, (n,).
        tiles: n h_i(t), (G, n).
    """

    query: Float32Array
    tiles: Float32Array

    @classmethod
    def of_query(cls, cosines: Float32Array, tiles: Float32Array, neighbours: int) -> CslsTerms:
        """Return the terms of a query by its part cosines with all tiles, (G, n).

        Args:
            tiles: see `CslsTerms`.
            neighbours: K; with fewer tiles, all of them count.
        """
        nearest = np.argsort(-cosines.mean(axis=1), kind="stable")[:neighbours]
        return cls(cast(Float32Array, cosines[nearest].mean(axis=0) / 2), tiles)


def check_neighbours(neighbours: int, queries: int, where: str = "") -> None:
    """Raise InputError unless K is from 1 to the number of queries; `where` names their group in the message."""
    if not isinstance(neighbours, int) or isinstance(neighbours, bool) or not 1 <= neighbours <= queries:
        raise InputError(
            f"CSLS takes the mean over {neighbours!r:.40} nearest queries, and there are {queries}{where}; expected "
            f"{'' if type(neighbours) is int else 'a whole number from '}1 to {queries}."
        )


def hubness(query: Float32Array, tiles: Float32Array, neighbours: int) -> Float32Array:
    """Return h_i(t) of each part of each tile, (G, n).

    Args:
        query, tiles: descriptors, (Q, n, D) and (G, n, D).
        neighbours: K.

    Raises:
        InputError: unless K is from 1 to the number of queries.
    """
    check_neighbours(neighbours, len(query))
    flat = query.reshape(len(query), -1)
    means = np.empty(tiles.shape[:2], np.float32)
    rows = max(1, _BLOCK // max(len(query), neighbours * flat.shape[1]))
    for start in range(0, len(tiles), rows):
        block = tiles[start : start + rows]
        products = block.reshape(len(block), -1) @ flat.T
        nearest = np.argpartition(products, len(query) - neighbours, axis=1)[:, -neighbours:]
        means[start : start + rows] = np.einsum("gknd,gnd->gn", query[nearest], block) / (2 * neighbours)
    return means


def scaled(query: Float32Array, tiles: Float32Array, neighbours: int) -> tuple[Float32Array, Float32Array]:
    """Return descriptors (Q, n, D + 1) and (G, n, D + 1), whose inner products are the scores of CSLS.

    The last number of each part is 1 for a query, and -h_i(t) for a tile; see `hubness` for arguments and errors.
    """
    ones = np.ones((*query.shape[:2], 1), np.float32)
    offsets = -hubness(query, tiles, neighbours)[..., None]
    return (
        cast(Float32Array, np.concatenate([query, ones], axis=2)),
        cast(Float32Array, np.concatenate([tiles, offsets], axis=2)),
    )
