"""A task whose tiles are in an index: each ranking is a search, exact to a depth, on 10^2 tiles and on 10^7.

The gallery is that of the tiles that searches have returned (`IndexGallery`). A ranking holds the `depth` nearest tiles in
order. Behind them it holds the query's true tiles as far as they are known, and the tile that is compared: their scores are
exact, as their descriptors are read by name, and their ranks are only known to be beyond the depth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn import descriptors
from lpn.analysis import query_outcomes
from lpn.analysis.gallery_geometry import GalleryGeometry
from lpn.analysis.query_outcomes import Outcomes
from lpn.analysis.task import RankUnderWeights, Task, choose_task, offered_tasks
from lpn.core.arrays import BoolArray, Float32Array, Int64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.views import views_of
from lpn.datasets import Dataset, Picture, Truth, geo
from lpn.datasets.base import checked_path
from lpn.datasets.geo import Position
from lpn.drawing import captions
from lpn.explain.counterfactual import Effect
from lpn.index.base import SearchResult, check_count
from lpn.index.gallery import IndexGallery
from lpn.index.ranking import IndexRanking, IndexRetrieval
from lpn.index.shared import SharedIndex
from lpn.maps import Map, NamedWindow
from lpn.maps.named_window import WindowCut, covers_part_of, describe_place
from lpn.models.base import Model, normalise
from lpn.retrieval import Ranking, scoring
from lpn.retrieval.metrics import JUNK, Retrieval

# Number of tiles that a search returns by default.
DEPTH = 100
# Smallest depth: R@10 is told.
MIN_DEPTH = 10
# Labels of tiles that no data set names begin here.
_NO_PLACE = 1 << 40
_PLACEHOLDER = 256
# Searches by drawn descriptors that show where an index's tiles lie, and how large windows are.
_PROBES = 2
_PROBED = 100
# Gallery pictures by which the described folder is found.
_SAMPLE = 50
# Share of the width of a map without a raster that is added on each side.
_BORDER = 0.1


@dataclass(frozen=True, eq=False)
class IndexQueries:
    """The queries of a task over an index.

    Attributes:
        name: of the task, such as "drone-to-satellite".
        data_name: to display.
        root: folder of the pictures; a person's notes are kept there.
        pictures: the queries.
        descriptors: (Q, n, D).
        places: what each query shows; None if no position is known.
        true: names of each query's true tiles in the index, none where `contains` finds them; None for a query whose place is not
            known, and in place of all if none is.
        junk: names of tiles that are left out of each query's ranking; empty for none.
        contains: returns which tiles, given by name, show a query's place, (K,), where the true tiles cannot be listed.
        tiles: pictures of tiles that the data set knows, by their names in the index.
        folders: where the pictures of other tiles are looked for, by their names.
    """

    name: str
    data_name: str
    root: Path
    pictures: Sequence[Picture]
    descriptors: Float32Array
    places: Sequence[Position | None] | None = None
    true: Sequence[Sequence[str] | None] | None = None
    junk: Sequence[Sequence[str]] = ()
    contains: Callable[[int, Sequence[str]], BoolArray] | None = None
    tiles: Mapping[str, Picture] = field(default_factory=dict)
    folders: Sequence[Path] = ()


@dataclass(frozen=True)
class TilePlaceholder:
    """Stands for the picture of a tile that is not at hand: plain grey with the tile's name.

    Attributes:
        reason: why there is no picture, as a sentence.
    """

    name: str
    reason: str

    def __call__(self) -> UInt8Array:
        """Draw the placeholder, (256, 256, 3)."""
        image, draw = captions.caption(_PLACEHOLDER, _PLACEHOLDER)
        draw.rectangle((0, 0, _PLACEHOLDER, _PLACEHOLDER), fill=(60, 60, 60))
        lines = ["no picture", *(self.name[i : i + 22] for i in range(0, min(len(self.name), 66), 22))]
        for i, line in enumerate(lines):
            draw.text(
                (128, 128 + 26 * (i - (len(lines) - 1) / 2)), line, (190, 190, 190), captions.font(20), anchor="mm"
            )
        return np.asarray(image)


@dataclass(frozen=True, eq=False)
class IndexGeometry(GalleryGeometry):
    """The positions of an index's tiles that were seen; the borders stay as they are while tiles are added.

    Attributes:
        borders: west, south, east, north in metres from the origin.
    """

    borders: tuple[float, float, float, float]

    def bounds(self) -> tuple[float, float, float, float]:
        return self.borders


@dataclass(frozen=True, eq=False)
class _Ground:
    """Where the tiles of an index lie; `frame` is a map's, whose metres are exact."""

    origin: Position
    width: float
    borders: tuple[float, float, float, float]
    town: Map | None

    def geometry(self, places: Sequence[Position | None], gallery: IndexGallery) -> IndexGeometry:
        degrees = gallery.degrees()
        tiles = [
            Position(latitude, longitude, width=_window_size(gallery.name_of(i)))
            for i, (latitude, longitude) in enumerate(degrees.tolist())
        ]
        ground = (
            geo.on_plane(tiles, self.origin) if self.town is None else self.town.frame.xy(degrees[:, 0], degrees[:, 1])
        )
        return IndexGeometry(places, tiles, self.origin, ground, self.width, self.borders)


