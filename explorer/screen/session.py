"""The session of one tab: its state, what a message changes, and what is sent back."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import viser

from explorer import uploads
from explorer.client.services import WorkspaceServices
from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.ranking_job import RankingJob
from explorer.compute.ranking_progress import RankingProgress
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import Worker
from explorer.screen import fields
from explorer.screen.curve import STEP, Curve, Turning, held_descriptors
from explorer.screen.fields import ScreenState
from explorer.screen.loop import Loop, ScreenMessage
from explorer.screen.occlusion import Covering, Occlusion
from explorer.screen.panel import PanelPart
from explorer.screen.panels import PANELS
from explorer.screen.rail import Rail
from explorer.screen.result import STRIP, ScreenResult, measured_scale
from explorer.screen.scene.scene import Scene, views_of
from explorer.server.message_filter import MAX_UPLOAD
from explorer.session_state import SessionState
from explorer.workspace import LazyWorkspace, StateAnalyser, StateAnalysis, Workspace
from lpn.core import images
from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.library.analyser import OwnPicture
from lpn.tasks.task import SCORINGS, scored_key

# Own photos that all tabs hold at a time, each of up to 8 MB.
_MOST_OWN = 100
# Seconds between two looks at a workspace that is being opened.
_POLL = 0.2
_SHOWN_OWN = 800


@dataclass(frozen=True, eq=False)
class _Opened:
    """A model's workspace with this tab's access to it."""

    workspace: Workspace
    requests: RequestContext
    background: RequestContext
    analyser: StateAnalyser


class Screens:
    """What all tabs share.

    Args:
        services: opens a workspace by its key; LPNError if that fails.
        home: key of the workspace that a page without an address shows.
        places: labels of all workspaces by their keys.
    """

    def __init__(self, services: Callable[[str], WorkspaceServices], home: str, places: Mapping[str, str]) -> None:
        self.services, self.home, self.places = services, home, places
        self.scale = lru_cache(maxsize=32)(measured_scale)
        self.held = held_descriptors()
        self.own = threading.BoundedSemaphore(_MOST_OWN)

    def session(self, send: Callable[[ScreenMessage], None]) -> ScreenSession:
        """Return the session of a new tab."""
        return ScreenSession(self, send)


class ScreenSession:
    """One tab. Messages come from one thread at a time.

    Attributes:
        client: viser's, of the tab's scene; None without one.

    Args:
        send: hands a message to the page, from any thread.
    """

    def __init__(self, screens: Screens, send: Callable[[ScreenMessage], None]) -> None:
        self._screens, self._send = screens, send
        self._lock, self._left = threading.RLock(), False
        self._opened: dict[Workspace, _Opened] = {}
        self._state: ScreenState | None = None
        self._analysed: tuple[ScreenState, StateAnalysis] | None = None
        self._rail = Rail()
        self._loop = Loop(self._answer, send, self._requests, self._after)
        self._curve = Curve(send, screens.held)
        self._occlusion, self._number = Occlusion(send), 0
        self._progress = RankingProgress(lambda _: None, self._show_rail)
        # The own photo by its key, the address of its picture, and the file that is being received.
        self._own: dict[str, tuple[OwnPicture, str]] = {}
        self._incoming: tuple[str, int, bytearray] | None = None
        self._actions: Mapping[str, Callable[[Mapping[str, Any]], None]] = {
            "open": self._open,
            "step": self._step,
            "random": self._random,
            "upload": self._upload,
            "forget": self._forget,
            "hover": self._hover,
            "pick": self._pick,
            "scene": lambda _: self._painter.wake("resized"),
        }
        # The tab's scene once its frame is there, and what it is to show.
        self.client: viser.ClientHandle | None = None
        self._scene: Scene | None = None
        self._painted: ScreenResult | None = None
        self._painter = Worker(self._paint, lambda _: None)
        # The open panel, whose work has a thread of its own.
        self._panel: tuple[str, PanelPart] | None = None
        self._panels = Worker(self._show_panel, self._fail_panel)

    # What panels use, see `Tab`.

    @property
    def state(self) -> ScreenState:
        """The newest state."""
        assert self._state is not None
        return self._state

    @property
    def result(self) -> ScreenResult | None:
        """The newest result."""
        return self._painted

    @property
    def services(self) -> WorkspaceServices:
        """What the state's place offers."""
        return self._of(self.state)

    @property
    def workspace(self) -> Workspace:
        """The workspace of the state's model."""
        return self._workspace(self.state)

    @property
    def ranking(self) -> RankingJob:
        """The ranking of the state's task."""
        return self._ranking(self.state)

    @property
    def background(self) -> RequestContext:
        """Access to the network behind what a person waits for."""
        return self._access().background

    def set(self, values: Mapping[str, object]) -> None:
        """Set fields of the state as the page does."""
        self._set(values)

    def send(self, message: ScreenMessage) -> None:
        """Send a message to the open panel's module."""
        self.append("", message)

    def append(self, kind: str, message: ScreenMessage) -> None:
        """Send a message that replaces only one of its kind."""
        panel = self._panel
        if panel is not None:
            self._send({"panel": {"name": panel[0], "message": message}, "kind": kind})

    def say(self, text: str) -> None:
        """Show a sentence in the headline's place."""
        self._send({"error": text})

    def receive(self, message: object) -> None:
        """Do what a message says: `set` fields of the state, or `do` an action; anything else changes nothing."""
        match message:
            case {"set": dict(values)} if self._state is not None:
                self._set(values)
            case {"do": str(name), "args": dict(arguments)} if name in self._actions:
                if name == "open" or self._state is not None:
                    self._actions[name](arguments)
            case {"do": str(name), "args": dict(arguments)} if (action := self._panel_action(name)) is not None:
                action(arguments)
            case {"do": str(name)}:
                self._send({"error": f"There is no action {printable(name)[:40]}."})

    def receive_bytes(self, part: bytes) -> None:
        """Take a part of the file that `upload` announced; the last one shows it."""
        if self._incoming is None:
            return
        name, size, content = self._incoming
        content += part
        if len(content) >= size:
            self._incoming = None
            self._take(name, bytes(content[:size]))

    def leave(self) -> None:
        """Stop all that goes on for this tab: it has left."""
        self._left = True
        self._loop.stop()
        self._curve.stop()
        self._occlusion.stop()
        self._painter.stop()
        self._panels.stop()
        self._close_panel()
        self._progress.close()
        with self._lock:
            for opened in self._opened.values():
                opened.requests.close()
                opened.background.close()
            if self._state is not None:
                self._of(self._state).feeds.leave(self)
                self._of(self._state).feeds.leave(self._rail)
            self._drop_own()

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in a frame of viser's page from now on; None once it has gone."""
        self.client = client
        self._painter.wake()

    # What messages do.

    def _open(self, arguments: Mapping[str, Any]) -> None:
        search = arguments.get("search")
        search = search if isinstance(search, str) else ""
        wanted = dict(fields.parsed(search)).get("show", self._screens.home)
        try:
            services = self._screens.services(wanted if wanted in self._screens.places else self._screens.home)
        except LPNError as error:
            self._send({"error": str(error)})
            services = self._screens.services(self._screens.home)
        state, problems = fields.from_address(search, services.workspace)
        if not self._opens_model(state):
            state = replace(state, model="0")
        self._show(state, problems, new_page=True)

    def _set(self, values: Mapping[str, Any]) -> None:
        state = self._state
        assert state is not None
        place = values.get("place")
        if isinstance(place, str) and place != state.place and place in self._screens.places:
            self._send({"busy": f"Opening {self._screens.places[place]}"})
            try:
                services = self._screens.services(place)
            except LPNError as error:
                self._send({"error": str(error)})
                return
            self._of(state).feeds.leave(self._rail)
            self._rail = Rail()
            self._drop_own()
            opened = replace(fields.opening(services.workspace), theme=state.theme, view=state.view)
            self._show(opened, [], new_page=True)
            return
        changed, problems = fields.changed(state, values, self._of(state).workspace)
        if changed.own not in ("", *self._own):
            changed = replace(changed, own="")
        if changed.model != state.model and not self._opens_model(changed):
            return
        self._show(changed, problems)

    def _step(self, arguments: Mapping[str, Any]) -> None:
        state = self._state
        assert state is not None
        query = self._rail.step(state.query, -1 if arguments.get("by") == -1 else 1)
        if query is not None:
            self._set({"query": query})

    def _random(self, _: Mapping[str, Any]) -> None:
        state = self._state
        assert state is not None
        query = self._rail.random(state.query)
        if query is not None:
            self._set({"query": query})

    def _upload(self, arguments: Mapping[str, Any]) -> None:
        name, size = arguments.get("name"), arguments.get("size")
        if not isinstance(name, str) or not isinstance(size, int) or isinstance(size, bool):
            return
        if not 0 < size <= MAX_UPLOAD:
            self._send({"error": f"{printable(name)[:80]} has {size / 1e6:.0f} MB; up to 30 MB are taken."})
            return
        self._incoming = name, size, bytearray()
        self._send({"busy": "Reading your photo"})

    def _take(self, name: str, content: bytes) -> None:
        """Read an own photo and show it; nothing is written to disk."""
        assert self._state is not None
        services = self._of(self._state)
        if services.workspace.model is None:
            self._send({"error": "Saved descriptors cannot describe a photo of yours; open the data set with a model."})
            return
        try:
            picture = replace(uploads.read(name, content), key=secrets.token_hex(4))
            if not self._own and not self._screens.own.acquire(blocking=False):
                raise InputError(f"The server holds {_MOST_OWN} photos of its visitors, which is the most; try later.")
        except LPNError as error:
            self._send({"error": str(error)})
            return
        file = images.jpeg(images.shrink(picture.picture, _SHOWN_OWN), 88)
        address = services.feeds.address + services.feeds.publish_bytes(self, "own", lambda: file, "image/jpeg") + "0"
        self._own = {picture.key: (picture, address)}
        self._set({"own": picture.key})

    def _forget(self, _: Mapping[str, Any]) -> None:
        self._drop_own()
        self._set({"own": ""})

    def _drop_own(self) -> None:
        if self._own:
            self._own = {}
            self._screens.own.release()

    def _hover(self, arguments: Mapping[str, Any]) -> None:
        part, scene = arguments.get("part"), self._scene
        if scene is not None:
            scene.hover(part if isinstance(part, int) and part >= 0 else None)

    def _pick(self, arguments: Mapping[str, Any]) -> None:
        """Say what is at a place of the scene."""
        place = [arguments.get(name) for name in ("x", "y")]
        if self._scene is not None and all(isinstance(one, (int, float)) and 0 <= one <= 1 for one in place):
            found = self._scene.pick(*map(float, place))  # type: ignore[arg-type]
            self._send({"picked": found or {}})

    def _paint(self) -> None:
        """Draw the newest result in the tab's scene, which is made for a frame that has just come."""
        client, result, state = self.client, self._painted, self._state
        if client is None or result is None or state is None:
            self._scene = None if client is None else self._scene
            return
        if self._scene is None or self._scene.client is not client:
            self._scene = Scene(client)
        query = None if result.state.own else result.state.query
        lines = [] if query is None else [of for one in PANELS.values() for of in one.lines(result.workspace, query)]
        self._scene.show(replace(result, state=replace(result.state, view=state.view, theme=state.theme)), lines)
        self._send({"scene": "ready"})

    # The open panel.

    def _panel_action(self, name: str) -> Callable[[Mapping[str, Any]], None] | None:
        panel = self._panel
        of_panel, _, action = name.partition(".")
        return panel[1].actions.get(action) if panel is not None and panel[0] == of_panel else None

    def _close_panel(self) -> None:
        if self._panel is not None:
            self._panel[1].close()
            self._panel = None

    def _turn_to_panel(self, name: str) -> None:
        """Make the state's panel the open one, for the state's place and model."""
        if (self._panel[0] if self._panel else "") != name:
            self._close_panel()
            if name:
                self._panel = name, PANELS[name].part(self)

    def _show_panel(self) -> None:
        panel = self._panel
        if panel is not None:
            panel[1].show()

    def _fail_panel(self, error: Exception) -> None:
        if isinstance(error, LPNError):
            self.say(str(error))

    # What is shown.

    def _show(self, state: ScreenState, problems: list[str], new_page: bool = False) -> None:
        """Make a state the newest one."""
        before, self._state = self._state, state
        if new_page or before is None or before.model != state.model or before.task != state.task:
            self._send({"page": self._page(state)})
        self._send({"state": self._choices(state)})
        if problems:
            self._send({"error": problems[0][:1].upper() + problems[0][1:]})
        self._show_rail()
        self._turn_to_panel(state.panel)
        self._panels.wake()
        if new_page or before is None or fields.needs_answer(before, state):
            self._loop.show(state)
        elif (before.view, before.theme) != (state.view, state.theme):
            self._painter.wake()

    def _choices(self, state: ScreenState) -> ScreenMessage:
        workspace = self._of(state).workspace
        address = fields.to_address(state, workspace)
        return state.values() | {"address": address, "query_name": workspace.tasks[state.task].query_names[state.query]}

    def _page(self, state: ScreenState) -> ScreenMessage:
        """Return what stays while a person looks at one model's task."""
        base, workspace = self._of(state).workspace, self._workspace(state)
        task = self._ranking(state).task
        scorings = [name for name in SCORINGS if scored_key(state.task, name) in workspace.rankings]
        return {
            "data": base.data_name,
            "models": [base.model_name, *(other.label for other in base.beside)],
            "places": dict(self._screens.places),
            "tasks": list(base.tasks),
            "scorings": scorings,
            "parts": workspace.contract.n_parts,
            "word": workspace.contract.part_noun,
            "names": workspace.part_names,
            "tiles": task.tiles,
            "photo": _noun(task.query_view, base.has_flight),
            "turns": workspace.model is not None,
            "place": "City" if base.basemap is None else "Map",
            "without_cells": workspace.without_cells,
            "step": STEP,
            "panels": [
                {"name": one.name, "title": one.title, "key": one.key, "place": one.place}
                for one in PANELS.values()
                if one.offered(base)
            ],
        }

    def _show_rail(self) -> None:
        state = self._state
        if state is not None:
            ranking, feeds = self._ranking(state), self._of(state).feeds
            self._send({"rail": self._rail.message(state, self._workspace(state), ranking, feeds)})

    # The analysis.

    def _of(self, state: ScreenState) -> WorkspaceServices:
        """Return what a state's place offers, which is open."""
        return self._screens.services(state.place)

    def _workspace(self, state: ScreenState) -> Workspace:
        """Return the workspace of the state's model, or that of the place until it is open."""
        beside = self._beside(state)
        return self._of(state).workspace if beside is None or beside.workspace is None else beside.workspace

    def _beside(self, state: ScreenState) -> LazyWorkspace | None:
        number = int(state.model)
        return self._of(state).workspace.beside[number - 1] if number else None

    def _opens_model(self, state: ScreenState) -> bool:
        """Wait until the state's model is open; False if it cannot be."""
        beside = self._beside(state)
        if beside is None or beside.workspace is not None:
            return True
        job: BackgroundJob[Workspace] = beside.open()
        while not job.wait(_POLL) and not self._left:
            done = f": {job.done:,} of {job.total:,} pictures" if job.total else ""
            self._send({"busy": f"Opening {beside.label}{done}"})
        if beside.workspace is None:
            self._send({"error": beside.error})
            return False
        return True

    def _ranking(self, state: ScreenState) -> RankingJob:
        workspace = self._workspace(state)
        name = state.task if state.task in workspace.tasks else next(iter(workspace.tasks))
        return workspace.rankings.get(scored_key(name, _scoring(state)), workspace.rankings[workspace.tasks[name].key])

    def _access(self) -> _Opened:
        """Return the newest state's workspace with this tab's access to it."""
        assert self._state is not None
        workspace = self._workspace(self._state)
        with self._lock:
            if workspace not in self._opened:
                requests, background = RequestContext(workspace.inference), RequestContext(workspace.inference)
                analyser = StateAnalyser(workspace, requests.queued(workspace.model))
                self._opened[workspace] = _Opened(workspace, requests, background, analyser)
            return self._opened[workspace]

    def _requests(self) -> RequestContext:
        return self._access().requests

    def _answer(self, state: ScreenState) -> ScreenMessage:
        services, opened = self._of(state), self._access()
        own = self._own.get(state.own)
        analysis = opened.analyser.analyse(
            _as_session_state(state, opened.workspace, None if own is None else own[0]), STRIP
        )
        address = f"{services.feeds.pictures(analysis.task, 'query')}{state.query}" if own is None else own[1]
        scale = self._screens.scale(analysis.task)
        result = ScreenResult(opened.workspace, services.feeds, state, analysis, scale, address)
        key = self._curve_key(state, analysis)
        if state.angle % STEP == 0 and opened.workspace.model is not None:
            self._screens.held.get((key, int(state.angle)), lambda: analysis.query.descriptor)
        self._analysed = state, analysis
        self._number += 1
        marks = [] if own else [one.mark(services.workspace, state.query) for one in PANELS.values()]
        message = result.message() | {"scene": views_of(result), "number": self._number, "marks": marks}
        self._painted = result
        self._panels.wake()
        return message | {"state": state.values(), "curve": _digest(key, state)}

    def _after(self, state: ScreenState) -> None:
        """Begin what goes on behind an answer: the scene, the ranking of all queries, the curve, and the occlusion."""
        self._painter.wake()
        ranking = self._ranking(state)
        self._progress.follow(ranking)
        assert self._analysed is not None
        shown, analysis = self._analysed
        opened = self._access()
        model = opened.background.queued(opened.workspace.model, background=True)
        if shown is not state or model is None:
            self._curve.follow(None, "")
            self._occlusion.follow(None)
            return
        index = None if state.own else state.query
        change = replace(SessionState(state.task, 1).change, weather=opened.workspace.weather)
        change = change.for_picture(analysis.task.queries[index], analysis.zoom) if index is not None else change
        key = self._curve_key(state, analysis)
        scored = opened.workspace.scored_model(model, analysis.task)
        turning = Turning(key, analysis.task, analysis.source, change, index, state.weights or None, scored)
        self._curve.follow(turning, _digest(key, state))
        covering = None
        if state.heat == "occlusion" and (result := self._painted) is not None:
            covering = Covering((key, state.angle, result.first.index), self._number, result, scored)
        self._occlusion.follow(covering)

    def _curve_key(self, state: ScreenState, analysis: StateAnalysis) -> tuple[object, ...]:
        return state.place, state.model, analysis.task.key, state.own or state.query


def _as_session_state(state: ScreenState, workspace: Workspace, own: OwnPicture | None) -> SessionState:
    return SessionState(
        state.task,
        workspace.contract.n_parts,
        query=state.query,
        upload=own,
        angle=state.angle,
        weights=state.weights,
        scoring=_scoring(state),
        selected=state.compare,
    )


def _digest(key: tuple[object, ...], state: ScreenState) -> str:
    """Return a text that names a photo and the part weights, by which the page knows the curve of a result."""
    return repr((key, state.weights))


def _scoring(state: ScreenState) -> Any:
    return state.scoring


def _noun(view: str, of_flight: bool) -> str:
    return {"drone": "photo", "street": "panorama", "satellite": "tile"}[view] if not of_flight else "photo"
