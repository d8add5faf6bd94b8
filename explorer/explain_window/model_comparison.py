"""The tab "Two models": what another model answers and looks at beside the workspace's own, and how several models compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from markupsafe import Markup, escape

from explorer import judge
from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.compute.scorings import TERMS
from explorer.session_state import SessionState
from explorer.stage.pictures import draw_parts
from explorer.web.render import call, progress_bar, render, run, send
from explorer.workspace import LazyWorkspace, StateAnalyser, StateAnalysis, Workspace
from lpn.core.arrays import BoolArray, FloatingArray, Int64Array
from lpn.core.numbers import shown_difference
from lpn.core.texts import ordinal
from lpn.core.views import View
from lpn.drawing import charts, heatmaps, overlays
from lpn.drawing.charts import ModelPoint
from lpn.drawing.words import say
from lpn.explain.centre import centre_box, centre_share, has_centre
from lpn.models.contract import Contract
from lpn.retrieval import DescribedPicture, Match
from lpn.tasks.task import Task

_Side = Literal["query", "tile"]
_SIDES: tuple[_Side, ...] = ("query", "tile")
# Numbers of matches and of queries listed, and the size of a picture with its heatmap: height, and the largest width.
_MATCHES, _QUERIES, _SIZE = 5, 8, (256, 700)
_LETTERS = "AB"
# Seconds between two looks at models that are being opened or ranked.
_OPENING_INTERVAL = 0.5


@dataclass(frozen=True)
class _Map:
    """One picture under one model.

    Attributes:
        caption: the side, and the name of the picture.
        picture: a data URI.
        labels: of the scale of its colours, and their places in percent.
        share: of its activation in the centre box, in percent; None without a centre.
    """

    side: _Side
    caption: str
    picture: str
    labels: list[tuple[float, str]]
    share: float | None


@dataclass(frozen=True)
class _Column:
    """One model's answer.

    Attributes:
        lead: d² of the nearest negative, less that of the nearest positive; None where one of them is not known.
        chosen: gallery position of the compared tile.
        comparable: its matches may be compared, as they are in the gallery of the workspace's own model.
    """

    description: str
    claim: str
    without_cells: str
    recall: float | None
    verdict: bool | None
    rank: int | None
    lead: float | None
    matches: list[tuple[Match, str, str]]
    chosen: int
    comparable: bool
    maps: list[_Map]


@dataclass(frozen=True)
class Changes:
    """Queries that one model alone answers right, and those that the second ranks most higher or lower: query and ranks.

    Attributes:
        graded: how many queries count.
    """

    graded: int
    alone: tuple[int, int]
    better: list[tuple[int, int, int]]
    worse: list[tuple[int, int, int]]


@dataclass(frozen=True)
class _Choice:
    """One of the models beside the workspace's own."""

    index: int
    label: str
    recall: float | None
    chosen: bool
    note: str


