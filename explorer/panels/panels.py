"""Both panels of one browser: the query on the left, the answer on the right."""

from __future__ import annotations

from collections.abc import Callable

import viser

from explorer.browse.feeds import Feeds
from explorer.compute.weight_figures import WeightFigures
from explorer.panels.answer_panel import AnswerPanel
from explorer.panels.controls import Controls
from explorer.panels.error_notice import ErrorNotice
from explorer.panels.navigation import Navigation
from explorer.panels.parts_panel import PartsPanel
from explorer.panels.query_panel import QueryPanel
from explorer.panels.upload_control import UploadControl
from explorer.session_state import SessionState, StateChange
from explorer.workspace import StateAnalysis, Workspace

# Widths in pixels.
_LEFT, _RIGHT = 290, 360


class Panels:
    """Builds and docks the panels. Their callbacks never compute: they pass a pure function of the state to `change`.

    A model of one vector has no panel of parts.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        feeds: Feeds,
        figures: WeightFigures,
        state: SessionState,
        change: Callable[[StateChange], None],
    ) -> None:
        self._client, gui = client, client.gui
        self._error = ErrorNotice(client)
        self.navigation = Navigation(workspace, client.add_notification)
        self.controls = Controls(gui, state, change)
        self._left = left = gui.add_panel()
        with left.add_tab("Query", viser.Icon.DRONE):
            self.query = QueryPanel(gui, workspace, feeds, self.controls, self.navigation, change, self.notify_error)
        self.parts: PartsPanel | None = None
        if workspace.has_parts:
            with left.add_tab("Parts", viser.Icon.ADJUSTMENTS):
                self.parts = PartsPanel(client, workspace, figures, self.controls, change)
        left.dock_left()
        left.set_width(_LEFT)
        left.minimize()  # until the page says that it was left open; what is folded is not built
        gui.set_panel_label("LPN Explorer")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_RIGHT)
        self.answer = AnswerPanel(gui, workspace, change)
        if self.query.own is not None:  # in the panel that is there on every screen: the left one may be folded
            self.query.own.run_scripts_in(gui)
            UploadControl(gui, self.query.own.take, self.notify_error, self.forget_error)

    def write(self, state: SessionState) -> None:
        """Write a state into the controls."""
        self.controls.write(state)
        self.query.update(state)

    def show(self, analysis: StateAnalysis, sequence: int, covered: bool = False) -> None:
        """Show an analysis.

        Args:
            covered: see `AnswerPanel.show`; the other panels are covered, too.
        """
        with self._client.atomic():
            self.answer.show(analysis, sequence, covered)
            if not covered:
                self.query.show(analysis)
                if self.parts is not None:
                    self.parts.show(analysis.state)

    def fit(self, folded: bool) -> None:
        """Fold the left panel, so that the stage has its room, or unfold it."""
        self._left.minimize() if folded else self._left.expand()

    def expand(self) -> None:
        """Unfold the left panel, which is folded unless the browser remembers it open."""
        self._left.expand()

    def leave(self) -> None:
        """Stop all threads and computations of the panels."""
        self.forget_error()
        self.query.leave()
        if self.parts is not None:
            self.parts.leave()

    def notify_error(self, title: str, text: str) -> None:
        """Show an error, see `ErrorNotice`."""
        self._error.show(title, text)

    def forget_error(self) -> None:
        """Take the last error away."""
        self._error.forget()
