"""A task whose gallery is the tiles of an index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import views_of
from lpn.datasets import Truth, labels_of
from lpn.datasets.geo import Position
from lpn.flight.maps import Map
from lpn.index.base import Index
from lpn.index.gallery import IndexGallery, open_gallery
from lpn.index.queries import IndexQueries
from lpn.index.tile_pictures import tile_pictures
from lpn.models.base import Model
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task, descriptor_clauses


def index_task(
    model: Model,
    model_name: str,
    index: Index,
    queries: IndexQueries,
    basemap: Map | None = None,
) -> Task:
    """Return the task of some queries over the tiles of an index, which may be closed then; see `open_gallery`.

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
    tiles = tile_pictures(gallery, queries, basemap, max(model.input_size))
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
    """Return the truth by positions in the gallery of an index; None where labels tell it."""
    if queries.spots is not None:
        assert basemap is not None
        xy, halves = basemap.frame.xy(*gallery.degrees.T), gallery.sizes[:, None] / 2
        return [
            Truth(
                np.flatnonzero((np.abs(xy - spot) <= halves).all(axis=1)),
                np.zeros(0, np.int64),
                known=bool(np.isfinite(spot).all()),
            )
            for spot in queries.spots
        ]
    if queries.truth is None:
        return None
    rows = {name: row for row, name in enumerate(gallery.names)}
    row_of = {place: rows[name] for name, (place, _) in queries.listed.items() if name in rows}

    def moved(places: Int64Array) -> Int64Array:
        return np.array(sorted(row_of[place] for place in places.tolist() if place in row_of), np.int64)

    # The queries of a region share an array.
    shared = {id(one.among): moved(one.among) for one in queries.truth if one.among is not None}
    truth = []
    for one in queries.truth:
        good, semi, overlaps = moved(one.good), moved(one.semi), one.overlaps
        if overlaps is not None:
            places = [*one.good.tolist(), *one.semi.tolist()]
            by_row = {row_of.get(place): overlap for place, overlap in zip(places, overlaps.tolist(), strict=True)}
            overlaps = np.array([by_row[row] for row in (*good.tolist(), *semi.tolist())], np.float64)
        junk, among = moved(one.junk), shared.get(id(one.among))
        truth.append(Truth(good, junk, one.known, one.trapezoid, semi, overlaps, among))
    return truth


def _geometry(
    gallery: IndexGallery, places: Sequence[Position | None], basemap: Map | None
) -> tuple[GalleryGeometry | None, str]:
    """Return where tiles lie, and why that is not known, as a sentence; tiles without a position are left off."""
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
