"""The tab "Two models": the answers of a second model to the same query, and the queries that they rank differently."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.session_state import SessionState
from explorer.stage.pictures import draw_parts
from explorer.web.render import render
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core.arrays import Int64Array
from lpn.drawing import overlays
from lpn.drawing.verdicts import ordinal
from lpn.retrieval import Match

# Numbers of matches and of queries listed, and the size of the picture with evidence.
_MATCHES, _QUERIES, _SIZE = 5, 8, (240, 700)


@dataclass(frozen=True)
class _Column:
    """One model's answer; `map` is the query with its evidence for and against the compared tile."""

    description: str
    claim: str
    without_cells: str
    recall: float | None
    verdict: bool | None
    rank: int | None
    matches: list[tuple[Match, str, str]]
    map: str | None = None
    limit: float = 0.0
    compared: str = ""


@dataclass(frozen=True)
class Changes:
    """Queries that one model alone answers right, and those that the second ranks most higher or lower: query and ranks."""

    alone: tuple[int, int]
    better: list[tuple[int, int, int]]
    worse: list[tuple[int, int, int]]


class ModelComparison:
    """Answers one browser's states with the second model."""

    def __init__(self, other: Workspace, requests: RequestContext) -> None:
        self._other, self._analyser = other, StateAnalyser(other, requests.queued(other.model, background=True))

    def page(self, analysis: StateAnalysis, workspace: Workspace) -> str:
        """Render the tab."""
        other, task = self._other, analysis.task
        names = workspace.model_name, other.model_name
        other_ranking = other.rankings.get(task.name)
        if other_ranking is None:
            return render("explain/model_comparison", columns=None, names=names, task=task.name)
        second = self._analyser.analyse(_state(analysis.state, other), _MATCHES)
        return render(
            "explain/model_comparison",
            names=names,
            columns=[_column(analysis, workspace), _column(second, other)],
            changes=changes(workspace.rankings[task.name], other_ranking),
            queries=task.queries,
            thumbnail=workspace.thumbnail,
            ordinal=ordinal,
        )


def _state(state: SessionState, other: Workspace) -> SessionState:
    """Return the state for a model with other parts: everything about parts and cells is reset."""
    return replace(
        state,
        n_parts=other.contract.n_parts,
        weights=(),
        enabled=(),
        heat_part=None,
        region=(),
        selected=None,
        why=True,
    )


def _column(analysis: StateAnalysis, workspace: Workspace) -> _Column:
    task, truth, ranking = analysis.task, analysis.positive, workspace.rankings[analysis.task.name]
    column = _Column(
        workspace.description,
        workspace.contract.claim,
        workspace.without_cells,
        None if ranking.result is None else ranking.results["recall@1"],
        analysis.matches[0].true,
        None if truth is None else truth.rank,
        [
            (match, task.gallery[match.index].name, workspace.thumbnail(task.gallery[match.index]))
            for match in analysis.matches[:_MATCHES]
        ],
    )
    if analysis.pair_evidence is None:
        return column
    cells, _ = maps = analysis.pair_evidence.evidence.cell_maps()
    limit = overlays.evidence_limit(*maps)
    picture = overlays.data_uri(draw_parts(workspace, analysis.query, task.query_view, _SIZE, cells, limit), 88)
    return replace(column, map=picture, limit=limit, compared=task.gallery[analysis.chosen.index].name)


def changes(first: RankingJob, second: RankingJob) -> Changes | None:
    """Compare the ranks of all queries; None until both models have ranked them."""
    if first.result is None or second.result is None:
        return None
    ranks, others = first.ranks, second.ranks
    known = (ranks >= 0) & (others >= 0)
    alone = int(((ranks == 0) & (others != 0)).sum()), int(((others == 0) & (ranks != 0)).sum())
    change = np.where(known, ranks - others, 0)
    order = np.argsort(-change, kind="stable")

    def rows(queries: Int64Array) -> list[tuple[int, int, int]]:
        return [(int(query), int(ranks[query]) + 1, int(others[query]) + 1) for query in queries if change[query]]

    return Changes(alone, rows(order[:_QUERIES]), rows(order[::-1][:_QUERIES]))
