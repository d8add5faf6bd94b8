"""What every index of tiles can do, and the arithmetic that all of them share.

With parts q_i, g_i of norm 1/sqrt(n) and weights w_i that sum to one, the score of a tile is

    score = sum_i w_i cos_i = sum_i (w_i n q_i) . g_i,

one inner product of the tile's descriptor with a rescaled query, so that one index serves all weights. Whatever an engine
finds, the scores are computed anew from the vectors that it gives back, in float64 and each tile's alike wherever it lies:
equal tiles have equal scores, and an engine's own rounding changes none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray, Int64Array
from lpn.core.errors import InputError, StoreError
from lpn.core.files import printable
from lpn.retrieval import scoring

Box = tuple[float, float, float, float]
"""South, west, north, east in degrees; west beyond east is across the antimeridian."""

ID_LENGTH = 512
"""Characters of a tile's name at most."""
LONGEST = 1.01
"""A part's norm is at most this, divided by sqrt(n): float16 stores round it."""
_ROWS = 256


@dataclass(frozen=True)
class Kind:
    """What descriptors an index holds.

    Attributes:
        fingerprint: of the model that made them; those of another cannot be compared with them.
        n_parts, embedding: n and D.
    """

    fingerprint: str
    n_parts: int
    embedding: int

    @property
    def numbers(self) -> int:
        """Of one descriptor, n D."""
        return self.n_parts * self.embedding

    def rescaled(self, query: npt.ArrayLike, weights: npt.ArrayLike | None) -> Float64Array:
        """The vector w_i n q_i whose inner product with a descriptor is its score: (n D,) float64.

        Raises:
            InputError: when the query is not (n, D) finite numbers, or the weights are not n of 0 or more.
        """
        values = np.asarray(query, dtype=np.float64)
        if values.shape != (self.n_parts, self.embedding) or not np.isfinite(values).all():
            raise InputError(
                f"The query is of shape {values.shape}; expected {self.n_parts} parts of {self.embedding} finite numbers."
            )
        share = scoring.part_weights(self.n_parts, weights).astype(np.float64)
        return (share[:, None] * self.n_parts * values).reshape(-1)

    def checked(self, descriptors: npt.ArrayLike) -> Float32Array:
        """Descriptors as they are added, (B, n D) float32.

        Raises:
            InputError: when they are not (B, n, D), finite, with parts of norm 1/sqrt(n), or 0 where a part is of nothing.
        """
        values = np.ascontiguousarray(descriptors, dtype=np.float32)
        if values.ndim != 3 or values.shape[1:] != (self.n_parts, self.embedding):
            raise InputError(
                f"The descriptors are of shape {values.shape}; this index takes (B, {self.n_parts}, {self.embedding})."
            )
        norms = np.linalg.norm(values, axis=2) * self.n_parts**0.5
        good = np.isfinite(norms) & ((norms == 0) | (abs(norms - 1) <= LONGEST - 1))
        if not good.all():
            row, part = np.argwhere(~good)[0]
            raise InputError(
                f"Part {part + 1} of descriptor {row + 1} has norm {norms[row, part] / self.n_parts**0.5:g}; expected "
                f"{self.n_parts**-0.5:g}, as lpn.models.base.normalise makes it."
            )
        return values.reshape(len(values), self.numbers)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The k nearest tiles, nearest first.

    Attributes:
        ids: their names.
        scores: weighted mean cosines, (k,) float64.
        vectors: their descriptors, (k, n, D) float32, from which contributions and evidence are computed.
        positions: latitude and longitude in degrees, (k, 2) float64, NaN where a tile has none.
    """

    ids: list[str]
    scores: Float64Array
    vectors: Float32Array
    positions: Float64Array

    def __len__(self) -> int:
        return len(self.ids)


class Index(ABC):
    """Tiles by name, searched by descriptor under any part weights.

    Attributes:
        kind: what descriptors it holds.
        most: tiles that a search can ask for; None: any number.
    """

    kind: Kind
    most: int | None = None

    @abstractmethod
    def add(
        self,
        ids: Sequence[str],
        descriptors: npt.ArrayLike,
        positions: Sequence[Sequence[float]] | Float64Array | None = None,
    ) -> None:
        """Add tiles; one that is there already is replaced, so that an add may be repeated.

        Args:
            ids: a name for each tile, 1 to 512 characters, none twice.
            descriptors: (B, n, D) float32 with parts of norm 1/sqrt(n).
            positions: latitude and longitude in degrees, (B, 2), NaN for a tile that has none; None: none has.

        Raises:
            InputError: when they are not so.
            StoreError: when they cannot be kept.
        """

    @abstractmethod
    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: Box | None = None
    ) -> SearchResult:
        """The k tiles of the highest score, or all where there are fewer.

        Args:
            query: (n, D).
            weights: part weights of 0 or more, (n,), which are brought to sum to one; None for equal ones.
            box: only tiles in it are searched, borders included; a tile without a position is in none.

        Raises:
            InputError: when one of them is not as expected.
            StoreError: when the index cannot be read.
        """

    @abstractmethod
    def holds(self, ids: Sequence[str]) -> BoolArray:
        """Which names are there, (B,)."""

    @abstractmethod
    def count(self) -> int:
        """How many tiles there are."""

    @abstractmethod
    def close(self) -> None:
        """Let go of files, threads, and connections."""

    def check_model(self, fingerprint: str) -> None:
        """Raise StoreError unless the descriptors are of this model."""
        if fingerprint != self.kind.fingerprint:
            raise StoreError(
                f"This index holds descriptors of model {self.kind.fingerprint}, and this model is {fingerprint}; search with "
                "that model, or make an index of this one's descriptors."
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def scores_of(vectors: FloatingArray, wanted: Float64Array) -> Float64Array:
    """Scores of vectors (B, n D) under a rescaled query (n D,): (B,) float64.

    Each row is summed by itself and in the same order: a matrix product would sum a row by where it lies in a block.
    """
    found = np.empty(len(vectors))
    for start in range(0, len(vectors), _ROWS):
        found[start : start + _ROWS] = (vectors[start : start + _ROWS] * wanted).sum(axis=1)
    return found


def best(scores: Float64Array, order: Int64Array, k: int) -> Int64Array:
    """Positions of the k highest scores; of equal ones, those of the lower `order` first."""
    return np.lexsort((order, -scores))[:k]


def check_names(ids: Sequence[str], rows: int) -> list[str]:
    """The names of tiles to add, `rows` of them; InputError when one cannot be a name, or is there twice."""
    if isinstance(ids, str) or len(ids) != rows:
        raise InputError(f"There are {len(ids)} names for {rows} descriptors; give each tile one.")
    for name in ids:
        if not isinstance(name, str) or not 0 < len(name) <= ID_LENGTH or "\0" in name:
            shown = printable(str(name))[:40] or "empty"
            raise InputError(f"A tile's name is {shown!r}; expected text of 1 to {ID_LENGTH} characters.")
        try:
            name.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"The tile's name {printable(name)[:40]!r} is not UTF-8; rename its file.") from error
    seen: set[str] = set()
    for name in ids:
        if name in seen:
            raise InputError(f"The tile {printable(name)} is given twice; give each tile once.")
        seen.add(name)
    return list(ids)


def check_positions(positions: Sequence[Sequence[float]] | Float64Array | None, rows: int) -> Float64Array:
    """Positions of tiles to add, (rows, 2), NaN where there is none; InputError when one is not on the globe."""
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


def check_count(k: int, what: str = "number of tiles asked for") -> int:
    """A number of tiles asked for, or of something else; InputError unless it is a whole number of 1 or more."""
    if not isinstance(k, (int, float, np.integer, np.floating)) or not k >= 1 or k % 1:
        raise InputError(f"The {what} is {k}; expected 1 or more.")
    return int(k)


def check_box(box: Sequence[float] | None) -> Box | None:
    """A box as it is searched; InputError unless it is south, west, north, east in degrees with south up to north."""
    if box is None:
        return None
    values = [float(value) for value in box]
    good = (
        len(values) == 4 and -90 <= values[0] <= values[2] <= 90 and all(abs(v) <= 180 for v in (values[1], values[3]))
    )
    if not good:
        raise InputError(
            f"The box is {', '.join(f'{value:g}' for value in values)}; expected south, west, north, and east in degrees, "
            "south not above north (west beyond east is across the antimeridian)."
        )
    return values[0], values[1], values[2], values[3]


def overlaps(extent: Box, box: Box) -> bool:
    """Whether a smallest box of positions, which is not across the antimeridian, meets a box; False where it is of NaN."""
    south, west, north, east = box
    both = [extent[3] >= west, extent[1] <= east]
    return extent[2] >= south and extent[0] <= north and (all(both) if west <= east else any(both))


def covers(box: Box, extent: Box) -> bool:
    """Whether a smallest box of positions, as for `overlaps`, lies in a box."""
    south, west, north, east = box
    both = [west <= extent[1], extent[3] <= east]
    return south <= extent[0] and extent[2] <= north and (all(both) if west <= east else any(both))


def within(positions: Float64Array, box: Box) -> BoolArray:
    """Which positions (N, 2) are in a box, (N,); a tile without one is in none."""
    south, west, north, east = box
    latitude, longitude = positions[:, 0], positions[:, 1]
    both = np.logical_and if west <= east else np.logical_or
    return (south <= latitude) & (latitude <= north) & both(west <= longitude, longitude <= east)
