"""The page behind the verdict: LPN's steps, its quality on this data, how that is judged, and the pictures' authors."""

from __future__ import annotations

from explorer.screen.fragments import fragment
from explorer.screen.panel import Panel, PanelPart
from explorer.screen.panels.why import words

# Seconds between two looks at an unfinished ranking.
_INTERVAL = 0.5


class _Why(PanelPart):
    def show(self) -> float | None:
        result, ranking = self.tab.result, self.tab.ranking
        if result is None:
            return None
        page = words.page(result, ranking) | {"word": result.workspace.contract.part_noun}
        self.tab.send({"html": fragment("why/why", **page)})
        return _INTERVAL if ranking.result is None and not ranking.error else None


PANEL = Panel("why", "How good, how judged", _Why, key="y")
