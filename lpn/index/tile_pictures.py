"""Pictures of an index's tiles, which has none itself: cut from a map, read from a folder, or a placeholder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
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

_PLACEHOLDER = 256


@dataclass(frozen=True)
class TilePlaceholder:
    """Stands for the picture of a tile that is not at hand: plain grey with the tile's name and position.

    Attributes:
        reason: why there is no picture, as a sentence.
        position: returns the tile's latitude and longitude, (2,), NaN where they are unknown.
    """

    name: str
    reason: str
    position: Callable[[], Float64Array]

    def __call__(self) -> UInt8Array:
        """Draw the placeholder, (256, 256, 3)."""
        image, draw = captions.caption(_PLACEHOLDER, _PLACEHOLDER)
        draw.rectangle((0, 0, _PLACEHOLDER, _PLACEHOLDER), fill=(60, 60, 60))
        lines = ["no picture", *(self.name[i : i + 22] for i in range(0, min(len(self.name), 66), 22))]
        latitude, longitude = self.position()
        if np.isfinite(latitude) and NamedWindow.parse(self.name) is None:
            lines.append(f"{latitude:.5f}, {longitude:.5f}")
        for i, line in enumerate(lines):
            draw.text(
                (128, 128 + 26 * (i - (len(lines) - 1) / 2)), line, (190, 190, 190), captions.font(20), anchor="mm"
            )
        return np.asarray(image)


def tile_picture(
    name: str,
    label: int,
    root: Path,
    folders: Sequence[Path],
    basemap: Map | None,
    pixels: int,
    position: Callable[[], Float64Array],
) -> Picture:
    """Return the picture of a tile that no data set lists: cut from the map, read from a folder, or a placeholder.

    Args:
        root: a folder for the paths of pictures that are no files.
        folders: where files of the tile's name are looked for, in this order.
        pixels: side of a picture that is cut from the map.
        position: see `TilePlaceholder`.
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
    return Picture(root / "index" / str(label), label, title, cut=TilePlaceholder(title, reason, position))