class _Snapshots:
    """The newest labels and geometry of a growing gallery, computed when it has grown."""

    def __init__(self) -> None:
        self._newest: tuple[int, Int64Array, IndexGeometry | None] | None = None

    def get(
        self, gallery: IndexGallery, ground: _Ground | None, places: Sequence[Position | None]
    ) -> tuple[Int64Array, IndexGeometry | None]:
        version, newest = gallery.version, self._newest
        if newest is None or newest[0] != version:
            geometry = None if ground is None else ground.geometry(places, gallery)
            newest = self._newest = version, gallery.labels(), geometry
        return newest[1], newest[2]


@dataclass(frozen=True, eq=False, kw_only=True)
class IndexTask(Task):
    """A task over an index; `gallery` grows, and `current` gives the labels and positions of all tiles in it.

    Attributes:
        index: the index.
        seen: the gallery.
        search_depth: number of tiles that a search returns.
        contains: see `IndexQueries`.
        no_map: why the gallery has no map, as a sentence; empty if it has one.
        town: the map that windows are cut from; None without one.
    """

    index: SharedIndex
    seen: IndexGallery
    search_depth: int
    snapshots: _Snapshots
    contains: Callable[[int, Sequence[str]], BoolArray] | None = None
    ground: _Ground | None = None
    no_map: str = ""
    town: Map | None = None

    @property
    def tiles(self) -> int:
        return self.index.tiles

    @property
    def depth(self) -> int | None:
        return self.search_depth

    @property
    def gallery_description(self) -> str:
        name = "exactly" if self.index.index.exhaustive else f"approximately ({self.index.index.engine})"
        return f"searched {name} to depth {self.search_depth} of {self.tiles:,} tiles"

    def current(self) -> Task:
        places = [None] * len(self.queries) if self.geometry is None else self.geometry.queries
        labels, geometry = self.snapshots.get(self.seen, self.ground, places)
        return replace(self, gallery_labels=labels, geometry=geometry)

    def without_picture(self, index: int) -> str:
        cut = self.seen[index].cut
        return cut.reason if isinstance(cut, TilePlaceholder) else ""

    def stored_descriptor(self, index: int) -> Float32Array:
        return cast(Float32Array, self.index.read([self.seen.name_of(index)])[0][0])

    def find_tile(self, name: str) -> int | None:
        """Return the gallery position of a tile by its name in the index; None if the index has no such tile."""
        place = self.seen.find(name)
        if place is None and 0 < len(name) <= 512 and self.index.holds([name])[0]:
            place = int(self.seen.add([name])[0])
        return place

    def start_search(
        self, query: int | None, descriptor: Float32Array, lengths: Float32Array | None = None
    ) -> RankUnderWeights:
        return IndexSearch(self, query, descriptor, lengths)

    def search(
        self,
        query: int | None,
        descriptor: Float32Array,
        weights: Float32Array,
        lengths: Float32Array | None = None,
        also: Sequence[int] = (),
        background: bool = False,
    ) -> Ranking:
        """Search the index with a descriptor (n, D), and rank what it returns.

        Args:
            query: position of the query whose truth counts; None for a picture that is not one.
            weights: that sum to one, (n,).
            lengths: see `Ranking`.
            also: gallery positions of tiles to rank behind the others, if the search does not return them.
            background: let other searches go first.
        """
        assert self.truth is not None
        truth = None if query is None else self.truth[query]
        junk = np.zeros(0, np.int64) if truth is None else truth.junk
        found = self.index.search(descriptor, weights, self.search_depth + len(junk), background)
        places = self.seen.add(found.ids, found.positions)
        kept = np.flatnonzero(~np.isin(places, junk))[: self.search_depth]
        places, vectors, scores = places[kept], found.vectors[kept], found.scores[kept]
        depth = None if len(found) >= self.tiles else len(places)
        good = np.zeros(0, np.int64) if truth is None else truth.good
        missing = np.setdiff1d([*good, *also], [*places, *junk]).astype(np.int64)
        if len(missing):
            read, positions = self.index.read([self.seen.name_of(i) for i in missing.tolist()])
            self.seen.add([self.seen.name_of(i) for i in missing.tolist()], positions)
            theirs = scoring.part_cosines(descriptor, read) @ weights
            order = np.argsort(-theirs, kind="stable")
            places, vectors = np.concatenate([places, missing[order]]), np.concatenate([vectors, read[order]])
            scores = np.concatenate([scores, theirs[order]])
        size, n = len(self.seen), self.contract.n_parts
        cosines = np.full((size, n), np.nan, np.float32)
        cosines[places] = scoring.part_cosines(descriptor, vectors)
        all_scores = np.full(size, np.nan, np.float32)
        all_scores[places] = scores
        relevant = None
        if query is not None and truth is not None and truth.known:
            relevant = np.zeros(size, bool)
            relevant[good] = True
            if self.contains is not None:
                relevant[places] = self.contains(query, [self.seen.name_of(i) for i in places.tolist()])
        return Ranking(cosines, weights, all_scores, places, relevant, lengths, depth)

    def resumable_ranking(self) -> IndexRanking:
        """Return the ranking of all queries, one search each."""
        return IndexRanking(self)

    @cached_property
    def outcomes(self) -> Outcomes:
        return self.outcomes_of(self._retrieved)

    @cached_property
    def metrics(self) -> dict[str, float]:
        return self._retrieved.metrics(self.known)

    @cached_property
    def _retrieved(self) -> IndexRetrieval:
        return IndexRanking(self).finish(lambda *_: None)

    def outcomes_of(self, ranking: Retrieval) -> Outcomes:
        assert isinstance(ranking, IndexRetrieval)
        return query_outcomes.outcomes_from_parts(ranking, ranking.parts, self.weights, self.known)

    def effect(self, before: npt.ArrayLike | None, after: npt.ArrayLike) -> Effect:
        del before, after
        raise InputError(
            "The effect of weights on all queries takes a search for each of them, so it is told for galleries in memory only."
        )


