"""The flight panel of one tab: its messages, and the requests of its script."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.own_photos import likely_windows
from explorer.compute.worker import Worker
from explorer.flight import page
from explorer.flight.own import own_photo
from explorer.flight.service import shared_flight
from explorer.parameters import UnusableError, parse_number
from explorer.screen.fields import Line, OneOf, PanelField, ScreenState
from explorer.screen.panel import PanelPart, Tab
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace
from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError, LPNError
from lpn.core.texts import counted
from lpn.flight.locate.own_photo import OwnPhoto
from lpn.library.analyser import OwnPicture

_FARTHEST = 1e6
# Seconds between two checks of a background registration.
_INTERVAL = 1.0


@dataclass(frozen=True)
class MetresOf:
    """A fixed count of values in metres, or none."""

    count: int

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> tuple[float, ...]:  # noqa: ARG002
        given = value.split(",") if isinstance(value, str) and value else value
        if given in ([], "", None):
            return ()
        if not isinstance(given, list) or len(given) != self.count:
            raise UnusableError(f"expected {self.count} numbers in metres.")
        return tuple(round(parse_number(str(one), -_FARTHEST, _FARTHEST), 2) for one in given)

    def write(self, value: tuple[float, ...], state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        return ",".join(f"{one:g}" for one in value)


@dataclass(frozen=True)
class PaintedPart:
    """The parts whose scores are painted over the map: "all", a part's number from 0, or "off"."""

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        parts = [str(part) for part in range(workspace.contract.n_parts)]
        if not isinstance(value, str) or value not in ("off", "all", *parts):
            raise UnusableError("expected off, all, or the number of a part, from 0.")
        return value

    def write(self, value: str, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        return value


PAINT: PanelField[str] = PanelField("flight_paint", PaintedPart(), "off", "flight_paint")
SPOT: PanelField[tuple[float, ...]] = PanelField("flight_spot", MetresOf(2), (), "flight_spot")
FIELDS: tuple[PanelField[Any], ...] = (
    PAINT,
    SPOT,
    PanelField("flight_over", OneOf(("off", "swipe", "correct")), "off", "flight_over"),
    # Names of tracks, separated by full stops, or "none". Default: tags, corrections, and the most frequent deciding stage.
    PanelField("flight_tracks", Line(), "", "flight_tracks"),
    # The middle and the width of the visible map.
    PanelField("flight_view", MetresOf(3), (), "flight_view"),
)


class FlightPart(PanelPart):
    """Sends the changed flight and the tab's photo from a worker thread."""

    def __init__(self, tab: Tab) -> None:
        super().__init__(tab)
        self._shared, self._pictures = shared_flight(tab.base)
        self._sent: dict[str, object] = {}
        self._saves = 0
        self._worker = Worker(self._work, self._fail)
        self._registering: tuple[str, BackgroundJob[OwnPhoto]] | None = None
        self._shared.watchers.watch(self._worker.wake)
        self.actions = {"correct": self._correct, "forget": self._forget, "positions": self._positions}

    def show(self) -> None:
        """Send the changes."""
        self._worker.wake()

    def close(self) -> None:
        """Stop the work for the panel."""
        self._shared.watchers.unwatch(self._worker.wake)
        self._worker.stop()
        if (jobs := self.tab.base.own_photos) is not None:
            jobs.leave(self)

    def _fail(self, error: Exception) -> None:
        self.tab.say(
            str(error) if isinstance(error, LPNError) else "Something failed; the server's log has the details."
        )

    def _work(self) -> float | None:
        state, result, workspace = self.tab.state, self.tab.result, self.tab.base
        job = workspace.registration
        running = job is not None and not job.wait(0)  # before the snapshot: when the job ends, it replaces the flight
        seen, addresses = self._shared.snapshot(), self._pictures.addresses
        if self._sent.get("flight") is not seen:
            self._sent["flight"] = seen
            place = self._shared.corrections_place
            message = page.data(seen, addresses) | {"parts": workspace.part_names, "kept": place}
            self.tab.append("flight", {"flight": message})
        own = None if result is None or result.state.own != state.own else result.own
        if result is not None and own is not None:
            registers = self._register(own, result)
            running = running or (registers is not None and not registers.wait(0))
            self._send("photo", own_photo(seen, own, registers, addresses))
        elif not state.own and state.query < len(seen.flight.frames):
            self._send("photo", page.chosen(seen, state.query, addresses, self._saves))
        if result is not None and (result.state.query, result.state.own) == (state.query, state.own):
            self._send("answer", page.answer_window(seen, result.first.index))
            ranking = result.analysis.ranking
            self._send("scores", page.painting(seen, ranking, state[PAINT], workspace.part_names))
        self._send("spot", page.spot(seen, (state[SPOT][0], state[SPOT][1])) if state[SPOT] else None)
        self._send("progress", _progress(job, len(seen.flight.frames)) if running or job is not None else "")
        return _INTERVAL if running else None

    def _register(self, own: OwnPicture, result: ScreenResult) -> BackgroundJob[OwnPhoto] | None:
        """Return the job that registers the user's own photo; `OwnPhotos.check` may have started it."""
        jobs, analysis = self.tab.base.own_photos, result.analysis
        if jobs is not None and (self._registering is None or self._registering[0] != own.key):
            windows = likely_windows(analysis.task, analysis.ranking.order.tolist())
            self._registering = own.key, jobs.join(own, windows, self)
        return None if self._registering is None else self._registering[1]

    def _send(self, kind: str, value: object) -> None:
        if kind not in self._sent or self._sent[kind] != value:
            self._sent[kind] = value
            self.tab.append(kind, {kind: value})

    def _correct(self, arguments: Mapping[str, Any]) -> None:
        """Store the corners of a photo as the user placed them, in metres of the map's frame."""
        try:
            corners = np.array(arguments.get("corners"), np.float64)
        except (TypeError, ValueError):
            corners = np.zeros(0)
        if corners.shape != (4, 2) or not (np.abs(corners) <= _FARTHEST).all():
            raise InputError("Not saved. A corner of the photo would lie over 1,000 km away; move the tie points back.")
        self._keep(arguments, corners)

    def _forget(self, arguments: Mapping[str, Any]) -> None:
        self._keep(arguments, None)

    def _keep(self, arguments: Mapping[str, Any], corners: Float64Array | None) -> None:
        frame = arguments.get("frame")
        if not isinstance(frame, int) or not 0 <= frame < len(self._shared.snapshot().flight.frames):
            return
        try:
            self._shared.correct(frame, corners)
        except LPNError as error:
            raise InputError(f"Not saved. {error}") from error
        self._saves += 1
        self._worker.wake()

    def _positions(self, arguments: Mapping[str, Any]) -> None:
        """Make a file with one position for each photo, which the page then saves."""
        suffix = arguments.get("suffix")
        if suffix not in (".csv", ".geojson"):
            raise InputError("expected .csv or .geojson.")
        name = re.sub(r"[^\w-]+", "-", self._shared.snapshot().flight.flight.name)
        self.tab.download("Positions", lambda _: (f"{name}-positions{suffix}", self._shared.positions(suffix)))


def _progress(job: BackgroundJob[Any] | None, frames: int) -> str:
    """Return the progress of a registration of `frames` frames, or the reason of its failure; "" after success."""
    if job is None or job.wait(0):
        return f"Registration failed: {job.error}" if job is not None and job.error is not None else ""
    return f"Registering {job.done} of {counted(job.total or frames, 'photo')}"
