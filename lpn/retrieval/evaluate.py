"""Retrieval on a data set's test split by the published protocols, for any model that `lpn.load` opens."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth, geo
from lpn.datasets.integrity import check_whole
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model
from lpn.retrieval import metrics
from lpn.retrieval.protocol import Protocol, averaged, sentence
from lpn.retrieval.published_results import PublishedResult

log = logging.getLogger(__name__)

# Distances in metres within which an answer counts as near.
WITHIN = (25, 50, 100)


@dataclass(frozen=True, eq=False)
class Result:
    """The metrics of one task in percent, and how they were measured.

    Attributes:
        recall: Recall@K for "1", "5", "10", and "1%".
        ap: mean average precision.
        queries, gallery: numbers of queries (places, if queries are averaged) and of gallery pictures.
        task: such as "drone-to-satellite".
        parts: the parts used, 1-based.
        cropped: True if queries were cropped to their boxes.
        listed: True if true matches and junk come from lists rather than from labels.
        sentence: the protocol in one sentence.
        seconds: wall-clock time, including the description of pictures that were not cached.
        errors: metres from each query's place to the centre of its top match, (Q,); None without positions, and for averaged
            queries.
    """

    recall: dict[str, float]
    ap: float
    queries: int
    gallery: int
    task: str
    protocol: Protocol
    parts: tuple[int, ...]
    cropped: bool
    listed: bool
    sentence: str
    seconds: float
    errors: Float64Array | None = None

    def distances(self) -> dict[str, float]:
        """The error shares, see `error_shares`; empty without positions."""
        return {} if self.errors is None else error_shares(self.errors)

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON values, as `lpn evaluate` writes them."""
        change = self.protocol.change
        return {
            **{f"recall@{k}": value for k, value in self.recall.items()},
            "ap": self.ap,
            **self.distances(),
            "queries": self.queries,
            "gallery": self.gallery,
            "task": self.task,
            "rotate": change.rotate,
            "shift": change.shift,
            "scale": change.scale,
            "parts": list(self.parts),
            "branch": self.protocol.branch,
            "averaged": self.protocol.average,
            "cropped": self.cropped,
            "junk": "lists" if self.listed else "label -1",
            "protocol": self.sentence,
            "seconds": self.seconds,
        }


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
) -> Result:
    """Evaluate one task, such as "drone-to-satellite".

    Args:
        protocol: the published protocol by default.
        read: returns descriptors; by default from the user's cache, which receives new ones.

    Raises:
        InputError: when the data set lacks the task, the model a view, or a part does not exist.
        DataError: when the test split is incomplete, or its `geo.csv` does not cover it.
    """
    started = time.perf_counter()
    protocol = protocol or Protocol()
    if task not in dataset.tasks():
        raise InputError(
            f"The task is {task!r}; {dataset.root.name} offers {', '.join(dataset.tasks()) or 'none'} in its test split."
        )
    protocol.chosen(model.n_parts)
    query_view, gallery_view = views_of(task)
    query_branch, gallery_branch = (protocol.branch or view for view in (query_view, gallery_view))
    for branch in (query_branch, gallery_branch):
        _check_branch(model, branch, protocol)
    queries, gallery = dataset.queries(query_view), dataset.gallery(gallery_view)
    if protocol.whole:
        queries = [replace(picture, box=None) for picture in queries]
    truth = dataset.truth(task)
    if truth is None and len({picture.label for picture in gallery}) == 1:
        log.warning(
            "%s shows one place only, so that every answer is right; its metrics say nothing.", dataset.root.name
        )
    if protocol.average and truth is not None:
        raise InputError(
            f"Each query of {dataset.root.name} has its own list of true matches; only queries with labels can be averaged, "
            "so leave --average-queries out."
        )
    # Read positions before the descriptors, so that a missing position is reported at once.
    known = None if protocol.average else geo.positions(dataset.root)
    positions = None if known is None else (known.of(queries), known.of(gallery))
    change = protocol.change.for_picture(queries[0])
    query = read(model, queries, query_branch, change)
    tiles = read(model, gallery, gallery_branch, UNCHANGED)
    cropped = any(picture.box for picture in queries)
    clauses = _clauses(model, protocol, cropped, change)
    labels = [np.array([picture.label for picture in pictures], np.int64) for pictures in (queries, gallery)]
    result, retrieval = _measure(query, labels[0], tiles, labels[1], truth, task, protocol, clauses)
    errors = None
    if positions is not None:
        metres = geo.metres(positions[0], [positions[1][index] for index in retrieval.best])
        errors = np.where(retrieval.best < 0, np.inf, metres)
    return replace(result, cropped=cropped, seconds=time.perf_counter() - started, errors=errors)


