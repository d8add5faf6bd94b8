"""The true tile against the answer, the change that would reverse them, and a second model, for the shown photo."""

from __future__ import annotations

from typing import Any

import numpy as np

from explorer.screen.fields import OneOf, PanelField
from explorer.screen.fragments import fragment
from explorer.screen.panel import Panel, PanelPart, Tab
from explorer.screen.panels.compare.models import OTHER, SecondModel
from explorer.screen.panels.compare.pair import TilePair
from explorer.screen.result import ScreenResult
from lpn.analysis.comparison import effect_on
from lpn.tasks.task import Task

# "yes" to try the weights that put the truth first on all photos.
TRIED = PanelField("compare_tried", OneOf(("no", "yes")), "no", "tried", of_query=True)


class _Compare(PanelPart):
    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self._second = SecondModel(tab)
        self._pair: TilePair | None = None
        self._closed = False
        self._values: dict[str, Any] = {"models": None}
        self.actions = {"again": lambda _: self._second.open_again()}

    def show(self) -> float | None:
        result = self.tab.result
        if result is None:
            return None
        if self._pair is None or self._pair.result.analysis is not result.analysis:
            self._pair = TilePair.of(result)
        self._show_pair(self._pair)
        models, again = self._second.message(result)
        self._send(models=models)
        return again

    def close(self) -> None:
        self._closed = True
        self._second.close()

    def _show_pair(self, pair: TilePair) -> None:
        tries = self.tab.state[TRIED] == "yes" and bool(pair.usable) and pair.effect is None
        self._send(**{"weights": [], "change": "", "account": None} | pair.message(trying=tries))
        if tries:
            pair.effect = effect_on(_counted(pair.result), pair.usable)
            self._show_pair(pair)

    def _send(self, **values: object) -> None:
        self._values |= values
        if not self._closed:
            html = fragment("compare/compare", word=self.tab.workspace.contract.part_noun, **self._values)
            self.tab.send({"html": html, "photo": self._values.get("photo")})


def _counted(result: ScreenResult) -> Task:
    """Return the task of a result under its weights, limited to the graded photos."""
    task, workspace = result.task, result.workspace
    doubtful = workspace.doubtful(workspace.rankings[task.key])
    counted = task if doubtful is None else task.without_truth(np.flatnonzero(doubtful).tolist())
    return counted.with_fields(weights=result.analysis.ranking.weights)


PANEL = Panel("compare", "Truth against answer, two models", _Compare, "c", "beside", (OTHER, TRIED))
