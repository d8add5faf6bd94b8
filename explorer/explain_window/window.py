"""The window of reasons: evidence, true against wrong, profiles, and search by a region, in tabs of one movable panel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import reports, session_state
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import Worker
from explorer.explain_window import comparison, evidence, region, sweep_page
from explorer.explain_window.comparison import Comparison
from explorer.explain_window.model_comparison import ModelComparison
from explorer.explain_window.sweep_request import Sweep
from explorer.panels.panels import Change
from explorer.panels.viewport import EDGE, Viewport
from explorer.reports import Reporter
from explorer.session_state import SessionState
from explorer.web.bridge import send
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.explain import counterfactual
from lpn.explain.counterfactual import Effect
from lpn.retrieval import Ranking

_WIDTH, _HEIGHT = 1000, 900
CLOSE = f"<div class='lpn'><a class='close' {send('close')} title='Close (Y)'>✕</a></div>"
_OFTEN = 0.15
"""Seconds between two drawings of a profile that is being computed."""


class ExplainWindow:
    """One browser's window; it shows answers while the state says that it is open.

    Args:
        change: replaces the browser's state by a function's result.
        failed: is told of what went wrong in long work.
        room: that the stage has for the window.
        reporter: makes reports of what is shown.
        asker: the browser, before the networks.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        change: Callable[[Change], None],
        failed: Callable[[Exception], None],
        room: Viewport,
        reporter: Reporter,
        asker: RequestContext,
    ) -> None:
        self._client, self._workspace, self._change, self._room = client, workspace, change, room
        self._reporter, self._model = reporter, asker.of(workspace.model, patient=True)
        self._analysis: StateAnalysis | None = None
        self._contest: Comparison | None = None
        self._effect: Effect | None = None
        self._argued: tuple[Ranking, int] | None = None
        """What the contest is of: a ranking, and the tile that is compared."""
        self._sweep: Sweep | None = None
        self._wanted: Comparison | None = None
        """The contest whose change of weights is to be tried on all queries."""
        self._open = False
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        pages: list[Html] = []
        tabs = [
            ("Why", viser.Icon.ZOOM_QUESTION),
            ("True or wrong", viser.Icon.SCALE),
            ("Turn, shift, zoom", viser.Icon.CHART_LINE),
            ("Search by a region", viser.Icon.BRUSH),
        ]
        self._other = None if workspace.beside is None else ModelComparison(workspace.beside, asker)
        if self._other is not None:
            tabs.append(("Two models", viser.Icon.COLUMNS_2))
        for name, icon in tabs:
            with self._panel.add_tab(name, icon):
                gui.add_html(CLOSE)
                pages.append(Html(gui))
        self._why, self._versus, self._profile, self._region = pages[:4]
        self._beside = pages[-1]
        self._worker = Worker(self._work, failed)
        self._second = Worker(self._draw_beside, failed)
        room.watch(self._place)

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """What the window's html may ask for, whatever the values."""
        return {
            "close": lambda _: self._change(lambda state: replace(state, why=False)),
            "part": self._part,
            "compare": self._compare,
            "query": self._query,
            "weigh": self._weigh,
            "effect": self._try,
            "report": self._report,
            "sweep": self._begin,
            "cancel": self._cancel,
            "take": self._take,
            "region": self._paint,
        }

    def orders(self) -> list[tuple[str, Callable[[], None]]]:
        """What the command palette offers of the window."""
        if self._workspace.model is None:
            return []
        sweeps = [
            (f"Profile: {said.lower()}", self._ordered(self._begin, key)) for key, said in sweep_page.CHOICES.items()
        ]
        return [
            *sweeps,
            ("Stop the profile", self._ordered(self._cancel)),
            ("Try the smallest change of part weights on all queries", self._ordered(self._try)),
            ("Use the smallest change of part weights", self._ordered(self._weigh)),
            ("Search by the whole query, not a region", self._ordered(self._paint, [])),
            ("Save a report of this query", self._ordered(self._report)),
        ]

    def _ordered(self, handler: Callable[[Any], None], value: Any = None) -> Callable[[], None]:
        def done() -> None:
            self._change(lambda state: replace(state, why=True))
            handler(value)

        return done

    def leave(self) -> None:
        """The browser is gone: stop what is being computed."""
        self._cancel(None)
        self._worker.stop()
        self._second.stop()

    def show(self, analysis: StateAnalysis) -> None:
        """Open or close the window, and fill it."""
        self._analysis = analysis
        sweep = self._sweep
        if sweep is not None and not sweep.is_of(analysis):
            self._cancel(None)
            self._sweep = None
        if analysis.state.why:
            if (
                self._argued is None
                or self._argued[0] is not analysis.ranking
                or self._argued[1] != analysis.chosen.index
            ):
                self._contest, self._effect = Comparison.of(analysis), None
                self._argued = analysis.ranking, analysis.chosen.index
            self._draw(analysis)
        if analysis.state.why != self._open:
            self._open = analysis.state.why
            self._place()
            self._panel.visible = self._open

    def _draw(self, analysis: StateAnalysis) -> None:
        self._why.show(evidence.page(analysis, self._workspace))
        self._draw_versus(analysis)
        self._draw_profile(analysis)
        self._region.show(region.page(analysis, self._workspace))
        if self._other is not None:
            self._second.wake()

    def _draw_beside(self) -> None:
        """The second model describes the query, too: on a thread of its own, so that the first's answer does not wait."""
        analysis = self._analysis
        if self._other is not None and analysis is not None and analysis.state.why:
            self._beside.show(self._other.page(analysis, self._workspace))

    def _draw_versus(self, analysis: StateAnalysis) -> None:
        busy = self._wanted is not None and self._wanted is self._contest
        self._versus.show(comparison.page(analysis, self._workspace, self._contest, self._effect, busy))

    def _draw_profile(self, analysis: StateAnalysis) -> None:
        sweep, names = self._sweep, self._workspace.part_names
        if sweep is None:
            self._profile.show(sweep_page.page(analysis, None, None, 0, names))
        else:
            profile = sweep.profile(analysis)
            self._profile.show(sweep_page.page(analysis, sweep.over, profile, sweep.of, names, sweep.stopped))

    def _place(self) -> None:
        """Over the stage, as large as it has room for."""
        if self._open:
            width, height = self._room.window((_WIDTH, _HEIGHT))
            self._panel.float(x=EDGE, y=EDGE, width=width, height=height)
            self._panel.expand()

    def _work(self) -> None:
        self._measure()
        sweep = self._sweep
        if sweep is None or sweep.begun:
            return
        drawn = 0.0
        try:
            for _ in sweep.points_of(self._workspace, self._model):
                self._measure()
                if time.monotonic() - drawn > _OFTEN and sweep is self._sweep:
                    self._draw_profile(self._analysis or sweep.analysis)
                    drawn = time.monotonic()
        finally:  # one that failed is not being computed any more either
            if sweep is self._sweep:
                self._draw_profile(self._analysis or sweep.analysis)

    def _measure(self) -> None:
        """Try the wanted change of weights on all queries."""
        contest, analysis = self._wanted, self._analysis
        if contest is None or analysis is None or contest.change is None:
            return
        task = analysis.task
        found = counterfactual.effect(
            task.asked, task.descriptors, analysis.ranking.weights, contest.change.weights, task.query_labels, task.labels,
            task.truth,
        )  # fmt: skip
        if self._wanted is contest:
            self._wanted = None
        if self._contest is contest:
            self._effect = found
            self._draw_versus(self._analysis or analysis)

    def _try(self, _: Any) -> None:
        analysis, contest = self._analysis, self._contest
        if analysis is not None and contest is not None and contest.change is not None and not analysis.state.region:
            self._wanted = contest
            self._draw_versus(analysis)
            self._worker.wake()

    def _begin(self, value: Any) -> None:
        analysis = self._analysis
        if analysis is not None and value in list(sweep_page.CHOICES):
            self._cancel(None)
            self._sweep = Sweep(value, analysis)
            self._draw_profile(analysis)
            self._worker.wake()

    def _cancel(self, _: Any) -> None:
        if self._sweep is not None:
            self._sweep.cancelled.set()

    def _report(self, _: Any) -> None:
        analysis = self._analysis
        if analysis is not None:
            self._reporter.make(lambda progress, model: reports.of_analysis(self._workspace, analysis, progress, model))

    def _part(self, value: Any) -> None:
        part = session_state.whole(value, 0, self._workspace.spec.n_parts - 1)
        if part is not None or value is None:
            self._change(lambda state: replace(state, heat_part=part))

    def _compare(self, value: Any) -> None:
        analysis = self._analysis
        index = session_state.whole(value, 0, len(analysis.task.gallery) - 1) if analysis else None
        if analysis is not None and index is not None:
            self._change(lambda state: session_state.compare(state, analysis.state, index))

    def _query(self, value: Any) -> None:
        def chosen(state: SessionState) -> SessionState:
            queries = len(self._workspace.tasks[state.task].queries)
            query = session_state.whole(value, 0, queries - 1)
            return state if query is None else session_state.choose(state, query, queries)

        self._change(chosen)

    def _weigh(self, _: Any) -> None:
        contest = self._contest
        if contest is not None and contest.change is not None:
            # As the sliders count: equal weights are 1 each, and none is more than the slider's end.
            scaled = contest.change.weights * min(
                len(contest.change.weights), session_state.MAX_WEIGHT / contest.change.weights.max()
            )
            weights = tuple(float(weight) for weight in scaled)
            self._change(lambda state: replace(state, weights=weights, enabled=()))

    def _take(self, value: Any) -> None:
        self._change(lambda state: session_state.taken(state, value, self._workspace.spec.input_size))

    def _paint(self, value: Any) -> None:
        analysis = self._analysis
        if analysis is not None:
            rows, columns = self._workspace.map_sizes[analysis.task.query_view]
            cells = session_state.painted(value, rows * columns)
            if cells is not None:
                self._change(lambda state: replace(state, region=cells))
