"""A task whose gallery is the tiles of an index: all of them, or the proposals of a large index's engine.

An index has no pictures. They are cut from a map, read from a folder, or placeholders.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.progress import report_progress
from lpn.core.views import views_of
from lpn.datasets import Picture, Truth, geo, labels_of
from lpn.datasets.geo import Position
from lpn.datasets.listed_paths import listed_path
from lpn.drawing import captions
from lpn.flight.maps import Map, NamedWindow
from lpn.flight.maps.named_window import WindowCut, caption_of, covers_part_of, describe_place
from lpn.index.base import Index
from lpn.index.queries import IndexQueries
from lpn.models.base import Model
from lpn.retrieval.saved import in_rows
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task, descriptor_clauses

# Largest number of ranked tiles. Their descriptors of 2048 numbers take 1.6 GB.
MOST_TILES = 200_000
# Number of tiles that an engine proposes for each query.
PROPOSED = 100
# Side of a placeholder in pixels.
_SIDE = 256
# Labels of tiles outside the data set begin here.
_NO_PLACE = 1 << 40


@dataclass(frozen=True, eq=False)
class IndexGallery:
    """Tiles of an index.

    Attributes:
        names: in the index.
        descriptors: (G, n, D); those of a folder of one part stay on disk.
        degrees: latitude and longitude, (G, 2), NaN for a tile without a position.
        chosen: the selection of the tiles from a larger index, in words; empty for all tiles.
    """

    names: list[str]
    descriptors: Float32Array
    degrees: Float64Array
    chosen: str = ""

    @cached_property
    def windows(self) -> list[NamedWindow | None]:
        """The window of a map in each name; None for other tiles."""
        return list(map(NamedWindow.parse, self.names))

    @property
    def sizes(self) -> Float64Array:
        """Sides of the windows in metres, (G,), NaN for other tiles."""
        return np.array([np.nan if window is None else window.size for window in self.windows], np.float64)


def open_gallery(index: Index, queries: IndexQueries) -> IndexGallery:
    """Read all tiles of an index; of a large index, or of one that does not list its tiles, only the relevant ones.

    Relevant are the true tiles, and those that the engine proposes for each query. If the engine misses no tile, ranks
    down to the last proposed tile equal those among all tiles.

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
                north, east = place.latitude, place.longitude
                box = north - high, east - wide, north + high, east + wide
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


def index_task(model: Model, model_name: str, index: Index, queries: IndexQueries, basemap: Map | None = None) -> Task:
    """Return the task of some queries over the tiles of an index, which may be closed afterwards; see `open_gallery`.

    Args:
        model: describes queries; the index holds its descriptors.
        model_name: to display.
        basemap: map that windows are cut from.

    Raises:
        InputError: if the index holds no tiles, or none on the map, or too many are proposed.
        StoreError: if the index cannot be read, or holds descriptors of another model.
    """
    views = views_of(queries.name)
    model = model.for_task(*views)
    index.check_model(model.fingerprint)
    gallery = open_gallery(index, queries)
    tiles = _tile_pictures(gallery, queries, basemap, max(model.input_size))
    geometry, no_map = _geometry(gallery, queries.places or [None] * len(queries.pictures), basemap)
    return Task(
        name=queries.name,
        model=model,
        model_name=printable(model_name),
        data_name=queries.data_name,
        root=queries.root,
        contract=model.contract,
        clauses=descriptor_clauses(model.contract),
        map_sizes={view: model.map_size(view) for view in dict.fromkeys((*views, *model.views))},
        queries=queries.pictures,
        gallery=tiles,
        query_labels=labels_of(queries.pictures),
        gallery_labels=labels_of(tiles),
        query_descriptors=queries.descriptors,
        gallery_descriptors=gallery.descriptors,
        truth=_truth(gallery, queries, basemap),
        geometry=geometry,
        no_map=no_map,
        of_index=gallery.chosen,
    )


def _truth(gallery: IndexGallery, queries: IndexQueries, basemap: Map | None) -> list[Truth] | None:
    """Return the truth by positions in the gallery of an index; None if labels define it."""
    if queries.spots is not None:
        assert basemap is not None
        xy, halves = basemap.frame.xy(*gallery.degrees.T), gallery.sizes[:, None] / 2
        good = [np.flatnonzero((np.abs(xy - spot) <= halves).all(axis=1)) for spot in queries.spots]
        known = (bool(np.isfinite(spot).all()) for spot in queries.spots)
        return [Truth(tiles, np.zeros(0, np.int64), of) for tiles, of in zip(good, known, strict=True)]
    if queries.truth is None:
        return None
    rows = {name: row for row, name in enumerate(gallery.names)}
    row_of = np.full(queries.gallery_size, -1)
    for name, (place, _) in queries.listed.items():
        row_of[place] = rows.get(name, -1)
    return in_rows(queries.truth, row_of)


def _geometry(
    gallery: IndexGallery, places: Sequence[Position | None], basemap: Map | None
) -> tuple[GalleryGeometry | None, str]:
    """Return the geometry of the tiles without those of unknown position, or a sentence with the reason why there is none."""
    degrees, sizes = gallery.degrees, gallery.sizes
    if np.isnan(degrees).any(axis=1).all():
        return (
            None,
            "The tiles of the index are without a position, so there is no map; lpn index --data adds positions.",
        )
    tiles = [
        Position(latitude, longitude, width=None if np.isnan(size) else size)
        for (latitude, longitude), size in zip(degrees.tolist(), sizes.tolist(), strict=True)
    ]
    if basemap is None:
        return GalleryGeometry.of(places, tiles), ""
    xy = basemap.frame.xy(*degrees.T)
    west, south, east, north = basemap.bounds
    inside = (xy >= (west, south)).all(axis=1) & (xy <= (east, north)).all(axis=1)
    if not inside.any():
        raise InputError(
            f"None of {len(xy):,} tiles of the index lies on the map {printable(basemap.name)}; give the map that was described."
        )
    xy[~inside] = np.nan
    middle = (np.nanmin(xy, axis=0) + np.nanmax(xy, axis=0)) / 2
    origin = Position(*basemap.frame.degrees([middle])[0].tolist())
    width = max(east - west, north - south) / 20 if np.isnan(sizes).all() else float(np.nanmedian(sizes))
    return GalleryGeometry(places, tiles, origin, xy - middle, width), ""


def _tile_pictures(gallery: IndexGallery, queries: IndexQueries, basemap: Map | None, pixels: int) -> list[Picture]:
    """Return the tiles' pictures: from a data set, from the map at `pixels` a side, from the queries' folders, or grey ones."""
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
    """Return the file of a tile's name in the first folder that has it, or None."""
    with suppress(DataError, OSError):
        for folder in folders:
            if (file := folder / listed_path(name, "The index")).is_file():
                return file
    return None


def _placeholder(name: str, degrees: Float64Array) -> UInt8Array:
    """Draw plain grey with a tile's name and position, (256, 256, 3)."""
    image = Image.new("RGB", (_SIDE, _SIDE), (60, 60, 60))
    draw = ImageDraw.Draw(image)
    lines = ["no picture", *(name[i : i + 22] for i in range(0, min(len(name), 66), 22))]
    if np.isfinite(degrees).all():
        lines.append(f"{degrees[0]:.5f}, {degrees[1]:.5f}")
    for i, line in enumerate(lines):
        at = 128, 128 + 26 * (i - (len(lines) - 1) / 2)
        draw.text(at, line, (190, 190, 190), captions.font(20), anchor="mm")
    return np.asarray(image)
