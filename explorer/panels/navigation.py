"""Steps from one query to another, and from one task to another."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random

import numpy as np

from explorer import session_state
from explorer.panels import wrong_answer
from explorer.session_state import SessionState, StateChange
from explorer.workspace import Workspace
from lpn.core.arrays import BoolArray, Int64Array


class Navigation:
    """State changes that choose another query.

    Args:
        notify: shows a notification with a title and a text.

    Attributes:
        step_own: steps through the user's own pictures by a number; returns None unless one of several is shown.
        order: returns the queries that `next` and `previous` step through; None for all queries.
    """

    def __init__(self, workspace: Workspace, notify: Callable[[str, str], object]) -> None:
        self._workspace, self._notify, self._rng = workspace, notify, Random()
        self._last_query: dict[str, int] = {}
        self.step_own: Callable[[SessionState, int], SessionState | None] = lambda *_: None
        self.order: Callable[[SessionState], Int64Array | None] = lambda _: None

    def next(self, state: SessionState) -> SessionState:
        """Choose the next query."""
        return self._step(state, 1)

    def previous(self, state: SessionState) -> SessionState:
        """Choose the previous query."""
        return self._step(state, -1)

    def random(self, state: SessionState) -> SessionState:
        """Choose another query at random."""
        return session_state.random_query(state, self._count(state), self._rng)

    def failure(self, state: SessionState) -> SessionState | None:
        """Choose another failure at random."""
        return self._failure(state, partial(session_state.random_failure, rng=self._rng))

    def next_failure(self, state: SessionState) -> SessionState | None:
        """Choose the next failure of the list.

        Those of a flight that its other methods do not mend are first.
        """

        def choose(state: SessionState, failed: BoolArray) -> SessionState | None:
            verdicts = self._workspace.verdicts
            mended = None if verdicts is None else np.array([int(one.sign is True) for one in verdicts.beliefs])
            return session_state.next_failure(state, failed, mended)

        return self._failure(state, choose)

    def _failure(
        self, state: SessionState, choose: Callable[[SessionState, BoolArray], SessionState | None]
    ) -> SessionState | None:
        ranking = self._workspace.rankings[state.ranking_key]
        if ranking.result is None:
            self._notify("Not known yet", "All queries are still being ranked; try again later.")
            return None
        graded = self._workspace.graded(ranking)
        chosen = choose(state, ranking.failed & graded)
        if chosen is None and not graded.any():
            self._notify("Nothing is known", "No query of this task has a place known for certain, so none can fail.")
        elif chosen is None:
            every = "Every" if graded.all() else "Every graded"
            right = f"{every} query of this task has its true tile at rank 1."
            self._notify("No failure", f"{every} first answer here is right." if state.plain else right)
        return chosen

    def choose_task(self, name: str) -> StateChange:
        """Return the change to another task, at a query of the same place if it has one; an unknown name changes nothing.

        If several queries show the place, the change takes the one that the task showed last, else the first. It drops
        the user's own picture, and a notification says so.
        """

        def choose(state: SessionState) -> SessionState:
            if name not in self._workspace.tasks or name == state.task:
                return state
            if state.upload is not None:
                self._notify("Your picture is closed", "Load it again to search the tiles of this task.")
            self._last_query[state.task] = state.query
            query = self._workspace.same_place(state, name, self._last_query.get(name, 0))
            return session_state.choose_task(state, name, query)

        return choose

    def _step(self, state: SessionState, by: int) -> SessionState:
        if state.fails and state.first_screen and (wrong := wrong_answer.rows(self._workspace, state)) is not None:
            chosen = session_state.step_in_order(state, by, wrong, self._count(state)).query
            return session_state.show_fails(state, chosen, self._count(state))
        if state.upload is not None and (own := self.step_own(state, by)) is not None:
            return own
        order, count = self.order(state), self._count(state)
        return (
            session_state.step(state, by, count)
            if order is None
            else session_state.step_in_order(state, by, order, count)
        )

    def _count(self, state: SessionState) -> int:
        return len(self._workspace.tasks[state.task].queries)
