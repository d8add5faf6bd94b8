"""Uses of the ground in each tile (`ground.csv` in a data set's folder): what a part of a tile shows, where somebody knows it.

    path,uses
    test/gallery_satellite/0300/0300.webp,bbrg bbrg rrrr tttt

`path` is relative to the folder, with forward slashes. `uses` has a word for each row of a grid over the tile, from the top, and
in it a letter for each column, from the left: b building, r road, p car park, t trees, w water, g grass, s sports ground,
f field, y paved yard, and a dot where nothing is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import BoolArray
from lpn.core.errors import DataError
from lpn.core.lists import read_text, table

NAME = "ground.csv"
UNKNOWN = "."
# Each letter's use in words.
USES = {
    "b": "a building",
    "r": "a road",
    "p": "a car park",
    "t": "trees",
    "w": "water",
    "g": "grass",
    "s": "a sports ground",
    "f": "fields",
    "y": "a paved yard",
}
Letters = NDArray[np.str_]
# Uses are named from this share of a region on, two at most.
_LEAST, _MOST = 0.2, 2


def ground_uses(root: Path) -> Mapping[str, Letters]:
    """Read the grid of letters, (rows, columns), of each tile by its path; empty if the data set has no `ground.csv`.

    Raises:
        DataError: if the file cannot be read; the message names the line.
    """
    if not (root / NAME).is_file():
        return {}
    known = {}
    for line, row in table(read_text(root / NAME, NAME), NAME, ["path", "uses"].__eq__, "path,uses")[1]:
        rows = row["uses"].split()
        if len({len(letters) for letters in rows}) != 1 or not set("".join(rows)) <= {*USES, UNKNOWN}:
            raise DataError(f"{line}: expected rows of equally many of the letters {''.join(USES)}{UNKNOWN} as uses.")
        known[row["path"]] = np.array([list(letters) for letters in rows])
    return known


def named_uses(letters: Letters, cells: BoolArray, zoom: float = 1.0) -> list[str]:
    """Name what fills most of some cells of a tile, the largest first; empty where too little of them is known.

    Args:
        letters: of the tile, (rows, columns).
        cells: of the tile as it is described, (h, w).
        zoom: of the described tile about its middle, see `Picture.zoom`.
    """
    rows, columns = np.nonzero(cells)
    if not len(rows):
        return []
    at = [
        (((place + 0.5) / side - 0.5) / zoom + 0.5) * size
        for place, side, size in zip((rows, columns), cells.shape, letters.shape, strict=True)
    ]
    inside = np.all([(place >= 0) & (place < size) for place, size in zip(at, letters.shape, strict=True)], axis=0)
    shown = letters[at[0][inside].astype(int), at[1][inside].astype(int)]
    uses, counts = np.unique(shown[shown != UNKNOWN], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return [USES[str(uses[i])] for i in order[:_MOST] if counts[i] >= _LEAST * len(rows)]
