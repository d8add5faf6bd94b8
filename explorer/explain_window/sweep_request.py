"""A profile that one browser asked for, point by point."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

from explorer.workspace import StateAnalysis, Workspace
from lpn.descriptors.transforms import UNCHANGED
from lpn.explain import sweeps
from lpn.explain.sweeps import FIELD, Over, Point, Profile
from lpn.models.base import Model


class Sweep:
    """A request that answers itself on whatever thread takes its points.

    Attributes:
        over: what is swept; everything else that is done to the query stays as it is.
        answer: what was shown when it was asked for.
        of: points that it will have, 0 before it is begun.
        begun, stopped: whether somebody takes its points, and whether that ended before the last.
        cancelled: set to end it.
    """

    def __init__(self, over: Over, analysis: StateAnalysis) -> None:
        self.over, self.analysis = over, analysis
        self.of, self.begun, self.stopped = 0, False, False
        self.cancelled = threading.Event()
        self._entry = analysis.task.queries[analysis.state.query]
        self._points: list[Point] = []

    def points_of(self, workspace: Workspace, model: Model | None = None) -> Iterator[Point]:
        """Compute the points, until it is cancelled; by the workspace's model unless another way to it is given."""
        self.begun = True
        analysis, task, state = self.analysis, self.analysis.task, self.analysis.state
        model = model or workspace.model
        assert model is not None
        height, width = workspace.spec.input_size
        changes = sweeps.changes_over(self.over, side=height if self.over == "shift-down" else width)
        changes = [change.for_picture(self._entry) for change in sweeps.around(self.over, state.change, changes)]
        self.of = len(changes)
        known = None if state.upload else state.query
        try:
            for point in sweeps.profile(
                model,
                analysis.source,
                task.query_view,
                task.descriptors,
                analysis.ranking.weights,
                changes,
                task.labels,
                None if known is None else int(task.query_labels[known]),
                None if known is None or task.truth is None else task.truth[known],
                None if analysis.truth else analysis.chosen.index,
            ):
                if self.cancelled.is_set():
                    break
                self._points.append(point)
                yield point
        finally:
            self.stopped = len(self._points) < self.of

    def profile(self, analysis: StateAnalysis) -> Profile | None:
        """What is known so far, away from what the page shows now, or where that is between two points, from the beginning."""
        points = tuple(self._points)
        if not points:
            return None
        now = sweeps.value(self.over, analysis.state.change)
        shown = next((p.change for p in points if abs(sweeps.value(self.over, p.change) - now) < 1e-6), None)
        return Profile(self.over, points, shown or self.analysis.state.change.for_picture(self._entry))

    def is_of(self, analysis: StateAnalysis) -> bool:
        """Whether it says something about what the page shows now."""
        return _about(self.over, self.analysis) == _about(self.over, analysis)


def _about(over: Over, analysis: StateAnalysis) -> object:
    state = analysis.state
    followed = None if analysis.truth else analysis.chosen.index
    return (
        state.task,
        state.query,
        state.upload,
        tuple(analysis.ranking.weights.tolist()),
        followed,
        # What is done to the query beside what is swept.
        replace(state.change, **{FIELD[over]: getattr(UNCHANGED, FIELD[over])}),
    )
