"""Two or more models on the same queries and the same gallery: figures with intervals, and paired tests.

Intervals are percentiles of a bootstrap: places are drawn with replacement, each with all its queries, the same draws for all
models.
A paired test (McNemar 1947) asks whether two models that each find b and c queries the other misses could be equally good.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lpn.analysis.text_tables import TableSection, TextTable
from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.datasets import Dataset, geo
from lpn.descriptors import Reader, cached_descriptors
from lpn.models.base import Model
from lpn.retrieval import csls, metrics
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.evaluate import FULL, WITHOUT
from lpn.retrieval.saved import PublishedResult, published_pictures
from lpn.retrieval.sides import TaskPictures
from lpn.tasks.task import Task

GalleryChoice = Literal["full", "without-distractors"]
DEPTHS = (1, 5, 10)
RESAMPLES = 1000
# Share of the bootstrap's means within an interval.
LEVEL = 0.95
# Up to so many queries that only one of two models finds, the test is the exact binomial one.
_MAX_EXACT = 1000


@dataclass(frozen=True, eq=False)
class RankedModel:
    """One model's ranking of a task.

    Attributes:
        name: to display.
        task: such as "drone-to-satellite".
        gallery_name: with its size, such as "full gallery, 951".
        queries, gallery: paths of the ranked queries and gallery pictures below the data set's folder; of an index the names of
            the true tiles, as it does not list the others.
        labels: the place of each query, (Q,).
        first: 0-based rank of each query's first true match, -1 without one, (Q,); the depth of a search beyond it.
        precision: average precision of each query, 0 .. 1, (Q,); NaN if a search does not return all ranks.
    """

    name: str
    task: str
    gallery_name: str
    queries: tuple[str, ...]
    gallery: frozenset[str]
    labels: Int64Array
    first: Int64Array
    precision: Float64Array

    def within(self, depth: int) -> BoolArray:
        """Return the queries whose first true match is among the nearest `depth`, (Q,)."""
        return np.asarray((self.first >= 0) & (self.first < depth))

    def in_order(self, queries: Sequence[str]) -> RankedModel:
        """Return the ranking with its queries in another order; they must be the same, and each of them once."""
        if self.queries == tuple(queries):
            return self
        at = {query: row for row, query in enumerate(self.queries)}
        rows = np.array([at[query] for query in queries], np.int64)
        sides = self.labels[rows], self.first[rows], self.precision[rows]
        return RankedModel(self.name, self.task, self.gallery_name, tuple(queries), self.gallery, *sides)


@dataclass(frozen=True)
class Estimate:
    """A percentage with its bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"

    def difference(self) -> dict[str, Any]:
        """Return a paired difference as JSON values."""
        return {"difference": self.value, "interval": [self.low, self.high]}


@dataclass(frozen=True)
class PairedTest:
    """Two models at Recall@1.

    Attributes:
        first, second: their names.
        only_first, only_second: numbers of queries that only one of them finds.
        both, neither: numbers of the other queries.
        p: the two-sided p-value of McNemar's test.
        exact: True for the binomial test; False for chi-square with continuity correction.
    """

    first: str
    second: str
    only_first: int
    only_second: int
    both: int
    neither: int
    p: float
    exact: bool


