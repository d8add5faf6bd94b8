"""The explain window: evidence, heatmaps, comparison, sweeps, and search by a region, in the tabs of one movable panel."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Any

import viser

from explorer import judge, reports, session_state
from explorer.compute.request_context import QueuedModel, RequestContext
from explorer.compute.turned_jobs import TurnedJobs
from explorer.compute.worker import Worker
from explorer.explain_window import activation, comparison, evidence, messages, region, sweep_page
from explorer.explain_window.messages import ExplainMessage
from explorer.explain_window.model_comparison import ModelComparison
from explorer.explain_window.sweep_request import SweepProgress, SweepRequest
from explorer.explain_window.whole_task import TurnChoice, WholeTask
from explorer.panels.first_screen import said
from explorer.reports import FileProgress, Reporter
from explorer.session_state import StateChange, WhyTab
from explorer.stage.viewport import EDGE, Viewport
from explorer.web.html import Html
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis.comparison import Comparison, effect_on
from lpn.core.errors import LPNError
from lpn.core.progress import at_intervals
from lpn.drawing.words import speaking
from lpn.explain.counterfactual import Effect
from lpn.explain.sweeps import SweptProperty
from lpn.retrieval import Ranking
from lpn.tasks.changes import why_not

_EVIDENCE, _HEATMAPS, _COMPARISON, _SWEEP = "Why", "Heatmaps", "True or wrong", "Turn, shift, zoom"
_REGION, _MODELS = "Search by a region", "Two models"
_TABS: dict[WhyTab, str] = {
    "evidence": _EVIDENCE,
    "heatmaps": _HEATMAPS,
    "comparison": _COMPARISON,
    "sweep": _SWEEP,
    "region": _REGION,
    "models": _MODELS,
}
_MAX_SIZE = (1600, 1100)
# Seconds between two drawings of a sweep in progress.
_DRAW_INTERVAL = 0.15
# Seconds between two reports on the reading of a map's files.
_READING = 0.3


@dataclass(frozen=True, eq=False)
class PairResult:
    """The comparison of one pair of tiles, and the effect of its weight change.

    Attributes:
        ranking: the ranking of one query under given weights and region; compared by identity.
        index: gallery position of the compared tile.
        effect: of the weight change on all queries; None until it is computed.
        computing: the effect was requested and is not computed yet.
    """

    ranking: Ranking
    index: int
    comparison: Comparison | None
    effect: Effect | None = None
    computing: bool = False

    @classmethod
    def of(cls, analysis: StateAnalysis) -> PairResult:
        """Compare the pair that an analysis shows."""
        return cls(analysis.ranking, analysis.chosen.index, Comparison.of(analysis.ranking, analysis.chosen))

    def belongs_to(self, analysis: StateAnalysis) -> bool:
        """Return True when the analysis shows this pair."""
        return self.ranking is analysis.ranking and self.index == analysis.chosen.index


@dataclass(frozen=True, eq=False)
class WindowContent:
    """The content of the window; `pair` and `sweep` belong to `analysis`."""

    analysis: StateAnalysis
    pair: PairResult | None = None
    sweep: SweepProgress | None = None

    def has_sweep(self, over: SweptProperty) -> bool:
        """Return True when this sweep is requested, in progress, or ended at its last point."""
        sweep = self.sweep
        return (
            sweep is not None and sweep.request.over == over and not (sweep.stopped or sweep.request.cancelled.is_set())
        )


class _Tab:
    """One tab, drawn by one thread at a time, so that the newest content is the last to be drawn."""

    def __init__(self, gui: viser.GuiApi, content: Callable[[], str | None]) -> None:
        gui.add_html(render("explain/close"))
        self._html, self._content, self._lock = Html(gui), content, Lock()

    def wait(self) -> None:
        """Say that the content is being computed."""
        with self._lock:
            self._html.show(render("explain/waiting"))

    def fail(self, text: str) -> None:
        """Say why there is no content."""
        with self._lock:
            self._html.show(render("explain/failed", text=text))

    def draw(self) -> None:
        with self._lock:
            html = self._content()
            if html is not None:
                self._html.show(html)


class ExplainWindow:
    """One browser's explain window; it is visible while `SessionState.why` is set.

    Three threads write its content: the browser's worker (`show`), viser's callbacks, and the window's own worker. So
    the content is a frozen record, replaced as a whole under one lock; a result is stored only where the content still
    has the pair or the sweep that the result was computed for.

    Args:
        change: updates the browser's state with a function.
        on_error: receives the exceptions of long computations.
        viewport: the size of the stage.
        reporter: makes reports of the shown analysis.
        requests: gives access to the networks for this browser.
        turned: computes whole tasks with turned queries.
        open_tab: makes the page show a tab by its name.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        change: Callable[[StateChange], None],
        on_error: Callable[[Exception], None],
        viewport: Viewport,
        reporter: Reporter,
        requests: RequestContext,
        turned: TurnedJobs,
        open_tab: Callable[[str], None],
    ) -> None:
        self._workspace, self._change, self._viewport, self._reporter = workspace, change, viewport, reporter
        self._model = requests.queued(workspace.model, background=True)
        self._tile_model = requests.queued(workspace.model)
        self._models = ModelComparison(workspace, requests)
        self._open_tab = open_tab
        # The tab that the page shows, None until it is known.
        self._tab_shown: WhyTab | None = None
        self._lock = Lock()
        self._content: WindowContent | None = None
        self._failure = ""
        self._open = self._left = False
        tabs: list[tuple[str, Any, Callable[[WindowContent], str]]] = [
            (_EVIDENCE, viser.Icon.ZOOM_QUESTION, lambda content: evidence.page(content.analysis, workspace)),
            (_HEATMAPS, viser.Icon.GRID_DOTS, self._heatmaps_html),
            (_COMPARISON, viser.Icon.SCALE, self._comparison_html),
            (_SWEEP, viser.Icon.CHART_LINE, self._sweep_html),
            (_REGION, viser.Icon.BRUSH, lambda content: region.page(content.analysis, workspace)),
        ]
        if workspace.beside:
            tabs.append((_MODELS, viser.Icon.COLUMNS_2, lambda content: self._models.page(content.analysis)))
        self._panel = client.gui.add_panel(visible=False)
        self._tabs: list[_Tab] = []
        for name, icon, content in tabs:
            with self._panel.add_tab(name, icon):
                self._tabs.append(_Tab(client.gui, self._renderer(content)))
                if name == _MODELS:
                    self._live = Html(client.gui)
        self._comparison_tab, self._sweep_tab = self._tabs[2:4]
        self._whole_task = WholeTask(turned, self._sweep_tab.draw)
        self._worker = Worker(self._compute, on_error)
        # The model beside runs in its own thread, so that the workspace's own answer need not wait for it.
        self._models_worker = Worker(self._draw_models, on_error)
        viewport.watch(self._place)

    def receive(self, message: ExplainMessage) -> None:
        """Do what a message of the window's HTML asks for; one that means nothing in this state changes nothing."""
        match message:
            case messages.CloseWhy():
                self._change(lambda state: replace(state, why=False))
            case messages.FollowTab(name):
                self._follow_tab(name)
            case messages.ShowPart(part) if part is None or part < self._workspace.contract.n_parts:
                self._change(lambda state: replace(state, heat_part=part))
            case messages.ShareScale(same):
                self._change(lambda state: replace(state, same_scale=same))
            case messages.LayOver(laid):
                self._change(lambda state: replace(state, heat_over=laid))
            case messages.CompareModels():
                self.compare_models()
            case messages.ChooseModel(model) if model < len(self._workspace.beside):
                self._change(lambda state: replace(state, beside=model))
            case messages.ShowMaps(kind):
                self._change(lambda state: replace(state, heat_kind=kind))
            case messages.CompareTile(tile):
                self._compare(tile)
            case messages.ChooseQuery(query):
                self._change(
                    lambda state: session_state.choose_query(
                        state, query, len(self._workspace.tasks[state.task].queries)
                    )
                )
            case messages.UseWeights():
                self._use_weights()
            case messages.RequestEffect():
                self._request_effect()
            case messages.SaveAnalysis():
                self._report()
            case messages.RequestSweep(over):
                self._request_sweep(over)
            case messages.TryAllTurns():
                self._reveal(_SWEEP)
                self._request_sweep("rotation")
            case messages.CancelSweep():
                self._cancel_sweep()
            case messages.MeasureTurns(turns):
                self._measure_turns(turns)
            case messages.StopTurns():
                self._whole_task.stop()
            case messages.TakePoint(angle, right, down, zoom, weather):
                size = self._workspace.contract.input_size
                self._change(lambda state: session_state.apply_point(state, angle, right, down, zoom, size, weather))
            case messages.SearchRegion(cells):
                self._search_region(cells)

    def commands(self) -> list[tuple[str, Callable[[], None]]]:
        """Return the window's commands for the palette: label and function."""
        if self._workspace.model is None:
            return []
        sweep_commands = [
            (f"Sweep: {label.lower()}", self._command(_SWEEP, partial(self._request_sweep, over)))
            for over, label in sweep_page.CHOICES.items()
        ]
        heatmaps = [
            ("Heatmaps: activation part by part", self._command(_HEATMAPS)),
            (
                "Heatmaps: same scale for query and tile, or each its own",
                self._command(_HEATMAPS, partial(self._change, session_state.flip_same_scale)),
            ),
        ]
        return [
            *(
                (f"Compare with {other.label}", partial(self._compare_with, index))
                for index, other in enumerate(self._workspace.beside)
            ),
            *([] if self._workspace.without_cells else heatmaps),
            *sweep_commands,
            ("Stop the sweep", self._command(_SWEEP, self._cancel_sweep)),
            *(
                (
                    f"Measure all queries turned: {label.lower()}",
                    self._command(_SWEEP, partial(self._measure_turns, turns)),
                )
                for turns, label in sweep_page.TURNS.items()
            ),
            (
                "Test on all queries the weights that put the true tile first",
                self._command(_COMPARISON, self._request_effect),
            ),
            ("Use the weights that put the true tile first", self._command(_COMPARISON, self._use_weights)),
            ("Search by the whole query, not a region", self._command(_REGION, partial(self._search_region, []))),
            ("Save this answer", self._command(_EVIDENCE, self._report)),
        ]

    def compare_models(self) -> None:
        """Show the tab, which opens the compared model, again if that failed; without models beside, do nothing."""
        if self._workspace.beside:
            if self._content is not None:
                self._models.open(self._content.analysis.state)
            self._reveal(_MODELS)
            self._models_worker.wake()

    def _compare_with(self, index: int) -> None:
        self._change(lambda state: replace(state, beside=index))
        self.compare_models()

    def _reveal(self, tab: str) -> None:
        """Open the window at a tab, also if the user has collapsed it."""
        wanted = next(key for key, name in _TABS.items() if name == tab)
        self._tab_shown = None  # the page opens it even if the window is folded or behind another one
        self._change(lambda state: replace(state, why=True, why_tab=wanted, first_screen=False))
        self._panel.expand()
        self.show_tab(wanted)

    def show_tab(self, tab: WhyTab) -> None:
        """Open a tab of the page and bring the window to the front; `show` does it for "best"."""
        if tab not in ("best", self._tab_shown) and not (tab == "models" and not self._workspace.beside):
            self._tab_shown = tab
            self._models_worker.wake()
            self._open_tab(_TABS[tab])

    def _follow_tab(self, name: str) -> None:
        tab = next((key for key, label in _TABS.items() if label == name), None)
        if self._open and tab is not None:
            self._tab_shown = tab
            self._models_worker.wake()
            self._change(lambda state: replace(state, why_tab=tab))

    def leave(self) -> None:
        """Stop all computations; the browser has disconnected."""
        self._left = True
        self._cancel_sweep()
        self._whole_task.leave()
        self._worker.stop()
        self._models_worker.stop()
        self._models.leave()

    def announce(self) -> None:
        """Open the window at once, and say what is being computed until `show` is called."""
        if not self._open:
            self._open = True
            for tab in self._tabs:
                tab.wait()
            self._place()
            self._panel.visible = True
            self._tab_shown = None

    def fail(self, text: str) -> None:
        """Keep why the pair could not be analysed, and say it in the open window."""
        self._failure = text
        if self._open:
            with self._lock:  # what is still being computed for the pair before is not drawn
                self._cancel_sweep()
                self._content = None
            for tab in self._tabs:
                tab.fail(text)

    def close(self) -> None:
        """Close the window at once."""
        self._open = False
        self._panel.visible = False
        self._models_worker.wake()

    def show(self, analysis: StateAnalysis) -> None:
        """Keep the analysis. Draw it if the window is open and was open in the analysed state."""
        drawn = self._open and analysis.state.shows_reasons
        before, self._failure = self._content, ""
        kept = before is not None and before.pair is not None and before.pair.belongs_to(analysis)
        pair = PairResult.of(analysis) if drawn and not kept else None
        with self._lock:  # meanwhile, other threads may have stored an effect for the same pair, or a sweep
            now = self._content or WindowContent(analysis)
            self._content = WindowContent(analysis, now.pair if kept else pair, now.sweep)
            if now.sweep is not None and not now.sweep.request.applies_to(analysis):
                now.sweep.request.cancelled.set()
                self._content = replace(self._content, sweep=None)
        if drawn:
            if analysis.state.why_tab == "best":
                best = best_tab(analysis)
                self._change(lambda state: replace(state, why_tab=best) if state.why_tab == "best" else None)
            for tab in self._tabs[:5]:
                tab.draw()
            self._models_worker.wake()
            if self._true_tile(self._content) is not None:
                self._worker.wake()

    def _renderer(self, render: Callable[[WindowContent], str]) -> Callable[[], str | None]:
        """Wrap a tab's function so that it renders the newest content."""

        def render_newest() -> str | None:
            content = self._content
            if content is None:
                return None
            with speaking(self._workspace.vocabulary(content.analysis.state.plain)):
                return render(content)

        return render_newest

    def _heatmaps_html(self, content: WindowContent) -> str:
        """Render the heatmaps of the pair, and below a wrong tile those of the true one as soon as it is described."""
        analysis, index = content.analysis, self._true_tile(content)
        tile = None if index is None else self._workspace.known_tile(analysis.task, index)
        return activation.page(analysis, self._workspace, tile)

    def _true_tile(self, content: WindowContent | None) -> int | None:
        """Return the gallery position of the true tile that a wrong one is shown with; None without one."""
        positive = None if content is None or content.analysis.chosen.true is not False else content.analysis.positive
        return None if positive is None or self._tile_model is None else positive.index

    def _describe_true_tile(self) -> None:
        content = self._content
        index = self._true_tile(content)
        if content is None or index is None or self._workspace.known_tile(content.analysis.task, index) is not None:
            return
        task = content.analysis.task
        assert self._tile_model is not None
        with suppress(LPNError):  # a damaged picture: the pair is shown without it
            self._workspace.tile(task, index, self._workspace.scored_model(self._tile_model, task))
            self._tabs[1].draw()

    def _comparison_html(self, content: WindowContent) -> str:
        pair = content.pair or PairResult.of(content.analysis)
        return comparison.page(content.analysis, self._workspace, pair.comparison, pair.effect, pair.computing)

    def _sweep_html(self, content: WindowContent) -> str:
        analysis, sweep, names = content.analysis, content.sweep, self._workspace.part_names
        whole = self._whole_task.section(analysis.task)
        if sweep is None:
            return sweep_page.page(analysis, None, None, 0, names, whole=whole)
        profile = sweep.profile(analysis)
        judged = judge.judged_piece(analysis, self._workspace)
        return sweep_page.page(analysis, sweep.request.over, profile, sweep.total, names, sweep.stopped, whole, judged)

    def _draw_models(self) -> float | None:
        """Draw the tab while it is shown; return the seconds after which to look again while something is still to come."""
        content = self._content
        if content is None or not self._open or self._tab_shown != "models":
            self._models.leave()
            return None
        interval = self._models.advance(content.analysis.state)
        self._tabs[-1].draw()
        with speaking(self._workspace.vocabulary(content.analysis.state.plain)):
            self._live.show(self._models.live(content.analysis.state))
        if self._left:  # meanwhile, what was joined would go on for nobody
            self._models.leave()
        return interval

    def _place(self) -> None:
        """Put the window over the stage, as large as fits."""
        if self._open:
            width, height = self._viewport.window(_MAX_SIZE)
            self._panel.float(x=EDGE, y=EDGE, width=width, height=height)
            self._panel.expand()

    def _compute(self) -> None:
        """Compute the requested effect and sweep.

        An effect that is requested during the sweep is computed after the sweep's current point.
        """
        self._describe_true_tile()
        self._compute_effect()
        sweep = None if self._content is None else self._content.sweep
        if sweep is None or sweep.total or sweep.ended:
            return
        assert self._model is not None
        progress, drawn = sweep, 0.0
        try:
            for progress in sweep.request.run(self._workspace, self._model):
                self._store_sweep(progress)
                self._compute_effect()
                if time.monotonic() - drawn > _DRAW_INTERVAL:
                    self._sweep_tab.draw()
                    drawn = time.monotonic()
        finally:
            self._store_sweep(replace(progress, ended=True))  # also after an exception
            self._sweep_tab.draw()

    def _store_sweep(self, progress: SweepProgress) -> None:
        with self._lock:
            content = self._content
            if content is not None and content.sweep is not None and content.sweep.request is progress.request:
                self._content = replace(content, sweep=progress)

    def _compute_effect(self) -> None:
        content = self._content
        pair = None if content is None else content.pair
        if content is None or pair is None or not pair.computing:
            return
        assert pair.comparison is not None
        assert pair.comparison.change is not None
        task, weights = content.analysis.task, pair.comparison.change.weights
        effect = None
        try:
            effect = effect_on(replace(task, weights=pair.ranking.weights), weights)
        finally:
            self._replace_pair(pair, replace(pair, effect=effect, computing=False))

    def _replace_pair(self, old: PairResult, new: PairResult) -> None:
        """Store a pair's newer result if the pair is still the current one, and draw it."""
        with self._lock:
            if self._content is None or self._content.pair is not old:
                return
            self._content = replace(self._content, pair=new)
        self._comparison_tab.draw()

    def _command(self, tab: str, call: Callable[[], None] = lambda: None) -> Callable[[], None]:
        """Return a palette command that opens the window at a tab and calls a function."""

        def run() -> None:
            self._reveal(tab)
            call()

        return run

    def _request_effect(self) -> None:
        content = self._content
        pair = None if content is None else content.pair
        if content is None or pair is None or pair.comparison is None or content.analysis.state.region:
            return
        if pair.comparison.change is not None and not pair.computing:
            self._replace_pair(pair, replace(pair, computing=True))
            self._worker.wake()

    def _request_sweep(self, over: SweptProperty) -> None:
        with self._lock:  # of two requests at once, the later one must cancel the earlier one
            if self._content is None or self._content.has_sweep(over):
                return
            self._cancel_sweep()
            progress = SweepProgress(SweepRequest(over, self._content.analysis))
            self._content = replace(self._content, sweep=progress)
        self._sweep_tab.draw()
        self._worker.wake()

    def _measure_turns(self, turns: TurnChoice) -> None:
        """Measure the whole task with turned queries, and sweep over the turns of this one, in whose chart it is drawn."""
        content = self._content
        if content is not None and not why_not(content.analysis.task):
            self._whole_task.measure(turns, content.analysis.state)
            self._request_sweep("rotation")

    def _cancel_sweep(self) -> None:
        content = self._content
        if content is not None and content.sweep is not None:
            content.sweep.request.cancelled.set()

    def _report(self) -> None:
        content = self._content
        if self._failure:
            self._reporter.refuse(f"There is no answer to save. {self._failure}")
        elif content is None:
            self._reporter.refuse("The answer is still being computed. Press “Save” again when it is shown.")
        else:
            self._reporter.make(partial(self._reported, content.analysis), control="Save")

    def _reported(
        self, analysis: StateAnalysis, progress: FileProgress, model: QueuedModel | None
    ) -> tuple[str, bytes]:
        def on_read(done: int, total: int) -> None:
            progress(round(done / 1e6), round(total / 1e6), "MB of the map's files read for their SHA-256")

        with speaking(self._workspace.vocabulary(True)):
            told = said(analysis, self._workspace, at_intervals(_READING, on_read))
        return reports.of_analysis(self._workspace, analysis, progress, model, told)

    def _compare(self, tile: int) -> None:
        content = self._content
        if content is not None and tile < len(content.analysis.task.gallery):
            self._change(lambda state: session_state.compare(state, content.analysis.state, tile))

    def _use_weights(self) -> None:
        pair = None if self._content is None else self._content.pair
        if pair is not None and pair.comparison is not None and pair.comparison.change is not None:
            new = pair.comparison.change.weights
            # The weights sum to 1, but equal weights are 1 each on the sliders.
            # If a scaled weight would exceed the sliders' maximum, all are scaled less.
            scaled = new * min(len(new), session_state.MAX_WEIGHT / new.max())
            weights = tuple(float(weight) for weight in scaled)
            self._change(lambda state: replace(state, weights=weights, enabled=()))

    def _search_region(self, cells: Sequence[int]) -> None:
        content = self._content
        if content is None:
            return
        rows, columns = self._workspace.map_sizes[content.analysis.task.query_view]
        if len(cells) <= rows * columns and all(cell < rows * columns for cell in cells):
            self._change(lambda state: replace(state, region=tuple(sorted(set(cells)))))


def best_tab(analysis: StateAnalysis) -> WhyTab:
    """Return the tab that explains the compared tile: for a wrong answer the comparison with the true tile, else evidence."""
    wrong = analysis.chosen.rank == 1 and analysis.chosen.true is False
    return "comparison" if wrong and analysis.positive is not None else "evidence"
