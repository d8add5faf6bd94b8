"""The pictures of GeoText-1652 (Chu et al. 2024): University-1652's places, all views of a place in one folder.

    [images/]train/<place>/*
    [images/]test/query(701)/<place>/*
    [images/]test/gallery_no_train(250)/<place>/*    distractors
    test_951_version.json, test_24G_version.json     not read: texts, and boxes of their objects

A picture's name gives its view: drone_view, satellite_view, street_view; or, as in University-1652, image-<number> for
a drone and the place's number for a satellite. Every other picture of a place is a street picture.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lpn.datasets.base import Dataset, PictureRow, sizes
from lpn.datasets.layouts.university import place_rows

_LISTS = ("test_951_version.json", "test_24G_version.json")
_QUERY, _DISTRACTORS = "test/query(701)", "test/gallery_no_train(250)"
_VIEWS = ("drone", "satellite", "street")
_DRONE = re.compile(r"image-\d+")


class GeoText(Dataset):
    """A folder of GeoText-1652; a picture's label is its place's number."""

    kind = "GeoText-1652"
    marks = (*((name,) for name in _LISTS), (f"images/{_QUERY}/",), (f"{_QUERY}/",))
    expected = f"{_QUERY}/<place>/* of two views"
    published_sizes = sizes(
        train={"drone": (37_854, 701), "satellite": (701, 701), "street": (11_663, 701)},
        query={"drone": (None, 701), "satellite": (701, 701)},
        gallery={"drone": (51_355, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def rows(self) -> Iterator[PictureRow]:
        top = next(
            (self.root / "images" for split in ("train", "test") if (self.root / "images" / split).is_dir()), self.root
        )
        inside = top.relative_to(self.root).as_posix()
        self.folders = [f"{inside}/{split}" for split in ("train", "test")]
        train, query, distractors = ([*place_rows("", top / folder)] for folder in ("train", _QUERY, _DISTRACTORS))
        for of, rows in (("train/", train), ("test/query_", query), ("test/gallery_", [*query, *distractors])):
            for view in _VIEWS:
                yield from (replace(row, of=of + view) for row in rows if _view(Path(row.file)) == view)


def _view(file: Path) -> str:
    named = next((view for view in _VIEWS if file.stem.startswith(f"{view}_view")), None)
    if named is not None:
        return named
    if _DRONE.fullmatch(file.stem):
        return "drone"
    return "satellite" if file.stem == file.parent.name else "street"
