"""Windows of a map that an index has described.

The index names its windows and its map (`lpn index --map`). It may hold each window at several headings (`--turns 8`). A photo of
unknown heading is then described once, and compared with windows at each heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.index import Index, WindowsRecord, open_index
from lpn.models.base import Model

# Most windows that are all compared with each frame: 400 MB with 4 parts of 512 numbers.
MOST = 50_000
# For a larger index: most compared windows for each description of a frame, and fewest for a flight of many frames.
NEAREST, _FEWEST = 500, 20


class WindowIndex:
    """An index of a map's windows, as the source of a flight's candidates.

    Up to 50,000 windows are all candidates. Of more, the 500 nearest to each description of a frame are, so that 10^7 windows
    need one search for each description and bounded memory.

    Args:
        where: the index's folder, or milvus://host:port/collection.

    Attributes:
        sizes: sides of its windows in metres, ascending.
        turns: headings of each window in degrees, from 0 on.
        overlap: share of a window's side that its neighbour also covers.

    Raises:
        StoreError: if there is no index, or it holds descriptors of another model.
        InputError: if it is empty, or holds other tiles than windows of this map.
    """

    def __init__(self, where: str, model: Model, basemap: Map) -> None:
        self._where, self._model, self._map = where, model, basemap
        with open_index(where, model.fingerprint) as index:
            record, self._held = recorded_windows(index, basemap), index.count()
        if not self._held:
            raise InputError("The index holds no window; fill it with lpn index --map, or leave --index out.")
        self._record = record
        self.sizes, self.overlap = list(record.sizes), record.overlap
        self.turns = [360 / record.turns * k for k in range(record.turns)]

    def near(self, described: Float32Array) -> tuple[list[Window], Float32Array, list[str]]:
        """Return the windows to compare with frames.

        Args:
            described: descriptions of frames, (Q, n, D); zeros are ignored.

        Returns:
            The windows, north up; their descriptors at each of `turns`, (T, W, n, D) float32; and sentences about the choice.

        Raises:
            InputError: if no frame is described, and not all windows are candidates.
        """
        notes: list[str] = []
        whole = self._record.count * self._record.turns
        with open_index(self._where, self._model.fingerprint) as index:
            if whole <= MOST:
                windows = self._map.pyramid(self.sizes, self.overlap)
                names = self._names(NamedWindow.all_of(windows, self._map.frame))
                held = index.holds([name for turned in names for name in turned]).reshape(len(names), -1).all(axis=1)
                chosen = [names[i] for i in np.flatnonzero(held).tolist()]
            else:
                chosen = self._names(self._nearest(index, described))
                notes.append(
                    f"The index holds {self._held:,} windows; photos were compared with the {len(chosen) * len(self.turns):,} of "
                    "them that are nearest to one."
                )
            if not chosen:
                raise InputError(
                    "The index holds no window at all of its headings; let lpn index --map go on to its end."
                )
            vectors = index.read([name for turned in zip(*chosen, strict=True) for name in turned])[0]
        if self._held < whole:
            notes.append(
                f"The index holds {self._held:,} of {whole:,} windows of the map, and no photo is found where it holds none; let "
                "lpn index --map go on to its end."
            )
        upright = [one for turned in chosen if (one := NamedWindow.parse(turned[0])) is not None]
        shape = len(self.turns), len(chosen), *vectors.shape[1:]
        return (
            NamedWindow.all_on(upright, self._map.frame),
            vectors.astype(np.float32, copy=False).reshape(shape),
            notes,
        )

    def _names(self, upright: Sequence[NamedWindow]) -> list[list[str]]:
        """Return the names of windows at each turn, as `NamedWindow.all_of` rounds their headings."""
        return [[replace(one, heading=round(turn, 2)).name for turn in self.turns] for one in upright]

    def _nearest(self, index: Index, described: Float32Array) -> list[NamedWindow]:
        """Return the windows nearest to descriptions, north up and without repeats, that have all turns in the index."""
        asked = described[np.abs(described).sum(axis=(1, 2)) > 0]
        if not len(asked):
            raise InputError(
                "No photo of the flight can be read, so no window of the index can be near one; check the photos."
            )
        wanted = min(NEAREST, max(_FEWEST, MOST // len(asked)), self._held, index.most or NEAREST)
        found = dict.fromkeys(name for one in asked for name in index.search(one, None, wanted).ids)
        named = [one for name in found if (one := NamedWindow.parse(name)) is not None]
        upright = list(dict.fromkeys(replace(one, heading=0.0) for one in named))
        names = self._names(upright)
        held = index.holds([name for turned in names for name in turned]).reshape(len(names), -1).all(axis=1)
        return [upright[i] for i in np.flatnonzero(held).tolist()]


def recorded_windows(index: Index, basemap: Map) -> WindowsRecord:
    """Return the record of an index's windows.

    Raises:
        InputError: if it was made for other tiles, or for another map.
    """
    record = index.kind.windows
    if record is None:
        raise InputError("The index does not say which windows of which map it holds; make it with lpn index --map.")
    if record.map != basemap.identity():
        raise InputError(
            f"The index holds windows of another map than {printable(basemap.name)}, or the map changed; make the index again."
        )
    return record
