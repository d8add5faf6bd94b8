"""One task of a data set under one model, with everything that is computed from its descriptors on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

import numpy.typing as npt

from lpn import descriptors, retrieval
from lpn.analysis import notes, query_outcomes
from lpn.analysis.gallery_geometry import GalleryGeometry
from lpn.analysis.notes import Note
from lpn.analysis.query_outcomes import Outcomes
from lpn.core.arrays import BoolArray, Float32Array, Int64Array
from lpn.core.demo import own_file
from lpn.core.errors import DataError, InputError, PictureError
from lpn.core.files import printable
from lpn.core.notebook_html import percentages
from lpn.core.tables import Column, Table
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth
from lpn.explain import counterfactual
from lpn.explain.counterfactual import Effect
from lpn.models.base import Model
from lpn.models.contract import Contract
from lpn.retrieval import Ranking, metrics, scoring
from lpn.retrieval.calibration import Calibration, calibrate
from lpn.retrieval.evaluate import check_test_split, lists_of
from lpn.retrieval.metrics import Retrieval

if TYPE_CHECKING:
    from lpn.retrieval.evaluate import Result
    from lpn.retrieval.protocol import Protocol as EvaluationProtocol


class RankUnderWeights(Protocol):
    """Ranks a gallery for one described query; equal arguments return the same ranking again."""

    def __call__(self, weights: Float32Array, also: int | None = None) -> Ranking:
        """Rank under weights that sum to one, (n,).

        Args:
            also: gallery position of a tile that the ranking must hold, even if it lies beyond the searched depth.
        """
        ...


class RankingOfAll(Protocol):
    """The ranking of all queries of a task; not thread-safe."""

    def finish(self, progress: Callable[[int, int], None]) -> Retrieval:
        """Rank the queries that are not ranked yet; `progress` may raise an exception to stop, and the next call continues."""
        ...


@dataclass(frozen=True, eq=False)
class Task:
    """Queries, a gallery, and the descriptors of both; `dataclasses.replace` gives the task under other part weights.

    Attributes:
        name: such as "drone-to-satellite".
        model: None where another program computed the descriptors, so that no picture can be described again.
        model_name, data_name: names to display.
        root: the data set's folder.
        contract: the model's, or that by which another program's parts are drawn.
        map_sizes: (h, w) of the feature map of each view.
        queries, gallery: the pictures.
        query_labels, gallery_labels: the place that each picture shows, (Q,) and (G,), -1 for junk.
        query_descriptors, gallery_descriptors: (Q, n, D) and (G, n, D), without part weights.
        truth: true matches and junk of each query, for data sets that list them; None if labels define the true matches.
        geometry: positions of the pictures; None without positions, such as those of a `geo.csv`.
        identity: digests of both sides' descriptors, for the key of the cached ranking; empty if a digest is missing.
        weights: part weights, see `scoring.part_weights`; None for equal ones.
        notes: a person's tags and notes by the query's path, see `lpn.analysis.notes`.
        columns: further columns of the table about the queries.
        calibration: what the pictures' zooms and the model's means come from; None without one.
    """

    name: str
    model: Model | None
    model_name: str
    data_name: str
    root: Path
    contract: Contract
    map_sizes: Mapping[View, tuple[int, int]]
    queries: Sequence[Picture]
    gallery: Sequence[Picture]
    query_labels: Int64Array
    gallery_labels: Int64Array
    query_descriptors: Float32Array
    gallery_descriptors: Float32Array
    truth: Sequence[Truth] | None = None
    geometry: GalleryGeometry | None = None
    identity: str = ""
    weights: npt.ArrayLike | None = None
    notes: Mapping[str, Note] = field(default_factory=dict)
    columns: Sequence[Column] = ()
    calibration: Calibration | None = None

    @property
    def query_view(self) -> View:
        """The view of the queries."""
        return views_of(self.name)[0]

    @property
    def gallery_view(self) -> View:
        """The view of the gallery."""
        return views_of(self.name)[1]

    @property
    def views(self) -> tuple[View, View]:
        """The views of queries and gallery."""
        return views_of(self.name)

    @property
    def tiles(self) -> int:
        """The number of searched tiles."""
        return len(self.gallery)

    @property
    def depth(self) -> int | None:
        """The number of tiles whose order a ranking tells; None for all."""
        return None

    @property
    def gallery_description(self) -> str:
        """The gallery in words, such as "951 tiles"."""
        return f"{self.tiles:,} {'tiles' if self.gallery_view == 'satellite' else 'gallery pictures'}"

    @property
    def no_map(self) -> str:
        """Why tiles have no positions on a map, as a sentence; empty if they have, or nothing can be said."""
        return ""

    @cached_property
    def query_names(self) -> list[str]:
        """The queries' names."""
        return [picture.name for picture in self.queries]

    @property
    def part_names(self) -> list[str]:
        """The parts' names in the queries' view."""
        return self.contract.names(self.query_view)

    @cached_property
    def part_weights(self) -> Float32Array:
        """The part weights, summing to one, (n,)."""
        return scoring.part_weights(self.contract.n_parts, self.weights)

    @property
    def approximate(self) -> bool:
        """True if a search may leave out tiles that are nearer than those it returns."""
        return False

    @property
    def lists_gallery(self) -> bool:
        """True if `gallery` is the whole gallery; False if it holds what searches returned, in their order."""
        return True

    @cached_property
    def retrieved(self) -> Retrieval:
        """The ranking of the gallery for each query under the part weights."""
        return metrics.retrieve(
            self.query_descriptors,
            self.query_labels,
            self.gallery_descriptors,
            self.gallery_labels,
            self.truth,
            query_outcomes.weight_factors(self.query_descriptors, self.weights),
        )

    def ranking(self) -> RankingOfAll:
        """A ranking of all queries under equal part weights that can be stopped and resumed."""
        from lpn.analysis.ranking_cache import ResumableRanking

        return ResumableRanking(self)

    @cached_property
    def outcomes(self) -> Outcomes:
        """The outcome of each query under the part weights."""
        return self.outcomes_of(self.retrieved)

    @cached_property
    def table(self) -> Table:
        """One row per query: outcome, metadata, tags, and notes; see `query_outcomes.table` for the errors."""
        table = self.tabulate(self.outcomes, self.part_names)
        return table.with_columns(notes.columns(self.notes, table.paths))

    def tabulate(self, outcomes: Outcomes, part_names: Sequence[str]) -> Table:
        """One row per query, without tags and notes; see `query_outcomes.table`."""
        columns = [*self.columns, *query_outcomes.listed_columns(outcomes, self.truth)]
        return query_outcomes.table(self.root, self.queries, self.gallery, outcomes, part_names, self.geometry, columns)

    @property
    def known(self) -> BoolArray | None:
        """The queries whose truth is known, (Q,); None for all."""
        return metrics.known_queries(self.truth)

    def evaluate(self, protocol: EvaluationProtocol | None = None) -> Result:
        """Evaluate the task, see `lpn.analysis.evaluation.evaluate_task`."""
        from lpn.analysis.evaluation import evaluate_task

        return evaluate_task(self, protocol)

    def check_truth(self) -> None:
        """Raise InputError unless the truth of some query is known."""
        if self.known is not None and not self.known.any():
            raise InputError(self.no_truth)

    @property
    def no_truth(self) -> str:
        """Why nothing can be measured where no query's truth is known, as a sentence."""
        return f"The true place of no query of {self.data_name} is known, so nothing can be measured."

    def _repr_html_(self) -> str:
        """The task in a notebook: recall and AP of all queries."""
        names = {"recall@1": "Recall@1", "recall@5": "Recall@5", "recall@10": "Recall@10", "ap": "AP"}
        figures = {title: self.metrics[name] for name, title in names.items()}
        caption = f"{self.data_name}, {self.name}: {len(self.queries):,} queries, {self.gallery_description}"
        return percentages(caption, "model", {self.model_name: figures})

    @cached_property
    def metrics(self) -> dict[str, float]:
        """Recall and AP in percent under the part weights, see `metrics.evaluate`; NaN where a search does not tell it."""
        return self.retrieved.metrics(self.known)

    def label_and_truth(self, query: int | None) -> tuple[int | None, Truth | None]:
        """The label and the list of true matches of a query, each None if unknown."""
        if query is None:
            return None, None
        return int(self.query_labels[query]), None if self.truth is None else self.truth[query]

    def current(self) -> Task:
        """The task with labels and positions of all tiles that `gallery` has by now; a gallery in memory does not grow."""
        return self

    def without_picture(self, index: int) -> str:
        """Why a tile's picture is not at hand, so that a placeholder stands for it, as a sentence; empty if it is."""
        del index
        return ""

    def stored_descriptor(self, index: int) -> Float32Array:
        """The descriptor of a gallery picture as it is searched, (n, D)."""
        return cast(Float32Array, self.gallery_descriptors[index])

    def start_search(
        self, query: int | None, descriptor: Float32Array, lengths: Float32Array | None = None
    ) -> RankUnderWeights:
        """Compare a described query, (n, D), with the gallery.

        Args:
            query: its position; None if it is not of the data set.
            lengths: see `Ranking`.

        Returns:
            The function that ranks the gallery under part weights.
        """
        return _GalleryRanks(self, query, descriptor, lengths)

    def ranks_under(
        self, query: int | None, weights: Float32Array | None = None, also: int | None = None
    ) -> Callable[[Float32Array], Ranking]:
        """A function that ranks the gallery for other descriptors (n, D) of a query, as a sweep needs.

        Args:
            query: its position; None if it is not of the data set.
            weights: part weights that sum to one, (n,); by default the task's.
            also: see `RankUnderWeights`.
        """
        used = self.part_weights if weights is None else weights
        return lambda descriptor: self.start_search(query, descriptor)(used, also)

    def outcomes_of(self, ranking: Retrieval) -> Outcomes:
        """The outcomes of all queries, ranked under the task's weights."""
        return query_outcomes.outcomes_of(
            ranking, self.query_descriptors, self.gallery_descriptors, self.weights, self.known
        )

    def tile_name(self, index: int) -> str:
        """The name of a tile, by which `find_tile` finds it."""
        return self.gallery[index].name

    def find_tile(self, name: str) -> int | None:
        """The gallery position of a tile by its name, the first on ties; None if there is no such tile."""
        return next((i for i, tile in enumerate(self.gallery) if tile.name == name), None)

    def effect(self, before: npt.ArrayLike | None, after: npt.ArrayLike, first: Int64Array | None = None) -> Effect:
        """Compare two sets of part weights over all queries, see `counterfactual.effect`; InputError if that is not possible."""
        return counterfactual.effect(
            self.query_descriptors,
            self.gallery_descriptors,
            before,
            after,
            self.query_labels,
            self.gallery_labels,
            self.truth,
            first,
        )

    def rank(
        self, query: int | None, cosines: Float32Array, weights: Float32Array, lengths: Float32Array | None = None
    ) -> Ranking:
        """Rank the gallery by its cosines (G, n) with a query; `query` is None if it is not of the data set."""
        return retrieval.rank(cosines, weights, self.gallery_labels, *self.label_and_truth(query), lengths)


