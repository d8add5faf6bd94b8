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


class IndexGallery(Sequence[Picture]):
    """Tiles that somebody has seen, in the order in which they were first seen; thread-safe.

    It only grows, so that a gallery position stays valid: those of an index of 10^7 tiles would not fit. A tile takes about
    0.5 kB; its descriptor stays in the index.

    Args:
        make_picture: called once for each tile.

    Attributes:
        version: changes with every tile and position that is added.
    """

    def __init__(self, make_picture: MakePicture) -> None:
        self._make_picture, self._lock = make_picture, threading.RLock()
        self._names: list[str] = []
        self._pictures: list[Picture] = []
        self._degrees: list[tuple[float, float]] = []
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
        given = np.full((len(names), 2), np.nan) if degrees is None else degrees
        with self._lock:
            places = []
            for name, (latitude, longitude) in zip(names, given.tolist(), strict=True):
                place = self._places.get(name)
                if place is None:
                    place = len(self._pictures)
                    self._pictures.append(self._make_picture(name, place))
                    self._names.append(name)
                    self._degrees.append((latitude, longitude))
                    self._places[name] = place
                    self.version += 1
                elif latitude == latitude and self._degrees[place] != (latitude, longitude):
                    self._degrees[place] = latitude, longitude
                    self.version += 1
                places.append(place)
        return np.array(places, np.int64)

    def find(self, name: str) -> int | None:
        """Return the gallery position of a tile; None if nobody has seen it yet."""
        return self._places.get(name)

    def name_of(self, place: int) -> str:
        """Return a tile's name in the index."""
        return self._names[place]

    def labels(self) -> Int64Array:
        """Return the label of each tile, (G,)."""
        return np.array([picture.label for picture in list(self._pictures)], np.int64)

    def degrees(self) -> Float64Array:
        """Return latitude and longitude of each tile, (G, 2), NaN where unknown."""
        return np.array(list(self._degrees), np.float64).reshape(-1, 2)
