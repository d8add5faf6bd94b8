"""The session of one tab: its state, what a message changes, and what is sent back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any
from urllib.parse import quote

import viser

from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import Worker
from explorer.feeds import Feeds
from explorer.screen import fields
from explorer.screen.access import Access
from explorer.screen.curve import STEP, Curve, Turning, held_descriptors
from explorer.screen.downloads import Downloads, MakeFile
from explorer.screen.fields import ScreenState
from explorer.screen.loop import Loop, ScreenMessage
from explorer.screen.occlusion import Covering, Occlusion
from explorer.screen.own import OwnPhotoBytes, OwnPhotos
from explorer.screen.panel import Action, PanelPart, SceneLines
from explorer.screen.panels import PANELS
from explorer.screen.rail import Rail
from explorer.screen.result import ScreenResult, measured_scale
from explorer.screen.scene.scene import views_of
from explorer.screen.scene.tab import TabScene
from explorer.services import WorkspaceServices
from explorer.workspace import Workspace
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.descriptors.transforms import Change
from lpn.library.answer import Answer
from lpn.tasks.task import SCORINGS, scored_key

# Seconds between two looks at a ranking that goes on.
_POLL = 0.5
# The panels' commands by the actions that the page asks for, each with its panel.
_COMMANDS = {f"{panel.name}.{one.name}": (panel, one) for panel in PANELS.values() for one in panel.commands}


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
        self.own = OwnPhotoBytes()

    def session(self, send: Callable[[ScreenMessage], None]) -> ScreenSession:
        """Return the session of a new tab."""
        return ScreenSession(self, send)


class ScreenSession:
    """One tab. Messages come from one thread at a time.

    Attributes:
        scene: of the tab.

    Args:
        send: hands a message to the page, from any thread.
    """

    def __init__(self, screens: Screens, send: Callable[[ScreenMessage], None]) -> None:
        self._screens, self._send = screens, send
        self._access = Access(screens.services)
        self._state: ScreenState | None = None
        self._result: ScreenResult | None = None
        self._number, self._left = 0, False
        self._loop = Loop(self._answer, self._deliver, lambda: self._access.opened(self.state).requests, self._after)
        # What goes on behind an answer.
        self._rail, self._listed, self._listing = Rail(), False, threading.Lock()
        self._ranked: RankingJob | None = None
        self._ranks = Worker(self._rank, lambda _: None)
        self._curve, self._occlusion = Curve(send, screens.held), Occlusion(send)
        self._own = OwnPhotos(screens.own, send)
        self.scene = TabScene(send, _lines)
        # The open panel, whose work has a thread of its own.
        self._panel: tuple[str, PanelPart] | None = None
        self._panels = Worker(self._show_panel, self._fail_panel)
        self._downloads = Downloads(send)
        # Those that serve its files, of all places that it has shown.
        self._feeds: set[Feeds] = set()
        self._actions: Mapping[str, Action] = {
            "open": self._open,
            "step": self._step,
            "random": self._random,
            "upload": self._upload,
            "forget": self._forget,
            "calibrate": self._calibrate,
            "hover": self.scene.hover,
            "pick": self.scene.pick,
            "scene": self.scene.draw,
            "still": self.scene.still,
        }

    # What panels use, see `Tab`.

    @property
    def state(self) -> ScreenState:
        """The newest state."""
        assert self._state is not None
        return self._state

    @property
    def result(self) -> ScreenResult | None:
        """The newest result; None before the first of the state's place, task, and model."""
        result = self._result
        return None if result is None or not fields.same_page(result.state, self.state) else result

    @property
    def services(self) -> WorkspaceServices:
        """The services of the state's place."""
        return self._access.services(self.state)

    @property
    def workspace(self) -> Workspace:
        """The workspace of the state's model."""
        return self._access.workspace(self.state)

    @property
    def ranking(self) -> RankingJob:
        """The ranking of the state's task."""
        return self._access.ranking(self.state)

    @property
    def background(self) -> RequestContext:
        """Access to the network behind what a person waits for."""
        return self._access.opened(self.state).background

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

    def note(self, text: str) -> None:
        """Show a sentence for some seconds in place of the headline's reason."""
        self._send({"note": text})

    def download(self, title: str, make: MakeFile) -> None:
        """Make a file on a thread of its own, and have the browser save it."""
        feeds = self.services.feeds
        self._feeds.add(feeds)
        self._downloads.make(title, make, feeds, self)

    # What the channel uses.

    def receive(self, message: object) -> None:
        """Do what a message says: `set` fields of the state, or `do` an action; anything else changes nothing."""
        match message:
            case {"set": dict(values)} if self._state is not None:
                self._set(values)
            case {"do": str(name), "args": dict(arguments)} if name in self._actions:
                if name == "open" or self._state is not None:
                    self._actions[name](arguments)
            case {"do": str(name)} if name in _COMMANDS and self._state is not None:
                panel, command = _COMMANDS[name]
                base = self.services.workspace
                if panel.offered(base) and command.offered(base):
                    self._try(lambda: command.act(self))
            case {"do": str(name), "args": dict(arguments)} if (action := self._panel_action(name)) is not None:
                self._try(lambda: action(arguments))
            case {"do": str(name)}:
                self.say(f"There is no action {printable(name)[:40]}.")

    def receive_bytes(self, part: bytes) -> None:
        """Take a part of the file that `upload` announced; the first photo of several is shown."""
        if self._state is None:
            return
        if self.services.workspace.model is None:
            self._own.refuse("Saved descriptors cannot describe a photo of yours; open the data set with a model.")
        key = self._own.receive(part)
        self._send(self._own.message(self.services.feeds))
        if key is not None:
            self._set({"own": key})

    @property
    def client(self) -> viser.ClientHandle | None:
        """The client of viser whose page is the tab's scene; None without one."""
        return self.scene.client

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in a frame of viser's page from now on; None once it has gone."""
        self.scene.attach(client)

    def leave(self) -> None:
        """Stop all that goes on for this tab: it has left."""
        self._left = True
        for one in (self._loop, self._curve, self._occlusion, self.scene, self._panels, self._ranks):
            one.stop()
        self._downloads.close()
        self._close_panel()
        self._access.close()
        self._own.leave()
        if self._ranked is not None:
            self._ranked.leave(self)
        for feeds in list(self._feeds):
            feeds.leave(self)
        if self._state is not None:
            self.services.feeds.leave(self._rail)

    # What messages do.

    def _open(self, arguments: Mapping[str, Any]) -> None:
        """Show the state of an address; a page that shows something keeps its place and theme where the address has none."""
        search, before = arguments.get("search"), self._state
        given = fields.parsed(search) if isinstance(search, str) else {}
        place = given.get("show", "")
        if place not in self._screens.places:
            place = self._screens.home if before is None else before.place
        if before is not None and place != before.place:
            self._send({"busy": f"Opening {self._screens.places[place]}"})
        try:
            services = self._screens.services(place)
        except LPNError as error:
            self.say(str(error))
            if before is not None:
                return
            services = self._screens.services(self._screens.home)
        if before is not None:
            given = {"theme": before.theme} | given
        state, problems = fields.from_values(given, services.workspace)
        if not self._opens_model(replace(state, place=services.workspace.key)):
            del given["model"]
        state, problems = fields.from_values(given, services.workspace)  # weights are those of an open model
        state = replace(state, place=services.workspace.key)  # not that of the address if it does not open
        moved = before is None or before.place != state.place
        if before is not None and moved:
            self._leave_place()
        self._show(state, problems, new_page=moved)

    def _set(self, values: Mapping[str, Any]) -> None:
        state, place = self.state, values.get("place")
        if isinstance(place, str) and place != state.place and place in self._screens.places:
            self._go_to(place)
            return
        changed, problems = fields.changed(state, values, self.services.workspace)
        if changed.model != state.model:
            if not self._opens_model(changed):
                return
            changed, problems = fields.changed(
                state, values, self.services.workspace
            )  # weights are those of an open model
        if changed.own and changed.own not in self._own:
            changed = replace(changed, own="")
        self._show(changed, problems)

    def _go_to(self, place: str) -> None:
        """Open another place, where an own photo is shown on."""
        state = self.state
        self._send({"busy": f"Opening {self._screens.places[place]}"})
        try:
            workspace = self._screens.services(place).workspace
        except LPNError as error:
            self.say(str(error))
            return
        self._leave_place()
        own = "" if workspace.model is None else state.own
        self._show(replace(fields.opening(workspace), theme=state.theme, view=state.view, own=own), [], new_page=True)

    def _leave_place(self) -> None:
        """Close what belongs to the place that is left, such as its panel: the next place may have one of the same name."""
        self._close_panel()
        self.services.feeds.leave(self._rail)
        self._rail = Rail()

    def _opens_model(self, state: ScreenState) -> bool:
        """Wait until a state's model is open; False if it cannot be, which is said."""
        try:
            self._access.open_model(state, lambda text: self._send({"busy": text}))
        except LPNError as error:
            self.say(str(error))
            return False
        return True

    def _step(self, arguments: Mapping[str, Any]) -> None:
        by = -1 if arguments.get("by") == -1 else 1
        state = self.state
        own = self._own.step(state.own, by) if state.own else ""
        if own or (state.own and by < 0):
            self._set({"own": own or state.own})
        elif (query := state.query if state.own else self._rail.step(state.query, by)) is not None:
            self._set({"query": query})

    def _random(self, _: Mapping[str, Any]) -> None:
        query = self._rail.random(self.state.query)
        if query is not None:
            self._set({"query": query})

    def _upload(self, arguments: Mapping[str, Any]) -> None:
        self._own.announce(arguments)
        self._send(self._own.message(self.services.feeds))

    def _forget(self, _: Mapping[str, Any]) -> None:
        self._set({"own": ""})
        self._own.forget()
        self._send(self._own.message(self.services.feeds))

    def _calibrate(self, _: Mapping[str, Any]) -> None:
        """Prepare the further scorings of the state's model, which may describe all pictures, and show the calibrated one."""
        job = self.workspace.scorings.prepare(self)
        while job is not None and not job.wait(_POLL) and not self._left:
            done = f": {job.done:,} of {job.total:,} pictures" if job.total else ""
            self._send({"busy": f"Calibrating{done}"})
        if job is not None:
            job.leave(self)
        if job is None or job.error is not None:
            self.say(self.workspace.scorings.why_not if job is None else str(job.error))
        elif not self._left:
            state, problems = fields.changed(self.state, {"scoring": "calibrated"}, self.services.workspace)
            self._show(state, problems, new_page=True)

    # Panels' commands, and the open panel.

    def _try(self, act: Callable[[], None]) -> None:
        try:
            act()
        except LPNError as error:
            self.say(str(error))

    def _panel_action(self, name: str) -> Callable[[Mapping[str, Any]], None] | None:
        panel = self._panel
        of_panel, _, action = name.partition(".")
        return panel[1].actions.get(action) if panel is not None and panel[0] == of_panel else None

    def _close_panel(self) -> None:
        panel, self._panel = self._panel, None
        if panel is not None:
            panel[1].close()

    def _turn_to_panel(self, name: str) -> None:
        """Make the state's panel the open one; it ends with its place."""
        if (self._panel[0] if self._panel else "") != name:
            self._close_panel()
            part = PANELS[name].part if name else None
            if part is not None:
                self._panel = name, part(self)

    def _show_panel(self) -> float | None:
        panel = self._panel
        return None if panel is None else panel[1].show()

    def _fail_panel(self, error: Exception) -> None:
        if isinstance(error, LPNError):
            self.say(str(error))

    # What is shown.

    def _show(self, state: ScreenState, problems: list[str], new_page: bool = False) -> None:
        """Make a state the newest one."""
        before, self._state = self._state, state
        message: ScreenMessage = {"state": self._choices(state)}
        if new_page or before is None or not fields.same_page(before, state):
            message = {"page": self._page(state)} | message
        self._send(message)
        if new_page or before is None or fields.needs_answer(before, state):
            self._loop.show(state)
        elif (before.view, before.theme) != (state.view, state.theme) and (result := self.result) is not None:
            self.scene.take(result, state)
            self.scene.draw()
        if problems:
            self.say(problems[0][:1].upper() + problems[0][1:])
        if new_page:
            self._listed = False
            self._send(self._own.message(self.services.feeds))
        else:
            self._show_rail()
        self._turn_to_panel(state.panel)
        self._panels.wake()

    def _choices(self, state: ScreenState) -> ScreenMessage:
        """Return the state as the page takes it, with its address, and that of its photo's picture."""
        services = self._access.services(state)
        task, address = services.workspace.tasks[state.task], fields.to_address(state, services.workspace)
        if state.place != self._screens.home:
            address = f"show={quote(state.place)}&{address}"
        return state.values() | {
            "address": address,
            "query_name": task.query_names[state.query],
            "photo": self._photo(state),
        }

    def _photo(self, state: ScreenState) -> str:
        feeds, task = self._access.services(state).feeds, self._access.ranking(state).task
        return self._own.address(feeds, state.own) if state.own else f"{feeds.pictures(task, 'query')}{state.query}"

    def _page(self, state: ScreenState) -> ScreenMessage:
        """Return what stays while a person looks at one model's task."""
        base, workspace = self._access.services(state).workspace, self._access.workspace(state)
        task = self._access.ranking(state).task
        scorings = [name for name in SCORINGS if scored_key(state.task, name) in workspace.rankings]
        return {
            "data": base.data_name,
            "models": [base.model_name, *(other.label for other in base.beside)],
            "places": dict(self._screens.places),
            "tasks": list(base.tasks),
            "scorings": scorings,
            "calibrates": workspace.scorings.prepares,
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
                if one.part is not None and one.offered(base)
            ],
            "commands": [
                {"name": name, "title": one.title, "key": one.key}
                for name, (panel, one) in _COMMANDS.items()
                if panel.offered(base) and one.offered(base)
            ],
        }

    def _show_rail(self) -> None:
        access = self._access
        with self._listing:
            if (state := self._state) is not None:
                self._listed = True
                ranking, feeds = access.ranking(state), access.services(state).feeds
                self._send({"rail": self._rail.message(state, access.workspace(state), ranking, feeds)})

    def _rank(self) -> float | None:
        """Wait for the ranking of the state's task, which goes on as long as a tab waits; then the rail shows its marks."""
        ranking = self.ranking
        if self._ranked not in (None, ranking):
            self._ranked.leave(self)
        self._ranked = ranking
        if ranking.result is not None or ranking.error:
            return None
        if not ranking.join(self).wait(_POLL):
            return 0.0
        self._show_rail()
        return None

    # The analysis.

    def _deliver(self, message: ScreenMessage) -> None:
        """Send what the loop has for the page; the first list comes after it, as thumbnails would delay a result."""
        self._send(message)
        if not self._listed:
            self._show_rail()

    def _answer(self, state: ScreenState) -> ScreenMessage:
        services, workspace = self._access.services(state), self._access.workspace(state)
        own = self._own.find(state.own)
        if own is None:  # it may have been forgotten
            state = replace(state, own="")
        question = state.question(own)
        analysis = self._access.analyse(state, question)
        scale = self._screens.scale(analysis.task)
        result = ScreenResult(workspace, services.feeds, state, question, analysis, scale, self._photo(state))
        key = _curve_key(state, analysis)
        if state.angle % STEP == 0 and workspace.model is not None:
            self._screens.held.get((key, int(state.angle)), lambda: analysis.query.descriptor)
        self._number += 1
        marks = [] if state.own else [one.mark(services.workspace, state.query) for one in PANELS.values()]
        message = result.message() | {"scene": views_of(result), "number": self._number, "marks": marks}
        message["beside"] = [] if state.own or state.angle else self._access.ranks_beside(state)
        self._result = result
        self.scene.take(result, self.state)
        return message | {"state": state.values(), "curve": _digest(key, state)}

    def _after(self, _: ScreenState) -> None:
        """Begin what goes on behind an answer."""
        result = self._result
        assert result is not None
        state = result.state
        self.scene.draw()
        self._panels.wake()
        self._ranks.wake()
        opened, analysis = self._access.opened(state), result.analysis
        self._own.check(opened.workspace.own_photos, result.own, analysis)
        model = opened.background.queued(opened.workspace.model, background=True)
        if model is None:
            self._curve.follow(None, "")
            return
        index = None if state.own else state.query
        change = Change(weather=opened.workspace.weather)
        change = change.for_picture(analysis.task.queries[index], analysis.zoom) if index is not None else change
        key = _curve_key(state, analysis)
        scored = opened.workspace.scored_model(model, analysis.task)
        turning = Turning(
            key,
            analysis.task,
            analysis.source,
            change,
            index,
            state.weights or None,
            scored,
            opened.workspace.described_query,
        )
        self._curve.follow(turning, _digest(key, state))
        covering = None
        if state.heat == "occlusion":
            covering = Covering((key, state.angle, result.first.index), self._number, result, scored)
        self._occlusion.follow(covering)


def _curve_key(state: ScreenState, analysis: Answer) -> tuple[object, ...]:
    return state.place, state.model, analysis.task.key, state.own or state.query


def _digest(key: tuple[object, ...], state: ScreenState) -> str:
    """Return a text that names a photo and the part weights, by which the page knows the curve of a result."""
    return repr((key, state.weights))


def _noun(view: str, of_flight: bool) -> str:
    return {"drone": "photo", "street": "panorama", "satellite": "tile"}[view] if not of_flight else "photo"


def _lines(result: ScreenResult) -> list[SceneLines]:
    """Return what the panels add to the scene of a result."""
    state = result.state
    return [] if state.own else [of for one in PANELS.values() for of in one.lines(result.workspace, state.query)]
