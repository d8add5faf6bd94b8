"""Pictures of an index's tiles, which has none itself: cut from a map, read from a folder, or a placeholder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import Picture
from lpn.datasets.listed_paths import listed_path
from lpn.drawing import captions
from lpn.flight.maps import Map, NamedWindow
from lpn.flight.maps.named_window import WindowCut, caption_of, covers_part_of, describe_place
from lpn.index.gallery import IndexGallery
from lpn.index.queries import IndexQueries

# Side of a placeholder in pixels.
_SIDE = 256
# Labels of tiles that no data set names begin here.
_NO_PLACE = 1 << 40


def tile_pictures(gallery: IndexGallery, queries: IndexQueries, basemap: Map | None, pixels: int) -> list[Picture]:
    """Return the pictures of tiles: a data set's, cut from the map, read from a folder of the queries, or placeholders.

    Args:
        pixels: side of a picture that is cut from the map.
    """
    windows = [window for window in gallery.windows if window is not None]
    on_map = iter([] if basemap is None else NamedWindow.all_on(windows, basemap.frame))
    pictures = []
    for i, (name, window) in enumerate(zip(gallery.names, gallery.windows, strict=True)):
        place = None if window is None else next(on_map, None)
        if name in queries.listed:
            picture = queries.listed[name][1]
        elif basemap is not None and place is not None and covers_part_of(basemap, place):
            file, cut = queries.root / "windows" / name, WindowCut(basemap, place, pixels)
            picture = Picture(file, _NO_PLACE + i, describe_place(place), cut=cut, caption=caption_of(place))
        elif window is None and (found := _file(name, queries.folders)) is not None:
            picture = Picture(found, _NO_PLACE + i, printable(name))
        else:
            reason = "no file of this name is at hand; give the folder that was described as --data."
            if window is not None:
                reason = "it is a window of a map; give that map as --map."
            if basemap is not None and window is not None:
                reason = f"the window lies outside the map {printable(basemap.name)}."
            drawn = partial(_placeholder, printable(name), np.full(2, np.nan) if window else gallery.degrees[i])
            file = queries.root / "index" / str(i)
            picture = Picture(file, _NO_PLACE + i, printable(name), cut=drawn, missing=reason)
        pictures.append(picture)
    return pictures


def _file(name: str, folders: Sequence[Path]) -> Path | None:
    """Return the file of a tile's name in the first folder that has one; None without."""
    with suppress(DataError, OSError):
        for folder in folders:
            if (file := folder / listed_path(name, "The index")).is_file():
                return file
    return None


def _placeholder(name: str, degrees: Float64Array) -> UInt8Array:
    """Draw plain grey with a tile's name and position, (256, 256, 3)."""
    image, draw = captions.caption(_SIDE, _SIDE)
    draw.rectangle((0, 0, _SIDE, _SIDE), fill=(60, 60, 60))
    lines = ["no picture", *(name[i : i + 22] for i in range(0, min(len(name), 66), 22))]
    if np.isfinite(degrees).all():
        lines.append(f"{degrees[0]:.5f}, {degrees[1]:.5f}")
    for i, line in enumerate(lines):
        at = 128, 128 + 26 * (i - (len(lines) - 1) / 2)
        draw.text(at, line, (190, 190, 190), captions.font(20), anchor="mm")
    return np.asarray(image)
