"""The tiles of an index as the gallery of a task: all of them, or those of a large index that its engine proposes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.errors import InputError
from lpn.core.progress import report_progress
from lpn.datasets import geo
from lpn.flight.maps import NamedWindow
from lpn.index.base import Index
from lpn.index.queries import IndexQueries

# Largest number of tiles that are ranked for a query. Their descriptors of 2048 numbers take 1.6 GB.
MOST_TILES = 200_000
# Number of tiles that an engine proposes for each query.
PROPOSED = 100


@dataclass(frozen=True, eq=False)
class IndexGallery:
    """Tiles of an index.

    Attributes:
        names: in the index.
        descriptors: (G, n, D); those of a folder of one part stay on disk.
        degrees: latitude and longitude, (G, 2), NaN for a tile without a position.
        chosen: how the tiles were chosen from a larger index, in words; empty for all tiles.
    """

    names: list[str]
    descriptors: Float32Array
    degrees: Float64Array
    chosen: str = ""

    @cached_property
    def windows(self) -> list[NamedWindow | None]:
        """The window of a map that each name tells; None for other tiles."""
        return list(map(NamedWindow.parse, self.names))

    @property
    def sizes(self) -> Float64Array:
        """Sides of the windows in metres, (G,), NaN for other tiles."""
        return np.array([np.nan if window is None else window.size for window in self.windows], np.float64)


def open_gallery(index: Index, queries: IndexQueries) -> IndexGallery:
    """Read all tiles of an index, or, of one that is large or does not list its tiles, those that matter to some queries.

    These are the tiles that the engine proposes for each query, and the true ones. Their ranks are those among all tiles
    down to the last proposed one, as far as the engine misses none.

    Raises:
        InputError: if the index holds no tiles, or too many are proposed.
        StoreError: if the index cannot be read.
    """
    count = index.count()
    if not count:
        raise InputError("The index holds no tiles; add some with lpn index.")
    if count <= MOST_TILES and (tiles := index.tiles()) is not None:
        return IndexGallery(*tiles)
    total = len(queries.pictures)
    names = dict.fromkeys(queries.true_tiles())
    for i, descriptor in enumerate(queries.descriptors):
        names |= dict.fromkeys(index.search(descriptor, None, PROPOSED).ids)
        report_progress("Searching the index", i, total)
    if queries.spots is not None:
        windows = [window for name in names if (window := NamedWindow.parse(name)) is not None]
        reach = max((window.size for window in windows), default=0) / 2
        for descriptor, place in zip(queries.descriptors, queries.places or (), strict=True):
            if place is not None:
                high, wide = (reach / metres for metres in geo.metres_per_degree(place.latitude))
                middle = place.latitude, place.longitude
                box = middle[0] - high, middle[1] - wide, middle[0] + high, middle[1] + wide
                names |= dict.fromkeys(index.search(descriptor, None, PROPOSED, box).ids)
    if len(names) > MOST_TILES:
        raise InputError(
            f"The index of {count:,} tiles is searched for {total:,} queries, which gives {len(names):,} tiles to rank; expected "
            f"{MOST_TILES:,} at most, so give fewer queries, or search with lpn search."
        )
    report_progress("Searching the index", total, total)
    chosen = (
        f"of {count:,} in the index: the {PROPOSED} that its engine ({index.engine}) proposes for each query, and the true ones; "
        "ranks and AP are among these"
    )
    return IndexGallery(list(names), *index.read(list(names)), chosen)
