"""Exact search in process, without extras: the result equals that of scanning every float32 vector.

A scan gives an upper bound on each tile's score (`lpn.index.scan`), from the vectors or from a copy of a half or a quarter of
their size. The k tiles with the highest bounds are scored first. Then the tiles whose bound reaches the k-th score are
scored, highest bound first, until no bound reaches the k-th best score. Ties keep the order of insertion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array, Int64Array
from lpn.descriptors.store import Precision
from lpn.index.base import DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import Candidates, FolderIndex, IndexManifest, create
from lpn.index.scan import Scan
from lpn.index.segments import Segment

# A scan reads only the searched rows if they are at most 1 / _FEW of a segment, else all rows.
_FEW = 4
_PICKED = 4096
_NEXT = 256
# Bounds of which the largest one stands for all when the k highest are looked for.
_GROUP = 512


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
        places, bounds = self._bounds(segments, wanted, box)
        k = min(k, len(bounds))
        if not k:
            return self._result(segments, Candidates(np.zeros(0, np.int64), bounds), 0)
        first = highest(bounds, k)
        candidates = Candidates.of(segments, places.of(first), wanted)
        least = float(candidates.scores.min())
        bounds[first] = -np.inf
        rest = np.flatnonzero(bounds >= least)
        rest = rest[np.argsort(-bounds[rest])]
        for start in range(0, len(rest), _NEXT):
            some = rest[start : start + _NEXT]
            if bounds[some[0]] < least:
                break
            candidates = candidates.merged_with(Candidates.of(segments, places.of(some), wanted), k)
            least = float(candidates.scores.min())
        return self._result(segments, candidates, k)

    def close(self) -> None:
        """See `Index.close`."""
        self._scan.close()
        super().close()

    def _finish(self, folder: Path, rows: int) -> None:
        pass

    def _bounds(
        self, segments: list[Segment], wanted: Float64Array, box: DegreeBox | None
    ) -> tuple[_SearchedPlaces, Float64Array]:
        """Return the places of the searched tiles, and an upper bound on the score of each."""
        searched: list[tuple[int, Int64Array | None]] = []
        bounds: list[Float64Array] = []
        counts: list[int] = []
        start = 0
        for segment in segments:
            rows = segment.chosen(box)
            if rows is not None and len(rows) * _FEW <= segment.rows:
                some = (self._picked(segment, rows[i : i + _PICKED], wanted) for i in range(0, len(rows), _PICKED))
                bounds.append(np.concatenate([np.zeros(0), *some]))
            else:
                every = self._scan.bounds(wanted, segment.small, segment.scales, segment.errors)
                bounds.append(every if rows is None else every[rows])
            searched.append((start, rows))
            counts.append(len(bounds[-1]))
            start += segment.rows
        return _SearchedPlaces(searched, counts), np.concatenate([np.zeros(0), *bounds])

    def _picked(self, segment: Segment, rows: Int64Array, wanted: Float64Array) -> Float64Array:
        scales = None if segment.scales is None else segment.scales[rows]
        errors = None if segment.errors is None else segment.errors[rows]
        return self._scan.bounds(wanted, segment.small[rows], scales, errors)


class _SearchedPlaces:
    """The places of searched tiles among the rows of all segments, made for those that are asked for: there may be 10^8.

    Args:
        searched: of each segment, the place of its first row, and its searched rows; None for all.
        counts: number of searched rows of each segment.
    """

    def __init__(self, searched: Sequence[tuple[int, Int64Array | None]], counts: Sequence[int]) -> None:
        self._searched, self._starts = searched, np.cumsum([0, *counts])

    def of(self, positions: Int64Array) -> Int64Array:
        """Return the places of some searched tiles by their positions, (P,)."""
        owners = np.searchsorted(self._starts, positions, "right") - 1
        places: Int64Array = positions - self._starts[owners]
        for owner in np.unique(owners).tolist():
            start, rows = self._searched[owner]
            mine = owners == owner
            places[mine] = start + (places[mine] if rows is None else rows[places[mine]])
        return places


def highest(values: Float64Array, k: int) -> Int64Array:
    """Return the positions of the k highest of values (N,), in no order.

    The k-th highest of the largest values of groups is at most the k-th highest of all, so values below it are left out: two
    quick passes in place of a partition of all.
    """
    groups = len(values) // _GROUP
    if groups <= k:
        return np.argpartition(values, len(values) - k)[len(values) - k :]
    largest = values[: groups * _GROUP].reshape(groups, _GROUP).max(axis=1)
    some = np.flatnonzero(values >= np.partition(largest, groups - k)[groups - k])
    return some[np.argpartition(values[some], len(some) - k)[len(some) - k :]]
