"""Recall, AP, and further metrics of a task by the published protocols, for any source."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError
from lpn.core.notebook_html import percentages
from lpn.datasets import Picture, Truth, geo
from lpn.descriptors.transforms import Change
from lpn.retrieval import csls, metrics
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.field_metrics import field_figures, nearest
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.task import Task, no_pictures

# Distances in metres within which an answer counts as near.
WITHIN = (25, 50, 100)
FULL = "full gallery"
WITHOUT = "without distractors"
GalleryChoice = Literal["full", "without-distractors"]


@dataclass(frozen=True, eq=False)
class Figures:
    """Recall and AP of some queries on one gallery.

    Attributes:
        gallery_name: "full gallery", or "without distractors" for a gallery without the places that no query shows.
        recall: Recall@K in percent for "1", "5", "10", and "1%"; the last takes K from the size of the full gallery.
        ap: mean average precision in percent.
        queries: number of queries (places, if queries are averaged).
        gallery: number of ranked gallery pictures; for a full gallery all pictures, junk included.
    """

    gallery_name: str
    recall: dict[str, float]
    ap: float
    queries: int
    gallery: int

    @property
    def name(self) -> str:
        """The gallery's name with its size, such as "full gallery, 951"."""
        return f"{self.gallery_name}, {self.gallery:,}"

    def to_dict(self) -> dict[str, Any]:
        """The figures as JSON values."""
        sizes = {"queries": self.queries, "gallery": self.gallery}
        return {"gallery_name": self.gallery_name, **self.shares(), **sizes}

    def shares(self) -> dict[str, float | None]:
        """Recall and AP as JSON values, None for NaN."""
        values = {**{f"recall@{k}": value for k, value in self.recall.items()}, "ap": self.ap}
        return {name: None if math.isnan(value) else value for name, value in values.items()}


