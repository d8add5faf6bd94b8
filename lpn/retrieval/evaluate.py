"""Retrieval on a data set's test split by the published protocols, for any model that `lpn.load` opens."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from lpn import descriptors
from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.notebook_html import percentages
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth, geo
from lpn.datasets.base import PositionProtocol
from lpn.datasets.integrity import check_whole
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import CLEAR
from lpn.models.base import Model
from lpn.retrieval import csls, field_metrics, metrics, transfer
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.per_query import PerQuery
from lpn.retrieval.protocol import Protocol, averaged, centred, sentence
from lpn.retrieval.saved import PublishedResult
from lpn.retrieval.sides import TaskPictures

log = logging.getLogger(__name__)

# Distances in metres within which an answer counts as near.
WITHIN = (25, 50, 100)


FULL = "full gallery"
WITHOUT = "without distractors"
CENTRED = "the mean of the queries and that of the gallery subtracted, and each part normalised again"


@dataclass(frozen=True, eq=False)
class Figures:
    """Recall and AP of some queries on one gallery.

    Attributes:
        gallery_name: "full gallery", or "without distractors", where the places that no query shows are dropped.
        recall: Recall@K in percent for "1", "5", "10", and "1%"; the last takes K from the size of the full gallery. NaN where K
            lies beyond the depth of a search.
        ap: mean average precision in percent; NaN if a search does not return all ranks.
        queries: number of queries (places, if queries are averaged).
        gallery: number of ranked gallery pictures; of a full gallery all that there are, junk included.
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
        recall = {f"recall@{k}": value for k, value in self.recall.items()}
        return {
            "gallery_name": self.gallery_name,
            **{key: _known(value) for key, value in recall.items()},
            "ap": _known(self.ap),
            "queries": self.queries,
            "gallery": self.gallery,
        }