class ModelComparison:
    """Opens the models beside a workspace's own for one browser, and draws the compared one beside it.

    Args:
        requests: gives access to the networks for this browser.
    """

    def __init__(self, workspace: Workspace, requests: RequestContext) -> None:
        self._workspace, self._requests = workspace, requests
        self._analysers: dict[int, StateAnalyser] = {}
        self._own: StateAnalyser | None = None
        self._joined: list[RankingJob] = []
        # The last page, and how many there were.
        self._drawn = "", 0

    def advance(self, state: SessionState) -> float | None:
        """Open the compared model, then the others one at a time, and rank them.

        Returns:
            Seconds until the next call, None once all is known.
        """
        compared = self._workspace.compared(state)
        beside = self._workspace.beside
        waiting = [one for one in (compared, *beside) if one is not None and one.workspace is None and not one.error]
        if waiting and not any(one.opening for one in beside):
            waiting[0].open()
        workspaces = [self._workspace, *(one.workspace for one in beside if one.workspace is not None)]
        task = self._shared_task(state)
        rankings = [ranking for one in workspaces if (ranking := one.ranked_as(task)) is not None]
        wanted = [ranking for ranking in rankings if ranking.result is None and not ranking.error]
        self._join(wanted[:1])
        return _OPENING_INTERVAL if wanted or waiting or any(one.opening for one in beside) else None

    def open(self, state: SessionState) -> None:
        """Open the compared model in the background, again if that failed."""
        compared = self._workspace.compared(state)
        if compared is not None and compared.workspace is None:
            compared.open()

    def leave(self) -> None:
        """Stop waiting for what is computed in the background."""
        self._join([])

    def page(self, analysis: StateAnalysis) -> str:
        """Render the tab; the column of a model that is being opened says how far it is."""
        workspace, state, task = self._workspace, analysis.state, self._shared_task(analysis.state)
        lazy = workspace.compared(state)
        assert lazy is not None
        other = lazy.workspace
        own = analysis if task.key == analysis.task.key else self._analyse_own(analysis, task)
        pairs, reason = [(workspace, own)], ""
        if other is None:
            reason = lazy.error
        elif other.ranked_as(task) is None:
            reason = f"{other.model_name} does not know the views of {task.name}; choose another task."
        else:
            pairs.append((other, self._analyse(replace(state, scoring=task.scoring), other, analysis)))
        maps = self._maps(pairs, state)
        columns = [
            _column(one, judge.shown(of_one, workspace), self._recall(one, of_one.task), _lead(of_one), drawn, own)
            for (one, of_one), drawn in zip(pairs, maps, strict=True)
        ]
        rankings = [ranking for one, _ in pairs if (ranking := one.ranked_as(task)) is not None]
        html = render(
            "explain/model_comparison",
            names=(workspace.model_name, lazy.label if other is None else other.model_name),
            letters=_LETTERS,
            columns=columns,
            judged=judge.judged_piece(analysis, workspace),
            reason=reason,
            error=lazy.error,
            opening=other is None and not lazy.error,
            kind=state.heat_kind,
            same_scale=state.same_scale,
            scale=overlays.data_uri(
                overlays.heat_scale(200, 10) if state.heat_kind == "activation" else overlays.evidence_scale(200, 10),
                95,
            ),
            has_box=any(one.share is not None for drawn in maps for one in drawn),
            changes=changes(rankings[0], rankings[1], workspace.graded(rankings[0])) if len(rankings) == 2 else None,
            scoring="" if own is analysis else TERMS[task.scoring],
            queries=task.queries,
            thumbnail=workspace.thumbnail,
            ordinal=ordinal,
            charts=self._charts(state) if len(workspace.beside) > 1 else [],
            choices=self._choices(state) if len(workspace.beside) > 1 else [],
        )
        if html != self._drawn[0]:
            self._drawn = html, self._drawn[1] + 1
        return html

    def live(self, state: SessionState) -> str:
        """Return a script that writes progress into the page: if the page were sent again, clicks would be lost."""
        compared = self._workspace.compared(state)
        assert compared is not None
        texts = {f"choice {i}": _progress(one) for i, one in enumerate(self._workspace.beside) if one.opening}
        if compared.workspace is None and not compared.error:
            texts["opening"] = _opening(compared, self._workspace.beside)
        return run(call("fill", "live", {key: escape(text) for key, text in texts.items()}, self._drawn[1]))

    def _shared_task(self, state: SessionState) -> Task:
        opened = [one.workspace for one in self._workspace.beside if one.workspace is not None]
        return self._workspace.shared_task(self._workspace.task_of(state), opened)

    def _analyse_own(self, analysis: StateAnalysis, task: Task) -> StateAnalysis:
        """Analyse the pair of an analysis under another scoring of its task."""
        if self._own is None:
            self._own = StateAnalyser(self._workspace, self._requests.queued(self._workspace.model, background=True))
        state = replace(analysis.state, scoring=task.scoring, heat=True, selected=analysis.chosen.index, why=False)
        return self._own.analyse(state, _MATCHES)

    def _analyse(self, state: SessionState, other: Workspace, analysis: StateAnalysis) -> StateAnalysis:
        """Analyse the same query and, where it is in its gallery, the same tile under another model."""
        analyser = self._analysers.get(state.beside)
        if analyser is None:
            model = self._requests.queued(other.model, background=True)
            analyser = self._analysers[state.beside] = StateAnalyser(other, model)
        tile = (
            analysis.chosen.index if _same_tile(analysis.task, other.tasks[state.task], analysis.chosen.index) else None
        )
        return analyser.analyse(_state(state, other, tile), _MATCHES)

    def _maps(self, pairs: Sequence[tuple[Workspace, StateAnalysis]], state: SessionState) -> list[list[_Map]]:
        """Draw query and tile under each model that has cells, on scales of their own or on one."""
        drawn = []
        values = [_values(analysis, state) for _, analysis in pairs]
        everything = [cells for of_model in values for cells in of_model]
        for (workspace, analysis), of_model in zip(pairs, values, strict=True):
            pictures: list[_Map] = []
            limit = overlays.evidence_limit(*(everything if state.same_scale else of_model)) if of_model else 0.0
            for side, cells in zip(_SIDES, of_model, strict=False):
                scaled = everything if state.same_scale else [cells]
                low, high = (
                    (-limit, limit)
                    if state.heat_kind == "evidence"
                    else (min(float(one.min()) for one in scaled), max(float(one.max()) for one in scaled))
                )
                pictures.append(self._map(workspace, analysis, side, cells, low, high))
            drawn.append(pictures)
        return drawn

    def _map(
        self, workspace: Workspace, analysis: StateAnalysis, side: _Side, cells: FloatingArray, low: float, high: float
    ) -> _Map:
        task = analysis.task
        described, view = _side(analysis, side)
        assert described.trace is not None
        if analysis.state.heat_kind == "evidence":
            picture = draw_parts(workspace, described, view, _SIZE, np.asarray(cells, np.float64), high)
        else:
            heat = np.asarray((cells - low) / max(high - low, 1e-12), np.float32)
            picture = draw_parts(workspace, described, view, _SIZE, heat=heat)
        centred = has_centre(workspace.contract, view)
        if centred:
            picture = overlays.with_box(picture, centre_box(*described.trace.size))
        return _Map(
            side,
            analysis.name if side == "query" else task.gallery[analysis.chosen.index].title,
            overlays.data_uri(picture, 88),
            heatmaps.scale_labels(low, high),
            100 * centre_share(described.trace.activation) if centred else None,
        )

    def _recall(self, workspace: Workspace, task: Task) -> float | None:
        """Return R@1 of a model in percent, of a flight over the photos that are graded under the workspace's own model."""
        ranking, own = workspace.ranked_as(task), self._workspace.ranked_as(task)
        if ranking is None or ranking.result is None:
            return None
        graded = workspace.graded(ranking)
        if self._workspace.has_flight and own is not None:
            graded &= self._workspace.graded(own)
        return ranking.result.ranking.metrics(graded)["recall@1"] if graded.any() else None

    def _join(self, wanted: list[RankingJob]) -> None:
        for job in self._joined:
            if job not in wanted:
                job.leave(self)
        self._joined = wanted
        for job in wanted:
            job.join(self)

    def _choices(self, state: SessionState) -> list[_Choice]:
        return [
            _Choice(
                index,
                one.label,
                None if one.workspace is None else self._recall(one.workspace, self._shared_task(state)),
                index == state.beside,
                "" if one.opening else "not opened" if one.error else f"{say('R@1')} not known yet",
            )
            for index, one in enumerate(self._workspace.beside)
        ]

    def _charts(self, state: SessionState) -> list[Markup]:
        """Draw R@1 of all models that are ranked by their number of parts and by their input size, whichever differ."""
        opened: list[tuple[int | None, str, Workspace]] = [(None, self._workspace.model_name, self._workspace)]
        opened += [
            (index, one.label, one.workspace)
            for index, one in enumerate(self._workspace.beside)
            if one.workspace is not None
        ]
        known = [
            (key, name, one.contract, recall)
            for key, name, one in opened
            if (recall := self._recall(one, self._shared_task(state))) is not None
        ]
        drawn = []
        differ = {
            title: property_of
            for title, property_of in (("number of parts n", _parts), ("input size in pixels", _size))
            if len({property_of(contract) for _, _, contract, _ in known}) > 1
        }
        for title, property_of in differ.items():
            points = [
                ModelPoint(key, name, *property_of(contract), recall, _role(key, state))
                for key, name, contract, recall in known
            ]
            chart = charts.model_chart(
                points, f"{say('R@1')} of the whole task, %", title, _attributes, joined=len(differ) == 1
            )
            drawn.append(chart)
        return drawn