@dataclass(frozen=True, eq=False)
class RankedModel:
    """One model's ranking of a task.

    Attributes:
        name: to display.
        task: such as "drone-to-satellite".
        gallery_name: with its size, such as "full gallery, 951".
        queries, gallery: paths of the ranked queries and gallery pictures below the data set's folder.
        labels: the place of each query, (Q,).
        first: 0-based rank of each query's first true match, -1 without one, (Q,).
        precision: average precision of each query, 0 .. 1, (Q,).
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
        """Return the ranking with its queries in another order; `queries` must be the same queries, each once."""
        if self.queries == tuple(queries):
            return self
        at = {query: row for row, query in enumerate(self.queries)}
        rows = np.array([at[query] for query in queries], np.int64)
        sides = self.labels[rows], self.first[rows], self.precision[rows]
        return RankedModel(self.name, self.task, self.gallery_name, tuple(queries), self.gallery, *sides)


def scored_names(models: Sequence[tuple[str, Calibration | None, int]]) -> list[str]:
    """Return names with scorings, such as "city-lpn, calibrated, CSLS"; plain ones are called so beside others."""
    scorings = [(", calibrated" if of else "") + (", CSLS" if neighbours else "") for _, of, neighbours in models]
    plain = ", plain" if any(scorings) else ""
    return [name + (scoring or plain) for (name, *_), scoring in zip(models, scorings, strict=True)]


@dataclass(frozen=True, eq=False)
class Result:
    """The metrics of one task, and their protocol.

    Attributes:
        name: of the model, to display.
        task: such as "drone-to-satellite".
        galleries: the figures on the full gallery, and, if it has distractors, without them.
        rankings: the ranking of each gallery, with all queries.
        root: the data set's folder.
        pictures: the queries and the gallery.
        labels: the place of each query and of each gallery picture, (Q,) and (G,); -1 for unranked gallery pictures.
        known: the queries with a known truth, (Q,); None for all.
        change: of the queries, see `Task.change`.
        parts: the parts used, 1-based.
        neighbours: of CSLS; 0 without it.
        listed: True if true matches and junk come from lists rather than from labels.
        sentence: the protocol in one sentence.
        seconds: wall-clock time, including the description of pictures that were not cached.
        errors: metres from each counted query to the centre of its top match, (K,); None unless all their places are known.
        groups: the figures for each group of the data set's pictures, such as each height; see `Dataset.group_name`.
        group_name: the quantity of the groups; empty without groups.
        measures: further metrics by their keys, see `field_figures`; empty if the data set has none.
        calibration: the model's; None without one.
        nearest: gallery positions of each query's nearest tiles without junk, (Q, K), -1 if no tile is left, and their scores,
            (Q, K), NaN for -1; None unless requested.
    """

    name: str
    task: str
    galleries: tuple[Figures, ...]
    rankings: tuple[Retrieval, ...]
    root: Path
    pictures: tuple[Sequence[Picture], Sequence[Picture]]
    labels: tuple[Int64Array, Int64Array]
    known: BoolArray | None
    change: Change
    parts: tuple[int, ...]
    neighbours: int
    listed: bool
    sentence: str
    seconds: float
    errors: Float64Array | None
    groups: Mapping[str, tuple[Figures, ...]]
    group_name: str
    measures: Mapping[str, float]
    calibration: Calibration | None
    nearest: tuple[Int64Array, Float64Array] | None

    @property
    def recall(self) -> dict[str, float]:
        """Recall@K in percent on the full gallery for "1", "5", "10", and "1%"."""
        return self.galleries[0].recall

    @property
    def ap(self) -> float:
        """Mean average precision in percent on the full gallery."""
        return self.galleries[0].ap

    @property
    def queries(self) -> int:
        """Number of queries (places, if queries are averaged)."""
        return self.galleries[0].queries

    @property
    def gallery(self) -> int:
        """Number of pictures of the full gallery."""
        return self.galleries[0].gallery

    @property
    def cropped(self) -> bool:
        """True if queries were cropped to their boxes."""
        return any(picture.box for picture in self.pictures[0])

    def distances(self) -> dict[str, float]:
        """The error shares, see `error_shares`; empty without positions."""
        return {} if self.errors is None else error_shares(self.errors)

    def ranked(self, gallery: GalleryChoice = "full") -> RankedModel:
        """Return the ranking of one gallery for comparisons, without the queries of unknown truth.

        Raises:
            InputError: when the gallery has no distractors to leave out, or there are no pictures.
        """
        if len(self.pictures[0]) < len(self.labels[0]):
            raise no_pictures(self.root.name)
        if gallery != "full" and len(self.galleries) == 1:
            reason = "True matches of {} are listed, so no gallery picture is a distractor"
            if not self.listed:
                reason = "Each place of the gallery of {} has a query, so it has no distractors"
            raise InputError(f"{reason.format(self.root.name)}; leave --without-distractors out.")
        one = int(gallery != "full")
        kept = np.isin(self.labels[1], self.labels[0]) if one else np.ones(len(self.labels[1]), bool)
        queries, tiles = (np.array(geo.names_below(self.root, side), object) for side in self.pictures)
        known, retrieval = slice(None) if self.known is None else self.known, self.rankings[one]
        return RankedModel(
            self.name,
            self.task,
            self.galleries[one].name,
            tuple(queries[known].tolist()),
            frozenset(tiles[kept].tolist()),
            self.labels[0][known],
            retrieval.first[known],
            retrieval.precision[known],
        )

    def queries_csv(self) -> bytes:
        """Return a line for each query: name, rank, AP, and names and scores of its nearest tiles; unknown cells are empty.

        The nearest tiles must have been requested.
        """
        assert self.nearest is not None
        places, (queries, gallery) = range(1, self.nearest[0].shape[1] + 1), self.pictures
        known, ranking = np.ones(len(queries), bool) if self.known is None else self.known, self.rankings[0]
        columns = known, ranking.first + 1, 100 * ranking.precision, *self.nearest
        lines: list[list[object]] = [
            ["query", "rank", "ap", *(f"top {k}" for k in places), *(f"score {k}" for k in places)]
        ]
        for query, told, rank, ap, tiles, scores in zip(queries, *(one.tolist() for one in columns), strict=True):
            names = [None if tile < 0 else gallery[tile].name for tile in tiles]
            values = [None if math.isnan(score) else round(score, 6) for score in scores]
            lines.append([query.name, (told and rank) or None, round(ap, 6) if told else None, *names, *values])
        return csv_bytes(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values, the format of `lpn evaluate`."""
        return {
            **self.galleries[0].shares(),
            **self.distances(),
            **self.measures,
            "queries": self.queries,
            "gallery": self.gallery,
            "galleries": [figures.to_dict() for figures in self.galleries],
            "groups": {name: [figures.to_dict() for figures in of_group] for name, of_group in self.groups.items()},
            "task": self.task,
            "rotate": self.change.rotate,
            "shift": self.change.shift,
            "scale": self.change.scale,
            "weather": asdict(self.change.weather),
            "parts": list(self.parts),
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
            "csls": self.neighbours,
            "cropped": self.cropped,
            "junk": "lists" if self.listed else "label -1",
            "protocol": self.sentence,
            "seconds": self.seconds,
        }

    def _repr_html_(self) -> str:
        rows = {
            one.name: {**{f"Recall@{k}": value for k, value in one.recall.items()}, "AP": one.ap}
            for one in self.galleries
        }
        return percentages(f"{self.task}: {self.sentence}", "gallery", rows)


