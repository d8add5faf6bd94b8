"""A sweep over turns, shifts, zooms, or weathers that one browser requested."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

from explorer.workspace import StateAnalysis, Workspace
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.explain import sweeps
from lpn.explain.sweeps import CHANGE_FIELD, SweepPoint, SweepResult, SweptProperty
from lpn.models.base import Model


class SweepRequest:
    """A requested sweep.

    Args:
        over: the swept property; everything else done to the query stays as it is.
        analysis: the analysis that was shown when the sweep was requested.

    Attributes:
        cancelled: set it to end the sweep.
    """

    def __init__(self, over: SweptProperty, analysis: StateAnalysis) -> None:
        self.over, self.analysis = over, analysis
        self.cancelled = threading.Event()
        self.query = analysis.task.queries[analysis.state.query]

    def run(self, workspace: Workspace, model: Model) -> Iterator[SweepProgress]:
        """Compute point by point until the end or a cancellation, and yield the progress after each point.

        The last progress is marked as ended, unless an exception ends the sweep.
        """
        analysis, task, state = self.analysis, self.analysis.task, self.analysis.state
        height, width = workspace.contract.input_size
        strength = (state.weather_strength or 1.0) if self.over == "weather" else None
        changes = sweeps.changes_over(self.over, reach=strength, side=height if self.over == "shift-down" else width)
        changes = [self.for_query(change) for change in sweeps.apply_to_base(self.over, state.change, changes)]
        known = None if state.upload else state.query
        progress = SweepProgress(self, total=len(changes))
        yield progress
        follow = None if analysis.positive else analysis.chosen.index
        rank = task.ranks_under(known, analysis.ranking.weights)
        for point in sweeps.sweep_points(
            workspace.scored_model(model, task).for_task(*task.views),
            analysis.source,
            task.query_view,
            changes,
            rank,
            follow,
        ):
            if self.cancelled.is_set():
                break
            progress = replace(progress, points=(*progress.points, point))
            yield progress
        yield replace(progress, ended=True)

    def for_query(self, change: Change) -> Change:
        """Return a change for the picture of the query, which has a zoom of its own if it is calibrated."""
        return change.for_picture(self.query, self.analysis.zoom)

    def applies_to(self, analysis: StateAnalysis) -> bool:
        """Return True when only the swept property of the query has changed since the request."""
        return self._key(self.analysis) == self._key(analysis)

    def _key(self, analysis: StateAnalysis) -> object:
        state, field = analysis.state, CHANGE_FIELD[self.over]
        followed = None if analysis.positive else analysis.chosen.index
        weights = tuple(analysis.ranking.weights.tolist())
        unswept = replace(state.change, **{field: getattr(UNCHANGED, field)})
        strength = state.weather_strength if self.over == "weather" else None
        return state.ranking_key, state.query, state.upload, weights, followed, unswept, strength


@dataclass(frozen=True, eq=False)
class SweepProgress:
    """The points of a sweep that are computed so far.

    Attributes:
        total: number of points of the whole sweep; 0 before the sweep begins.
        ended: True when no more points will come.
    """

    request: SweepRequest
    points: tuple[SweepPoint, ...] = ()
    total: int = 0
    ended: bool = False

    @property
    def stopped(self) -> bool:
        """True when the sweep ended before its last point."""
        return self.ended and len(self.points) < max(self.total, 1)

    def profile(self, analysis: StateAnalysis) -> SweepResult | None:
        """Return the profile around the shown query, or around the requested one where the shown query is no point.

        None before the first point.
        """
        if not self.points:
            return None
        over = self.request.over
        now = sweeps.swept_value(over, analysis.state.change)
        nearest = next((p.change for p in self.points if abs(sweeps.swept_value(over, p.change) - now) < 1e-6), None)
        return SweepResult(over, self.points, nearest or self.request.for_query(self.request.analysis.state.change))
