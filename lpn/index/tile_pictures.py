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
from lpn.maps import Map, NamedWindow
from lpn.maps.named_window import WindowCut, caption_of, covers_part_of, describe_place

_SIDE = 256


def tile_picture(
    name: str,
    label: int,
    degrees: Float64Array,
    root: Path,
    folders: Sequence[Path],
    basemap: Map | None,
    pixels: int,
) -> Picture:
    """Return the picture of a tile that no data set lists: cut from the map, read from a folder, or a placeholder.

    Args:
        degrees: latitude and longitude, (2,), NaN where they are unknown.
        root: a folder for the paths of pictures that are no files.
        folders: where files of the tile's name are looked for, in this order.
        pixels: side of a picture that is cut from the map.
    """
    window, title = NamedWindow.parse(name), printable(name)
    if window is not None and basemap is not None:
        place = window.on(basemap.frame)
        if covers_part_of(basemap, place):
            cut = WindowCut(basemap, place, pixels)
            return Picture(root / "windows" / name, label, describe_place(place), cut=cut, caption=caption_of(place))
        reason = f"the window lies outside the map {printable(basemap.name)}."
    elif window is not None:
        reason = "it is a window of a map; give that map as --map."
    else:
        with suppress(DataError, OSError):
            for folder in folders:
                if (file := folder / listed_path(name, "The index")).is_file():
                    return Picture(file, label, title)
        reason = "no file of this name is at hand; give the folder that was described as --data."
    drawn = partial(_placeholder, title, np.full(2, np.nan) if window else degrees)
    return Picture(root / "index" / str(label), label, title, cut=drawn, missing=reason)


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