@dataclass(frozen=True, eq=False)
class ModelTable:
    """Models that ranked the same queries in the same gallery.

    Attributes:
        task, gallery_name: common to all.
        models: rankings, their queries in one order.
        seed, resamples: of the bootstrap.
    """

    task: str
    gallery_name: str
    models: tuple[RankedModel, ...]
    seed: int
    resamples: int

    @property
    def queries(self) -> int:
        """Number of queries."""
        return len(self.models[0].queries)

    @property
    def places(self) -> int:
        """Number of places that the queries show."""
        return len(np.unique(self.models[0].labels))

    @cached_property
    def figures(self) -> list[dict[str, Estimate]]:
        """For each model its `R@1`, `R@5`, `R@10`, and `AP`, in percent; without `AP` if a ranking is incomplete."""
        ranked_all = not any(np.isnan(one.precision).any() for one in self.models)
        names = [*(f"R@{depth}" for depth in DEPTHS), *(["AP"] if ranked_all else [])]
        values = np.stack(
            [
                [*(one.within(depth) for depth in DEPTHS), *([one.precision] if ranked_all else [])]
                for one in self.models
            ]
        )
        estimates = intervals(
            values.reshape(-1, self.queries).astype(np.float64), self.models[0].labels, self.seed, self.resamples
        )
        rows = iter(estimates)
        return [{name: next(rows) for name in names} for _ in self.models]

    @cached_property
    def tests(self) -> list[PairedTest]:
        """A paired test for each two models."""
        return [paired_test(a, b) for a, b in combinations(self.models, 2)]

    @property
    def sentence(self) -> str:
        """How the figures were made, in words."""
        return (
            f"{self.task}, {self.gallery_name} pictures ranked for {self.queries} queries of {self.places} places. Intervals "
            f"hold {100 * LEVEL:.0f} % of {self.resamples} bootstrap means over places, seed {self.seed}. p is of McNemar's "
            "two-sided test on Recall@1, which takes queries as independent; several queries of one place are not, so it is then "
            "too small."
        )

    def to_dict(self) -> dict[str, Any]:
        """The comparison as JSON values."""
        models = [
            {"name": one.name, **{key: {"value": e.value, "low": e.low, "high": e.high} for key, e in of.items()}}
            for one, of in zip(self.models, self.figures, strict=True)
        ]
        facts = {"task": self.task, "gallery": self.gallery_name, "queries": self.queries, "places": self.places}
        bootstrap = {"seed": self.seed, "resamples": self.resamples, "level": LEVEL}
        return {
            **facts,
            "bootstrap": bootstrap,
            "models": models,
            "tests": [vars(test) for test in self.tests],
            "protocol": self.sentence,
        }

    @property
    def section(self) -> TableSection:
        """A table of figures, a table of paired tests, and the sentence."""
        names = list(self.figures[0])
        figures = TextTable(
            ("model", *names),
            [(one.name, *map(str, of.values())) for one, of in zip(self.models, self.figures, strict=True)],
        )
        tests = []
        for test in self.tests:
            counts = (test.only_first, test.only_second, test.both, test.neither)
            p = f"{test.p:.3g}{'' if test.exact else ' (chi-square)'}"
            tests.append((test.first, test.second, *map(str, counts), p))
        head = ("A", "B", "only A", "only B", "both", "neither", "p")
        return TableSection(
            f"{self.task}, {self.gallery_name}",
            (figures, TextTable(head, tests, texts=2, title="Paired tests")),
            after=self.sentence,
        )

    def to_markdown(self) -> str:
        """Return the tables and the sentence, without a title."""
        return "\n".join(replace(self.section, title="").markdown_lines())

    def to_csv(self) -> bytes:
        """Return one line a model: its figures with intervals, and its test against each other model."""
        against = [f"{what} {one.name}" for one in self.models for what in ("only this, not", "only", "p against")]
        columns = [f"{name}{bound}" for name in self.figures[0] for bound in ("", " low", " high")]
        rows: list[list[object]] = [["model", "task", "gallery", "queries", *columns, *against]]
        for one, of in zip(self.models, self.figures, strict=True):
            figures = [f"{number:.4f}" for e in of.values() for number in (e.value, e.low, e.high)]
            tests = [cell for other in self.models for cell in self._against(one.name, other.name)]
            rows.append([one.name, self.task, self.gallery_name, self.queries, *figures, *tests])
        return csv_bytes(rows)

    def _against(self, name: str, other: str) -> tuple[str, str, str]:
        for test in self.tests:
            if (test.first, test.second) == (name, other):
                return str(test.only_first), str(test.only_second), f"{test.p:.6g}"
            if (test.second, test.first) == (name, other):
                return str(test.only_second), str(test.only_first), f"{test.p:.6g}"
        return "", "", ""


