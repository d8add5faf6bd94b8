"""The list of queries at the left: all, or the missed ones, worst first. The page asks for pieces of it as it scrolls."""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np

from explorer.compute.ranking_job import RankingJob
from explorer.feeds import Feeds
from explorer.screen.fields import ScreenState
from explorer.workspace import Workspace
from lpn.core.arrays import Int64Array

_RANDOM = Random()
# Name of the filter for missed queries, and the word of a search for them.
_MISSED = "missed"


class Rail:
    """One tab's list of queries."""

    def __init__(self) -> None:
        self._key: object = None
        self._listed: Int64Array = np.zeros(0, np.int64)
        self._message: dict[str, Any] = {}

    def message(self, state: ScreenState, workspace: Workspace, ranking: RankingJob, feeds: Feeds) -> dict[str, Any]:
        """Return the list of a state as JSON.

        Args:
            workspace: the model's workspace, whose ranking marks the queries.
            feeds: serves the list, and the thumbnails.
        """
        key = state.place, state.model, ranking.task.key, state.filter, state.find, ranking.result
        if key != self._key:
            self._key = key
            ranks, names = ranks_of(workspace, ranking), ranking.task.query_names
            listed = self._listed = listed_queries(state, workspace, ranking)
            self._message = {
                "feed": feeds.publish_list(
                    self,
                    "rail",
                    len(listed),
                    lambda start, end: [(q, names[q], int(ranks[q])) for q in listed[start:end].tolist()],
                ),
                "address": feeds.address,
                "thumbnails": feeds.thumbnails(ranking.task, "query"),
                "total": len(listed),
                "queries": len(names),
                "missed": int((ranks > 1).sum()),
                "worst_first": _lists_missed(state),
                "find": state.find,
            }
        return self._message | {"chosen": -1 if state.own else self._position(state.query)}

    def step(self, query: int, by: int) -> int | None:
        """Return the query that is `by` places further in the list; None for an empty list."""
        if not len(self._listed):
            return None
        at = self._position(query)
        return int(self._listed[0 if at < 0 else (at + by) % len(self._listed)])

    def random(self, query: int) -> int | None:
        """Return another query of the list; None for an empty list."""
        others = self._listed[self._listed != query]
        return int(_RANDOM.choice(others.tolist())) if len(others) else None

    def _position(self, query: int) -> int:
        found = np.flatnonzero(self._listed == query)
        return int(found[0]) if len(found) else -1


def listed_queries(state: ScreenState, workspace: Workspace, ranking: RankingJob) -> Int64Array:
    """Return the listed queries of a state; the missed ones in descending order of rank."""
    words = state.find.casefold().split()
    text = " ".join(word for word in words if word != _MISSED)
    named = np.array([i for i, name in enumerate(ranking.task.query_names) if text in name.casefold()], np.int64)
    if not _lists_missed(state):
        return named
    ranks = ranks_of(workspace, ranking)[named]
    order = np.argsort(-ranks, kind="stable")
    return named[order][ranks[order] > 1]


def _lists_missed(state: ScreenState) -> bool:
    return state.filter == _MISSED or _MISSED in state.find.casefold().split()


def ranks_of(workspace: Workspace, ranking: RankingJob) -> Int64Array:
    """Return the rank of each query's truth from 1, (Q,); 0 if it is unknown or not ranked yet."""
    if ranking.result is None:
        return np.zeros(len(ranking.task.queries), np.int64)
    return np.where(workspace.graded(ranking) & (ranking.ranks >= 0), ranking.ranks + 1, 0)
