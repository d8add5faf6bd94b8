"""A second model's answer to the same photo beside the first one's, and both models' results on all photos."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.screen.fields import OneOf, PanelField, ScreenState
from explorer.screen.panel import Tab
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace, WorkspaceAnalyser
from lpn.core.arrays import BoolArray, Int64Array
from lpn.core.errors import LPNError
from lpn.core.numbers import rounded_to_sum
from lpn.core.texts import counted, ordinal
from lpn.library.analyser import QueryRequest
from lpn.library.answer import Answer
from lpn.tasks.task import Task

# The second model; empty for the first other one.
OTHER = PanelField("compare_model", OneOf("models"), "", "beside")
# Tiles of a column, photos of a list, and seconds between two updates.
_TILES, _PHOTOS, _INTERVAL = 5, 4, 0.5


# The section of both models as JSON, None without a second one; and seconds until the next update, None if no work goes on.
ModelsMessage = tuple[dict[str, Any] | None, float | None]


class SecondModel:
    """Opens the second model of one tab, analyses the shown photo with it, and ranks all photos by both."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._opened: dict[Workspace, tuple[RequestContext, WorkspaceAnalyser]] = {}
        self._joined: list[RankingJob] = []

    def open_again(self) -> None:
        """Open the second model again after a failure."""
        self._tab.base.models[self._number(self._tab.state)].open()
        self._tab.set({})

    def close(self) -> None:
        """Stop the work for the tab."""
        self._join([])
        for requests, _ in self._opened.values():
            requests.close()

    def message(self, result: ScreenResult) -> ModelsMessage:
        """Return the columns of both models, or the state of the work that the second one waits for."""
        base, number = self._tab.base, self._number(result.state)
        if not base.beside:
            return None, None
        labels = [one.label.removesuffix(".onnx") for one in base.models]
        shown = {
            "labels": labels,
            "own": int(result.state.model),
            "other": number,
            "text": "",
            "unlike": "",
            "again": False,
            "columns": [],
        }
        lazy = base.models[number]
        if not lazy.asked:
            lazy.open()
        other = lazy.workspace
        if other is None:
            if lazy.error:
                return shown | {"text": lazy.error, "again": True}, None
            done, total = lazy.progress
            read = f": {done:,} of {counted(total, 'picture')} described" if total else ""
            return shown | {"text": f"Opening {lazy.label}{read}."}, _INTERVAL
        if result.task.name not in other.tasks:
            return shown | {"text": f"{labels[number]} does not know the views of this task."}, None
        try:
            return self._both(result, other, shown)
        except (LPNError, WorkCancelledError) as error:
            return shown | {"text": str(error)}, None

    def _both(self, result: ScreenResult, other: Workspace, shown: dict[str, Any]) -> ModelsMessage:
        own = result.workspace
        task = own.shared_task(result.task, [other])
        question, analysis = replace(result.question, compare=None), result.analysis
        if task.key != result.task.key:
            analysis = self._analyse(own, task, question)
        theirs = self._analyse(other, other.ranking(task.name, task.scoring).task, replace(question, weights=None))
        rankings = [ranking for one in (own, other) if (ranking := one.ranked_as(task)) is not None]
        waits = [ranking for ranking in rankings if ranking.result is None and not ranking.error]
        self._join(waits[:1])
        unlike = (
            ""
            if task.key == result.task.key
            else f"Compared by {task.scoring} distances: one of the models has no {result.task.scoring} ones."
        )
        failed = next((ranking.error for ranking in rankings if ranking.error), "")
        columns = [
            self._column(result, one, of_one, ranking)
            for (one, of_one), ranking in zip(((own, analysis), (other, theirs)), rankings, strict=True)
        ]
        values = shown | {"text": failed, "columns": columns, "unlike": unlike, **self._changes(result, rankings)}
        return values, _INTERVAL if waits else None

    def _column(
        self, result: ScreenResult, workspace: Workspace, analysis: Answer, ranking: RankingJob
    ) -> dict[str, Any]:
        truth, verdict = analysis.positive, analysis.verdict
        graded = workspace.graded(ranking)
        recall = None if ranking.result is None or not graded.any() else ranking.result.measured(graded)["recall@1"]
        matches = analysis.matches[:_TILES]
        if truth is not None and truth.index not in [match.index for match in matches]:
            matches = [*matches[:-1], truth]
        address = result.feeds.pictures(result.task, "tile")
        tiles = [
            {
                "index": match.index,
                "name": analysis.task.gallery[match.index].title,
                "src": f"{address}{match.index}" if _same(analysis.task, result.task, match.index) else "",
                "rank": match.rank,
                "true": match.true,
                "distance": f"{match.distance2:.3f}",
                "shares": rounded_to_sum(match.contributions.tolist(), total=match.distance2),
            }
            for match in matches
        ]
        n = workspace.contract.n_parts
        return {
            "model": workspace.model_name.removesuffix(".onnx"),
            "parts": f"{n} {workspace.contract.part_noun}s" if n > 1 else "one part",
            "recall": "" if recall is None else f"{recall:.1f} %, {ranking.task.scoring.replace('csls', 'CSLS')}",
            "sign": verdict.sign,
            "rank": "" if truth is None else ordinal(truth.rank),
            "headline": f"{verdict.headline}.",
            "tiles": tiles,
        }

    def _changes(self, result: ScreenResult, rankings: list[RankingJob]) -> dict[str, Any]:
        """Count the photos that one model alone finds, and return those whose ranks differ most."""
        if any(ranking.result is None for ranking in rankings):
            return {"alone": None}
        first, second = (ranking.ranks for ranking in rankings)
        graded = result.workspace.graded(rankings[0])
        alone, better, worse = changes(first, second, graded, _PHOTOS)
        address, names = result.feeds.thumbnails(result.task, "query"), result.task.query_names
        listed = [
            [{"query": query, "name": names[query], "src": f"{address}{query}", "ranks": ranks} for query, *ranks in of]
            for of in (better, worse)
        ]
        return {"alone": [int(graded.sum()), *alone], "better": listed[0], "worse": listed[1]}

    def _analyse(self, workspace: Workspace, task: Task, question: QueryRequest) -> Answer:
        if workspace not in self._opened:
            requests = RequestContext(workspace.inference)
            model = requests.queued(workspace.model, background=True)
            self._opened[workspace] = requests, WorkspaceAnalyser(workspace, model, cancellable=False)
        return self._opened[workspace][1].analyse(task, question, _TILES)

    def _number(self, state: ScreenState) -> int:
        own, chosen = int(state.model), state[OTHER]
        return int(chosen) if chosen and int(chosen) != own else 0 if own else 1

    def _join(self, wanted: list[RankingJob]) -> None:
        for job in self._joined:
            if job not in wanted:
                job.leave(self)
        self._joined = wanted
        for job in wanted:
            job.join(self)


def changes(
    first: Int64Array, second: Int64Array, graded: BoolArray, most: int
) -> tuple[tuple[int, int], list[tuple[int, int, int]], list[tuple[int, int, int]]]:
    """Compare two models' 0-based ranks, (Q,), -1 without a truth.

    Returns:
        Counts of the graded photos that each model alone finds; then the `most` photos that the second model ranks higher,
        and the `most` that it ranks lower, each with both ranks from 1.
    """
    known = graded & (first >= 0) & (second >= 0)
    alone = int((graded & (first == 0) & (second != 0)).sum()), int((graded & (second == 0) & (first != 0)).sum())
    gain = np.where(known, first - second, 0)
    order = np.argsort(-gain, kind="stable")
    better, worse = (
        [(query, int(first[query]) + 1, int(second[query]) + 1) for query in rows.tolist() if gain[query]]
        for rows in (order[gain[order] > 0][:most], order[gain[order] < 0][::-1][:most])
    )
    return alone, better, worse


def _same(one: Task, other: Task, index: int) -> bool:
    """Return whether a position means the same tile in both galleries; the data set may have changed in between."""
    return index < len(other.gallery) and one.gallery[index].path == other.gallery[index].path