class _GalleryRanks:
    """Ranks a gallery in memory: the part cosines are computed once, and serve all weights."""

    def __init__(self, task: Task, query: int | None, descriptor: Float32Array, lengths: Float32Array | None) -> None:
        self._task, self._query, self._lengths = task, query, lengths
        self._cosines = scoring.part_cosines(descriptor, task.gallery_descriptors)
        self._last: tuple[bytes, Ranking] | None = None

    def __call__(self, weights: Float32Array, also: int | None = None) -> Ranking:
        del also  # every tile is ranked
        if self._last is None or self._last[0] != weights.tobytes():
            ranking = self._task.rank(self._query, self._cosines, weights, self._lengths)
            self._last = weights.tobytes(), ranking
        return self._last[1]


def open_task(
    model: Model,
    model_name: str,
    dataset: Dataset,
    name: str | None = None,
    weights: npt.ArrayLike | None = None,
    tags_and_notes: Mapping[str, Note] | None = None,
    calibration: Calibration | None = None,
) -> Task:
    """Describe queries and gallery of a task, or read their stored descriptors.

    Args:
        model_name: the model's name to display.
        name: the task, see `choose_task`.
        weights: part weights, see `scoring.part_weights`.
        tags_and_notes: by the query's path; by default those in the data set's folder.
        calibration: see `calibrated`; its zooms and means are applied to `model`, which is that before the calibration.

    Raises:
        InputError: when model and data set do not offer the task, or the weights are invalid.
        LPNError: when pictures, positions, truth, or stores cannot be read.
    """
    name, offered = choose_task(model, dataset, name), offered_tasks(model, dataset)
    scoring.part_weights(model.n_parts, weights)
    if tags_and_notes is None:
        tags_and_notes = notes.read_notes(own_file(dataset.root, notes.NAME))
    views = views_of(name)
    model = model.for_task(*views)
    queries, gallery = dataset.queries(views[0]), dataset.gallery(views[1])
    geometry = gallery_geometry(dataset, queries, gallery)
    try:
        if calibration is None:
            query_side = descriptors.shipped_or_cached(model, queries, views[0], dataset.root, "query")
            gallery_side = descriptors.shipped_or_cached(model, gallery, views[1], dataset.root, "gallery")
        else:
            query_side, gallery_side = (
                calibration.stored(model, side, view, descriptors.descriptor_reader(dataset.root))
                for side, view in zip((queries, gallery), views, strict=True)
            )
    except PictureError:  # of one list; name the broken pictures of all lists at once
        check_test_split(dataset, offered)
        raise
    if calibration is not None:
        queries, gallery = calibration.pictures(views[0], queries), calibration.pictures(views[1], gallery)
        model = calibration.applied(model)
    identities = query_side.identity, gallery_side.identity
    return Task(
        name=name,
        model=model,
        model_name=printable(model_name),
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        contract=model.contract,
        map_sizes={view: model.map_size(view) for view in views},
        queries=queries,
        gallery=gallery,
        query_labels=query_outcomes.labels_of(queries),
        gallery_labels=query_outcomes.labels_of(gallery),
        query_descriptors=query_side.descriptors,
        gallery_descriptors=gallery_side.descriptors,
        truth=dataset.truth(name),
        geometry=geometry,
        identity=" ".join(identities) if all(identities) else "",
        weights=weights,
        notes=tags_and_notes,
        columns=dataset.columns(queries),
        calibration=calibration,
    )