def rank_model(
    model: Model,
    name: str,
    dataset: Dataset,
    task: str,
    gallery: GalleryChoice = "full",
    read: Reader = cached_descriptors,
    calibration: Calibration | None = None,
    neighbours: int = 0,
) -> RankedModel:
    """Rank a task by a model; queries whose truth is not known are left out.

    Args:
        calibration: the model's, see `lpn.tasks.opening.task_calibration`; None ranks plain.
        neighbours: of CSLS, see `lpn.retrieval.csls`; 0 ranks by inner product alone.

    Raises:
        InputError: when the data set lacks the task, the model a view, the gallery distractors to leave out, or CSLS queries.
        DataError: when the test split is incomplete.
    """
    pictures = TaskPictures.of(dataset, task)
    for view in pictures.views:
        model.check_view(view)
    if neighbours:
        csls.check_neighbours(neighbours, len(pictures.queries))
    sides = pictures.described(model.for_task(*pictures.views), read, calibration=calibration)
    compared = csls.scaled(*sides, neighbours) if neighbours else sides
    return _ranked(name, dataset.root, pictures, gallery, compared, pictures.labels)


def has_distractors(pictures: TaskPictures) -> bool:
    """Return True if the gallery of a task has places that no query shows, and lists name no true matches."""
    if pictures.truth is not None:
        return False
    queries, gallery = pictures.labels
    return bool((metrics.without_distractors(gallery, queries) == metrics.JUNK).any())


def rank_published(saved: PublishedResult, name: str, dataset: Dataset, gallery: GalleryChoice = "full") -> RankedModel:
    """Rank the descriptors of a published result, whatever their norms.

    Raises:
        InputError: when a picture occurs twice, or the gallery has no distractors to leave out.
        DataError: when its pictures are not in the data set.
    """
    pictures, labels = published_pictures(saved, dataset)
    for side in (pictures.queries, pictures.gallery):  # rows of one picture are not told apart in another result
        if repeated := _repeated(geo.names_below(dataset.root, side)):
            raise InputError(f"{name} holds {printable(repeated)} twice; expected one descriptor of each picture.")
    return _ranked(name, dataset.root, pictures, gallery, (saved.query, saved.gallery), labels)


def rank_task(task: Task, name: str, weights: Sequence[float] | None = None) -> RankedModel:
    """Rank an opened task, whatever it was opened from, under part weights, equal ones by default.

    Indexes count as one gallery if they hold the same number of tiles and the same true ones.

    Raises:
        InputError: when no query's truth is known.
        StoreError: when an index cannot be read.
    """
    task = replace(task, weights=weights)
    task.check_truth()
    if task.lists_gallery:
        pictures = TaskPictures(task.name, task.queries, task.gallery, task.truth)
        query, gallery = task.compared
        if weights is not None:
            query = query * task.part_weights[:, None]
        return _ranked(name, task.root, pictures, "full", (query, gallery), (task.query_labels, task.gallery_labels))
    retrieval, known = task.retrieved, task.known
    kept = np.ones(len(task.queries), bool) if known is None else known
    queries = np.array(geo.names_below(task.root, task.queries), object)
    return RankedModel(
        name,
        task.name,
        f"index, {task.tiles:,}",
        tuple(queries[kept].tolist()),
        frozenset(task.tile_name(i) for lists in task.truth or () for i in lists.good.tolist()),
        task.query_labels[kept],
        retrieval.first[kept],
        retrieval.precision[kept],
    )


def _repeated(names: Sequence[str]) -> str:
    """Return the first name that occurs twice, or ""."""
    return next((name for name, count in Counter(names).items() if count > 1), "")


def _ranked(
    name: str,
    root: Path,
    pictures: TaskPictures,
    gallery: GalleryChoice,
    sides: tuple[Float32Array, Float32Array],
    labels: tuple[Int64Array, Int64Array],
) -> RankedModel:
    truth, of_gallery = pictures.truth, labels[1]
    kept = np.ones(len(of_gallery), bool)
    if gallery != "full":
        if truth is not None:
            raise InputError(
                f"True matches of {root.name} are listed, so no gallery picture is a distractor; leave --gallery out."
            )
        of_gallery = metrics.without_distractors(of_gallery, labels[0])
        kept = of_gallery != metrics.JUNK
        if kept.all():
            raise InputError(
                f"Each place of the gallery of {root.name} has a query, so it has no distractors; leave --gallery out."
            )
    retrieval = metrics.retrieve(sides[0], labels[0], sides[1], of_gallery, truth)
    query_names, tiles = (
        np.array(geo.names_below(root, side), object) for side in (pictures.queries, pictures.gallery)
    )
    known = metrics.known_queries(truth)
    known = np.ones(len(query_names), bool) if known is None else known
    size = int(kept.sum())
    return RankedModel(
        name,
        pictures.name,
        f"{FULL if gallery == 'full' else WITHOUT}, {size:,}",
        tuple(query_names[known].tolist()),
        frozenset(tiles[kept].tolist()),
        labels[0][known],
        retrieval.first[known],
        retrieval.precision[known],
    )


