"""Recall@1 and AP of a whole task whose queries are all turned by one angle (Table IV)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lpn.core.errors import InputError
from lpn.core.progress import CountProgress
from lpn.descriptors import cached_descriptors
from lpn.descriptors.transforms import Change
from lpn.tasks.task import Task

# The turns of Table IV, in degrees counter-clockwise.
PAPER_TURNS = (0.0, 45.0, 90.0, 180.0, 270.0)


@dataclass(frozen=True)
class TurnedFigures:
    """A whole task with turned queries.

    Attributes:
        degrees: counter-clockwise, 0 to less than 360.
        recall, ap: Recall@1 and AP under equal part weights, in percent.
        queries: number of queries whose truth is known.
    """

    degrees: float
    recall: float
    ap: float
    queries: int


def why_not(task: Task) -> str:
    """Say why a task is not measured with turned queries, as a sentence; empty if it can be."""
    if task.model is None:
        return "These are descriptors without their network, so queries cannot be turned."
    if not task.lists_gallery:
        return "The gallery is searched in an index; turned queries are measured with a gallery in memory."
    if any(picture.cut is not None for picture in task.queries):
        return "The queries are cut out of other pictures, so descriptors of turned ones are not kept."
    if task.known is not None and not task.known.any():
        return task.no_truth
    return ""


def turned(task: Task, degrees: float, progress: CountProgress | None = None) -> TurnedFigures:
    """Turn all queries of a task, describe them by its model, and measure it.

    Descriptors are cached as `lpn evaluate --rotate` caches them, so that a second time takes no network. Those of an upright
    query are the task's own.

    Args:
        degrees: counter-clockwise.
        progress: called with the numbers of described and of all queries; an exception stops the work, and what is described
            already is kept.

    Raises:
        InputError: when the task cannot be measured so, see `why_not`.
        LPNError: when a picture cannot be read or the cache cannot be written.
    """
    if reason := why_not(task):
        raise InputError(reason)
    assert task.model is not None
    query, _ = task.sides()
    angle = float(degrees % 360)
    if angle:
        query = np.empty_like(query)
        zooms = np.array([picture.zoom for picture in task.queries])
        done = 0
        for zoom in np.unique(zooms).tolist():
            rows = np.flatnonzero(zooms == zoom)
            some = [task.queries[row] for row in rows.tolist()]
            change = Change(rotate=angle, scale=float(zoom), around=some[0].panorama)

            def on_progress(count: int, _: int, before: int = done) -> None:
                if progress is not None:
                    progress(before + count, len(zooms))

            query[rows] = cached_descriptors(task.model, some, task.query_view, change, on_progress)
            done += len(rows)
    figures = replace(task, query_descriptors=query, weights=None).metrics
    return TurnedFigures(angle, figures["recall@1"], figures["ap"], int(figures["queries"]))
