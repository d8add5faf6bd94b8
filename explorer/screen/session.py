"""The session of one tab: its state, the changes by messages, and the messages sent back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any
from urllib.parse import quote

import viser

from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.cache import SingleFlightCache
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
from explorer.screen.panels import PANELS, scripted
from explorer.screen.rail import Rail, listed_queries
from explorer.screen.result import STRIP, BarScale, ScreenResult, measured_scale
from explorer.screen.scene.scene import views_of
from explorer.screen.scene.tab import TabScene
from explorer.workspace import Workspace
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.descriptors.transforms import Change
from lpn.library.answer import Answer
from lpn.tasks.task import SCORINGS, Task, scored_key

# Seconds between two looks at an unfinished ranking.
_POLL = 0.5
# The panels' commands by the names of their actions, each with its panel.
_COMMANDS = {f"{panel.name}.{one.name}": (panel, one) for panel in PANELS.values() for one in panel.commands}


class Screens:
    """The state that all tabs share.

    Args:
        workspace: returns an open workspace by its key.
        home: key of the workspace of a page without an address.
        places: labels of all workspaces by their keys.
        opening: returns the job that opens a workspace by its key; None if it is open.
    """

    def __init__(
        self,
        workspace: Callable[[str], Workspace],
        home: str,
        places: Mapping[str, str],
        opening: Callable[[str], BackgroundJob[Workspace] | None] = lambda _: None,
    ) -> None:
        self.workspace, self.home, self.places, self.opening = workspace, home, places, opening
        self._scales = SingleFlightCache[Task, BarScale](32)
        self.held = held_descriptors()
        self.own = OwnPhotoBytes()

    def scale(self, task: Task) -> BarScale:
        """Return the ends of all bars of a task, measured once."""
        return self._scales.get(task, lambda: measured_scale(task))

    def session(self, send: Callable[[ScreenMessage], None]) -> ScreenSession:
        """Return the session of a new tab."""
        return ScreenSession(self, send)


class ScreenSession:
    """One tab. Messages, panels, and ended jobs change it one by one, under its lock.

    Attributes:
        scene: the tab's scene.

    Args:
        send: hands a message to the page, from any thread.
    """

    def __init__(self, screens: Screens, send: Callable[[ScreenMessage], None]) -> None:
        self._screens, self._send = screens, send
        self._access = Access(screens.workspace)
        self._state: ScreenState | None = None
        self._result: ScreenResult | None = None
        self._number, self._left, self._lock = 0, False, threading.RLock()
        # The wait before the newest request can be shown: its job, a sentence, and its handlers of success and failure.
        self._awaited: tuple[BackgroundJob[Any], str, tuple[Callable[[], None], Callable[[], None]]] | None = None
        self._awaiting = Worker(self._await)
        self._loop = Loop(self._answer, self._deliver, lambda: self._access.opened(self.state).requests, self._after)
        # Work after an answer.
        self._rail, self._listed, self._listing = Rail(), False, threading.Lock()
        self._ranked: RankingJob | None = None
        # The state at the request for the missed queries, if they were not ranked yet; else None.
        self._unlisted: ScreenState | None = None
        self._ranks = Worker(self._rank)
        self._curve, self._occlusion = Curve(send, screens.held), Occlusion(send)
        self._own = OwnPhotos(screens.own, send)
        self.scene = TabScene(send, _lines)
        # The open panel, whose work has a thread of its own.
        self._panel: tuple[str, PanelPart] | None = None
        self._panels = Worker(self._show_panel, self._fail_panel)
        self._downloads = Downloads(send)
        # The feeds that have served files of this tab.
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
        }

    # The interface of panels, see `Tab`.

    @property
    def state(self) -> ScreenState:
        """The newest state."""
        assert self._state is not None
        return self._state

    @property
    def result(self) -> ScreenResult | None:
        """The newest result; None before the first result for the state's place, task, and model."""
        result = self._result
        return None if result is None or not fields.same_page(result.state, self.state) else result

    @property
    def base(self) -> Workspace:
        """The workspace of the state's place."""
        return self._access.base(self.state)

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
        """The request context for background work."""
        return self._access.opened(self.state).background

    def set(self, values: Mapping[str, object]) -> None:
        """Set fields of the state as the page does."""
        with self._lock:
            state, place = self.state, values.get("place")
            if isinstance(place, str) and place != state.place and place in self._screens.places:
                text = f"Opening {self._screens.places[place]}"
                self._once(self._screens.opening(place), text, lambda: self._go_to(place))
                return
            changed, problems = fields.changed(state, values, self.base)
            opening = self._access.opening(changed) if changed.model != state.model else None
            if opening is not None:  # weights need an open model
                self._once(opening, self._opening(changed), lambda: self.set(values))
                return
            if "place" in values or "model" in values:  # this choice replaces a place or model that is being opened
                self._forgo()
            if changed.own and changed.own not in self._own:
                changed = replace(changed, own="")
            changed = self._with_photo_of_list(state, changed)
            self._show(changed, problems)

    def _with_photo_of_list(self, before: ScreenState, state: ScreenState) -> ScreenState:
        """Show the worst missed query when the missed ones are listed; close a panel over the rings if the photo changes."""
        if state.filter == "missed" != before.filter and not state.own:
            self._unlisted = state if self._access.ranking(state).result is None else None
            state = self._at_missed(state)
        moved = (before.query, before.own) != (state.query, state.own)
        covers = state.panel == before.panel != "" and PANELS[state.panel].place == "page"
        return replace(state, panel="") if moved and covers else state

    def _at_missed(self, state: ScreenState) -> ScreenState:
        """Show the worst missed query unless a missed one is shown."""
        missed = listed_queries(state, self._access.workspace(state), self._access.ranking(state)).tolist()
        if not missed or state.query in missed:
            return state
        return fields.changed(state, {"query": missed[0]}, self.base)[0]

    def send(self, message: ScreenMessage) -> None:
        """Send a message to the open panel's module."""
        self.append("", message)

    def append(self, kind: str, message: ScreenMessage) -> None:
        """Send a message; it replaces a waiting message of the same kind only."""
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
        feeds = self.base.feeds
        self._feeds.add(feeds)
        self._downloads.make(title, make, feeds, self)

    # The interface of the channel.

    def receive(self, message: object) -> None:
        """Handle a message: `set` fields of the state, or `do` an action; anything else changes nothing."""
        if self._left:
            return
        match message:
            case {"set": dict(values)} if self._state is not None:
                self.set(values)
            case {"do": str(name), **rest}:
                arguments = rest.get("args")
                with self._lock:
                    self._do(name, arguments if isinstance(arguments, dict) else None)

    def _do(self, name: str, arguments: Mapping[str, Any] | None) -> None:
        """Run an action of the page or of the open panel with its arguments, or a panel's command."""
        if name in self._actions and arguments is not None:
            if name == "open" or self._state is not None:
                self._actions[name](arguments)
        elif name in _COMMANDS and self._state is not None:
            panel, command = _COMMANDS[name]
            base = self.base
            if panel.offered(base) and command.offered(base):
                self._try(lambda: command.act(self))
        elif (action := self._panel_action(name)) is not None and arguments is not None:
            self._try(lambda: action(arguments))
        else:
            self.say(f"There is no action {printable(name)[:40]}.")

    def receive_bytes(self, part: bytes) -> None:
        """Take a part of the file that `upload` announced; the first photo of several is shown."""
        with self._lock:
            if self._state is None or self._left:
                return
            if self.base.model is None:
                self._own.refuse("Saved descriptors cannot describe a photo of yours; open the data set with a model.")
            key = self._own.receive(part)
            self._send(self._own.message(self.base.feeds))
            if key is not None:
                self.set({"own": key})

    @property
    def client(self) -> viser.ClientHandle | None:
        """The client of viser whose page is the tab's scene; None without one."""
        return self.scene.client

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in the scene of a viser client from now on; None once the client has left."""
        self.scene.attach(client)

    def leave(self) -> None:
        """Stop all work for this tab: it has left."""
        self._left = True
        workers = self._loop, self._curve, self._occlusion, self.scene, self._panels, self._ranks, self._awaiting
        for one in workers:
            one.stop()
        self._access.close()
        self._forgo()  # without the lock: a message in progress must not delay the end
        self._downloads.close()
        self._close_panel()
        self._own.leave()
        if self._ranked is not None:
            self._ranked.leave(self)
        for feeds in list(self._feeds):
            feeds.leave(self)
        if self._state is not None:
            self.base.feeds.leave(self._rail)

    # Messages.

    def _open(self, arguments: Mapping[str, Any]) -> None:
        """Show the state of an address; a page that shows something keeps place and theme unless the address has them."""
        search, before, screens = arguments.get("search"), self._state, self._screens
        given = fields.parsed(search) if isinstance(search, str) else {}
        place = given.get("show", "")
        if place not in screens.places:
            place = screens.home if before is None else before.place
        failed = partial(self._open_at, screens.home, given) if before is None else lambda: None
        text = f"Opening {screens.places[place]}"
        self._once(screens.opening(place), text, partial(self._open_at, place, given), failed)

    def _open_at(self, place: str, given: Mapping[str, str]) -> None:
        """Show the state of an address's values at an open place, once its model is open."""
        workspace = self._screens.workspace(place)
        if self._state is not None:
            given = {"theme": self._state.theme} | dict(given)
        state = replace(fields.from_values(given, workspace)[0], place=workspace.key)
        without = {key: value for key, value in given.items() if key != "model"}
        show, show_without = (partial(self._show_address, workspace, values) for values in (given, without))
        self._once(self._access.opening(state), self._opening(state), show, show_without)

    def _show_address(self, workspace: Workspace, given: Mapping[str, str]) -> None:
        state, problems = fields.from_values(given, workspace)
        state = replace(state, place=workspace.key)  # the address's place may fail to open
        before = self._state
        moved = before is None or before.place != state.place
        if before is not None and moved:
            self._leave_place()
        self._show(state, problems, new_page=moved)

    def _go_to(self, place: str) -> None:
        """Show another place, which is open; an own photo stays shown."""
        state, workspace = self.state, self._screens.workspace(place)
        self._leave_place()
        own = "" if workspace.model is None else state.own
        self._show(replace(fields.opening(workspace), theme=state.theme, view=state.view, own=own), [], new_page=True)

    # Waits for opening.

    def _opening(self, state: ScreenState) -> str:
        return f"Opening {self._access.base(state).models[int(state.model)].label}"

    def _once(
        self,
        job: BackgroundJob[Any] | None,
        text: str,
        done: Callable[[], None],
        failed: Callable[[], None] = lambda: None,
    ) -> None:
        """Call `done` or `failed` after a job, or `done` at once without a job; a newer request replaces a waiting one.

        Args:
            text: names the job's work.
            done, failed: called after success, and after the report of a failure.
        """
        self._forgo(job)
        if job is None:
            self._try(done)
            return
        self._send({"busy": text})
        self._awaited = job, text, (done, failed)
        self._awaiting.wake()

    def _forgo(self, job: BackgroundJob[Any] | None = None) -> None:
        """Stop the current wait, unless it is for `job`."""
        awaited, self._awaited = self._awaited, None
        if awaited is not None and awaited[0] is not job:
            awaited[0].leave(self)

    def _await(self) -> float | None:
        awaited = self._awaited
        if awaited is None:
            return None
        job, text, (done, failed) = awaited
        ended = job.wait(_POLL)
        with self._lock:
            if self._awaited is not awaited:  # a newer request has come
                return 0.0
            if not ended:
                counted = f": {job.done:,} of {job.total:,} pictures" if job.total else ""
                self._send({"busy": f"{text}{counted}"})
                return 0.0
            self._forgo()
            if job.error is not None:
                self.say(job.error)
            self._try(done if job.error is None else failed)
        return None

    def _leave_place(self) -> None:
        """End the work for the old place. The panel closes, too, because the new place may have a panel of equal name."""
        self._close_panel()
        self.base.feeds.leave(self._rail)
        self._rail = Rail()

    def _step(self, arguments: Mapping[str, Any]) -> None:
        by = -1 if arguments.get("by") == -1 else 1
        state = self.state
        own = self._own.step(state.own, by) if state.own else ""
        if own or (state.own and by < 0):
            self.set({"own": own or state.own})
        elif (query := state.query if state.own else self._rail.step(state.query, by)) is not None:
            self.set({"query": query})

    def _random(self, _: Mapping[str, Any]) -> None:
        query = self._rail.random(self.state.query)
        if query is not None:
            self.set({"query": query})

    def _upload(self, arguments: Mapping[str, Any]) -> None:
        self._own.announce(arguments)
        self._send(self._own.message(self.base.feeds))

    def _forget(self, _: Mapping[str, Any]) -> None:
        self.set({"own": ""})
        self._own.forget()
        self._send(self._own.message(self.base.feeds))

    def _calibrate(self, _: Mapping[str, Any]) -> None:
        """Prepare the further scorings of the state's model, and show the calibrated one."""
        job = self.workspace.scorings.prepare(self)
        if job is None:
            self.say(self.workspace.scorings.why_not)
        else:
            self._once(job, "Calibrating", self._show_calibrated)

    def _show_calibrated(self) -> None:
        state, problems = fields.changed(self.state, {"scoring": "calibrated"}, self.base)
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
        """Open the state's panel; it closes with its place."""
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

    # Display.

    def _show(self, state: ScreenState, problems: list[str], new_page: bool = False) -> None:
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
            self._send(self._own.message(self.base.feeds))
        else:
            self._show_rail()
        self._turn_to_panel(state.panel)
        self._panels.wake()

    def _choices(self, state: ScreenState) -> ScreenMessage:
        """Return the state for the page, with its address and the address of its photo's picture."""
        address = fields.to_address(state, self._access.base(state))
        if state.place != self._screens.home:
            address = f"show={quote(state.place)}&{address}"
        return state.values() | {
            "address": address,
            "photo": self._photo(state),
        }

    def _photo(self, state: ScreenState) -> str:
        feeds, task = self._access.base(state).feeds, self._access.ranking(state).task
        return self._own.address(feeds, state.own) if state.own else f"{feeds.pictures(task, 'query')}{state.query}"

    def _page(self, state: ScreenState) -> ScreenMessage:
        """Return the values that stay the same while the user looks at one task of one model."""
        base, workspace = self._access.base(state), self._access.workspace(state)
        task = self._access.ranking(state).task
        scorings = [name for name in SCORINGS if scored_key(state.task, name) in workspace.rankings]
        return {
            "models": [one.label for one in base.models],
            "places": dict(self._screens.places),
            "tasks": list(base.tasks),
            "scorings": scorings,
            "calibrates": workspace.scorings.prepares,
            "parts": workspace.contract.n_parts,
            "word": workspace.contract.part_noun,
            "names": workspace.part_names,
            "tiles": task.tiles,
            "photo": _noun(task.query_view, base.flight is not None),
            "turns": workspace.model is not None,
            "place": "City" if base.basemap is None else "Map",
            "panels": [
                {"name": one.name, "title": one.title, "key": one.key, "place": one.place, "script": scripted(one.name)}
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
                ranking, feeds = access.ranking(state), access.base(state).feeds
                self._send({"rail": self._rail.message(state, access.workspace(state), ranking, feeds)})

    def _rank(self) -> float | None:
        """Wait for the ranking of the state's task, which goes on while a tab waits; then mark the rail."""
        ranking = self.ranking
        if self._ranked not in (None, ranking):
            self._ranked.leave(self)
        self._ranked = ranking
        if ranking.result is not None or ranking.error:
            return None
        if not ranking.join(self).wait(_POLL):
            return 0.0
        self._show_rail()
        with self._lock:
            state, before = self.state, self._unlisted
            if before is not None and (state.filter, state.query, state.own) == ("missed", before.query, before.own):
                self._show(self._at_missed(state), [])
            self._unlisted = None
        return None

    # The analysis.

    def _deliver(self, message: ScreenMessage) -> None:
        """Send a message of the loop. The rail comes after the first result, because its thumbnails would delay the result."""
        self._send(message)
        if not self._listed:
            self._show_rail()

    def _answer(self, state: ScreenState) -> ScreenMessage:
        base, workspace = self._access.base(state), self._access.workspace(state)
        own = self._own.find(state.own)
        if own is None:  # the photo may have been forgotten
            state = replace(state, own="")
        question = state.question(own)
        analysis = self._access.opened(state).analyser.analyse(self._access.ranking(state).task, question, STRIP)
        scale = self._screens.scale(analysis.task)
        result = ScreenResult(workspace, base.feeds, state, question, analysis, scale, self._photo(state))
        key = _curve_key(state, analysis)
        if state.angle % STEP == 0 and workspace.model is not None:
            self._screens.held.get((key, int(state.angle)), lambda: analysis.query.descriptor)
        self._number += 1
        marks = [] if state.own else [one.mark(base, state.query) for one in PANELS.values()]
        message = result.message() | {"scene": views_of(result), "number": self._number, "marks": marks}
        message["beside"] = [] if state.own or state.angle else self._access.ranks_beside(state)
        self._result = result
        self.scene.take(result, self.state)
        return message | {"state": state.values(), "curve": _digest(key, state)}

    def _after(self, _: ScreenState) -> None:
        """Begin the work after an answer."""
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
    """Return the name of a photo under part weights, by which the page assigns a curve to a result."""
    return repr((key, state.weights))


def _noun(view: str, of_flight: bool) -> str:
    return {"drone": "photo", "street": "panorama", "satellite": "tile"}[view] if not of_flight else "photo"


def _lines(result: ScreenResult) -> list[SceneLines]:
    state = result.state
    return [] if state.own else [of for one in PANELS.values() for of in one.lines(result.workspace, state.query)]
