"""The panel on the right: results on the task, verdict, ranked tiles, and the compared pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import session_state
from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.ranking_job import RankingJob
from explorer.panels import pages
from explorer.server.viser_compat import uuid_of
from explorer.session_state import POSITIVE, StateChange
from explorer.stage.cards import SHOWN
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.drawing.words import speaking


class AnswerPanel:
    """One browser's view of an analysis.

    Args:
        change: updates the browser's state with a function.

    Attributes:
        stories: the row of the names of stories.
    """

    def __init__(self, gui: viser.GuiApi, workspace: Workspace, change: Callable[[StateChange], None]) -> None:
        self._workspace, self._change = workspace, change
        self._header, self._verdict = Html(gui), Html(gui)
        self._last: pages.ShownAnalysis | None = None
        self._preparing: BackgroundJob[None] | None = None
        self._status = Html(gui, pages.status(None))
        why = gui.add_button("Why this answer?", icon=viser.Icon.ZOOM_QUESTION, visible=workspace.model is not None)
        why.on_click(lambda _: change(session_state.flip_why))
        gui.add_html(pages.main_button(uuid_of(why)))
        matches, pair = gui.add_folder("Matches"), gui.add_folder("Compared pair")
        self._folders = matches, pair
        with matches:
            self._matches = Html(gui)
            buttons = [gui.add_button(f"match {slot + 1}") for slot in range(SHOWN)]
            for slot, button in enumerate(buttons):
                button.on_click(self.compare(slot))
            buttons.append(gui.add_button("true tile"))
            buttons[-1].on_click(lambda _: change(lambda state: replace(state, selected=POSITIVE)))
            self._match_buttons = [uuid_of(button) for button in buttons]
            gui.add_html(pages.hidden(self._match_buttons))
        with pair:
            self._table = Html(gui)
        self.stories = Html(gui)
        gui.add_html(pages.keys(workspace))

    def compare(self, slot: int) -> Callable[[Any], None]:
        """Return a callback that compares the query with the tile in a slot of the ranking."""

        def on_click(_: Any) -> None:
            analysis = None if self._last is None else self._last.analysis
            if analysis is not None and slot < len(analysis.matches):
                index = analysis.matches[slot].index
                self._change(lambda state: session_state.compare(state, analysis.state, index))

        return on_click

    def show(self, analysis: StateAnalysis, sequence: int, covered: bool = False) -> None:
        """Show an analysis.

        Args:
            covered: the first screen covers the panel, so that only the verdict is shown, which screen readers hear.
        """
        workspace = self._workspace
        self._last = pages.ShownAnalysis(analysis, sequence)
        self.show_results(self._workspace.rankings[analysis.task.key])
        self._verdict.show(pages.verdict(analysis, workspace))
        # In plain words the window of a flight tells where a photo lies, and nothing of the tiles.
        tiles = not (analysis.state.plain and analysis.state.flight)
        for folder in self._folders:
            if folder.visible != tiles:
                folder.visible = tiles
        if not covered:
            self._matches.show(pages.matches(analysis, workspace, self._match_buttons))
            self._table.show(pages.parts_table(analysis, workspace))
        self.show_idle()

    def show_results(self, ranking: RankingJob) -> None:
        """Show the model's results on a task, or the progress of their ranking."""
        state = None if self._last is None else self._last.analysis.state
        with speaking(self._workspace.vocabulary(state is not None and state.plain)):
            own = state is not None and state.upload is not None
            self._header.show(pages.header(self._workspace, ranking.task, self._preparing, own))

    def show_preparation(self, job: BackgroundJob[None] | None, ranking: RankingJob) -> None:
        """Show how far the preparation of a scoring is beside a model's results; None when it has ended."""
        self._preparing = job
        self.show_results(ranking)

    def show_idle(self) -> None:
        """Show the status of the last analysis."""
        self._status.show(pages.status(self._last))

    def show_busy(self) -> None:
        """Show that the next analysis is being computed; the last one stays until then."""
        self._status.show(pages.status(self._last, "computing"))

    def show_overloaded(self) -> None:
        """Show that the server is overloaded and the page will retry; the last analysis stays."""
        self._status.show(pages.status(self._last, "full"))
