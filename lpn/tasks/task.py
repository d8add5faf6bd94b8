"""A task of any source: queries, their gallery, and their truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self, cast

import numpy.typing as npt

from lpn import retrieval
from lpn.core.arrays import BoolArray, Float32Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.notebook_html import percentages
from lpn.core.tables import Column, Table
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model
from lpn.models.contract import Contract
from lpn.retrieval import Ranking, csls, metrics, scoring
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.csls import CslsTerms
from lpn.retrieval.metrics import Retrieval
from lpn.tasks import notes, query_outcomes
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.notes import Note
from lpn.tasks.query_outcomes import Outcomes

if TYPE_CHECKING:
    from lpn.tasks.measure import Result


# Ranks the gallery for one described query under part weights.
RankUnderWeights = Callable[[Float32Array], Ranking]
# The scorings of a gallery: by plain descriptors, by calibrated ones, and by calibrated ones under CSLS.
Scoring = Literal["plain", "calibrated", "csls"]
SCORINGS: Final[tuple[Scoring, ...]] = ("plain", "calibrated", "csls")


class LazyArray:
    """A field for an array, or for a function that returns it; the function is called once, when the field is first read."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, task: Any, owner: type) -> Float32Array:
        if task is None:
            raise AttributeError(self._name)  # so the field has no default
        value = vars(task)[self._name]
        if callable(value):
            value = vars(task)[self._name] = value()
        return cast(Float32Array, value)

    def __set__(self, task: Any, value: Float32Array | Callable[[], Float32Array]) -> None:
        vars(task)[self._name] = value


@dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Queries and their gallery; `dataclasses.replace` gives the task under other part weights.

    Attributes:
        name: such as "drone-to-satellite".
        model: None if another program computed the descriptors, so that no picture can be described again.
        model_name, data_name: names to display.
        root: the data set's folder.
        contract: of the model; for descriptors of another program, a contract for drawing.
        map_sizes: (h, w) of the feature map of each view.
        queries, gallery: the pictures.
        query_labels, gallery_labels: the place that each picture shows, (Q,) and (G,), -1 for junk.
        query_descriptors, gallery_descriptors: (Q, n, D) and (G, n, D), without part weights.
        truth: true matches and junk of each query, for data sets that list them; None if labels define the true matches.
        geometry: positions of the pictures, for example from a `geo.csv`; None without positions.
        weights: part weights, see `scoring.part_weights`; None for equal ones.
        notes: the user's tags and notes by the query's path, see `lpn.tasks.notes`.
        columns: further columns of the table about the queries.
        calibration: the origin of the pictures' zooms and the model's means; None without one.
        neighbours: of CSLS, see `lpn.retrieval.csls`; 0 ranks without it.
        no_map: a sentence with the reason why tiles have no positions on a map; empty if they have some, or it is unknown.
        of_index: the selection of the gallery from a larger index, in words; empty for a whole gallery.
        clauses: the origin of the descriptors, for the sentence of the protocol.
        change: of the queries; its weather falls on the gallery if the queries are tiles and the gallery is not.
        parts: the numbers, from 1, of the model's compared parts; empty for all.
        describe: describes changed pictures of a view, (N, n, D); None for `model` and the user's cache.
        dataset: the data set with groups and metrics to measure; None for recall and AP alone.
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
    query_descriptors: LazyArray = LazyArray()
    gallery_descriptors: LazyArray = LazyArray()
    truth: Sequence[Truth] | None = None
    geometry: GalleryGeometry | None = None
    weights: npt.ArrayLike | None = None
    notes: Mapping[str, Note] = field(default_factory=dict)
    columns: Sequence[Column] = ()
    calibration: Calibration | None = None
    neighbours: int = 0
    no_map: str = ""
    of_index: str = ""
    clauses: tuple[str, ...] = ()
    change: Change = UNCHANGED
    parts: tuple[int, ...] = ()
    describe: Callable[[Sequence[Picture], View, Change], Float32Array] | None = None
    dataset: Dataset | None = None

    def with_fields(self, **changes: Any) -> Self:
        """Return the task with other fields, like `dataclasses.replace`; unread descriptors stay unread."""
        unread = {one.name: partial(getattr, self, one.name) for one in fields(self) if "_descriptors" in one.name}
        return replace(self, **{**unread, **changes})

    @property
    def scoring(self) -> Scoring:
        """The scoring of the gallery."""
        return "csls" if self.neighbours else "plain" if self.calibration is None else "calibrated"

    @property
    def key(self) -> str:
        """The name, with the scoring unless it is plain: a unique text for each ranking of a data set's tasks under one model."""
        return scored_key(self.name, self.scoring)

    @property
    def query_view(self) -> View:
        """The view of the queries."""
        return views_of(self.name)[0]

    @property
    def gallery_view(self) -> View:
        """The view of the gallery."""
        return views_of(self.name)[1]

    @property
    def of_map(self) -> bool:
        """True if the tiles are pieces of a map, from any camera."""
        return len(self.gallery) > 0 and self.gallery[0].cut is not None and not self.gallery[0].missing

    @property
    def views(self) -> tuple[View, View]:
        """The views of queries and gallery."""
        return views_of(self.name)

    @property
    def tiles(self) -> int:
        """The number of gallery pictures."""
        return len(self.gallery_descriptors)

    @property
    def gallery_description(self) -> str:
        """The gallery in words, such as "951 tiles"."""
        noun = "tiles" if self.name.endswith("-to-satellite") else "gallery pictures"
        return f"{self.tiles:,} {noun}{self.of_index and f' {self.of_index}'}"

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
        """The part weights, with sum one, (n,)."""
        return scoring.part_weights(self.contract.n_parts, self.weights)

    def sides(self) -> tuple[Float32Array, Float32Array]:
        """Return the descriptors of all queries and of the whole gallery, (Q, n, D) and (G, n, D)."""
        return self.query_descriptors, self.gallery_descriptors

    @cached_property
    def compared(self) -> tuple[Float32Array, Float32Array]:
        """The descriptors for ranking by inner product, see `sides`; CSLS appends one number to each part."""
        return csls.scaled(*self.sides(), self.neighbours) if self.neighbours else self.sides()

    @property
    def csls_tiles(self) -> Float32Array | None:
        """The tiles' terms of CSLS, see `CslsTerms`, (G, n); None without it."""
        return -self.contract.n_parts * self.compared[1][..., -1] if self.neighbours else None

    @cached_property
    def retrieved(self) -> Retrieval:
        """The ranking of the gallery for each query under the part weights."""
        queries, gallery = self.compared
        factors = query_outcomes.weight_factors(queries, self.weights)
        return metrics.retrieve(queries, self.query_labels, gallery, self.gallery_labels, self.truth, factors)

    @cached_property
    def outcomes(self) -> Outcomes:
        """The outcome of each query under the part weights."""
        return query_outcomes.outcomes_of(self, self.retrieved)

    @cached_property
    def table(self) -> Table:
        """Return a row for each query: outcome, metadata, tags, and notes.

        Raises:
            InputError: if there are no pictures, see also `query_outcomes.table`.
        """
        if len(self.queries) < len(self.query_labels):
            raise no_pictures(self.data_name)
        table = query_outcomes.table(self, self.outcomes, self.part_names)
        return table.with_columns(notes.columns(self.notes, table.paths))

    @cached_property
    def metrics(self) -> dict[str, float]:
        """Return recall and AP in percent under the part weights, see `metrics.evaluate`."""
        return self.retrieved.metrics(self.known)

    def evaluate(self) -> Result:
        """Measure the task, see `lpn.tasks.measure.measure`."""
        from lpn.tasks.measure import measure

        return measure(self)

    @property
    def known(self) -> BoolArray | None:
        """The queries with a known truth, (Q,); None for all."""
        return metrics.known_queries(self.truth)

    @property
    def no_truth(self) -> str:
        """A sentence with the reason why nothing can be measured; empty if some query's truth is known."""
        if self.known is None or self.known.any():
            return ""
        return f"The true place of no query of {self.data_name} is known, so nothing can be measured."

    def without_truth(self, queries: Collection[int]) -> Self:
        """Return the task with the truth of some queries unknown, so that they are not graded.

        Raises:
            InputError: if labels, not a list, define the true matches.
        """
        if self.truth is None and queries:
            raise InputError(
                f"The true matches of {self.data_name} are defined by labels, so no query can be left ungraded; leave it out."
            )
        if self.truth is None or not any(self.truth[query].known for query in queries):
            return self
        truth = [replace(one, known=one.known and i not in queries) for i, one in enumerate(self.truth)]
        return replace(self, truth=truth)

    def search(self, query: int, weights: npt.ArrayLike | None = None, change: Change = UNCHANGED) -> Ranking:
        """Rank the gallery for one query.

        Args:
            query: its position.
            weights: part weights, see `scoring.part_weights`; None for the task's.
            change: applied to the query's picture, which the model then describes again.

        Raises:
            InputError: if there is no such query, the number of weights is wrong, or descriptors alone cannot be changed.
            LPNError: if the picture cannot be read.
        """
        if not 0 <= query < len(self.query_descriptors):
            raise InputError(
                f"There is no query {query}; queries have positions 0 to {len(self.query_descriptors) - 1}."
            )
        used = self.part_weights if weights is None else scoring.part_weights(self.contract.n_parts, weights)
        return self.ranks_under(query, used)(self._described(query, change))

    def _described(self, query: int, change: Change) -> Float32Array:
        if not change:
            descriptor: Float32Array = self.query_descriptors[query]
            return descriptor
        if self.model is None:
            raise InputError(
                f"{self.model_name} has descriptors but no network to describe a changed picture; leave the change out."
            )
        picture = self.queries[query]
        model, change = self.model.for_task(*self.views), change.for_picture(picture, picture.zoom)
        return retrieval.describe_picture(model, picture.load_cropped(), self.query_view, change).descriptor

    def start_search(
        self, query: int | None, descriptor: Float32Array, lengths: Float32Array | None = None
    ) -> RankUnderWeights:
        """Compare a described query, (n, D), with the gallery, and return a function that ranks it under part weights.

        The part cosines are computed once. Weights have sum one, (n,); the last call's ranking is cached.

        Args:
            query: its position; None if it is not of the data set.
            lengths: see `Ranking`.
        """
        cosines = scoring.part_cosines(descriptor, self.gallery_descriptors)
        # A region's score has no constants, and so no terms of CSLS.
        tiles = None if lengths is not None else self.csls_tiles
        terms = None if tiles is None else CslsTerms.of_query(cosines, tiles, self.neighbours)
        label = None if query is None else int(self.query_labels[query])
        truth = None if query is None or self.truth is None else self.truth[query]
        last: tuple[bytes, Ranking] | None = None

        def rank(weights: Float32Array) -> Ranking:
            nonlocal last
            found = last
            if found is None or found[0] != weights.tobytes():
                ranking = retrieval.rank(cosines, weights, self.gallery_labels, label, truth, lengths, terms)
                found = last = weights.tobytes(), ranking
            return found[1]

        return rank

    def ranks_under(self, query: int | None, weights: Float32Array | None = None) -> Callable[[Float32Array], Ranking]:
        """Return a function that ranks the gallery for other descriptors (n, D) of a query, for example in a sweep.

        Args:
            query: its position; None if it is not of the data set.
            weights: part weights with sum one, (n,); by default the task's.
        """
        used = self.part_weights if weights is None else weights
        return lambda descriptor: self.start_search(query, descriptor)(used)

    def _repr_html_(self) -> str:
        names = {"recall@1": "Recall@1", "recall@5": "Recall@5", "recall@10": "Recall@10", "ap": "AP"}
        figures = {title: self.metrics[name] for name, title in names.items()}
        caption = f"{self.data_name}, {self.name}: {len(self.query_labels):,} queries, {self.gallery_description}"
        return percentages(caption, "model", {self.model_name: figures})


def descriptor_clauses(contract: Contract) -> tuple[str, ...]:
    """Return the origin of a model's descriptor, as clauses of the protocol's sentence."""
    mirrored = ("descriptors of picture and mirror added",) if contract.mirror == "sum" else ()
    return *mirrored, "each part normalised" if contract.n_parts > 1 else "normalised"


def no_pictures(name: str) -> InputError:
    """Return the error for a saved result that was opened without the data set of its pictures."""
    return InputError(f"{name} holds no pictures; give the data set that it was computed on as --data.")


def scored_key(name: str, scoring: Scoring) -> str:
    """Return the key of a task's ranking under a scoring, see `Task.key`."""
    return name if scoring == "plain" else f"{name}, {scoring}"
