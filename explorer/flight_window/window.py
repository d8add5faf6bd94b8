"""The flight window: one browser's view of the flight over its map."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import viser
from markupsafe import escape

from explorer import session_state
from explorer.compute.worker import Worker
from explorer.flight_window import messages, page
from explorer.flight_window.messages import FlightMessage
from explorer.flight_window.own_picture import own_picture
from explorer.flight_window.page import Painted
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightService, FlightView
from explorer.session_state import SessionState, StateChange
from explorer.stage.viewport import EDGE, Viewport
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Float64Array
from lpn.core.errors import LPNError
from lpn.drawing import words
from lpn.drawing.words import speaking
from lpn.locate.coverage import seen_by

# Share of the stage, from its top, that the compared pair takes where the window leaves it in sight.
_PAIR_SHARE = 0.49
# Height of the panel's own frame in pixels.
_FRAME_HEIGHT = 52
# Seconds between two looks at a registration that goes on in the background.
_INTERVAL = 1.0
# Seconds for which the window tells what a correction led to.
_SHOWN = 15.0
_NO_PLACE = "Not saved. A corner of the photo would lie more than 1,000 km away; move the tie points back."


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


@dataclass(frozen=True)
class _Message:
    """The result of the last correction, its frame, and the end of its display in seconds of the monotonic clock."""

    frame: int
    text: str
    until: float


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
        self._client, self._service = client, service
        self._workspace, self._pictures, self._change, self._viewport = workspace, pictures, change, viewport
        self._lock = threading.RLock()
        self._choices = _Choices()
        self._analysis: StateAnalysis | None = None
        self._view: FlightView | None = None
        self._plain = False
        self._placed: bool | None = None
        self._resized = False
        self._message: _Message | None = None
        self._saves = 0
        # The newest message to the page about the frame that it shows, and its number.
        self._followed: dict[str, Any] = {}
        self._sequence = 0
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Flight", viser.Icon.DRONE):
            self._shell = Html(gui)
            # The script of each element runs again when the page shows the window again.
            self._data, self._chosen, self._spot, self._progress = (Html(gui) for _ in range(4))
        self._worker = Worker(self._spoken, on_error)
        viewport.watch(self._resize)
        service.watchers.watch(self._worker.wake)

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
        self._service.watchers.unwatch(self._worker.wake)
        self._worker.stop()

    def join(self, seconds: float) -> None:
        """Wait until the window's work has ended after `leave`, the given seconds at most."""
        self._worker.join(seconds)

    def _paint(self, part: Painted) -> None:
        self._change(session_state.open_flight)
        self._choose(painted=part)

    def _choose(self, **choices: Any) -> None:
        with self._lock:
            self._choices = replace(self._choices, **choices)
        self._worker.wake()

    def receive(self, message: FlightMessage) -> None:
        """Do what a message of the window's HTML asks for."""
        match message:
            case messages.ChooseFrame(frame):
                self._change(lambda state: self._choose_query(state, frame))
            case messages.PaintScores(part) if isinstance(part, str) or part < self._workspace.contract.n_parts:
                self._choose(painted=part)
            case messages.ShowSpot(spot):
                self._choose(spot=spot)
            case messages.CorrectFrame(frame):
                if (spots := message.spots()) is None:
                    self._say(frame, _NO_PLACE)
                else:
                    self._correct(frame, np.array(spots, np.float64))
            case messages.ForgetCorrection(frame):
                self._correct(frame, None)
            case messages.ToggleHeight():
                self._choose(full_height=not self._choices.full_height)
            case messages.SavePositions(suffix):
                self._save(suffix)
            case messages.CloseFlight():
                self._change(lambda state: replace(state, flight=False))

    def _save(self, suffix: str) -> None:
        if self._workspace.has_flight:
            name = re.sub(r"[^\w-]+", "-", self._service.view().flight.flight.name)
            contents = self._service.positions(suffix)
            self._client.send_file_download(f"{name}-positions{suffix}", contents, save_immediately=True)

    def _correct(self, frame: int, corners: Float64Array | None) -> None:
        if not self._workspace.has_flight or frame >= len(self._service.view().flight.frames):
            return
        try:
            self._service.correct(frame, corners)
            text = "" if corners is None else f"Saved in {self._service.corrections_place}."
        except LPNError as error:
            self._say(frame, f"Not saved. {error}")
        else:
            with self._lock:
                self._saves += 1
            self._say(frame, text)

    def _say(self, frame: int, text: str) -> None:
        with self._lock:
            self._message = _Message(frame, text, time.monotonic() + _SHOWN)
        self._worker.wake()

    def _message_of(self, frame: int | None) -> _Message | None:
        """Return what is told of a frame; it is forgotten at the next frame, and after some seconds."""
        with self._lock:
            if self._message is not None and (self._message.frame != frame or time.monotonic() >= self._message.until):
                self._message = None
            return self._message

    def _choose_query(self, state: SessionState, frame: int) -> SessionState:
        return session_state.choose_query(state, frame, len(self._workspace.tasks[state.task].queries))

    def _spoken(self) -> float | None:
        plain = self._analysis is not None and self._analysis.state.plain
        with speaking(self._workspace.vocabulary(plain)):
            return self._work()

    def _work(self) -> float | None:
        with self._lock:
            analysis, choices, saves = self._analysis, self._choices, self._saves
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
        if view is not self._view or words.plain() != self._plain:
            self._view, self._plain = view, words.plain()
            self._data.show(page.calls({"show": page.data(view, self._pictures.address), "lists": page.lists(view)}))
        names = self._workspace.part_names
        self._shell.show(page.shell(names, self._panel_height, choices.full_height, alone=state.map_alone))
        frame = None if state.upload or state.query >= len(view.flight.frames) else state.query
        right = analysis.matches[0].true
        message = self._message_of(frame)
        agreement = None if frame is None else self._service.agreement(frame)
        self._progress.show(
            page.calls(
                {
                    "sentence": escape(page.sentence(view, running)),
                    "accuracy": page.accuracy(view),
                    "status": escape((message and message.text) or page.progress(job, len(view.flight.frames))),
                }
            )
        )
        followed = {
            "address": self._pictures.address,
            "frame": self._own_picture(analysis, view)
            if frame is None
            else page.chosen(view, frame, self._pictures.address, saves, right, agreement),
            "answer": page.answer_window(view, analysis),
            "scores": page.painting(view, analysis, choices.painted, names),
        }
        if followed != self._followed:
            self._followed, self._sequence = followed, self._sequence + 1
        self._chosen.show(page.calls({"follow": followed | {"sequence": self._sequence}}))
        if choices.spot is not None:
            frames = seen_by(view.outlines, *choices.spot)
            html = page.spot_list(view, frames, choices.spot)
            self._spot.show(page.calls({"spot": {"spot": choices.spot, "frames": frames, "html": html}}))
        if running:
            return _INTERVAL
        return None if message is None else max(message.until - time.monotonic(), 0.0)

    def _own_picture(self, analysis: StateAnalysis, view: FlightView) -> dict[str, Any] | None:
        """Return what the page shows of the own picture; None without one."""
        return None if analysis.state.upload is None else own_picture(analysis, self._workspace, view.flight)

    @property
    def _panel_height(self) -> int:
        return max(self._height - _FRAME_HEIGHT, 300)

    def _place(self, full_height: bool | None) -> None:
        """Cover the whole stage or its lower part; None hides the window."""
        with self._lock:
            resized, self._resized = self._resized, False
        if full_height == self._placed and not resized:
            return
        if full_height is not None:
            width, self._height = self._viewport.window(share=1.0 if full_height else 1 - _PAIR_SHARE)
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=self._height)
            self._panel.expand()
        self._panel.visible = full_height is not None
        self._placed = full_height

    def _resize(self) -> None:
        """Place the window again, because the viewport changed."""
        with self._lock:
            self._resized = True
        self._worker.wake()
