"""Exact search in process, without extras: the result equals that of scanning every float32 vector.

A scan gives an upper bound on each tile's score (`lpn.index.scan`), from the vectors or from a copy of a half or a quarter of
their size. The k tiles with the highest bounds are scored first. Then the tiles whose bound reaches the k-th score are
scored, highest bound first, until no bound reaches the k-th best score. Ties keep the order of insertion.
"""

from __future__ import annotations

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
        k = min(k, len(places))
        if not k:
            return self._result(segments, Candidates(places, bounds), 0)
        first = np.argpartition(bounds, len(bounds) - k)[len(bounds) - k :]
        candidates = Candidates.of(segments, places[first], wanted)
        least = float(candidates.scores.min())
        bounds[first] = -np.inf
        rest = np.flatnonzero(bounds >= least)
        rest = rest[np.argsort(-bounds[rest])]
        for start in range(0, len(rest), _NEXT):
            some = rest[start : start + _NEXT]
            if bounds[some[0]] < least:
                break
            candidates = candidates.merged_with(Candidates.of(segments, places[some], wanted), k)
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
    ) -> tuple[Int64Array, Float64Array]:
        """Return the places of the searched tiles, and an upper bound on the score of each."""
        places: list[Int64Array] = []
        bounds: list[Float64Array] = []
        start = 0
        for segment in segments:
            rows = segment.chosen(box)
            if rows is None:
                places.append(np.arange(start, start + segment.rows))
                bounds.append(self._scan.bounds(wanted, segment.small, segment.scales, segment.errors))
            elif len(rows) * _FEW <= segment.rows:
                places.append(rows + start)
                bounds += (self._picked(segment, rows[i : i + _PICKED], wanted) for i in range(0, len(rows), _PICKED))
            else:
                places.append(rows + start)
                bounds.append(self._scan.bounds(wanted, segment.small, segment.scales, segment.errors)[rows])
            start += segment.rows
        return np.concatenate([np.zeros(0, np.int64), *places]), np.concatenate([np.zeros(0), *bounds])

    def _picked(self, segment: Segment, rows: Int64Array, wanted: Float64Array) -> Float64Array:
        scales = None if segment.scales is None else segment.scales[rows]
        errors = None if segment.errors is None else segment.errors[rows]
        return self._scan.bounds(wanted, segment.small[rows], scales, errors)
