"""The tiles of an index that searches have returned, as the gallery of a task."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.datasets import Picture

# Returns the picture of a tile, given its name in the index and its gallery position.
MakePicture = Callable[[str, int], Picture]
_SPARE = 256


class IndexGallery(Sequence[Picture]):
    """Tiles that somebody has seen, in the order in which they were first seen; thread-safe.

    It only grows, so that a gallery position stays valid. A tile takes about 1 kB; its descriptor stays in the index.

    Args:
        make_picture: called once for each tile.

    Attributes:
        version: changes with every tile and position that is added.
    """

    def __init__(self, make_picture: MakePicture) -> None:
        self._make_picture, self._lock = make_picture, threading.RLock()
        self._names: list[str] = []
        self._pictures: list[Picture] = []
        # Rows beyond the number of tiles are spare.
        self._labels, self._degrees = np.zeros(_SPARE, np.int64), np.zeros((_SPARE, 2))
        self._places: dict[str, int] = {}
        self.version = 0

    def __len__(self) -> int:
        return len(self._pictures)

    def __getitem__(self, place: Any) -> Any:
        return self._pictures[place]

    def add(self, names: Sequence[str], degrees: Float64Array | None = None) -> Int64Array:
        """Return the gallery position of each tile, (B,); tiles that are not there yet are appended.

        Args:
            names: the tiles' names in the index.
            degrees: latitude and longitude, (B, 2), NaN where unknown; None if they are not known yet.
        """
        positions = np.full((len(names), 2), np.nan) if degrees is None else degrees
        with self._lock:
            places = []
            for name, position in zip(names, positions, strict=True):
                place = self._places.get(name)
                if place is None:
                    place = self._append(name)
                elif np.isnan(position).any() or (self._degrees[place] == position).all():
                    places.append(place)
                    continue
                self._degrees[place] = position
                self.version += 1
                places.append(place)
        return np.array(places, np.int64)

    def find(self, name: str) -> int | None:
        """Return the gallery position of a tile; None if nobody has seen it yet."""
        return self._places.get(name)

    def name_of(self, place: int) -> str:
        """Return a tile's name in the index."""
        return self._names[place]

    def degrees_of(self, place: int) -> Float64Array:
        """Return a tile's latitude and longitude, (2,), NaN where unknown."""
        with self._lock:
            degrees: Float64Array = self._degrees[place].copy()
        return degrees

    def labels(self) -> Int64Array:
        """Return the label of each tile, (G,)."""
        with self._lock:
            return self._labels[: len(self)].copy()

    def degrees(self) -> Float64Array:
        """Return latitude and longitude of each tile, (G, 2), NaN where unknown."""
        with self._lock:
            return self._degrees[: len(self)].copy()

    def _append(self, name: str) -> int:
        place = len(self._pictures)
        if place == len(self._labels):
            self._labels = np.concatenate([self._labels, np.zeros_like(self._labels)])
            self._degrees = np.concatenate([self._degrees, np.zeros_like(self._degrees)])
        picture = self._make_picture(name, place)
        self._labels[place] = picture.label
        self._names.append(name)
        self._places[name] = place
        self._pictures.append(picture)  # last, as it gives the length
        return place
