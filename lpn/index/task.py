"""A task whose tiles are in an index: each ranking is a search, exact to a depth, on 10^2 tiles and on 10^7.

The gallery is that of the tiles that searches have returned (`IndexGallery`). A ranking holds the `depth` nearest tiles in
order. Behind them it holds the query's true tiles as far as they are known, and the tile that is compared: their scores are
exact, as their descriptors are read by name. Their ranks are only known to be beyond the depth. Those of nearer tiles,
which an approximate search misses, are not known at all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import views_of
from lpn.datasets import Picture, Truth, labels_of
from lpn.datasets.geo import Position
from lpn.index.base import ID_LENGTH, check_count
from lpn.index.gallery import IndexGallery
from lpn.index.ground import IndexGeometry, IndexGround, ground_of, probes
from lpn.index.queries import IndexQueries
from lpn.index.ranking import IndexRanking, IndexRetrieval
from lpn.index.shared import SharedIndex
from lpn.index.tile_pictures import TilePlaceholder, tile_picture
from lpn.maps import Map
from lpn.models.base import Model
from lpn.retrieval import Ranking, scoring
from lpn.retrieval.metrics import Retrieval
from lpn.tasks import query_outcomes
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.task import RankUnderWeights, Task

# Number of tiles that a search returns by default.
DEPTH = 100
# Smallest depth, because R@10 is reported.
MIN_DEPTH = 10
# Labels of tiles that no data set names begin here.
_NO_PLACE = 1 << 40


class _Snapshots:
    """The newest labels and geometry of a growing gallery, computed when it has grown."""

    def __init__(self) -> None:
        self._newest: tuple[int, Int64Array, IndexGeometry | None] | None = None

    def get(
        self, gallery: IndexGallery, ground: IndexGround | None, places: Sequence[Position | None]
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
        gallery: the tiles that searches have returned.
        index: the index.
        search_depth: number of tiles that a search returns.
        contains: see `IndexQueries`.
        basemap: the map that windows are cut from; None without one.
    """

    gallery: IndexGallery
    index: SharedIndex
    search_depth: int
    snapshots: _Snapshots
    contains: Callable[[int, Sequence[str]], BoolArray] | None = None
    ground: IndexGround | None = None
    basemap: Map | None = None

    @property
    def tiles(self) -> int:
        return self.index.tiles

    @property
    def depth(self) -> int | None:
        return self.search_depth

    @property
    def approximate(self) -> bool:
        return not self.index.index.exhaustive

    @property
    def gallery_description(self) -> str:
        name = f"approximately ({self.index.index.engine})" if self.approximate else "exactly"
        return f"searched {name} to depth {self.search_depth} of {self.tiles:,} tiles"

    def sides(self) -> tuple[Float32Array, Float32Array]:
        raise InputError(
            f"The {self.tiles:,} tiles are in an index, which is searched and not read whole; open their data set with a model."
        )

    def current(self) -> Task:
        places = [None] * len(self.queries) if self.geometry is None else self.geometry.queries
        labels, geometry = self.snapshots.get(self.gallery, self.ground, places)
        return replace(self, gallery_labels=labels, geometry=geometry)

    def without_picture(self, index: int) -> str:
        cut = self.gallery[index].cut
        return cut.reason if isinstance(cut, TilePlaceholder) else ""

    def stored_descriptor(self, index: int) -> Float32Array:
        return cast(Float32Array, self.index.read([self.gallery.name_of(index)])[0][0])

    def tile_name(self, index: int) -> str:
        return self.gallery.name_of(index)

    def find_tile(self, name: str) -> int | None:
        """The gallery position of a tile by its name in the index; None if the index has no such tile."""
        place = self.gallery.find(name)
        if place is None and 0 < len(name) <= ID_LENGTH and self.index.holds([name])[0]:
            place = int(self.gallery.add([name])[0])
        return place

    def start_search(
        self, query: int | None, descriptor: Float32Array, lengths: Float32Array | None = None
    ) -> RankUnderWeights:
        return IndexSearch(self, query, descriptor, lengths)

    def search_index(
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
        hits = self.index.search(descriptor, weights, self.search_depth + len(junk), background)
        places = self.gallery.add(hits.ids, hits.positions)
        kept = np.flatnonzero(~np.isin(places, junk))[: self.search_depth]
        places, vectors, scores = places[kept], hits.vectors[kept], hits.scores[kept]
        depth = None if len(hits) >= self.tiles else len(places)
        good = np.zeros(0, np.int64) if truth is None else truth.good
        missing = np.setdiff1d([*good, *also], [*places, *junk]).astype(np.int64)
        if len(missing):
            read, positions = self.index.read([self.gallery.name_of(i) for i in missing.tolist()])
            self.gallery.add([self.gallery.name_of(i) for i in missing.tolist()], positions)
            theirs = scoring.part_cosines(descriptor, read) @ weights
            order = np.argsort(-theirs, kind="stable")
            places, vectors = np.concatenate([places, missing[order]]), np.concatenate([vectors, read[order]])
            scores = np.concatenate([scores, theirs[order]])
        size, n = len(self.gallery), self.contract.n_parts
        cosines = np.full((size, n), np.nan, np.float32)
        cosines[places] = scoring.part_cosines(descriptor, vectors)
        all_scores = np.full(size, np.nan, np.float32)
        all_scores[places] = scores
        relevant = None
        if query is not None and truth is not None and truth.known:
            relevant = np.zeros(size, bool)
            relevant[good] = True
            if self.contains is not None:
                relevant[places] = self.contains(query, [self.gallery.name_of(i) for i in places.tolist()])
        return Ranking(cosines, weights, all_scores, places, relevant, lengths, depth, self.approximate)

    @property
    def no_truth(self) -> str:
        return (
            f"The index holds no tile that {self.data_name} names as true for a query, so nothing can be measured; the names in "
            "the index must be those of its gallery, below the folder that was described."
        )

    @property
    def lists_gallery(self) -> bool:
        return False

    def ranking(self) -> IndexRanking:
        return IndexRanking(self)

    @cached_property
    def retrieved(self) -> IndexRetrieval:
        return self.ranking().finish(lambda *_: None)

    def outcomes_of(self, ranking: Retrieval) -> Outcomes:
        assert isinstance(ranking, IndexRetrieval)
        outcomes = query_outcomes.outcomes_from_parts(ranking, ranking.parts, self.weights, self.known)
        return replace(outcomes, missed=ranking.missed)


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
        ranking = self._task.search_index(self._query, self._descriptor, weights, self._lengths, others)
        self._last = key, ranking
        return ranking


def index_task(
    model: Model,
    model_name: str,
    index: SharedIndex,
    queries: IndexQueries,
    depth: int = DEPTH,
    basemap: Map | None = None,
) -> IndexTask:
    """Return the task of some queries over an index.

    Args:
        model: describes queries; the index holds its descriptors.
        model_name: to display.
        depth: number of tiles that a search returns.
        basemap: map that windows are cut from.

    Raises:
        InputError: if the depth is less than 10, or the index holds no tiles, or none on the map.
        StoreError: if the index cannot be read, or holds descriptors of another model.
    """
    if check_count(depth, "depth") < MIN_DEPTH:
        raise InputError(f"The depth is {depth}; expected {MIN_DEPTH} or more, because R@10 is reported.")
    if not index.tiles:
        raise InputError("The index holds no tiles; add some with lpn index.")
    views = views_of(queries.name)
    model = model.for_task(*views)
    index.index.check_model(model.fingerprint)

    def make_picture(name: str, place: int) -> Picture:
        if (listed := queries.tiles.get(name)) is not None:
            return listed
        side = max(model.input_size)
        return tile_picture(
            name, _NO_PLACE + place, queries.root, queries.folders, basemap, side, lambda: gallery.degrees_of(place)
        )

    gallery = IndexGallery(make_picture)
    none = np.zeros(0, np.int64)
    truth = []
    for i in range(len(queries.pictures)):
        names = None if queries.true is None else queries.true[i]
        junk = np.sort(gallery.add(queries.junk[i])) if queries.junk else none
        truth.append(Truth(np.sort(gallery.add(names)) if names else none, junk, known=names is not None))
    places = queries.places or [None] * len(queries.pictures)
    ground, no_map = ground_of(probes(index, model), index.extent(), places, basemap)
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
        query_labels=labels_of(queries.pictures),
        gallery_labels=gallery.labels(),
        query_descriptors=queries.descriptors,
        truth=truth,
        geometry=None if ground is None else ground.geometry(places, gallery),
        index=index,
        search_depth=min(depth, index.tiles, index.index.most or depth),
        snapshots=_Snapshots(),
        contains=queries.contains,
        ground=ground,
        no_map=no_map,
        basemap=basemap,
    )