def calibrated(model: Model, dataset: Dataset) -> Calibration:
    """Calibrate a model on the pictures of all tasks that it offers, so that all tasks are searched by one model.

    Raises:
        InputError: when the model's branches have roles, so that a task decides its descriptors, or pictures are too few.
        LPNError: when pictures cannot be read.
    """
    if model.contract.roles == "role":
        raise InputError(
            f"{model.contract.method} describes a view otherwise as query than as gallery, and a calibration is for all tasks; "
            "leave --calibrate out."
        )
    tasks = offered_tasks(model, dataset)
    if not tasks:
        raise no_task_error(model, dataset)
    check_test_split(dataset, tasks)
    lists: dict[View, list[Sequence[Picture]]] = {}
    for name, pictures in lists_of(dataset, tasks).items():
        lists.setdefault(cast(View, name.split()[1]), []).append(pictures)
    return calibrate(model, lists, descriptors.descriptor_reader(dataset.root))


def gallery_geometry(
    dataset: Dataset, queries: Sequence[Picture], gallery: Sequence[Picture]
) -> GalleryGeometry | None:
    """The geometry of a task from the data set's positions; None without any."""
    positions = dataset.positions()
    return None if positions is None else GalleryGeometry.of(positions.of(queries), positions.of(gallery))


def offered_tasks(model: Model, dataset: Dataset) -> list[str]:
    """The tasks of a data set whose views a model knows."""
    return [name for name in dataset.tasks() if set(views_of(name)) <= set(model.views)]


def no_task_error(model: Model, dataset: Dataset) -> DataError:
    """Return the error for a model and a data set without any of `offered_tasks`."""
    name = printable(dataset.root.resolve().name)
    if not (tasks := dataset.tasks()):
        return DataError(f"{name} {dataset.why_no_task()}.")
    return DataError(
        f"The test split of {name} is for {', '.join(tasks)}, and the model knows only {' and '.join(model.views)} pictures; "
        "choose another data set or model."
    )


def choose_task(model: Model, dataset: Dataset, name: str | None = None) -> str:
    """The given task, or the first of `offered_tasks`.

    Raises:
        DataError: when there is none.
        InputError: when the data set does not have the task, or the model does not know its views.
    """
    offered = offered_tasks(model, dataset)
    if not offered:
        raise no_task_error(model, dataset)
    name = name or offered[0]
    if name not in offered:
        raise InputError(
            f"The task is {name}; with this model, {dataset.root.name} has the tasks {', '.join(offered)}."
        )
    return name
