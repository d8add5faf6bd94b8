"""Exact search in process, without extras: the result equals that of scanning every float32 vector.

A scan gives bounds on each tile's score (`lpn.index.scan`), from the vectors or from a copy of a half or a quarter of their
size, and only tiles that may be among the k best are held. The k tiles with the highest upper bounds are scored first. Then the
tiles whose bound reaches the k-th score get a finer one, and those that still reach it are scored, highest bound first, until no
bound reaches the k-th best score. Ties keep the order of insertion.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.descriptors.store import Precision
from lpn.index.base import DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import Candidates, FolderIndex, IndexManifest, create, gather
from lpn.index.scan import Scan
from lpn.index.segments import Segment

# A scan reads only the searched rows if they are at most 1 / _FEW of a segment, else all rows.
_FEW = 4
_PICKED = 4096
_NEXT = 256
# Tiles that are held before those that are not among the k best are looked for.
_HELD = 4096


class ExactIndex(FolderIndex):
    """An index that compares every tile.

    Args:
        folder: folder of the index; any number of processes may open it.
        threads: number of threads for scans in float16 or int8; by default one for each usable core, 8 at most.
    """

    engine = "exact"

    def __init__(self, folder: str | Path, threads: int | None = None) -> None:
        super().__init__(folder)
        self._scan = Scan(self.kind, self.precision, threads)

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind, precision: Precision = "float32") -> ExactIndex:
        """Make an empty index, or open an existing one of the same kind.

        Args:
            precision: precision of the scanned copy; float16 takes 1/2 and int8 1/4 more disk, for quicker scans.

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
        k, box = check_count(k), check_box(box)
        segments = self._current().segments
        places, bounds = self._near(segments, wanted, k, box)
        k = min(k, len(places))
        if not k:
            return self._result(segments, Candidates(places, bounds), 0)
        order = np.argsort(-bounds)
        candidates = Candidates.of(segments, places[order[:k]], wanted)
        for start in range(k, len(order), _NEXT):
            some = order[start : start + _NEXT]
            least = float(candidates.scores.min())
            if bounds[some[0]] < least:
                break
            near = places[some][self._finer(segments, places[some], wanted) >= least]
            candidates = candidates.merged_with(Candidates.of(segments, near, wanted), k)
        return self._result(segments, candidates, k)

    def close(self) -> None:
        """See `Index.close`."""
        self._scan.close()
        super().close()

    def _finish(self, folder: Path, rows: int) -> None:
        pass

    def _near(
        self, segments: list[Segment], wanted: Float64Array, k: int, box: DegreeBox | None
    ) -> tuple[Int64Array, Float64Array]:
        """Return the places of the searched tiles that may be among the k best, and an upper bound on the score of each."""
        nearest = _Nearest(k)
        start = 0
        for segment in segments:
            rows = segment.chosen(box)
            if rows is not None and len(rows) * _FEW <= segment.rows:
                for i in range(0, len(rows), _PICKED):
                    some = rows[i : i + _PICKED]
                    self._scan.run(wanted, *segment.compact(some), partial(nearest.take, start + some, None))
            else:
                searched = None
                if rows is not None:
                    searched = np.zeros(segment.rows, np.bool_)
                    searched[rows] = True
                self._scan.run(wanted, *segment.compact(), partial(nearest.take, start, searched))
            start += segment.rows
        return nearest.end()

    def _finer(self, segments: list[Segment], places: Int64Array, wanted: Float64Array) -> Float64Array:
        """Return an upper bound on the score of each of few tiles, close enough that few of their vectors are read in vain."""
        if self.precision == "float32":
            return np.full(len(places), np.inf)
        small, scales, errors = (
            gather([getattr(segment, name) for segment in segments], places) for name in ("small", "scales", "errors")
        )
        return self._scan.bounds(wanted, small, scales, errors, finely=True)


class _Nearest:
    """The tiles that may be among the k best, by the bounds that are known so far. Thread-safe.

    A tile is left out when k others have lower bounds above its upper bound. So few tiles of 10^8 are held at a time.
    """

    def __init__(self, k: int) -> None:
        self._k, self._lock, self._count, self._most = k, Lock(), 0, _HELD
        # The k-th highest lower bound, which the k-th best score reaches.
        self._least = -np.inf
        none = np.zeros(0)
        self._held: list[tuple[Int64Array, Float64Array, Float64Array]] = [(np.zeros(0, np.int64), none, none)]

    def take(
        self,
        places: Int64Array | int,
        searched: BoolArray | None,
        block: slice,
        upper: Float64Array,
        slack: Float64Array,
    ) -> None:
        """Take the bounds of a block of rows, see `Scan.run`.

        Args:
            places: of all rows, or of the first of them if they follow each other.
            searched: rows that count, (N,); None for all.
        """
        near = np.flatnonzero(upper >= self._least)
        rows = block.start + near
        if searched is not None:
            near, rows = near[searched[rows]], rows[searched[rows]]
        upper = upper[near]
        found = places + rows if isinstance(places, int) else places[rows], upper, upper - 2 * slack[near]
        with self._lock:
            self._held.append(found)
            self._count += len(near)
            if self._count > self._most:
                self._shrink()
                self._most = 2 * self._count + _HELD

    def end(self) -> tuple[Int64Array, Float64Array]:
        """Return the places of the tiles, and their upper bounds."""
        self._shrink()
        return self._held[0][:2]

    def _shrink(self) -> None:
        places, upper, lower = (np.concatenate(values) for values in zip(*self._held, strict=True))
        if len(lower) >= self._k:
            self._least = np.partition(lower, len(lower) - self._k)[len(lower) - self._k]
        near = upper >= self._least
        self._held, self._count = [(places[near], upper[near], lower[near])], int(near.sum())
