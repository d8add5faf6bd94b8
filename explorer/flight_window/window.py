"""The flight window: one browser's view of the flight over its map."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import viser

from explorer import session_state
from explorer.compute.worker import Worker
from explorer.flight_window import messages, page
from explorer.flight_window.page import Painted
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService, FlightView
from explorer.session_state import SessionState, StateChange
from explorer.stage.viewport import EDGE, Viewport
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Float64Array
from lpn.core.errors import LPNError
from lpn.locate.coverage import seen_by

# Share of the stage, from its top, that the compared pair takes where the window leaves it in sight.
_PAIR_SHARE = 0.49
# Height of the panel's own frame in pixels.
_FRAME_HEIGHT = 52
# Seconds between two looks at a registration that goes on in the background.
_INTERVAL = 1.0


@dataclass(frozen=True)
class _Choices:
    """One browser's choices in the window.

    Attributes:
        painted: whose scores are painted over the map.
        full_height: the window covers the whole stage.
        spot: whose frames are listed, in metres of the map's frame.
    """

    painted: Painted = "off"
    full_height: bool = True
    spot: tuple[float, float] | None = None


class FlightWindow:
    """One browser's flight window; it is visible while `SessionState.flight` is set and no other window lies over the stage.

    It works on its own thread, so that neither the stage nor the server waits for it.

    Args:
        service: the view of the flight, for all browsers.
        pictures: tiles and photos, for all browsers.
        change: updates the browser's state with a function.
        on_error: receives the exceptions of the window's work.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        service: FlightService,
        pictures: FlightPictures,
        change: Callable[[StateChange], None],
        viewport: Viewport,
        on_error: Callable[[Exception], None],
    ) -> None:
        self._service = service
        self._workspace, self._pictures, self._change, self._viewport = workspace, pictures, change, viewport
        self._lock = threading.RLock()
        self._choices = _Choices()
        self._analysis: StateAnalysis | None = None
        self._view: FlightView | None = None
        self._placed: bool | None = None
        # What the last correction led to, and its frame.
        self._said: tuple[int, str] = (-1, "")
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Flight", viser.Icon.DRONE):
            self._shell = Html(gui)
            # The script of each element runs again when the page shows the window again.
            self._data, self._chosen, self._painting, self._spot, self._progress = (Html(gui) for _ in range(5))
        self._worker = Worker(self._work, on_error)
        viewport.watch(self._resize)

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """Return a handler for each kind of message of the window's HTML."""
        return {kind: partial(self._receive, kind) for kind in messages.MESSAGES}

    def commands(self) -> list[tuple[str, Callable[[], None]]]:
        """Return the window's commands for the palette."""
        if not self._workspace.has_flight:
            return []
        painted: list[tuple[str, Painted]] = [("no scores", "off"), ("the scores of all parts", "all")]
        painted += [(f"the scores of part {name}", part) for part, name in enumerate(self._workspace.part_names)]
        return [(f"Flight: paint {label} over the map", partial(self._paint, part)) for label, part in painted]

    def show(self, analysis: StateAnalysis) -> None:
        """Open or close the window as the state says, and follow the query that the page shows."""
        if self._workspace.has_flight:
            with self._lock:
                self._analysis = analysis
            self._worker.wake()

    def leave(self) -> None:
        """Stop working for a browser that left."""
        self._worker.stop()

    def _paint(self, part: Painted) -> None:
        self._change(lambda state: replace(state, flight=True, why=False, lab=False))
        self._choose(painted=part)

    def _choose(self, **choices: Any) -> None:
        with self._lock:
            self._choices = replace(self._choices, **choices)
        self._worker.wake()

    def _receive(self, kind: str, value: Any) -> None:
        match messages.decode(kind, value):
            case messages.ChooseFrame(frame):
                self._change(lambda state: self._choose_query(state, frame))
            case messages.PaintScores(part) if isinstance(part, str) or part < self._workspace.spec.n_parts:
                self._choose(painted=part)
            case messages.ShowSpot(spot):
                self._choose(spot=spot)
            case messages.CorrectFrame(frame, corners):
                self._correct(frame, np.array(corners, np.float64))
            case messages.ForgetCorrection(frame):
                self._correct(frame, None)
            case messages.ToggleHeight():
                self._choose(full_height=not self._choices.full_height)
            case messages.CloseFlight():
                self._change(lambda state: replace(state, flight=False))

    def _correct(self, frame: int, corners: Float64Array | None) -> None:
        if not self._workspace.has_flight or frame >= len(self._service.view().flight.frames):
            return
        try:
            self._service.correct(frame, corners)
            text = "" if corners is None else f"Saved in {self._service.corrections_file.name}, beside the flight."
        except LPNError as error:
            text = f"Not saved. {error}"
        self._said = frame, text
        self._worker.wake()

    def _choose_query(self, state: SessionState, frame: int) -> SessionState:
        return session_state.choose_query(state, frame, len(self._workspace.tasks[state.task].queries))

    def _work(self) -> float | None:
        with self._lock:
            analysis, choices = self._analysis, self._choices
        if analysis is None:
            return None
        state = analysis.state
        is_open = state.flight and not state.why and not state.lab
        self._place(choices.full_height if is_open else None)
        if not is_open:
            return None
        job = self._workspace.registration
        running = job is not None and not job.wait(0)  # asked before the flight, which the job replaces at its end
        view = self._service.view()
        if view is not self._view:
            self._view = view
            self._data.show(page.calls({"show": page.data(view, self._pictures.address), "lists": page.lists(view)}))
        names = self._workspace.part_names
        self._shell.show(page.shell(names, self._panel_height))
        shown = None if state.upload or state.query >= len(view.flight.frames) else state.query
        said = self._said[1] if self._said[0] == shown else ""
        self._progress.show(page.calls({"status": said or page.progress(job)}))
        self._chosen.show(
            page.calls(
                {
                    "follow": None if shown is None else page.chosen(view, shown, self._pictures.address),
                    "answer": page.answer_window(view, analysis),
                }
            )
        )
        self._painting.show(page.calls({"paint": page.painting(view, analysis, choices.painted, names)}))
        if choices.spot is not None:
            frames = seen_by(view.outlines, *choices.spot)
            html = page.spot_list(view, frames, choices.spot)
            self._spot.show(page.calls({"spot": {"spot": choices.spot, "frames": frames, "html": html}}))
        return _INTERVAL if running else None

    @property
    def _panel_height(self) -> int:
        return max(self._height - _FRAME_HEIGHT, 300)

    def _place(self, full_height: bool | None) -> None:
        """Cover the whole stage or its lower part; None hides the window."""
        if full_height == self._placed:
            return
        if full_height is not None:
            width, self._height = self._viewport.window(share=1.0 if full_height else 1 - _PAIR_SHARE)
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=self._height)
            self._panel.expand()
        self._panel.visible = full_height is not None
        self._placed = full_height

    def _resize(self) -> None:
        """Place the window again, because the viewport changed."""
        self._placed = None if self._placed is None else not self._placed
        self._worker.wake()
