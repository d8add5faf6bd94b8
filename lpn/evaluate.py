"""Retrieval on a data set's test split by the published protocol, for any model that `lpn.load` opens."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from lpn import features, geo, metrics
from lpn.datasets import Dataset
from lpn.errors import InputError
from lpn.geo import FloatArray
from lpn.model import Model
from lpn.spec import View

PROTOCOL = (
    "Published protocol: descriptors of picture and mirror added, each part normalised; ranked by inner product; "
    "a query without a true match counts as missed; AP by the trapezoid rule."
)

WITHIN = (25, 50, 100)
"""Distances in metres within which an answer counts as near."""


@dataclass(frozen=True, eq=False)
class Result:
    """Figures of one task, in percent, and what they were measured on.

    Attributes:
        recall: Recall@K for "1", "5", "10", and "1%".
        ap: mean average precision.
        queries, gallery: numbers of pictures.
        task: such as "drone-to-satellite".
        rotate: degrees counter-clockwise the queries were turned.
        parts: the parts used, 1-based.
        seconds: wall-clock time, descriptors included (none for those taken from the cache).
        errors: metres from what each query shows to the centre of its top match, (Q,); None without positions.
    """

    recall: dict[str, float]
    ap: float
    queries: int
    gallery: int
    task: str
    rotate: float
    parts: tuple[int, ...]
    seconds: float
    errors: FloatArray | None = None

    def distances(self) -> dict[str, float]:
        """See `error_shares`; empty without positions."""
        return {} if self.errors is None else error_shares(self.errors)

    def to_dict(self) -> dict[str, Any]:
        """The keys of the JSON file."""
        return {
            **{f"recall@{k}": value for k, value in self.recall.items()},
            "ap": self.ap,
            **self.distances(),
            "queries": self.queries,
            "gallery": self.gallery,
            "task": self.task,
            "rotate": self.rotate,
            "parts": list(self.parts),
            "seconds": self.seconds,
        }


def error_shares(errors: FloatArray) -> dict[str, float]:
    """`median error m` of errors in metres, and the percentage `within 25 m`, `within 50 m`, `within 100 m`."""
    within = {f"within {limit} m": 100.0 * float(np.mean(errors <= limit)) for limit in WITHIN}
    return {"median error m": float(np.median(errors)), **within}


def evaluate(
    model: Model,
    dataset: Dataset,
    task: str,
    rotate: float = 0.0,
    parts: Sequence[int] | None = None,
    cached: bool = True,
) -> Result:
    """Evaluate one task, such as "drone-to-satellite".

    Args:
        rotate: degrees counter-clockwise each query is turned on its own canvas, corners black (Table IV).
        parts: 1-based parts to use, all by default (Table V).
        cached: take descriptors from the user's cache and leave new ones there.

    Raises:
        InputError: when the data set lacks the task, the model a view, or a part does not exist.
        DataError: when the test split is incomplete, or its `geo.csv` does not cover it.
    """
    started = time.perf_counter()
    if task not in dataset.tasks():
        raise InputError(
            f"The task is {task!r}; {dataset.root.name} offers {', '.join(dataset.tasks()) or 'none'} in its test split."
        )
    chosen = tuple(range(1, model.n_parts + 1)) if parts is None else tuple(dict.fromkeys(parts))
    if not chosen or any(not 1 <= part <= model.n_parts for part in chosen):
        raise InputError(
            f"The parts are {', '.join(map(str, chosen)) or 'none'}; this model has parts 1 to {model.n_parts}."
        )
    if not np.isfinite(rotate):
        raise InputError(f"The rotation is {rotate}; expected degrees.")
    query_view, gallery_view = cast("tuple[View, View]", tuple(task.split("-to-")))
    for view in (query_view, gallery_view):
        model.check_view(view)
    queries, gallery = dataset.queries(query_view), dataset.gallery(gallery_view)
    index = np.array(chosen) - 1
    # Before the long part, so that a gap in it costs nothing.
    where = geo.positions(dataset.root)
    places = None if where is None else (where.of(queries), where.of(gallery))
    read = features.cached_descriptors if cached else features.passing_descriptors
    query = read(model, queries, query_view, rotate)[:, index]
    tiles = read(model, gallery, gallery_view)[:, index]
    labels = [np.array([picture.label for picture in pictures]) for pictures in (queries, gallery)]
    scores = metrics.evaluate(query, labels[0], tiles, labels[1])
    errors = None
    if places is not None:
        top = metrics.best(query, tiles, labels[1])
        errors = geo.metres(places[0], [places[1][index] for index in top])
    recall = {key.removeprefix("recall@"): value for key, value in scores.items() if key.startswith("recall@")}
    return Result(
        recall,
        scores["ap"],
        len(queries),
        len(gallery),
        task,
        float(rotate),
        chosen,
        time.perf_counter() - started,
        errors,
    )
