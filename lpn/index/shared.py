"""One open index that several threads search, one at a time; people before background work."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array
from lpn.index.base import DegreeBox, Index, SearchResult

T = TypeVar("T")


class SharedIndex:
    """An index for several threads; its engines use all cores for one search.

    Attributes:
        index: the index; use it through this object only.
        tiles: its number of tiles when it was opened.
    """

    def __init__(self, index: Index) -> None:
        self.index = index
        self.tiles = index.count()
        self._free, self._busy, self._urgent = threading.Condition(), False, 0

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, background: bool = False
    ) -> SearchResult:
        """See `Index.search`; a background search waits for all others."""
        most = self.index.most
        return self._run(lambda: self.index.search(query, weights, k if most is None else min(k, most)), not background)

    def extent(self) -> DegreeBox | None:
        """See `Index.extent`."""
        return self._run(self.index.extent)

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """See `Index.read`."""
        return self._run(lambda: self.index.read(ids))

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        return self._run(lambda: self.index.holds(ids))

    def close(self) -> None:
        """Close the index when the search in progress is done."""
        self._run(self.index.close)

    def _run(self, task: Callable[[], T], urgent: bool = True) -> T:
        with self._free:
            self._urgent += urgent
            try:
                self._free.wait_for(lambda: not self._busy and (urgent or not self._urgent))
            finally:
                self._urgent -= urgent
            self._busy = True
        try:
            return task()
        finally:
            with self._free:
                self._busy = False
                self._free.notify_all()