def _parts(contract: Contract) -> tuple[int, str]:
    return contract.n_parts, str(contract.n_parts)


def _size(contract: Contract) -> tuple[int, str]:
    height, width = contract.input_size
    return height * width, str(height) if height == width else f"{height} x {width}"


def _role(key: int | None, state: SessionState) -> Literal["own", "compared", "other"]:
    return "own" if key is None else "compared" if key == state.beside else "other"


def _attributes(point: ModelPoint) -> Markup:
    """Make a model's circle choose it when it is clicked; the workspace's own is always compared."""
    return Markup('role="img"') if point.key is None else send("beside", point.key)


def _opening(lazy: LazyWorkspace, beside: Sequence[LazyWorkspace]) -> str:
    """Say what the compared model waits for, while it is not open."""
    ahead = next((one for one in beside if one.opening), lazy)
    first = "" if ahead is lazy else f"{lazy.label} is opened after {ahead.label}. "
    return progress_bar(*ahead.progress, f"{first}Opening {ahead.label}: {_progress(ahead)}.", "pictures described")


def _progress(lazy: LazyWorkspace) -> str:
    done, total = lazy.progress
    return f"{done:,} of {total:,} pictures are described" if total else "its file and the data set are read"


def _same_tile(first: Task, second: Task, index: int) -> bool:
    """Return whether a position means the same tile in two galleries; a data set that changed in between has others."""
    return index < len(second.gallery) and first.gallery[index].path == second.gallery[index].path


