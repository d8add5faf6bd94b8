"""Exact search in process, without extras: the k best of all tiles by their scores in float64.

One float32 product of each block of rows finds the tiles that may be among the k best: all within twice the rounding of that
product of the k-th highest. They are scored in float64. Ties keep the order of insertion.

A product of m numbers in float32, summed in any order after v is rounded, has an error of at most M u / (1 - M u) |v| |g| with
M = m + 2 and u = 2^-24.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.index.base import LONGEST, DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import FolderIndex, IndexManifest, create
from lpn.index.segments import Segment

# Numbers in a block of rows, which takes 16 MB.
_BLOCK = 1 << 22
# A scan reads only the searched rows if they are at most 1 / _FEW of a segment, else all rows.
_FEW = 4
# Tiles that are held before those that are not among the k best are looked for.
_HELD = 4096
_UNIT = 2.0**-24
# Exceeds the rounding of a score in float64, for a query whose numbers are at most 1.
_ROUNDING = 1e-12


class ExactIndex(FolderIndex):
    """An index that compares every tile.

    Args:
        folder: folder of the index; any number of processes may open it.
    """

    engine = "exact"

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind) -> ExactIndex:
        """Make an empty index, or open an existing one of the same kind.

        Raises:
            StoreError: when the folder holds something else, or cannot be written.
        """
        create(Path(folder), IndexManifest(engine=cls.engine, **vars(kind)))
        return cls(folder)

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
        found = self._result(segments, self._near(segments, wanted, k, box), wanted, k)
        return replace(found, scores=np.ldexp(found.scores, exponent))

    def _finish(self, folder: Path, rows: int) -> None:
        pass

    def _near(self, segments: list[Segment], wanted: Float64Array, k: int, box: DegreeBox | None) -> Int64Array:
        """Return the places of the searched tiles that may be among the k best, holding few others at a time."""
        slack = 2 * rounding_bound(wanted)
        held, count, most = [(np.zeros(0, np.int64), np.zeros(0))], 0, _HELD
        least = -np.inf
        for places, scores in self._scored(segments, wanted.astype(np.float32), box):
            near = np.flatnonzero(scores >= least)
            held.append((places[near], scores[near]))
            count += len(near)
            if count > most:
                held, least = _among_best(held, k, slack)
                count = len(held[0][0])
                most = 2 * count + _HELD
        return _among_best(held, k, slack)[0][0][0]

    def _scored(
        self, segments: list[Segment], asked: Float32Array, box: DegreeBox | None
    ) -> Iterator[tuple[Int64Array, Float64Array]]:
        """Yield the places of the searched tiles and their float32 scores, in blocks."""
        size = max(1, _BLOCK // self.kind.numbers)
        start = 0
        for segment in segments:
            rows = segment.chosen(box)
            if rows is not None and len(rows) * _FEW <= segment.rows:
                for i in range(0, len(rows), size):
                    some = rows[i : i + size]
                    yield start + some, (segment.in_order[some] @ asked).astype(np.float64)
            else:
                for i in range(0, segment.rows, size):
                    scores = (segment.in_order[i : i + size] @ asked).astype(np.float64)
                    some = np.arange(i, i + len(scores))
                    if rows is not None:
                        some = rows[slice(*np.searchsorted(rows, (i, i + size)))]
                    yield start + some, scores[some - i]
            start += segment.rows


def rounding_bound(wanted: Float64Array) -> float:
    """Bound the error of float32 scores of any tiles.

    Args:
        wanted: a rescaled query whose numbers are at most 1, (n D,).
    """
    share = (len(wanted) + 2) * _UNIT
    return 1.001 * share / (1 - share) * float(np.linalg.norm(wanted)) * LONGEST + _ROUNDING


def _among_best(
    held: list[tuple[Int64Array, Float64Array]], k: int, slack: float
) -> tuple[list[tuple[Int64Array, Float64Array]], float]:
    """Return the tiles whose scores are at most `slack` below the k-th best, as one pair, and the lowest such score."""
    places, scores = (np.concatenate(values) for values in zip(*held, strict=True))
    least = np.partition(scores, len(scores) - k)[len(scores) - k] - slack if len(scores) >= k else -np.inf
    near = scores >= least
    return [(places[near], scores[near])], least