class IndexSearch:
    """One query's searches; asks the index again when the weights change, and reuses the last ranking otherwise."""

    def __init__(
        self, task: IndexTask, query: int | None, descriptor: Float32Array, lengths: Float32Array | None
    ) -> None:
        self._task, self._query, self._descriptor, self._lengths = task, query, descriptor, lengths
        self._last: tuple[bytes, Ranking] | None = None

    def __call__(self, weights: Float32Array, also: int | None = None) -> Ranking:
        """Rank under weights (n,) that sum to one; the tile `also` is ranked, too."""
        key = weights.tobytes()
        if self._last is not None and self._last[0] == key and (also is None or self._last[1].holds(also)):
            return self._last[1]
        others = () if also is None else (also,)
        ranking = self._task.search(self._query, self._descriptor, weights, self._lengths, others)
        self._last = key, ranking
        return ranking


def index_task(
    model: Model,
    model_name: str,
    index: SharedIndex,
    queries: IndexQueries,
    depth: int = DEPTH,
    town: Map | None = None,
) -> IndexTask:
    """Return the task of some queries over an index.

    Args:
        model: describes queries; the index holds its descriptors.
        model_name: to display.
        depth: number of tiles that a search returns.
        town: map that windows are cut from.

    Raises:
        InputError: if the depth is less than 10, or the index holds no tiles, or none on the map.
        StoreError: if the index cannot be read, or holds descriptors of another model.
    """
    if check_count(depth, "depth") < MIN_DEPTH:
        raise InputError(f"The depth is {depth}; expected {MIN_DEPTH} or more, as R@10 is told.")
    if not index.tiles:
        raise InputError("The index holds no tiles; add some with lpn index.")
    views = views_of(queries.name)
    model = model.for_task(*views)
    index.index.check_model(model.fingerprint)

    def make_picture(name: str, place: int) -> Picture:
        if (listed := queries.tiles.get(name)) is not None:
            return listed
        return _picture(name, _NO_PLACE + place, queries.root, queries.folders, town, max(model.input_size))

    gallery = IndexGallery(make_picture)
    none = np.zeros(0, np.int64)
    truth = []
    for i in range(len(queries.pictures)):
        names = None if queries.true is None else queries.true[i]
        junk = np.sort(gallery.add(queries.junk[i])) if queries.junk else none
        truth.append(Truth(np.sort(gallery.add(names)) if names else none, junk, known=names is not None))
    places = queries.places or [None] * len(queries.pictures)
    ground, no_map = _ground(_probes(index, model), places, town)
    return IndexTask(
        name=queries.name,
        model=model,
        model_name=printable(model_name),
        data_name=queries.data_name,
        root=queries.root,
        contract=model.contract,
        map_sizes={view: model.map_size(view) for view in dict.fromkeys((*views, *model.views))},
        queries=queries.pictures,
        gallery=gallery,
        query_labels=query_outcomes.labels_of(queries.pictures),
        gallery_labels=gallery.labels(),
        query_descriptors=queries.descriptors,
        gallery_descriptors=np.zeros((0, model.n_parts, model.embedding), np.float32),
        truth=truth,
        geometry=None if ground is None else ground.geometry(places, gallery),
        index=index,
        seen=gallery,
        search_depth=min(depth, index.tiles),
        snapshots=_Snapshots(),
        contains=queries.contains,
        ground=ground,
        no_map=no_map,
        town=town,
    )