def _state(state: SessionState, other: Workspace, tile: int | None) -> SessionState:
    """Return the state for a model with other parts: everything about parts and cells is reset."""
    return replace(
        state,
        n_parts=other.contract.n_parts,
        weights=(),
        enabled=(),
        heat=True,
        heat_part=None,
        region=(),
        selected=tile,
        why=False,
    )


def _side(analysis: StateAnalysis, side: _Side) -> tuple[DescribedPicture, View]:
    query, tile = analysis.task.views
    return (analysis.query, query) if side == "query" else (analysis.tile, tile)


def _values(analysis: StateAnalysis, state: SessionState) -> list[FloatingArray]:
    """Return the cells of query and tile that the state shows, (h, w) each; none without cells."""
    if state.heat_kind == "evidence":
        return [] if analysis.pair_evidence is None else list(analysis.pair_evidence.evidence.cell_maps())
    traces = [analysis.query.trace, analysis.tile.trace]
    return [trace.activation for trace in traces if trace is not None] if None not in traces else []


def _column(
    workspace: Workspace,
    analysis: StateAnalysis,
    recall: float | None,
    lead: float | None,
    maps: list[_Map],
    own: StateAnalysis,
) -> _Column:
    task, truth = analysis.task, analysis.positive
    return _Column(
        workspace.description,
        task.contract.claim,
        workspace.without_cells,
        recall,
        analysis.matches[0].true,
        None if truth is None else truth.rank,
        lead,
        [
            (match, task.gallery[match.index].title, workspace.thumbnail(task.gallery[match.index]))
            for match in analysis.matches[:_MATCHES]
        ],
        analysis.chosen.index,
        all(_same_tile(task, own.task, match.index) for match in analysis.matches[:_MATCHES]),
        maps,
    )


def _lead(analysis: StateAnalysis) -> float | None:
    truth, wrong = analysis.positive, next((match for match in analysis.matches if match.true is False), None)
    return None if truth is None or wrong is None else shown_difference(wrong.distance2, truth.distance2)


def changes(first: RankingJob, second: RankingJob, graded: BoolArray) -> Changes | None:
    """Compare the ranks of the graded queries, (Q,); None until both models have ranked all."""
    if first.result is None or second.result is None:
        return None
    ranks, others = first.ranks, second.ranks
    known = graded & (ranks >= 0) & (others >= 0)
    alone = int((graded & (ranks == 0) & (others != 0)).sum()), int((graded & (others == 0) & (ranks != 0)).sum())
    change = np.where(known, ranks - others, 0)
    order = np.argsort(-change, kind="stable")

    def rows(queries: Int64Array) -> list[tuple[int, int, int]]:
        return [(int(query), int(ranks[query]) + 1, int(others[query]) + 1) for query in queries if change[query]]

    return Changes(int(graded.sum()), alone, rows(order[:_QUERIES]), rows(order[::-1][:_QUERIES]))