@dataclass(frozen=True, eq=False)
class Result:
    """The metrics of one task, and how they were measured.

    Attributes:
        galleries: the figures on the full gallery, and, where it has distractors, those without them.
        task: such as "drone-to-satellite".
        parts: the parts used, 1-based.
        cropped: True if queries were cropped to their boxes.
        listed: True if true matches and junk come from lists rather than from labels.
        sentence: the protocol in one sentence.
        seconds: wall-clock time, including the description of pictures that were not cached.
        errors: metres from each query's place to the centre of its top match, (Q,); None without positions, and for averaged
            queries.
        groups: the same figures for each group of the data set's pictures, such as each height; see `Dataset.group_name`.
        group_name: what the groups are; empty without groups.
        measures: the field's further metrics by their keys, see `field_figures`; empty where the data set has none.
        calibration: the model's; None without one.
        per_query: what `evaluate` ranked for each query, if it was asked to.
    """

    galleries: tuple[Figures, ...]
    task: str
    protocol: Protocol
    parts: tuple[int, ...]
    cropped: bool
    listed: bool
    sentence: str
    seconds: float
    errors: Float64Array | None = None
    groups: Mapping[str, tuple[Figures, ...]] = field(default_factory=dict)
    group_name: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)
    calibration: Calibration | None = None
    per_query: PerQuery | None = None

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

    def distances(self) -> dict[str, float]:
        """The error shares, see `error_shares`; empty without positions."""
        return {} if self.errors is None else error_shares(self.errors)

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON values, as `lpn evaluate` writes them."""
        change = self.protocol.change
        return {
            **{f"recall@{k}": _known(value) for k, value in self.recall.items()},
            "ap": _known(self.ap),
            **self.distances(),
            **self.measures,
            "queries": self.queries,
            "gallery": self.gallery,
            "galleries": [figures.to_dict() for figures in self.galleries],
            "groups": {name: [figures.to_dict() for figures in of_group] for name, of_group in self.groups.items()},
            "task": self.task,
            "rotate": change.rotate,
            "shift": change.shift,
            "scale": change.scale,
            "weather": asdict(change.weather),
            "parts": list(self.parts),
            "branch": self.protocol.branch,
            "averaged": self.protocol.average,
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
            "csls": self.protocol.csls,
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


def _known(value: float) -> float | None:
    """Return a number as JSON has it: None for NaN."""
    return None if math.isnan(value) else value


def error_shares(errors: Float64Array) -> dict[str, float]:
    """The keys `median error m` and, in percent, `within 25 m`, `within 50 m`, `within 100 m` of errors in metres (Q,)."""
    within = {f"within {limit} m": 100.0 * float(np.mean(errors <= limit)) for limit in WITHIN}
    return {"median error m": float(np.median(errors)), **within}


def evaluate(
    model: Model,
    dataset: Dataset,
    task: str,
    protocol: Protocol | None = None,
    read: descriptors.Reader = descriptors.cached_descriptors,
    calibration: Calibration | None = None,
    depth: int = 0,
) -> Result:
    """Evaluate one task, such as "drone-to-satellite".

    Args:
        protocol: the published protocol by default.
        read: returns descriptors; by default from the user's cache, which receives new ones.
        calibration: the model's, see `lpn.tasks.opening.task_calibration`; None ranks plain.
        depth: number of nearest tiles of each query in `Result.per_query`; 0 for none.

    Raises:
        InputError: when the data set lacks the task, the model a view, or a part does not exist.
        DataError: when the test split is incomplete, or its `geo.csv` does not cover it.
    """
    started = time.perf_counter()
    protocol = protocol or Protocol()
    protocol.chosen(model.n_parts)
    if protocol.change.weather:
        check_weather(task)
    pictures = TaskPictures.of(dataset, task)
    model = model if protocol.branch else model.for_task(*pictures.views)
    for view in pictures.views:
        _check_branch(model, protocol.branch or view, protocol)
    queries, gallery, truth = pictures.queries, pictures.gallery, pictures.truth
    if truth is None and len({picture.label for picture in gallery}) == 1:
        log.warning(
            "%s shows one place only, so that every answer is right; its metrics say nothing.", dataset.root.name
        )
    if protocol.average and truth is not None:
        raise InputError(
            f"Each query of {dataset.root.name} has its own list of true matches; only queries with labels can be averaged, "
            "so evaluate them one by one."
        )
    if protocol.csls:
        _check_csls(protocol, queries, gallery, truth)
    # Read positions before the descriptors, so that a missing position is reported at once.
    known = None if protocol.average else dataset.positions()
    positions = None if known is None else (known.of(queries), known.of(gallery))
    measured_by = None if protocol.average else dataset.measured_by
    where = None if measured_by is None else (dataset.coordinates(queries), dataset.coordinates(gallery))
    change = replace(protocol.change, released=protocol.released).for_picture(queries[0])
    gallery_change = Change(released=protocol.released)
    if _falls_on_gallery(pictures.views):
        change, gallery_change = replace(change, weather=CLEAR), replace(gallery_change, weather=change.weather)
    if calibration is not None and (protocol.branch or protocol.centre or protocol.released):
        raise InputError(
            "A calibration centres each view, takes its own branch, and is ours; leave --centre, another branch, and the "
            "released protocol out."
        )
    if protocol.released and truth is not None and task == "street-to-street":
        return _carried(model, pictures, truth, protocol, started)
    query, tiles = pictures.described(model, read, change, gallery_change, protocol.branch, calibration)
    if protocol.centre:
        query, tiles = centred(query), centred(tiles)
    cropped = any(picture.box for picture in queries)
    clauses = _clauses(model, protocol, cropped, change)
    clauses += [f"gallery pictures {gallery_change.describe()}"] if gallery_change.weather else []
    clauses += [] if calibration is None else [calibration.describe()]
    labels = pictures.labels
    result, retrieval = _measure(query, labels[0], tiles, labels[1], truth, task, protocol, clauses)
    errors = None if positions is None else _errors(retrieval, *positions)
    # Half-true matches of GTA-UAV are measured by distances; its paper has no hit rate.
    measures = {} if truth is None or dataset.measured_by else _hit_rate(query, tiles, truth, protocol)
    if measured_by is not None and where is not None:
        measures |= field_figures(measured_by, *protocol.compared(query, tiles), *where)
    groups = {
        name: _measure(
            query[query_rows],
            labels[0][query_rows],
            tiles[tile_rows],
            labels[1][tile_rows],
            lists,
            task,
            protocol,
            clauses,
        )[0].galleries
        for name, query_rows, tile_rows, lists in _groups(queries, gallery, truth)
    }
    if dataset.mean_of_groups:
        measures |= _mean_of_groups(dataset.group_name, groups)
    return replace(
        result,
        cropped=cropped,
        seconds=time.perf_counter() - started,
        errors=errors,
        groups=groups,
        group_name=dataset.group_name,
        measures=measures,
        calibration=calibration,
        per_query=PerQuery.of(retrieval, *protocol.compared(query, tiles), labels[1], truth, depth)
        if depth and not protocol.average
        else None,
    )


def check_weather(task: str) -> None:
    """Raise InputError for a task that compares tiles with tiles, on which no weather falls."""
    if task == "satellite-to-satellite":
        raise InputError(f"{task} has satellite tiles on both sides, which have no weather; leave --weather out.")


def _falls_on_gallery(views: tuple[View, View]) -> bool:
    """Return whether weather falls on the gallery: where its pictures are taken below the clouds, and the queries are tiles."""
    return views[0] == "satellite" != views[1]


def _carried(
    model: Model, pictures: TaskPictures, truth: Sequence[Truth], protocol: Protocol, started: float
) -> Result:
    """Measure features carried over to landmarks as released."""
    if protocol.change or protocol.parts or protocol.average or protocol.centre or protocol.csls:
        raise InputError(
            "The released transfer takes whole descriptors of queries as they are; leave changes of queries, parts, averaging, "
            "centring, and CSLS out."
        )
    view = protocol.branch or "street"
    query, tiles = (transfer.map_means(model, side, view) for side in (pictures.queries, pictures.gallery))
    cropped = any(picture.box for picture in pictures.queries)
    clauses = [transfer.SENTENCE, f"both sides described by the {view} branch"]
    clauses += ["queries cropped to the part that is meant"] if cropped else []
    labels = pictures.labels
    result, _ = _measure(query, labels[0], tiles, labels[1], truth, pictures.name, protocol, clauses)
    return replace(result, cropped=cropped, seconds=time.perf_counter() - started)


def _check_csls(
    protocol: Protocol, queries: Sequence[Picture], gallery: Sequence[Picture], truth: Sequence[Truth] | None
) -> None:
    """Refuse more neighbours than a group of queries has, before pictures are described."""
    groups = [(f" in {name}", rows) for name, rows, _, _ in _groups(queries, gallery, truth)]
    for where, rows in [("", np.arange(len(queries))), *groups]:
        labels = {queries[row].label for row in rows.tolist()}
        csls.check_neighbours(protocol.csls, len(labels) if protocol.average else len(rows), where)


def field_figures(
    measured_by: PositionProtocol,
    query: Float32Array,
    gallery: Float32Array,
    query_places: Float64Array,
    places: Float64Array,
) -> dict[str, float]:
    """Return the metrics that a published evaluation takes from positions, as means over the queries.

    Keys: for DenseUAV `sdm_denseuav@K` (0 .. 1) for K = 1, 3, 5, 10 and `ma@m` in percent for m = 5, 10, 20, 50, 100 metres; for
    GTA-UAV and UAV-VisLoc `sdm_gta_uav@K` (0 .. 1) and `dis@K` in metres for K = 1, 3, 5. K above the size of the gallery is left
    out. See `lpn.retrieval.field_metrics`.

    Args:
        query, gallery: descriptors, (Q, n, D) and (G, n, D).
        query_places, places: see `Dataset.coordinates`, (Q, 2) and (G, 2).
    """
    order = field_metrics.nearest(query, gallery, 10)
    starts, ends = query_places[:, None], places[order]
    if measured_by == "DenseUAV":
        degrees = field_metrics.degree_distances(starts, ends)
        top = field_metrics.great_circle(query_places, ends[:, 0])
        depths = [k for k in (1, 3, 5, 10) if k <= order.shape[1]]
        figures = {f"sdm_denseuav@{k}": float(field_metrics.sdm_denseuav(degrees, k).mean()) for k in depths}
        return figures | {f"ma@{metres}": field_metrics.accuracy_within(top, metres) for metres in (5, 10, 20, 50, 100)}
    metres = (
        field_metrics.geodesic(starts, ends) if measured_by == "UAV-VisLoc" else np.linalg.norm(starts - ends, axis=2)
    )
    depths = [k for k in (1, 3, 5) if k <= order.shape[1]]
    figures = {f"sdm_gta_uav@{k}": float(field_metrics.sdm_gta_uav(metres, k).mean()) for k in depths}
    return figures | {f"dis@{k}": float(field_metrics.distance_at(metres, k).mean()) for k in depths}


def _hit_rate(query: Float32Array, tiles: Float32Array, truth: Sequence[Truth], protocol: Protocol) -> dict[str, float]:
    """Return VIGOR's hit rate, Recall@1 with each query's half-true matches left out of its ranking; empty without any."""
    if not any(len(lists.semi) for lists in truth):
        return {}
    without = [replace(lists, junk=np.concatenate([lists.junk, lists.semi])) for lists in truth]
    query, tiles = protocol.compared(query, tiles)
    return {"hit rate": metrics.retrieve(query, None, tiles, None, without).recall(1)}


def _mean_of_groups(name: str, groups: Mapping[str, tuple[Figures, ...]]) -> dict[str, float]:
    """Return the mean recall of groups, in percent, such as "region_recall@1"; each group counts alike."""
    recalls = [figures[0].recall for figures in groups.values()]
    depths = recalls[0] if recalls else ()
    return {f"{name}_recall@{k}": float(np.mean([recall[k] for recall in recalls])) for k in depths}


def _groups(
    queries: Sequence[Picture], gallery: Sequence[Picture], truth: Sequence[Truth] | None
) -> Iterator[tuple[str, Int64Array, Int64Array, list[Truth] | None]]:
    """Yield each group with the rows of its queries and of its gallery pictures, and the truth of these queries."""
    names = dict.fromkeys(picture.group for pictures in (queries, gallery) for picture in pictures)
    names.pop("", None)
    if len(names) < 2:
        return
    for name in sorted(names, key=lambda name: (len(name), name)):
        rows = [
            np.array([i for i, picture in enumerate(pictures) if picture.group in ("", name)], np.int64)
            for pictures in (queries, gallery)
        ]
        if truth is not None and len(rows[1]) < len(gallery):
            raise InputError(
                f"The gallery of {name} is a part of that in which true matches are listed; leave its group out."
            )
        if len(rows[0]) and len(rows[1]):
            yield name, rows[0], rows[1], None if truth is None else [truth[i] for i in rows[0]]


def check_test_split(dataset: Dataset, tasks: Sequence[str]) -> None:
    """Check a test split before long work, so that the evaluation at its end does not fail.

    Raises:
        InputError: when the data set does not offer one of the tasks, but others.
        PictureError: when a picture of the split is damaged.
        DataError: when there is no task, the test split is incomplete, or a picture lacks the position that its metrics take.
    """
    if missing := [task for task in tasks if task not in dataset.tasks()]:
        raise dataset.lacks_task(missing[0])
    lists = lists_of(dataset, tasks)
    files = list(dict.fromkeys(picture.path for pictures in lists.values() for picture in pictures))
    check_whole(files, f"test pictures of {dataset.root.name}", dataset.root)
    positions = dataset.positions()
    for pictures in lists.values():
        if positions is not None:
            positions.of(pictures)
        if dataset.measured_by is not None:
            dataset.coordinates(pictures)


def lists_of(dataset: Dataset, tasks: Sequence[str]) -> dict[str, list[Picture]]:
    """Return the lists of pictures of some tasks, by keys such as "query drone" and "gallery satellite"."""
    queries = dict.fromkeys(views_of(task)[0] for task in tasks)
    galleries = dict.fromkeys(views_of(task)[1] for task in tasks)
    return {f"query {view}": dataset.queries(view) for view in queries} | {
        f"gallery {view}": dataset.gallery(view) for view in galleries
    }


def evaluate_saved(saved: PublishedResult, protocol: Protocol | None = None) -> Result:
    """Evaluate the descriptors of a published result, see `lpn.retrieval.saved`.

    Raises:
        DataError: when no query has a label of the gallery.
        InputError: when a part does not exist, or the protocol needs pictures to be described again.
    """
    saved.check_labels()
    return evaluate_descriptors(
        (saved.query, saved.gallery), (saved.query_labels, saved.gallery_labels), None, saved.task, protocol
    )


def evaluate_descriptors(
    sides: tuple[Float32Array, Float32Array],
    labels: tuple[Int64Array, Int64Array],
    truth: Sequence[Truth] | None,
    task: str,
    protocol: Protocol | None = None,
    positions: tuple[Sequence[geo.Position], Sequence[geo.Position]] | None = None,
    clauses: Sequence[str] = ("descriptors as saved",),
) -> Result:
    """Evaluate descriptors that are at hand.

    Args:
        sides: descriptors of queries and gallery, (Q, n, D) and (G, n, D).
        labels: the place of each, (Q,) and (G,), -1 for junk.
        truth: true matches and junk of each query, in place of labels; queries whose truth is not known do not count.
        task: its name.
        positions: of the queries and of the gallery, for errors in metres.
        clauses: how the descriptors were made, for the protocol's sentence.

    Raises:
        InputError: when a part does not exist, or the protocol needs pictures to be described again.
    """
    started = time.perf_counter()
    protocol = protocol or Protocol()
    if protocol.change or protocol.branch or protocol.released:
        raise InputError(
            "These are descriptors, not pictures: weather, rotation, shift, scale, branch, and the released protocol need a "
            "model and a data set; leave them out."
        )
    query, tiles = (centred(side) for side in sides) if protocol.centre else sides
    stated = [*clauses, *([CENTRED] if protocol.centre else [])]
    result, retrieval = _measure(query, labels[0], tiles, labels[1], truth, task, protocol, stated)
    errors = None if positions is None or protocol.average else _errors(retrieval, *positions)
    return replace(result, seconds=time.perf_counter() - started, errors=errors)


def _errors(
    retrieval: metrics.Retrieval, queries: Sequence[geo.Position], gallery: Sequence[geo.Position]
) -> Float64Array:
    """Return metres from each query to its top match, infinite without one, (Q,)."""
    metres = geo.metres(queries, [gallery[index] for index in retrieval.best])
    return np.where(retrieval.best < 0, np.inf, metres)


def _measure(
    query: Float32Array,
    query_labels: Int64Array,
    gallery: Float32Array,
    gallery_labels: Int64Array,
    truth: Sequence[Truth] | None,
    task: str,
    protocol: Protocol,
    clauses: list[str],
) -> tuple[Result, metrics.Retrieval]:
    """Average queries, select parts, and scale by CSLS as the protocol demands, and rank."""
    n, pictures = query.shape[1], len(query)
    chosen = protocol.chosen(n)
    if protocol.average:
        query, query_labels = averaged(query, query_labels)
    query, gallery = protocol.compared(query, gallery)
    retrieval = metrics.retrieve(query, query_labels, gallery, gallery_labels, truth)
    galleries = [_figures(FULL, retrieval, len(gallery), metrics.known_queries(truth))]
    if truth is None:
        kept = metrics.without_distractors(gallery_labels, query_labels)
        ranked = int(np.count_nonzero(kept != metrics.JUNK))
        if 0 < ranked < np.count_nonzero(gallery_labels != metrics.JUNK):
            galleries.append(_figures(WITHOUT, metrics.retrieve(query, query_labels, gallery, kept), ranked))
    result = Result(
        galleries=tuple(galleries),
        task=task,
        protocol=protocol,
        parts=chosen,
        cropped=False,
        listed=truth is not None,
        sentence=sentence(
            clauses,
            chosen,
            n,
            pictures if protocol.average else None,
            truth is not None,
            truth is None or all(lists.trapezoid for lists in truth),
            protocol.csls,
        ),
        seconds=0.0,
    )
    return result, retrieval


def _figures(name: str, retrieval: metrics.Retrieval, ranked: int, known_queries: BoolArray | None = None) -> Figures:
    values = retrieval.metrics(known_queries)
    recall = {key.removeprefix("recall@"): value for key, value in values.items() if key.startswith("recall@")}
    return Figures(name, recall, values["ap"], int(values["queries"]), ranked)


def _check_branch(model: Model, branch: View, protocol: Protocol) -> None:
    if branch not in model.views and protocol.branch is None:
        raise InputError(
            f"This model has no {branch!r} view; it has {', '.join(model.views)}. Of landmarks, lpn reproduce table6 "
            "describes both sides with one of these; in Python, Protocol(branch=...) does so of any data set."
        )
    model.check_view(branch)


def _clauses(model: Model, protocol: Protocol, cropped: bool, change: Change) -> list[str]:
    """The clauses about the descriptors in the protocol's sentence."""
    mirrored = "descriptors of picture and mirror added, " if model.contract.mirror == "sum" else ""
    clauses = [f"{mirrored}each part normalised"]
    clauses += ["queries cropped to the part that is meant"] if cropped else []
    clauses += ["pictures read by Pillow without their EXIF orientation, as released"] if protocol.released else []
    bicubic = ", bicubic" if change.rotate and not change.around and not change.released else ""
    clauses += [f"queries {change.describe()}{bicubic}"] if change.describe() else []
    clauses += [CENTRED] if protocol.centre else []
    clauses += [f"both sides described by the {protocol.branch} branch"] if protocol.branch else []
    return clauses
