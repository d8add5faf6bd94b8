"""The windows of a map that an index holds, so that they need not be described again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.descriptors.parallel_inference import describe_each
from lpn.index import open_index
from lpn.maps import Map, NamedWindow, Window
from lpn.maps.named_window import WindowCut
from lpn.models.base import Model, normalise

# Number of windows that are described again, and the least cosine of each with its descriptor in the index. Other ground stays
# below it. Quantized descriptors, positions rounded to a centimetre, and another execution provider stay above it.
_CHECKED = 4
_ALIKE = 0.95
# Windows by which the overlap is measured.
_SAMPLE = 100


@dataclass(frozen=True, eq=False)
class IndexedWindows:
    """Windows of a map and their descriptors.

    Attributes:
        windows: of the map, north up.
        descriptors: (W, n, D) float32.
    """

    windows: list[Window]
    descriptors: Float32Array

    @property
    def overlap(self) -> float:
        """The median share of a window's side that its nearest neighbour of the same size covers, 0 .. 1; 0 without one."""
        places = np.array([(window.x, window.y) for window in self.windows])
        sizes = np.array([window.size for window in self.windows])
        steps = []
        for i in np.linspace(0, len(sizes) - 1, min(len(sizes), _SAMPLE)).astype(np.int64):
            apart = np.linalg.norm(places[sizes == sizes[i]] - places[i], axis=1)
            steps.append(apart[apart > 0].min(initial=sizes[i]) / sizes[i])
        return 1 - float(np.median(steps))


def indexed_windows(where: str, model: Model, basemap: Map) -> IndexedWindows:
    """Return all windows of an index, after some of them were described again and found alike.

    Args:
        where: the index's folder, or milvus://host:port/collection.

    Raises:
        StoreError: if there is no index, or it holds descriptors of another model.
        InputError: if the index is empty, holds other tiles than north-up windows of this map, or is too large for one search.
    """
    with open_index(where, model.fingerprint) as index:
        count = index.count()
        if not count:
            raise InputError(
                "The index holds no window; fill it with lpn describe --map and lpn index, or leave --index out."
            )
        probe = normalise(np.ones((1, model.n_parts, model.embedding), np.float32))[0]
        tiles = index.search(probe, None, min(count, index.most or count))
    if len(tiles) < count:
        raise InputError(
            f"A search of the index returns {len(tiles)} of its {count} windows, and lpn locate needs all of them; make an "
            "index with --engine exact, or leave --index out."
        )
    named = [NamedWindow.parse(name) for name in tiles.ids]
    if (i := next((i for i, one in enumerate(named) if one is None or one.heading), None)) is not None:
        raise InputError(
            f"The index holds {printable(tiles.ids[i])[:80]}, which is no window with its top to the north; make it by lpn "
            "describe --map."
        )
    windows = [one.on(basemap.frame) for one in named if one is not None]
    side, least = max(model.input_size), 1.0
    some = sorted({round(i) for i in np.linspace(0, count - 1, _CHECKED)})
    cuts = [WindowCut(basemap, windows[i], side) for i in some]
    for batch in describe_each(model, cuts, lambda cut: model.prepare(cut(), "satellite"), "satellite"):
        for _, error in batch.broken:
            raise error
        cosines = (batch.descriptors * tiles.vectors[[some[i] for i in batch.items]]).sum(axis=(1, 2))
        least = min(least, float(cosines.min(initial=1.0)))
    if least < _ALIKE:
        raise InputError(
            f"Windows of {printable(basemap.name)} that were described again have a cosine of {least:.2f} with those of the "
            f"index, and {_ALIKE:.2f} is expected; it is of another map, or the map has changed: make the index again."
        )
    return IndexedWindows(windows, tiles.vectors.astype(np.float32, copy=False))
