"""The true tile against the answer, what would have to change, and a second model beside the first, for the shown photo."""

from __future__ import annotations

from explorer.screen.fields import OneOf, PanelField
from explorer.screen.panel import Panel, PanelPart, Tab
from explorer.screen.panels.compare.models import OTHER, SecondModel
from explorer.screen.panels.compare.pair import TilePair
from lpn.analysis.comparison import effect_on

# The weights that put the truth first are tried on all photos.
TRIED = PanelField("compare_tried", OneOf(("no", "yes")), "no", "tried", of_query=True)


class _Compare(PanelPart):
    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self._second = SecondModel(tab)
        self._pair: TilePair | None = None
        self._closed = False
        self.actions = {"again": lambda _: self._second.open_again()}

    def show(self) -> float | None:
        result = self.tab.result
        if result is None:
            return None
        if self._pair is None or self._pair.result.analysis is not result.analysis:
            self._pair = TilePair.of(result)
        self._show_pair(self._pair)
        second = self._second.message(result)
        if not self._closed:
            self.tab.append("models", {"models": second.values})
        return second.again

    def close(self) -> None:
        self._closed = True
        self._second.close()

    def _show_pair(self, pair: TilePair) -> None:
        tries = self.tab.state[TRIED] == "yes" and bool(pair.usable) and pair.effect is None
        if not self._closed:
            self.tab.append("pair", {"pair": pair.message(trying=tries)})
        if tries:
            weights = pair.result.analysis.ranking.weights
            pair.effect = effect_on(pair.result.task.with_fields(weights=weights), pair.usable)
            self._show_pair(pair)


PANEL = Panel("compare", "Truth against answer, two models", _Compare, "c", "beside", (OTHER, TRIED))
