"""The queries of a task over an index: those of a data set whose gallery it holds, or plain pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import views_of
from lpn.datasets import Dataset, Picture, Truth, geo
from lpn.datasets.geo import Position
from lpn.index.base import Index
from lpn.models.base import Model
from lpn.tasks.opening import choose_task, offered_tasks

# Gallery pictures that are compared to find the described folder.
_SAMPLE = 50


@dataclass(frozen=True, eq=False)
class IndexQueries:
    """The queries of a task over an index.

    Attributes:
        name: of the task, such as "drone-to-satellite".
        data_name: to display.
        root: folder of the pictures; the user's notes are stored there.
        pictures: the queries.
        descriptors: (Q, n, D).
        places: the position of each query; None if no position is known.
        listed: gallery pictures in the index, by their names in it, with their positions in the data set's gallery.
        truth: of each query, by positions in the data set's gallery; None if labels or `spots` define it.
        gallery_size: number of pictures in the data set's gallery.
        spots: metres in the frame of a map, (Q, 2), NaN if unknown; windows that contain them are true.
        folders: folders of further tiles' pictures, searched by their names.
    """

    name: str
    data_name: str
    root: Path
    pictures: Sequence[Picture]
    descriptors: Float32Array
    places: Sequence[Position | None] | None = None
    listed: Mapping[str, tuple[int, Picture]] = field(default_factory=dict)
    truth: Sequence[Truth] | None = None
    gallery_size: int = 0
    spots: Float64Array | None = None
    folders: Sequence[Path] = ()

    def true_tiles(self) -> list[str]:
        """Return the names of listed tiles that are true for some query."""
        if self.truth is None:
            labels = {query.label for query in self.pictures}
            return [name for name, (_, tile) in self.listed.items() if tile.label in labels]
        good = {place for one in self.truth for place in one.good.tolist()}
        return [name for name, (place, _) in self.listed.items() if place in good]


def unknown_truth(queries: Sequence[Picture]) -> list[Truth]:
    """Return the truth of queries of unknown places."""
    return [Truth(np.zeros(0, np.int64), np.zeros(0, np.int64), known=False)] * len(queries)


def dataset_queries(model: Model, dataset: Dataset, index: Index) -> IndexQueries:
    """Return the test queries of the data set's task whose gallery has the most pictures in an index.

    Names in the index are paths below the described folder: the data set's or one below it. If no gallery picture is in the
    index, the queries' places are unknown.

    Raises:
        InputError: when the names fit the pictures below several folders equally well.
        StoreError: when the index holds descriptors of another model.
        LPNError: when the data set has no task that the model knows, or cannot be read.
    """
    offered = fitting_tasks(model, offered_tasks(model, dataset) or [choose_task(model, dataset)], index)
    galleries = {name: dataset.gallery(views_of(name)[1]) for name in offered}
    held_of = [(name, *_names_held(index, dataset.root, gallery)) for name, gallery in galleries.items()]
    name, folders, held = max(held_of, key=lambda task: len(task[2]))
    if len(folders) > 1:
        first, second = (printable(folder) for folder in folders[:2])
        raise InputError(
            f"The names in the index fit the pictures below {first} and those below {second} equally well; describe a folder "
            "that holds both, so that names tell them apart."
        )
    view, model = views_of(name)[0], model.for_task(*views_of(name))
    queries, positions = dataset.queries(view), dataset.positions()
    return IndexQueries(
        name=name,
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        pictures=queries,
        descriptors=descriptors.shipped_or_cached(model, queries, view, dataset.root, "query"),
        places=None if positions is None else positions.of(queries),
        listed=held,
        truth=dataset.truth(name) if held else unknown_truth(queries),
        gallery_size=len(galleries[name]),
        folders=tuple(dict.fromkeys((*(dataset.root / folder for folder in folders), dataset.root))),
    )


def picture_queries(model: Model, folder: Path, index: Index, tiles: Path | None = None) -> IndexQueries:
    """Return plain pictures below a folder as queries of unknown places.

    Args:
        tiles: folder of the tiles' pictures, whose names are paths below it; None without pictures.

    Raises:
        StoreError: when the index holds descriptors of another model.
        LPNError: when there are no pictures, or one cannot be read.
    """
    query, gallery = views_of(view_pair(model))
    name = fitting_tasks(model, [f"{query}-to-{gallery}", f"{gallery}-to-{query}"], index)[0]
    files = descriptors.pictures_below(folder)
    pictures = [
        Picture(file, i, printable(file.relative_to(folder).with_suffix("").as_posix())) for i, file in enumerate(files)
    ]
    positions = geo.positions(folder)
    return IndexQueries(
        name=name,
        data_name=printable(folder.resolve().name),
        root=folder,
        pictures=pictures,
        descriptors=descriptors.cached_descriptors(model.for_task(*views_of(name)), pictures, views_of(name)[0]),
        places=None if positions is None else positions.match(geo.names_below(folder, pictures)),
        truth=unknown_truth(pictures),
        folders=() if tiles is None else (tiles,),
    )


def fitting_tasks(model: Model, names: Sequence[str], index: Index) -> list[str]:
    """Return the tasks whose gallery an index may hold; all of them unless the model's branches have roles.

    Raises:
        StoreError: when the index holds descriptors of another model, or of queries.
    """
    fingerprints = {name: model.for_task(*views_of(name)).fingerprint for name in names}
    fitting = [name for name, fingerprint in fingerprints.items() if fingerprint == index.kind.fingerprint]
    if not fitting:
        index.check_model(fingerprints[names[0]])
    return fitting


def view_pair(model: Model) -> str:
    """Return the task of pictures without a data set: from the drone's view to the satellite's, if the model has them."""
    query = "drone" if "drone" in model.views else model.views[-1]
    return f"{query}-to-{'satellite' if 'satellite' in model.views else model.views[0]}"


def _names_held(
    index: Index, root: Path, gallery: Sequence[Picture]
) -> tuple[list[str], dict[str, tuple[int, Picture]]]:
    """Return the folders that fit the index's names best, and the gallery pictures below the first, by names in the index."""
    paths = geo.names_below(root, gallery)
    splits = [
        (path[:start], path[start:])
        for path in paths[:: max(1, len(paths) // _SAMPLE)]
        for start in (0, *(slash.end() for slash in re.finditer("/", path)))
    ]
    fits = index.holds([name for _, name in splits]).tolist()
    best: list[str] = []
    most: dict[str, tuple[int, Picture]] = {}
    for folder in sorted({folder for (folder, _), fit in zip(splits, fits, strict=True) if fit}):
        inside = [i for i, path in enumerate(paths) if path.startswith(folder)]
        names = [paths[i][len(folder) :] for i in inside]
        held = {names[j]: (inside[j], gallery[inside[j]]) for j in np.flatnonzero(index.holds(names)).tolist()}
        if len(held) > len(most):
            best, most = [folder], held
        elif len(held) == len(most):
            best.append(folder)
    return best, most
