"""Resumable rankings of all queries of a task, cached on disk between runs.

    <cache>/rankings/<key>.npz     first, true, false (Q,) int64, precision, gap (Q,) float64, gallery: see `metrics.Retrieval`

The key is a digest of both sides' descriptors and of the true matches, so that a stale ranking is never read. A damaged file, or
a file with other numbers of pictures than the task, counts as missing.
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, AnyArray
from lpn.core.errors import OutputError
from lpn.core.files import cache_folder, write_atomic
from lpn.retrieval import metrics
from lpn.retrieval.metrics import Retrieval
from lpn.retrieval.ranks import Ranked

if TYPE_CHECKING:
    from lpn.tasks.task import Task

log = logging.getLogger(__name__)

FORMAT = "lpn-ranking/2"
# Queries ranked at a time; a stopped ranking loses at most the current step.
STEP = 4096
_COLUMNS = ("first", "true", "false", "precision", "gap")


class ResumableRanking:
    """The ranking of all queries of a task under equal part weights; not thread-safe.

    If `progress` stops `finish` by an exception, the next call of `finish` continues the ranking.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._steps: list[Ranked] = []

    def finish(self, progress: Callable[[int, int], None]) -> Retrieval:
        """Rank the remaining queries.

        Args:
            progress: called with the numbers of ranked and of all queries; may raise an exception to stop.

        Raises:
            InputError: as for `metrics.retrieve`.
        """
        task, (queries, gallery) = self._task, self._task.compared
        total = len(queries)
        while (done := sum(len(step.first) for step in self._steps)) < total:
            progress(done, total)
            rows = slice(done, done + STEP)

            def on_progress(count: int, _: int, before: int = done) -> None:
                progress(before + count, total)

            ranked = metrics.retrieve(
                queries[rows],
                task.query_labels[rows],
                gallery,
                task.gallery_labels,
                None if task.truth is None else task.truth[rows],
                progress=on_progress,
            )
            self._steps.append(ranked)
        return metrics.joined(self._steps, len(gallery))


def cache_file(task: Task) -> Path | None:
    """Return the file of a task's ranking; None if descriptors have no identity, or there is no cache folder."""
    if not task.identity:
        return None
    try:
        folder = cache_folder() / "rankings"
    except OutputError:
        return None
    digest = hashlib.sha256(f"{FORMAT} {task.identity} {task.neighbours}".encode())
    for labels in (task.query_labels, task.gallery_labels):
        digest.update(np.ascontiguousarray(labels, np.int64).tobytes() + b"|")
    for truth in task.truth or ():
        digest.update(truth.good.astype(np.int64).tobytes() + b"/" + truth.junk.astype(np.int64).tobytes())
        digest.update(b"" if truth.among is None else b"/" + truth.among.tobytes())
        digest.update(b"|" if truth.trapezoid else b"-")
    return folder / f"{digest.hexdigest()[:24]}.npz"


def save(task: Task, ranking: Retrieval) -> None:
    """Write a ranking to the cache; log a warning if that fails."""
    file = cache_file(task)
    if file is None:
        return
    data = io.BytesIO()
    np.savez(data, gallery=ranking.gallery, **{name: getattr(ranking, name) for name in _COLUMNS})
    try:
        write_atomic(file, data.getvalue())
    except OutputError as error:
        log.warning("The ranking could not be cached: %s", error)


def load(task: Task) -> Retrieval | None:
    """Read a task's ranking from the cache; None if it is missing or damaged."""
    file = cache_file(task)
    if file is None:
        return None
    try:
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as archive:
            columns = [archive[name] for name in _COLUMNS]
            gallery = int(archive["gallery"])
    except DAMAGED_ARRAY:
        return None
    if not all(isinstance(column, np.ndarray) for column in columns):
        return None
    queries, tiles = len(task.query_descriptors), task.tiles
    first, true, false, precision, gap = columns
    positions_valid = all(_valid(column, np.int64, queries, -1, tiles - 1) for column in (first, true, false))
    numbers_valid = _valid(precision, np.float64, queries, 0, 1) and _valid(np.nan_to_num(gap), np.float64, queries, 0)
    if gallery != tiles or not positions_valid or not numbers_valid:
        return None
    return Retrieval(first, true, false, precision, gap, tiles)


def _valid(column: AnyArray, dtype: type, length: int, low: float, high: float = np.inf) -> bool:
    """Return whether a column has this dtype and length, and all values are in low .. high."""
    return column.dtype == dtype and column.shape == (length,) and bool(((column >= low) & (column <= high)).all())