def compare(models: Sequence[RankedModel], seed: int = 0, resamples: int = RESAMPLES) -> ModelTable:
    """Compare two or more models.

    Raises:
        InputError: when there are fewer than two, names repeat, tasks, galleries, or queries differ, or a repeated query has
            another place in the order of one of them.
    """
    if len(models) < 2:
        raise InputError(f"A comparison takes two models or more; found {len(models)}.")
    if not (seed >= 0 and 1 <= resamples <= 1_000_000):
        raise InputError(
            f"Seed and resamples are {seed} and {resamples}; expected a seed from 0 and 1 to 1,000,000 resamples."
        )
    if len({one.name for one in models}) < len(models):
        raise InputError(f"The models are called {', '.join(one.name for one in models)}; expected different names.")
    first = models[0]
    for other in models[1:]:
        if other.task != first.task:
            raise InputError(
                f"{first.name} ranked {first.task}, and {other.name} {other.task}; compare models on one task."
            )
        if other.gallery != first.gallery or other.gallery_name != first.gallery_name:
            raise InputError(
                f"{first.name} ranked the {first.gallery_name}, and {other.name} the {other.gallery_name}"
                f"{'' if other.gallery_name != first.gallery_name else ' of other pictures'}; figures on two galleries do not "
                "compare."
            )
        if Counter(other.queries) != Counter(first.queries):
            raise InputError(
                f"{first.name} has {len(first.queries)} queries, and {other.name} {len(other.queries)}, which are not the same; "
                "compare models on the same queries."
            )
        if other.queries != first.queries and (repeated := _repeated(first.queries)):
            raise InputError(
                f"{first.name} and {other.name} have their queries in different orders, and {printable(repeated)} is among them "
                "more than once; save both in one order."
            )
    ordered = tuple(one.in_order(first.queries) for one in models)
    return ModelTable(first.task, first.gallery_name, ordered, seed, resamples)


def intervals(values: Float64Array, labels: Int64Array, seed: int, resamples: int) -> list[Estimate]:
    """Return the mean of each row in percent with its bootstrap interval; the draws are common to all rows.

    Args:
        values: of the queries, 0 .. 1, (M, Q).
        labels: the place of each query, (Q,); places are drawn, each with all its queries.
    """
    places, of_query = np.unique(labels, return_inverse=True)
    counts = np.bincount(of_query, minlength=len(places)).astype(np.float64)
    sums = np.stack([np.bincount(of_query, row, minlength=len(places)) for row in values])
    rng = np.random.default_rng(seed)
    means = np.empty((resamples, len(values)))
    for draw in range(resamples):
        times = np.bincount(rng.integers(len(places), size=len(places)), minlength=len(places)).astype(np.float64)
        means[draw] = sums @ times / (counts @ times)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    mean = values.mean(axis=1)
    return [Estimate(*(100 * float(number) for number in row)) for row in zip(mean, low, high, strict=True)]


def paired_test(first: RankedModel, second: RankedModel) -> PairedTest:
    """Compare two models at Recall@1; their queries must be in one order."""
    a, b = first.within(1), second.within(1)
    only_first, only_second = int((a & ~b).sum()), int((b & ~a).sum())
    p, exact = mcnemar(only_first, only_second)
    return PairedTest(
        first.name, second.name, only_first, only_second, int((a & b).sum()), int((~a & ~b).sum()), p, exact
    )


def mcnemar(only_first: int, only_second: int) -> tuple[float, bool]:
    """Return the two-sided p-value of McNemar's test, and whether it is exact.

    Up to 1000 discordant queries it is the binomial test with probability 1/2, above it chi-square with continuity correction.
    """
    total = only_first + only_second
    if total <= _MAX_EXACT:
        tail = sum(math.comb(total, k) for k in range(min(only_first, only_second) + 1))
        return min(1.0, 2 * tail / 2**total), True
    statistic = max(abs(only_first - only_second) - 1, 0) ** 2 / total
    return math.erfc(math.sqrt(statistic / 2)), False
