"""An index that compares every tile, in a folder, without extras.

A float32 product finds the tiles that can be among the k best. These are scored in float64. Ties keep the order of insertion.
A product of m numbers in float32, summed in any order after v is rounded, has an error of at most M u / (1 - M u) |v| |g| with
M = m + 2 and u = 2^-24.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.index.base import LONGEST, DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import FolderIndex, IndexManifest, create

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
        state = self._current()
        places, scores = state.scores(range(len(state.parts)), wanted.astype(np.float32), box)
        if len(scores) > k:
            least = float(np.partition(scores, len(scores) - k)[len(scores) - k]) - 2 * rounding_bound(wanted)
            places = places[scores >= np.nextafter(np.float32(least), np.float32(-np.inf))]
        found = self._result(state, places, wanted, k)
        return replace(found, scores=np.ldexp(found.scores, exponent))

    def _with_engine_file(self, manifest: IndexManifest) -> IndexManifest:
        return manifest


def rounding_bound(wanted: Float64Array) -> float:
    """Bound the error of float32 scores of any tiles.

    Args:
        wanted: a rescaled query whose numbers are at most 1, (n D,).
    """
    share = (len(wanted) + 2) * _UNIT
    return 1.001 * share / (1 - share) * float(np.linalg.norm(wanted)) * LONGEST + _ROUNDING
