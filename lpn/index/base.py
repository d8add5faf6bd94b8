"""The protocol of an index of tiles, and the arithmetic that all indexes share.

With parts q_i, g_i of norm 1/sqrt(n) and weights w_i with sum one, the score of a tile is

    score = sum_i w_i cos_i = sum_i (w_i n q_i) . g_i,

one inner product of the tile's descriptor with a rescaled query. One index therefore serves all weights. Scores are
recomputed from the vectors that an engine returns, in float64 and in a fixed order of summation. So equal tiles have equal
scores, whatever the engine's rounding.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray
from lpn.core.errors import InputError, StoreError
from lpn.core.files import printable
from lpn.descriptors.store import DescriptorKind
from lpn.retrieval import scoring

# South, west, north, east in degrees; a box with west > east crosses the antimeridian.
DegreeBox = tuple[float, float, float, float]
# A tile's descriptor of n D numbers in any shape, and its latitude and longitude, NaN for none.
TileRow = tuple[Any, Any]
# Names, descriptors (B, n, D) float32, and positions (B, 2).
Tiles = tuple[list[str], Float32Array, Float64Array]

# Maximum length of a tile's name in characters.
ID_LENGTH = 512
# Maximum norm of a part times sqrt(n); rounding to float16 makes it exceed 1.
LONGEST = 1.01
_ROWS = 256


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The k nearest tiles, nearest first.

    Attributes:
        ids: their names.
        scores: weighted mean cosines, (k,) float64.
        vectors: their descriptors, (k, n, D) float32, from which contributions and evidence are computed.
        positions: latitude and longitude in degrees, (k, 2) float64, NaN for a tile without a position.
    """

    ids: list[str]
    scores: Float64Array
    vectors: Float32Array
    positions: Float64Array

    def __len__(self) -> int:
        return len(self.ids)