def check_test_split(dataset: Dataset, tasks: Sequence[str]) -> None:
    """Check a test split before long work, so that the evaluation at its end does not fail.

    Raises:
        InputError: when the data set does not offer one of the tasks.
        PictureError: when a picture of the split is damaged.
        DataError: when the test split is incomplete, or its `geo.csv` does not cover it.
    """
    missing = [task for task in tasks if task not in dataset.tasks()]
    if missing:
        raise InputError(
            f"{dataset.root.name} does not offer {missing[0]}; it offers {', '.join(dataset.tasks()) or 'no task'}."
        )
    lists = lists_of(dataset, tasks)
    files = list(dict.fromkeys(picture.path for pictures in lists.values() for picture in pictures))
    check_whole(files, f"test pictures of {dataset.root.name}", dataset.root)
    positions = geo.positions(dataset.root)
    if positions is not None:
        for pictures in lists.values():
            positions.of(pictures)


def lists_of(dataset: Dataset, tasks: Sequence[str]) -> dict[str, list[Picture]]:
    """Return the lists of pictures of some tasks, by keys such as "query drone" and "gallery satellite"."""
    queries = dict.fromkeys(views_of(task)[0] for task in tasks)
    galleries = dict.fromkeys(views_of(task)[1] for task in tasks)
    return {f"query {view}": dataset.queries(view) for view in queries} | {
        f"gallery {view}": dataset.gallery(view) for view in galleries
    }


def evaluate_saved(saved: PublishedResult, protocol: Protocol | None = None) -> Result:
    """Evaluate the descriptors of a published result, see `lpn.retrieval.published_results`.

    Raises:
        InputError: when a part does not exist, or the protocol needs pictures to be described again.
    """
    started = time.perf_counter()
    protocol = protocol or Protocol()
    if protocol.change or protocol.branch or protocol.whole:
        raise InputError(
            f"{saved.name} holds descriptors, not pictures: rotation, shift, scale, branch, and whole queries need --model and "
            "--data; leave them out."
        )
    clauses = ["descriptors as saved"]
    result, _ = _measure(
        saved.query, saved.query_labels, saved.gallery, saved.gallery_labels, None, saved.task, protocol, clauses
    )
    return replace(result, seconds=time.perf_counter() - started)


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
    """Average queries and select parts as the protocol demands, and rank."""
    n, pictures = query.shape[1], len(query)
    chosen = protocol.chosen(n)
    if protocol.average:
        query, query_labels = averaged(query, query_labels)
    retrieval = metrics.retrieve(protocol.select(query), query_labels, protocol.select(gallery), gallery_labels, truth)
    values = retrieval.metrics()
    result = Result(
        recall={key.removeprefix("recall@"): value for key, value in values.items() if key.startswith("recall@")},
        ap=values["ap"],
        queries=len(query),
        gallery=len(gallery),
        task=task,
        protocol=protocol,
        parts=chosen,
        cropped=False,
        listed=truth is not None,
        sentence=sentence(clauses, chosen, n, pictures if protocol.average else None, truth is not None),
        seconds=0.0,
    )
    return result, retrieval


def _check_branch(model: Model, branch: View, protocol: Protocol) -> None:
    if branch not in model.views and protocol.branch is None:
        raise InputError(
            f"This model has no {branch!r} view; it has {', '.join(model.views)}. To describe both sides with one of "
            "these, choose it with --branch."
        )
    model.check_view(branch)


def _clauses(model: Model, protocol: Protocol, cropped: bool, change: Change) -> list[str]:
    """The clauses about the descriptors in the protocol's sentence."""
    mirrored = "descriptors of picture and mirror added, " if model.spec.mirrored else ""
    clauses = [f"{mirrored}each part normalised"]
    clauses += ["queries cropped to the part that is meant"] if cropped else []
    clauses += [f"queries {change.describe()}"] if change else []
    clauses += [f"both sides described by the {protocol.branch} branch"] if protocol.branch else []
    return clauses
