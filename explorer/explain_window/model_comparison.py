"""A second model on the same query as html: what it answers, on what evidence, and which queries it turns around."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np

from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.explain_window import evidence
from explorer.session_state import SessionState
from explorer.web.render import SIGNS, send
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import Int64Array
from lpn.drawing import overlays
from lpn.drawing.verdicts import ordinal

_SHOWN, _LISTED, _HEIGHT = 5, 8, 240


class ModelComparison:
    """Answers one browser's states with the second model."""

    def __init__(self, other: Workspace, requests: RequestContext) -> None:
        self._other, self._analyser = other, StateAnalyser(other, requests.queued(other.model, background=True))

    def page(self, analysis: StateAnalysis, workspace: Workspace) -> str:
        """The whole tab."""
        other, task = self._other, analysis.task
        theirs = other.rankings.get(task.name)
        if theirs is None:
            return (
                f"<div class='lpn' id='lpn-beside'>{escape(other.model_name)} does not know the views of {escape(task.name)}; "
                "choose another task.</div>"
            )
        found = self._analyser.analyse(_state(analysis.state, other), _SHOWN)
        columns = "".join(_column(one, of) for one, of in ((analysis, workspace), (found, other)))
        names = (workspace.model_name, other.model_name)
        return (
            f"<div class='lpn' id='lpn-beside'><div class='models'>{columns}</div>"
            f"{_changes(workspace.rankings[task.name], theirs, names, workspace)}</div>"
        )


def _state(state: SessionState, other: Workspace) -> SessionState:
    """The same query for a model of other parts; what belongs to parts and cells is left out."""
    return replace(
        state, n_parts=other.spec.n_parts, weights=(), enabled=(), heat_part=None, region=(), selected=None, why=True
    )


def _column(analysis: StateAnalysis, workspace: Workspace) -> str:
    first, truth, task = analysis.matches[0], analysis.truth, analysis.task
    rank = "the true tile is not known" if truth is None else f"the true tile is {ordinal(truth.rank)}"
    tiles = "".join(
        f"<figure><img src='{workspace.thumbnail(task.gallery[match.index].path)}' "
        f"style='border-color:{overlays.css(overlays.verdict_colour(match.true))}' alt=''><figcaption class='num'>"
        f"{SIGNS[match.true]} {escape(task.gallery[match.index].name)}<br>{match.distance2:.3f}</figcaption></figure>"
        for match in analysis.matches[:_SHOWN]
    )
    ranking = workspace.rankings[task.name]
    recall = "R@1 not known yet" if ranking.result is None else f"R@1 {ranking.results['recall@1']:.1f} %"
    return (
        f"<div><h2>{escape(workspace.model_name)}</h2><div class='dim'>{escape(workspace.description)}, {recall}</div>"
        f"<div class='said'><b>{SIGNS[first.true]}</b> {rank}</div>"
        f"<div class='tops'>{tiles}</div>{_evidence(analysis, workspace)}</div>"
    )


def _evidence(analysis: StateAnalysis, workspace: Workspace) -> str:
    """The query's cells, for and against the tile that it is compared with."""
    if analysis.pair_evidence is None:
        return ""
    view = analysis.task.query_view
    cells, limit = evidence.maps(analysis.pair_evidence.evidence, None)
    width = round(_HEIGHT * workspace.layout.picture[0] / workspace.layout.picture[1])
    picture = images.resize(workspace.cut(analysis.query.picture, view), _HEIGHT, min(width, 700))
    drawn = overlays.with_evidence(picture, cells[0], limit)
    drawn = overlays.with_rings(drawn, workspace.spec.partition(view), workspace.map_sizes[view], 2)
    entry = analysis.task.gallery[analysis.chosen.index]
    return (
        f"<img class='map' src='{overlays.data_uri(drawn, 85)}' alt=''><div class='dim'>evidence for and against "
        f"{escape(entry.name)}, each to its own scale (±{limit:.4f})</div>"
    )


def _changes(ours: RankingJob, theirs: RankingJob, names: tuple[str, str], workspace: Workspace) -> str:
    """How many queries each finds alone, and those whose rank differs most."""
    if ours.result is None or theirs.result is None:
        return "<div class='said dim'>Which queries one of them finds alone is said when both have ranked all of them.</div>"
    one, other = ours.ranks, theirs.ranks
    known = (one >= 0) & (other >= 0)
    only = [int((known & (one == 0) & (other > 0)).sum()), int((known & (other == 0) & (one > 0)).sum())]
    # From 2nd to 1st is as much as from 200th to 100th.
    change = np.where(known, np.log((one + 1.0) / (other + 1.0)), 0.0)
    order = np.argsort(-change, kind="stable")
    better, worse = order[:_LISTED], order[::-1][:_LISTED]
    tables = "".join(
        f"<div><b>{escape(title)}</b>{_rows(ours, theirs, rows[change[rows] != 0], workspace)}</div>"
        for title, rows in ((f"{names[1]} ranks higher", better), (f"{names[1]} ranks lower", worse))
    )
    return (
        f"<div class='said'>Of {len(one):,} queries, {escape(names[0])} alone finds {only[0]:,} and {escape(names[1])} alone "
        f"{only[1]:,}. Where the rank of the true tile differs most:</div><div class='models'>{tables}</div>"
    )


def _rows(ours: RankingJob, theirs: RankingJob, rows: Int64Array, workspace: Workspace) -> str:
    if not len(rows):
        return "<div class='dim'>none</div>"
    return "".join(
        f"<div class='row' data-query='{row}' {send('query', int(row))} title='Open this query'>"
        f"<img src='{workspace.thumbnail(ours.task.queries[row].path)}' style='border-color:transparent' alt=''>"
        f"<span class='name'>{escape(ours.task.queries[row].name)}</span><span class='num'>{ordinal(int(ours.ranks[row]) + 1)} → "
        f"{ordinal(int(theirs.ranks[row]) + 1)}</span></div>"
        for row in rows
    )


STYLE = """<style>
.lpn .models{display:grid;grid-template-columns:1fr 1fr;gap:.4em 1.2em;margin:.3em 0 .6em}
.lpn .tops{display:flex;gap:5px}
.lpn .tops figure{margin:0;flex:1;min-width:0;font-size:11px;text-align:center;overflow:hidden;white-space:nowrap}
.lpn .tops img{width:100%;max-width:64px;border:3px solid;border-radius:3px;box-sizing:border-box}
.lpn .models .map{width:100%;max-width:340px;display:block;margin-top:.4em;border-radius:3px}
</style>"""
