"""Exact search in process, without extras: the result equals that of scanning every float32 vector.

One float32 product of each block of rows bounds the scores of its tiles (`lpn.index.scan`). The rows are the vectors, or their
copies in float16 or int8. Only tiles that may be among the k best are held. They are scored in float64, highest bound first,
until no bound reaches the k-th best score. Ties keep the order of insertion.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array, Int64Array
from lpn.descriptors.store import Precision
from lpn.index.base import DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import Candidates, FolderIndex, IndexManifest, create
from lpn.index.scan import score_bounds
from lpn.index.segments import Segment

# Numbers in a block of rows, whose copy in float32 takes 16 MB.
_BLOCK = 1 << 22
# A scan reads only the searched rows if they are at most 1 / _FEW of a segment, else all rows.
_FEW = 4
_NEXT = 256
# Tiles that are held before those that are not among the k best are looked for.
_HELD = 4096


class ExactIndex(FolderIndex):
    """An index that compares every tile.

    Args:
        folder: folder of the index; any number of processes may open it.
    """

    engine = "exact"

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind, precision: Precision = "float32") -> ExactIndex:
        """Make an empty index, or open an existing one of the same kind.

        Args:
            precision: precision of the scanned copy, which takes 1/2 (float16) or 1/4 (int8) of the vectors' size beside them.
                It is for galleries that exceed the memory: its conversion takes longer than a scan of vectors in memory.

        Raises:
            StoreError: when the folder holds something else, or cannot be written.
        """
        create(Path(folder), IndexManifest(engine=cls.engine, **vars(kind), precision=precision))
        return cls(folder)

    @property
    def exhaustive(self) -> bool:
        """See `Index.exhaustive`."""
        return True

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """See `Index.search`; ties keep the order of insertion."""
        wanted = self.kind.rescaled(query, weights)
        # A power of two changes no digit, and keeps the query within the range of float32.
        exponent = int(np.frexp(np.abs(wanted).max())[1])
        wanted = np.ldexp(wanted, -exponent)
        k, box = check_count(k), check_box(box)
        segments = self._current().segments
        places, upper = self._near(segments, wanted, k, box)
        order = np.argsort(-upper)
        candidates = Candidates.of(segments, places[order[:k]], wanted)
        for start in range(k, len(order), _NEXT):
            some = order[start : start + _NEXT]
            some = some[upper[some] >= candidates.scores.min()]
            if not len(some):
                break
            candidates = candidates.merged_with(Candidates.of(segments, places[some], wanted), k)
        return self._result(segments, Candidates(candidates.places, np.ldexp(candidates.scores, exponent)), k)

    def _finish(self, folder: Path, rows: int) -> None:
        pass

    def _near(
        self, segments: list[Segment], wanted: Float64Array, k: int, box: DegreeBox | None
    ) -> tuple[Int64Array, Float64Array]:
        """Return the places of the searched tiles that may be among the k best, and an upper bound on the score of each."""
        nearest = _Nearest(k)
        size = max(1, _BLOCK // self.kind.numbers)
        start = 0
        for segment in segments:
            rows = segment.chosen(box)
            if rows is not None and len(rows) * _FEW <= segment.rows:
                for i in range(0, len(rows), size):
                    some = rows[i : i + size]
                    nearest.take(start + some, *score_bounds(self.kind, wanted, *segment.compact(some)))
            else:
                for i in range(0, segment.rows, size):
                    lower, upper = score_bounds(self.kind, wanted, *segment.compact(slice(i, i + size)))
                    some = np.arange(i, i + len(upper))
                    if rows is not None:
                        some = rows[slice(*np.searchsorted(rows, (i, i + size)))]
                        lower, upper = lower[some - i], upper[some - i]
                    nearest.take(start + some, lower, upper)
            start += segment.rows
        return nearest.end()


class _Nearest:
    """The tiles that may be among the k best, by the bounds that are known so far.

    A tile is left out when k others have lower bounds above its upper bound. So few tiles of 10^8 are held at a time.
    """

    def __init__(self, k: int) -> None:
        self._k, self._count, self._most = k, 0, _HELD
        # The k-th highest lower bound, which the k-th best score reaches.
        self._least = -np.inf
        none = np.zeros(0)
        self._held: list[tuple[Int64Array, Float64Array, Float64Array]] = [(np.zeros(0, np.int64), none, none)]

    def take(self, places: Int64Array, lower: Float64Array, upper: Float64Array) -> None:
        """Take tiles with the bounds of their scores, (B,) each."""
        near = np.flatnonzero(upper >= self._least)
        self._held.append((places[near], lower[near], upper[near]))
        self._count += len(near)
        if self._count > self._most:
            self._shrink()
            self._most = 2 * self._count + _HELD

    def end(self) -> tuple[Int64Array, Float64Array]:
        """Return the places of the tiles, and their upper bounds."""
        self._shrink()
        places, _, upper = self._held[0]
        return places, upper

    def _shrink(self) -> None:
        places, lower, upper = (np.concatenate(values) for values in zip(*self._held, strict=True))
        if len(lower) >= self._k:
            self._least = np.partition(lower, len(lower) - self._k)[len(lower) - self._k]
        near = upper >= self._least
        self._held, self._count = [(places[near], lower[near], upper[near])], int(near.sum())