def measure(task: Task, depth: int = 0) -> Result:
    """Rank a task's queries, and measure recall, AP, and the further published metrics of its data set.

    Part weights and queries of unknown truth do not count. Everything is checked before a picture is described.

    Args:
        depth: number of nearest tiles of each query in `Result.nearest`; 0 for none.

    Raises:
        InputError: when no query can be measured, CSLS needs more queries than a group has, or there are no pictures for the
            names in `Result.nearest`.
        DataError: when a picture lacks a position that the data set's metrics need.
        LPNError: when a picture or an index cannot be read.
    """
    started = time.perf_counter()
    if depth and len(task.queries) < len(task.query_labels):
        raise no_pictures(task.data_name)
    task = task.with_fields(weights=None)
    data, known = task.dataset, task.known
    counted = known if known is not None and known.any() else np.ones(len(task.query_labels), bool)
    geometry = task.geometry
    if geometry is None or any(geometry.queries[row] is None for row in np.flatnonzero(counted).tolist()):
        geometry = None
        if task.no_truth:
            raise InputError(task.no_truth)
    groups = list(_groups(task))
    if task.neighbours:
        for where, count in [("", len(task.query_labels)), *((f" in {name}", len(rows)) for name, rows, _ in groups)]:
            csls.check_neighbours(task.neighbours, count, where)
    places = None
    if data is not None and data.measured_by is not None:
        places = data.coordinates(task.queries), data.coordinates(task.gallery)
    found = _ranked(task)
    of_groups = {name: tuple(figures for figures, _ in _ranked(_part(task, *rows))) for name, *rows in groups}
    errors = None if geometry is None else geometry.answer_errors_m(found[0][1].best)[counted]
    measures: dict[str, float] = {}
    if data is not None and data.measured_by is not None and places is not None:
        measures = field_figures(data.measured_by, *task.compared, *places)
    elif any(len(lists.semi) for lists in task.truth or ()):
        measures = {"hit rate": _hit_rate(task)}
    if data is not None and data.mean_of_groups and of_groups:
        recalls = [figures[0].recall for figures in of_groups.values()]
        means = {depth: float(np.mean([recall[depth] for recall in recalls])) for depth in recalls[0]}
        measures |= {f"{data.group_name}_recall@{depth}": mean for depth, mean in means.items()}
    return Result(
        name=task.model_name,
        task=task.name,
        galleries=tuple(figures for figures, _ in found),
        rankings=tuple(ranking for _, ranking in found),
        root=task.root,
        pictures=(task.queries, task.gallery),
        labels=(task.query_labels, task.gallery_labels),
        known=known,
        change=task.change,
        parts=task.parts or tuple(range(1, task.contract.n_parts + 1)),
        neighbours=task.neighbours,
        listed=task.truth is not None,
        sentence=sentence(task),
        seconds=time.perf_counter() - started,
        errors=None if errors is None or np.isnan(errors).any() else errors,
        groups=of_groups,
        group_name="" if data is None else data.group_name,
        measures=measures,
        calibration=task.calibration,
        nearest=_nearest(task, depth) if depth else None,
    )


def sentence(task: Task) -> str:
    """Return the protocol of a task in one sentence."""
    clauses = [*task.clauses]
    if task.weights is not None:
        clauses.append("part weights " + " : ".join(f"{100 * weight:.0f}" for weight in task.part_weights) + " %")
    clauses += [f"tiles {task.of_index}"] if task.of_index else []
    clauses.append(
        "ranked by inner product less half of each tile's mean inner product with its "
        f"{task.neighbours} nearest queries (CSLS)"
        if task.neighbours
        else "ranked by inner product"
    )
    clauses.append(
        "true matches by label, gallery pictures labelled -1 taken out of the ranking"
        if task.truth is None
        else "true matches and junk by the data set's lists, junk taken out of the ranking"
    )
    clauses.append("a query without a true match counts as missed")
    trapezoid = all(lists.trapezoid for lists in task.truth or ())
    clauses.append("AP by the trapezoid rule" if trapezoid else "AP as the mean precision at the true matches")
    return f"Protocol: {'; '.join(clauses)}."