class Index(ABC):
    """Tiles by name, searched by descriptor under any part weights.

    A further engine is a subclass with `_add`, `_nearest`, `_rows`, `count`, and `close`, registered as an entry point of the
    group `lpn.indexes`; its address is NAME://... . It proposes tiles; scores and order are computed here.

    Attributes:
        engine: its name.
        kind: the kind of descriptors.
        most: maximum number of tiles in a search result; None for no limit.
    """

    engine: str
    kind: DescriptorKind
    most: int | None = None

    def add(
        self,
        ids: Sequence[str],
        descriptors: npt.ArrayLike,
        positions: Sequence[Sequence[float]] | Float64Array | None = None,
    ) -> None:
        """Add tiles, replacing those of the same names, so that an interrupted add can be repeated.

        Args:
            ids: a unique name for each tile, 1 to 512 characters.
            descriptors: (B, n, D) float32 with parts of norm 1/sqrt(n).
            positions: latitude and longitude in degrees, (B, 2), NaN for a tile without a position; None for no positions.

        Raises:
            InputError: when an argument is not as described.
            StoreError: when the tiles cannot be written.
        """
        vectors = checked(self.kind, descriptors)
        names, places = check_names(ids, len(vectors)), check_positions(positions, len(vectors))
        if names:
            self._add(names, vectors, places)

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """Return the k tiles with the highest scores, or all if there are fewer.

        Args:
            query: (n, D).
            weights: part weights of 0 or more, (n,), normalised to sum to one; None for equal weights.
            box: search only tiles in this box, borders included; tiles without a position are in no box.

        Raises:
            InputError: when an argument is not as described.
            StoreError: when the index cannot be read.
        """
        wanted, k, box = rescaled(self.kind, query, weights), check_count(k), check_box(box)
        if self.most is not None and k > self.most:
            raise InputError(f"The number of tiles asked for is {k}; {self.engine} gives {self.most} at most.")
        names, vectors, positions = self._nearest(wanted, k, box)
        scores = scores_of(vectors.reshape(len(vectors), self.kind.numbers), wanted)
        chosen = np.lexsort((np.arange(len(names)), -scores))[:k]
        return SearchResult([names[i] for i in chosen.tolist()], scores[chosen], vectors[chosen], positions[chosen])

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """Return descriptors (B, n, D) and positions (B, 2), NaN for none, of tiles by name.

        Raises:
            InputError: when the index has no tile of one of these names.
            StoreError: when the index cannot be read.
        """
        rows = self._rows(ids)
        if missing := [name for name in ids if name not in rows]:
            raise InputError(
                f"The index has no tile {printable(missing[0])[:80]}; tiles are named by their path when they were added."
            )
        return self._tiles(ids, rows)[1:]

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """Return a mask of the names that are in the index, (B,)."""
        there = self._rows(ids, vectors=False)
        return np.array([name in there for name in ids], np.bool_)

    def tiles(self) -> Tiles | None:
        """Return names, descriptors (N, n, D), and positions (N, 2) of all tiles; None if the engine does not list them.

        Raises:
            StoreError: when the index cannot be read.
        """
        return None

    @abstractmethod
    def count(self) -> int:
        """Return the number of tiles."""

    @abstractmethod
    def _add(self, names: list[str], vectors: Float32Array, places: Float64Array) -> None:
        """Add checked tiles, at least one: their vectors (B, n, D) and positions (B, 2)."""

    @abstractmethod
    def _nearest(self, wanted: Float64Array, k: int, box: DegreeBox | None) -> Tiles:
        """Return at least k tiles with high inner products with a rescaled query (n D,); tiles of equal score keep this order."""

    @abstractmethod
    def _rows(self, names: Sequence[str], vectors: bool = True) -> dict[str, TileRow]:
        """Return the vector and the position of each existing tile by its name; without `vectors`, both may be None."""

    @abstractmethod
    def close(self) -> None:
        """Release files, threads, and connections."""

    def _tiles(self, names: Sequence[str], rows: Mapping[str, TileRow]) -> Tiles:
        """Return the tiles of these names from the result of `_rows`."""
        vectors = np.array([rows[name][0] for name in names], np.float32)
        positions = np.array([rows[name][1] for name in names], np.float64)
        shape = len(names), self.kind.n_parts, self.kind.embedding
        return list(names), vectors.reshape(shape), positions.reshape(-1, 2)

    def check_model(self, fingerprint: str) -> None:
        """Raise StoreError unless the descriptors are of this model."""
        if fingerprint != self.kind.fingerprint:
            raise StoreError(
                f"This index holds descriptors of model {self.kind.fingerprint}, and this model is {fingerprint}; search with "
                "that model, or make an index with this one."
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def rescaled(kind: DescriptorKind, query: npt.ArrayLike, weights: npt.ArrayLike | None) -> Float64Array:
    """Compute w_i n q_i, whose inner product with a descriptor is its score: (n D,) float64.

    Raises:
        InputError: when the query is not (n, D) finite numbers, or the weights are not n numbers of 0 or more.
    """
    values = np.asarray(query, dtype=np.float64)
    if values.shape != (kind.n_parts, kind.embedding) or not np.isfinite(values).all():
        raise InputError(
            f"The query is of shape {values.shape}; expected {kind.n_parts} parts of {kind.embedding} finite numbers."
        )
    share = scoring.part_weights(kind.n_parts, weights).astype(np.float64)
    return (share[:, None] * kind.n_parts * values).reshape(-1)


def checked(kind: DescriptorKind, descriptors: npt.ArrayLike) -> Float32Array:
    """Check descriptors to be added, and return them as (B, n, D) float32.

    Raises:
        InputError: when they are not (B, n, D) and finite with parts of norm 1/sqrt(n), or 0 for an empty part.
    """
    values = np.ascontiguousarray(descriptors, dtype=np.float32)
    if values.ndim != 3 or values.shape[1:] != (kind.n_parts, kind.embedding):
        raise InputError(
            f"The descriptors are of shape {values.shape}; this index takes (B, {kind.n_parts}, {kind.embedding})."
        )
    norms = np.linalg.norm(values, axis=2) * kind.n_parts**0.5
    good = np.isfinite(norms) & ((norms == 0) | (abs(norms - 1) <= LONGEST - 1))
    if not good.all():
        row, part = np.argwhere(~good)[0]
        raise InputError(
            f"Part {part + 1} of descriptor {row + 1} has norm {norms[row, part] / kind.n_parts**0.5:g}; expected "
            f"{kind.n_parts**-0.5:g}, as lpn.models.base.normalise makes it."
        )
    return values


def scores_of(vectors: FloatingArray, wanted: Float64Array) -> Float64Array:
    """Score vectors (B, n D) under a rescaled query (n D,): (B,) float64.

    Each row is summed separately: in a matrix product, the order of summation would depend on the row's place in a block.
    """
    scores = np.empty(len(vectors))
    for start in range(0, len(vectors), _ROWS):
        scores[start : start + _ROWS] = (vectors[start : start + _ROWS] * wanted).sum(axis=1)
    return scores


def check_names(ids: Sequence[str], rows: int) -> list[str]:
    """Check the names of `rows` tiles to be added; InputError when a name is invalid or repeated."""
    if isinstance(ids, str) or len(ids) != rows:
        raise InputError(f"There are {len(ids)} names for {rows} descriptors; give one name for each tile.")
    for name in ids:
        if not isinstance(name, str) or not 0 < len(name) <= ID_LENGTH or "\0" in name:
            printed = printable(str(name))[:40] or "empty"
            raise InputError(f"A tile's name is {printed!r}; expected text of 1 to {ID_LENGTH} characters.")
        try:
            name.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"The tile's name {printable(name)[:40]!r} is not UTF-8; rename its file.") from error
    repeated = next((name for name, count in Counter(ids).items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"The tile {printable(repeated)} is given twice; give each tile once.")
    return list(ids)


def check_positions(positions: Sequence[Sequence[float]] | Float64Array | None, rows: int) -> Float64Array:
    """Check positions of tiles to be added: (rows, 2), NaN for none; InputError if one is out of range."""
    if positions is None:
        return np.full((rows, 2), np.nan)
    values = np.array(positions, dtype=np.float64)
    if values.shape != (rows, 2):
        raise InputError(
            f"The positions are of shape {values.shape}; expected a latitude and a longitude for {rows} tiles."
        )
    none = np.isnan(values).all(axis=1)
    wrong = ~none & ~((abs(values[:, 0]) <= 90) & (abs(values[:, 1]) <= 180))
    if wrong.any():
        latitude, longitude = values[wrong][0]
        raise InputError(
            f"A tile is at latitude {latitude:g} and longitude {longitude:g}; expected -90 to 90 and -180 to 180 degrees."
        )
    return values


def check_count(k: int) -> int:
    """Check a number of tiles; InputError unless it is a whole number of 1 or more."""
    if not isinstance(k, (int, float, np.integer, np.floating)) or not k >= 1 or k % 1:
        raise InputError(f"The number of tiles asked for is {k}; expected 1 or more.")
    return int(k)


def check_box(box: Sequence[float] | None) -> DegreeBox | None:
    """Check a box; InputError unless it is south, west, north, east in degrees with south <= north."""
    if box is None:
        return None
    values = [float(value) for value in box]
    if not (len(values) == 4 and -90 <= values[0] <= values[2] <= 90 and all(abs(v) <= 180 for v in values[1::2])):
        raise InputError(
            f"The box is {', '.join(f'{value:g}' for value in values)}; expected south, west, north, and east in degrees, "
            "with south <= north (west > east crosses the antimeridian)."
        )
    return values[0], values[1], values[2], values[3]


def within(positions: Float64Array, box: DegreeBox) -> BoolArray:
    """Return a mask of the positions (N, 2) in a box, (N,); NaN is in no box."""
    south, west, north, east = box
    latitude, longitude = positions[:, 0], positions[:, 1]
    both = np.logical_and if west <= east else np.logical_or
    return (south <= latitude) & (latitude <= north) & both(west <= longitude, longitude <= east)
