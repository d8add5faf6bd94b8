"""The list of queries in the panel Query: thumbnails that scroll, drawn as they come into sight."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from explorer import session_state
from explorer.browse.feeds import Feeds
from explorer.browse.messages import PickQuery
from explorer.compute.ranking_job import RankingJob
from explorer.session_state import StateChange
from explorer.web.html import Html
from explorer.web.render import call, render, run
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import BoolArray, Int64Array

# An entry of the list: the query, its name, and 1 if it was found, 0 if it failed, None where that is not known for certain.
Entry = tuple[int, str, int | None]


class QueryList:
    """One browser's list of queries: those whose names contain the search text, with the chosen one in sight.

    Args:
        change: updates the browser's state with a function.
    """

    def __init__(
        self, gui: viser.GuiApi, workspace: Workspace, feeds: Feeds, change: Callable[[StateChange], None]
    ) -> None:
        self._workspace, self._feeds, self._change = workspace, feeds, change
        self._key: object = None
        self._listed, self._feed = np.zeros(0, np.int64), ""
        self._count, self._shell = Html(gui), Html(gui, render("browse/queries"))
        self._data = Html(gui)

    def show(self, analysis: StateAnalysis) -> None:
        """Show the queries that the state's search text leaves, and mark the state's query."""
        state, task = analysis.state, analysis.task
        ranking = self._workspace.rankings[task.key]
        key = task.key, state.find, ranking.result, self._workspace.flight
        if self._key != key:
            self._key = key
            self._listed = np.array(session_state.matching_names(task.query_names, state.find), np.int64)
            self._feed = publish(self._feeds, self, ranking, self._listed, self._workspace.graded(ranking))
            self._count.show(render("browse/count", listed=len(self._listed), total=len(task.queries)))
        position = -1 if state.upload else position_of(state.query, self._listed)
        data = {
            "kind": "queries",
            "message": "pick",
            "task": task.name,
            "title": f"{task.name} {state.find}",
            "address": self._feeds.address,
            "feed": self._feed,
            "pictures": self._feeds.thumbnails(task, "query"),
            "total": len(self._listed),
            "chosen": position,
            "reveal": True,
        }
        self._data.show(run(call("list", "lpn-queries", data)))

    def leave(self) -> None:
        """Serve nothing more to a browser that left."""
        self._feeds.leave(self)

    def pick(self, message: PickQuery) -> None:
        """Choose a query, unless another task is shown by now."""
        if message.task in self._workspace.tasks:
            queries = len(self._workspace.tasks[message.task].queries)
            self._change(
                lambda state: (
                    session_state.choose_query(state, message.query, queries) if state.task == message.task else state
                )
            )


def publish(feeds: Feeds, owner: object, ranking: RankingJob, queries: Int64Array, graded: BoolArray) -> str:
    """Publish a list of queries, given by their positions in the list's order; the list is that of this moment's ranking.

    Args:
        graded: those of all queries that are graded, see `Workspace.graded`, (Q,).
    """
    return feeds.publish_list(
        owner, "queries", len(queries), lambda start, end: entries(ranking, queries[start:end].tolist(), graded)
    )


def entries(ranking: RankingJob, queries: Sequence[int], graded: BoolArray) -> list[Entry]:
    """Return the list's entries of some queries, given which of all are graded, (Q,)."""
    names, failed = ranking.task.query_names, ranking.failed if graded.any() else None
    return [
        (query, names[query], None if failed is None or not graded[query] else int(not failed[query]))
        for query in queries
    ]


def position_of(query: int, ascending: Int64Array) -> int:
    """Return where a query is in a list, -1 if it is not there."""
    position = int(np.searchsorted(ascending, query))
    return position if position < len(ascending) and ascending[position] == query else -1
