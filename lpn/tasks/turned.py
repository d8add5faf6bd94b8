"""A whole task with changed queries: all turned by one angle, with Recall@1 and AP (Table IV), or all in one weather."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np

from lpn.core.errors import InputError
from lpn.core.progress import counted_among
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
    """Say why queries of a task are not changed, as a sentence about turned ones; empty if they can be."""
    if task.model is None:
        return "These are descriptors without their network, so queries cannot be turned."
    if not task.lists_gallery:
        return "The gallery is searched in an index; turned queries are measured with a gallery in memory."
    if any(picture.cut is not None for picture in task.queries):
        return "The queries are cut out of other pictures, so descriptors of turned ones are not kept."
    if task.known is not None and not task.known.any():
        return task.no_truth
    return ""


def turned(task: Task, degrees: float) -> TurnedFigures:
    """Turn all queries of a task, describe them by its model, and measure it.

    Descriptors are cached as `lpn evaluate --rotate` caches them, so that a second time takes no network. Those of an upright
    query are the task's own.

    Args:
        degrees: counter-clockwise.

    Raises:
        InputError: when the task cannot be measured so, see `why_not`.
        LPNError: when a picture cannot be read or the cache cannot be written.
    """
    angle = float(degrees % 360)
    figures = replace(changed(task, Change(rotate=angle)), weights=None).metrics
    return TurnedFigures(angle, figures["recall@1"], figures["ap"], int(figures["queries"]))


def changed(task: Task, change: Change) -> Task:
    """Change all queries of a task, and describe them by its model; the task with their descriptors, cached as `turned` says.

    Raises:
        InputError, LPNError: as `turned`.
    """
    if reason := why_not(task):
        raise InputError(reason)
    assert task.model is not None
    if not change:
        return task
    query, _ = task.sides()
    query = np.empty_like(query)
    zooms = np.array([picture.zoom for picture in task.queries])
    done = 0
    for zoom in np.unique(zooms).tolist():
        rows = np.flatnonzero(zooms == zoom)
        some = [task.queries[row] for row in rows.tolist()]
        zoomed = replace(change, scale=change.scale * float(zoom), around=some[0].panorama)
        with counted_among(done, len(zooms)):
            query[rows] = cached_descriptors(task.model, some, task.query_view, zoomed)
        done += len(rows)
    identity = hashlib.sha256(f"{task.identity} {change}".encode()).hexdigest() if task.identity else ""
    return replace(task, query_descriptors=query, identity=identity)