def error_shares(errors: Float64Array) -> dict[str, float]:
    """Return `median error m` and, in percent, `within 25 m`, `within 50 m`, `within 100 m` of errors in metres (Q,)."""
    within = {f"within {limit} m": 100.0 * float(np.mean(errors <= limit)) for limit in WITHIN}
    return {"median error m": float(np.median(errors)), **within}


def _ranked(task: Task) -> list[tuple[Figures, Retrieval]]:
    """Rank the full gallery, and, if labels show distractors, the gallery without them."""
    found = [(_figures(FULL, task.retrieved, task.tiles, task.known), task.retrieved)]
    if task.truth is None:
        kept = metrics.without_distractors(task.gallery_labels, task.query_labels)
        size = int(np.count_nonzero(kept != metrics.JUNK))
        if 0 < size < np.count_nonzero(task.gallery_labels != metrics.JUNK):
            queries, tiles = task.compared
            retrieval = metrics.retrieve(queries, task.query_labels, tiles, kept)
            found.append((_figures(WITHOUT, retrieval, size), retrieval))
    return found


def _figures(name: str, retrieval: Retrieval, size: int, known: BoolArray | None = None) -> Figures:
    values = retrieval.metrics(known)
    recall = {key.removeprefix("recall@"): value for key, value in values.items() if key.startswith("recall@")}
    return Figures(name, recall, values["ap"], int(values["queries"]), size)


def _groups(task: Task) -> Iterator[tuple[str, Int64Array, Int64Array]]:
    """Yield each group of the data set with the rows of its queries and of its gallery pictures."""
    sides = (task.queries, task.gallery) if task.dataset is not None else ((), ())
    names = {picture.group for pictures in sides for picture in pictures} - {""}
    if len(names) < 2:
        return
    for name in sorted(names, key=lambda name: (len(name), name)):
        rows = [
            np.array([i for i, picture in enumerate(pictures) if picture.group in ("", name)], np.int64)
            for pictures in sides
        ]
        if task.truth is not None and len(rows[1]) < len(task.gallery):
            raise InputError(
                f"True matches are listed for the whole gallery, and {name} has only a part of it; leave this group out."
            )
        if len(rows[0]) and len(rows[1]):
            yield name, rows[0], rows[1]


def _part(task: Task, queries: Int64Array, tiles: Int64Array) -> Task:
    sides = task.sides()
    return task.with_fields(
        query_descriptors=sides[0][queries],
        gallery_descriptors=sides[1][tiles],
        query_labels=task.query_labels[queries],
        gallery_labels=task.gallery_labels[tiles],
        truth=None if task.truth is None else [task.truth[row] for row in queries],
    )


def _hit_rate(task: Task) -> float:
    """Return VIGOR's hit rate, Recall@1 with each query's half-true matches left out of its ranking."""

    def without(lists: Truth) -> Truth:
        return replace(lists, junk=np.concatenate([lists.junk, lists.semi]))

    queries, tiles = task.compared
    return metrics.retrieve(queries, None, tiles, None, [without(lists) for lists in task.truth or ()]).recall(1)


def _nearest(task: Task, depth: int) -> tuple[Int64Array, Float64Array]:
    """Return the nearest tiles of each query and their scores, see `Result.nearest`."""
    (queries, gallery), truth = task.compared, task.truth
    common = task.gallery_labels == metrics.JUNK if truth is None else None
    junk = [np.zeros(0, np.int64)] * len(queries) if truth is None else [lists.junk for lists in truth]
    tiles, scores = np.full((len(queries), depth), -1), np.full((len(queries), depth), np.nan)
    found = nearest(queries, gallery, depth + max(map(len, junk)), common)
    for row, (positions, left_out) in enumerate(zip(found, junk, strict=True)):
        kept = positions[~np.isin(positions, left_out)][:depth]
        tiles[row, : len(kept)] = kept
        scores[row, : len(kept)] = np.tensordot(gallery[kept].astype(np.float64), queries[row], 2)
    return tiles, scores
