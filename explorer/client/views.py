"""All that one browser's page shows: the stage, the panels, and the windows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from threading import Lock
from typing import Any

import msgspec
import viser
from markupsafe import escape

from explorer import judge
from explorer.browse.messages import BrowseMessage
from explorer.client.services import WorkspaceServices
from explorer.compute.request_context import RequestContext
from explorer.explain_window.messages import ExplainMessage
from explorer.explain_window.window import ExplainWindow
from explorer.failure_lab.messages import LabMessage
from explorer.failure_lab.window import FailureLabWindow
from explorer.flight_window.messages import FlightMessage
from explorer.flight_window.window import FlightWindow
from explorer.panels import answer_text, shortcuts
from explorer.panels.first_screen import FirstScreen, page
from explorer.panels.glossary import Glossary
from explorer.panels.messages import PartsMessage, StageMessage
from explorer.panels.panels import Panels
from explorer.panels.stage_controls import StageControls
from explorer.reports import Reporter
from explorer.session_state import SessionState, StateChange
from explorer.stage.scene import Stage
from explorer.stage.viewport import Viewport
from explorer.stories import tour
from explorer.stories.library import stories_of
from explorer.stories.messages import StoryMessage
from explorer.stories.telling import StoryTeller
from explorer.web import style
from explorer.web.bridge import PageBridge
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.errors import LPNError
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import theme
from lpn.drawing.words import speaking
from lpn.tasks.task import Scoring


class ClientViews:
    """Builds a page's views, and draws analyses in them. A view's callbacks change the state; they never compute.

    Args:
        state: returns the newest state.
        change: updates the state with a function.
        go: shows the state of a query string; returns a sentence about each value that is invalid.
        on_select: compares with the tile at a gallery position, which was clicked while a state was drawn.
        show_scoring: ranks by a scoring, which is prepared first where it is not ready.
        receivers: of the messages that no view receives, see `Receivers`.

    Attributes:
        sequence: the number of analyses that were drawn.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        services: WorkspaceServices,
        requests: RequestContext,
        state: Callable[[], SessionState],
        change: Callable[[StateChange], None],
        go: Callable[[str], list[str]],
        on_select: Callable[[SessionState, int], None],
        show_scoring: Callable[[Scoring], None],
        receivers: Mapping[type[Any], Callable[[Any], None]],
    ) -> None:
        self._client, self._change = client, change
        self._workspace = workspace = services.workspace
        self.sequence, self._small = 0, True
        # The page keeps the theme that it has until it has sent its own, or an answer is drawn.
        self._dark: bool | None = None
        self.panels = Panels(client, workspace, services.feeds, services.weight_figures, state(), change)
        self.viewport = viewport = Viewport()
        model = requests.queued(workspace.model, background=True)
        self.reporter = reporter = Reporter(client, model, lambda *count: self.bridge.work(*count))
        self.explain_window = ExplainWindow(
            client,
            workspace,
            change,
            self._say,
            viewport,
            reporter,
            requests,
            services.turned,
            lambda name: self.bridge.open_tab(name),
        )
        self.lab = FailureLabWindow(client, workspace, services.failure_lab, services.feeds, change, viewport, reporter)
        self.flight = FlightWindow(
            client, workspace, services.flight, services.flight_pictures, change, viewport, self._say
        )
        self.stories = StoryTeller(
            client,
            workspace,
            services.url_state,
            self.panels.answer.stories,
            state,
            go,
            partial(self.show_state, whole=True),
            lambda function, *arguments: self.bridge.call(function, *arguments),
            reporter,
        )
        self.panels.navigation.order = self.lab.order
        self.panels.query.compare_models = self.explain_window.compare_models
        self.stage_controls = StageControls(workspace, self.panels.navigation, change, self._look)
        self.glossary = Glossary(client.gui, lambda: state().plain)
        own = self.panels.query.own
        self.first_screen = FirstScreen(
            client.gui,
            workspace,
            self.panels.navigation,
            change,
            self.lab.restore,
            own,
        )
        of_views: dict[type[Any], Callable[[Any], None]] = {
            ExplainMessage: self.explain_window.receive,
            LabMessage: self.lab.receive,
            FlightMessage: self.flight.receive,
            StoryMessage: self.stories.receive,
            BrowseMessage: self.panels.query.receive,
            PartsMessage: self._to_parts,
            StageMessage: self.stage_controls.receive,
        }
        properties = {
            "title": f"{workspace.data_name} · LPN Explorer",
            "tour": msgspec.to_builtins(self.stories.tour),
            "places": tour.places(),
            "keys": services.url_state.keys,
            "noLink": answer_text.NO_LINK,
            "docked": True,
            "ownHint": answer_text.own_hint(workspace, shows_rendered(workspace.root)),
        }
        self.bridge = PageBridge(client.gui, {**of_views, **receivers}, properties, style.STYLE)
        windows = (self.explain_window, self.lab, self.flight)
        commands = self.stories.commands()
        commands += [(label, None, call) for window in windows for label, call in window.commands()]
        if self.panels.parts is not None:
            commands.append(("Try all combinations of parts", None, self._try_combinations))
        commands.append(("Glossary", None, self.glossary.show))
        if workspace.has_flight:
            commands.append(
                (
                    "Look through the photo's camera on the map, then hide and show the photo",
                    "Z",
                    lambda: self.stage.look_through(),
                )
            )
        commands.append(("First screen", None, lambda: self.first_screen.act("start")))
        shortcuts.add(client.gui, workspace, self.panels, change, self.bridge, commands, show_scoring)
        self._make_stage = partial(Stage, client, workspace, on_select, model, viewport, self.bridge.set_photo)
        self._stage: Stage | None = None
        self._building = Lock()

    @property
    def stage(self) -> Stage:
        """The 3-D view, built when it is first needed: behind the first screen nobody sees it."""
        with self._building:
            if self._stage is None:
                self._stage = self._make_stage()
            return self._stage

    def _look(self, through: bool) -> None:
        """Look through the photo's camera, or take note that the view has been moved away from it."""
        if through:
            self.stage.look_through()
        else:
            self.stage.look_away()

    def fit_camera(self) -> None:
        """Fit the stage to the page's window, whose camera has changed."""
        if self._stage is not None:
            self._stage.fit()

    def outgrown(self, analysis: StateAnalysis) -> bool:
        """Return True if the stage shows the analysis, and has another size than it was drawn for."""
        return not analysis.state.first_screen and self.stage.outgrown

    def _to_parts(self, message: PartsMessage) -> None:
        if self.panels.parts is not None:
            self.panels.parts.receive(message)

    def _try_combinations(self) -> None:
        assert self.panels.parts is not None
        self.panels.expand()
        self.bridge.open_tab("Parts")
        self.panels.parts.try_combinations()

    def show_state(self, state: SessionState, whole: bool = False) -> None:
        """Replace the state, and what the laboratory shows; see `FailureLabWindow.restore`."""
        self.lab.restore(state, whole)
        self._change(lambda _: state)

    def preview(self, analysis: StateAnalysis, workspace: Workspace) -> None:
        """Show the first screen of another workspace; nothing of it can be used before a session of that workspace."""
        with speaking(workspace.vocabulary(analysis.state.plain)):
            self.bridge.call("preview", page(analysis, workspace, list(stories_of(workspace).by_name)))

    def follow(self, before: SessionState, state: SessionState) -> None:
        """Open and close what a state opens and closes at once, before its analysis."""
        self.set_theme(state)
        if state.shows_reasons and not before.shows_reasons:
            self.explain_window.announce()
            self.bridge.call("revealReasons")
        if before.shows_reasons and not state.shows_reasons:
            self.explain_window.close()
        if state.flight and not before.flight:
            self.bridge.call("reveal", "#lpn-flight")
        if before.flight and not state.flight:
            self.bridge.call("flight.leave")
        if state.lab and not before.lab:
            self.bridge.call("reveal", ".lab-bar")
        if state.shows_reasons:
            self.explain_window.show_tab(state.why_tab)

    def show(self, analysis: StateAnalysis, drawn: Callable[[], None]) -> None:
        """Draw an analysis. The stage and its panels are drawn only when the first screen, which covers them, is left.

        Args:
            drawn: called when all but the panels is drawn.
        """
        self.sequence += 1
        if self._dark is None:  # the page sent no greeting; later, an older answer must not bring its theme back
            self.set_theme(analysis.state)
        covered = analysis.state.first_screen
        with speaking(self._workspace.vocabulary(analysis.state.plain)):
            if covered:
                self.first_screen.show(analysis, self.stories.names)
            with self._client.atomic():  # the page draws one frame
                if not covered:
                    self._draw_stage(analysis)
                    self.bridge.set_ground(self.stage.ground)
                self.explain_window.show(analysis)
                self.lab.show(analysis)
                self.flight.show(analysis)
                self.stories.show(analysis)
                drawn()
                self.panels.show(analysis, self.sequence, covered)
            if not covered:  # it goes when what it covered is there
                self.first_screen.show(analysis, self.stories.names)

    def _draw_stage(self, analysis: StateAnalysis) -> None:
        """Draw the stage, and the controls and bars that lie over it."""
        self.stage.show(judge.shown(analysis, self._workspace))
        self.bridge.set_stage(self.stage_controls.html(analysis, self.stage.layout))

    def show_own_photo(self, analysis: StateAnalysis) -> None:
        """Show how far the registration of the own picture is, or its answer beside the analysis that is shown."""
        with speaking(self._workspace.vocabulary(analysis.state.plain)):
            job, covered = analysis.own_photo, analysis.state.first_screen
            if job is not None and not job.wait(0):
                self.bridge.call("comparing", escape(answer_text.comparing(job)))
                return
            self.flight.show(analysis)
            if covered:
                self.first_screen.show(analysis, self.stories.names)
            else:
                self._draw_stage(analysis)
            self.panels.show(analysis, self.sequence, covered)

    def refit(self, analysis: StateAnalysis) -> None:
        """Draw the stage of an analysis that is shown for the stage's new size."""
        with speaking(self._workspace.vocabulary(analysis.state.plain)), self._client.atomic():
            self._draw_stage(analysis)

    def fail(self, error: Exception) -> None:
        """Say why there is no answer."""
        self._say(error)
        self.explain_window.fail(_in_words(error))
        if not self.sequence:
            self.first_screen.fail(_in_words(error))

    def _say(self, error: Exception) -> None:
        self.panels.answer.show_idle()
        self.panels.notify_error("No answer", _in_words(error))

    def fit(self, small: bool) -> None:
        """Fit the panels to a small window, or back to a large one."""
        if small or self._small:
            self._small = small
            self.panels.fit(small)

    def leave(self) -> None:
        """Stop all threads and computations of the views."""
        self.reporter.leave()
        self.explain_window.leave()
        if self._stage is not None:
            self._stage.leave()
        self.lab.leave()
        self.flight.leave()
        self.panels.leave()

    def set_theme(self, state: SessionState) -> None:
        """Show the state's theme."""
        if state.dark == self._dark:
            return
        self._dark = state.dark
        self._client.gui.configure_theme(
            dark_mode=state.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=state.palette.ink(theme.COLOURS["accent"]),
        )
        self.bridge.tell_theme(state.dark)


def _in_words(error: Exception) -> str:
    if isinstance(error, LPNError):
        return str(error)
    return f"{type(error).__name__}: try another picture, or load the page again; the server's log has the details."