def window_sizes(index: SharedIndex, model: Model) -> list[float]:
    """Return the sides in metres of some windows that an index holds, ascending; empty if its tiles are no windows."""
    names = [name for one in _probes(index, model) for name in one.ids]
    return sorted({size for name in names if (size := _window_size(name)) is not None})


def _window_size(name: str) -> float | None:
    window = NamedWindow.parse(name)
    return None if window is None else window.size


def _picture(name: str, label: int, root: Path, folders: Sequence[Path], town: Map | None, pixels: int) -> Picture:
    """Return the picture of a tile that no data set lists: cut from the map, read from a folder, or a placeholder."""
    window, shown = NamedWindow.parse(name), printable(name)
    if window is not None and town is not None:
        place = window.on(town.frame)
        if covers_part_of(town, place):
            return Picture(root / "windows" / name, label, describe_place(place), cut=WindowCut(town, place, pixels))
        reason = f"the window lies outside the map {printable(town.name)}."
    elif window is not None:
        reason = "it is a window of a map; give that map as --map."
    else:
        with suppress(DataError, OSError):
            for folder in folders:
                if (file := folder / checked_path(name, "The index")).is_file():
                    return Picture(file, label, shown)
        reason = "no file of this name is at hand; give the folder that was described as --data."
    return Picture(root / "index" / str(label), label, shown, cut=TilePlaceholder(shown, reason))


def _probes(index: SharedIndex, model: Model) -> list[SearchResult]:
    """Search with drawn descriptors: their results show what tiles an index holds."""
    rng = np.random.default_rng(0)
    shape = (_PROBES, model.n_parts, model.embedding)
    return [index.search(one, None, _PROBED) for one in normalise(rng.standard_normal(shape).astype(np.float32))]


def _ground(
    found: Sequence[SearchResult], places: Sequence[Position | None], town: Map | None
) -> tuple[_Ground | None, str]:
    """Return where tiles lie, and why that is not known, as a sentence."""
    degrees = np.concatenate([one.positions for one in found])
    if np.isnan(degrees).any():
        return None, "The index has tiles without a position, so there is no map; lpn index --data adds positions."
    sizes = [size for one in found for name in one.ids if (size := _window_size(name)) is not None]
    if town is not None:
        xy = town.frame.xy(degrees[:, 0], degrees[:, 1])
        west, south, east, north = town.bounds
        inside = (xy[:, 0] >= west) & (xy[:, 0] <= east) & (xy[:, 1] >= south) & (xy[:, 1] <= north)
        if not inside.any():
            raise InputError(
                f"None of {len(xy)} tiles of the index lies on the map {printable(town.name)}; give the map that was described."
            )
        origin = Position(town.frame.latitude, town.frame.longitude)
        width = float(np.median(sizes)) if sizes else max(east - west, north - south) / 20
        return _Ground(origin, width, town.bounds, town), ""
    tiles = [Position(*row) for row in np.unique(degrees, axis=0).tolist()]
    known = [*tiles, *(place for place in places if place is not None)]
    layout = GalleryGeometry.of([], known)
    width = float(np.median(sizes)) if sizes else GalleryGeometry.of([], tiles).width
    west, south, east, north = layout.bounds()
    pad = _BORDER * max(east - west, north - south)
    return _Ground(layout.origin, width, (west - pad, south - pad, east + pad, north + pad), None), ""


