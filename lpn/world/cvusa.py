"""A world's panoramas in CVUSA's layout, in their own folder, each with a tile centred at its camera.

    cvusa/bingmap/19/<number>.jpg      the tile: north up, the panorama's camera in the middle
    cvusa/streetview/panos/<number>.jpg   the panorama: north in the middle column, as in the polar transform of a tile
    cvusa/splits/{train,val}-19zl.csv  pairs of both, by the split of the place
    cvusa/geo.csv                      positions of both, in the format of `lpn.datasets.geo`

A number is that of the place, followed by two digits that count its panoramas from 00.
"""

from __future__ import annotations

from collections.abc import Sequence

from lpn.world.city import Split

FOLDER = "cvusa"
_SPLITS: dict[Split, str] = {"train": f"{FOLDER}/splits/train-19zl.csv", "test": f"{FOLDER}/splits/val-19zl.csv"}


def tile_path(place: int, number: int) -> str:
    """The path of a tile in the world's folder."""
    return f"{FOLDER}/bingmap/19/{place:05d}{number:02d}.jpg"


def panorama_path(place: int, number: int) -> str:
    """The path of a panorama in the world's folder."""
    return f"{FOLDER}/streetview/panos/{place:05d}{number:02d}.jpg"


def splits(pairs: Sequence[tuple[Split, str, str]]) -> dict[str, bytes]:
    """Return the files of both splits by path, from each pair's split, tile, and panorama.

    CVUSA's third column names a semantic map of the panorama. There are none here, so the column is empty; readers that split
    lines at commas need it.
    """
    lines: dict[str, list[str]] = {file: [] for file in _SPLITS.values()}
    for split, tile, panorama in pairs:
        lines[_SPLITS[split]].append(",".join([*(path.removeprefix(f"{FOLDER}/") for path in (tile, panorama)), ""]))
    return {file: "".join(f"{line}\n" for line in lines_of).encode() for file, lines_of in lines.items()}