def dataset_queries(model: Model, dataset: Dataset, index: SharedIndex) -> IndexQueries:
    """Return the test queries of a data set whose gallery an index holds: of the task of which it holds most pictures.

    The names in the index are paths below the folder that was described, which is the data set's or one below it. Where it
    holds none of the gallery, the queries' places are not known.

    Raises:
        LPNError: when the data set has no task that the model knows, or cannot be read.
    """
    offered = offered_tasks(model, dataset) or [choose_task(model, dataset)]
    sides = [(name, *_names_held(index, dataset.root, dataset.gallery(views_of(name)[1]))) for name in offered]
    name, folder, held = max(sides, key=lambda side: len(side[2]))
    view, model = views_of(name)[0], model.for_task(*views_of(name))
    queries, lists = dataset.queries(view), dataset.truth(name)
    positions = geo.positions(dataset.root)
    by_label: dict[int, list[str]] = {}
    for tile, (_, picture) in held.items():
        by_label.setdefault(picture.label, []).append(tile)
    true: list[Sequence[str] | None]
    junk: list[Sequence[str]] = []
    if not held:
        true = [None] * len(queries)
    elif lists is None:
        common = by_label.pop(JUNK, [])
        true = [by_label.get(query.label, ()) for query in queries]
        junk = [common] * len(queries) if common else []
    else:
        names = {place: tile for tile, (place, _) in held.items()}
        true = [[names[i] for i in one.good.tolist() if i in names] if one.known else None for one in lists]
        junk = [[names[i] for i in one.junk.tolist() if i in names] for one in lists]
    return IndexQueries(
        name=name,
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        pictures=queries,
        descriptors=descriptors.shipped_or_cached(model, queries, view, dataset.root, "query").descriptors,
        places=None if positions is None else positions.of(queries),
        true=true,
        junk=junk,
        tiles={tile: picture for tile, (_, picture) in held.items()},
        folders=(dataset.root / folder, dataset.root) if folder else (dataset.root,),
    )


def picture_queries(model: Model, folder: Path, tiles: Path | None = None) -> IndexQueries:
    """Return plain pictures below a folder as queries, whose places are not known.

    Args:
        tiles: folder that the tiles' names are relative to; None if their pictures are not at hand.

    Raises:
        LPNError: when there are no pictures, or one cannot be read.
    """
    files = descriptors.pictures_below(folder)
    pictures = [
        Picture(file, i, printable(file.relative_to(folder).with_suffix("").as_posix())) for i, file in enumerate(files)
    ]
    positions = geo.positions(folder)
    name = view_pair(model)
    return IndexQueries(
        name=name,
        data_name=printable(folder.resolve().name),
        root=folder,
        pictures=pictures,
        descriptors=descriptors.cached_descriptors(model.for_task(*views_of(name)), pictures, views_of(name)[0]),
        places=None if positions is None else positions.match(geo.names_below(folder, pictures)),
        folders=() if tiles is None else (tiles,),
    )


def view_pair(model: Model) -> str:
    """Return the task of pictures that no data set lists: from the drone's view to the satellite's, if the model has them."""
    query = "drone" if "drone" in model.views else model.views[-1]
    return f"{query}-to-{'satellite' if 'satellite' in model.views else model.views[0]}"


def _names_held(
    index: SharedIndex, root: Path, gallery: Sequence[Picture]
) -> tuple[str, dict[str, tuple[int, Picture]]]:
    """Return the folder below the root that the names in an index are relative to, and the gallery pictures that it holds.

    The pictures, with their positions in the gallery, are keyed by their names in the index.
    """
    paths = geo.names_below(root, gallery)
    parts = paths[0].split("/")[:-1]
    folders = ["/".join(parts[:depth]) for depth in range(len(parts) + 1)]
    sample = paths[:: max(1, len(paths) // _SAMPLE)]
    counts = [int(index.holds(_below(folder, sample)).sum()) for folder in folders]
    folder = folders[int(np.argmax(counts))]
    start = len(folder) + 1 if folder else 0
    inside = [i for i, path in enumerate(paths) if path.startswith(f"{folder}/" if folder else "")]
    names = [paths[i][start:] for i in inside]
    held = index.holds(names)
    return folder, {names[j]: (inside[j], gallery[inside[j]]) for j in np.flatnonzero(held).tolist()}


def _below(folder: str, paths: Sequence[str]) -> list[str]:
    start = f"{folder}/" if folder else ""
    return [path[len(start) :] for path in paths if path.startswith(start)]
