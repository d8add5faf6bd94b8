"""The controls of one browser: they read into a `SessionState`, and show an `Answer`. Nothing is computed here."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any, cast

import viser
from viser import UploadedFile

from explorer import session_state, uploads
from explorer.panels import pages
from explorer.session_state import SessionState, StateChange
from explorer.stage.cards import SHOWN
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Task, Workspace
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError

THUMBS = 12
LEFT, RIGHT, NARROW = 290, 370, 330
"""Pixels of the panels' widths; NARROW is the right one's where the left one is folded to a strip."""
ALL_PARTS = "All parts"
HEAT: dict[str, session_state.HeatKind] = {"Activation": "activation", "Evidence": "evidence"}


class Panels:
    """Both panels of one browser: the query on the left, the answer on the right.

    Callbacks never compute: `change` is handed a pure function on the state, and decides what follows.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        state: SessionState,
        change: Callable[[StateChange], None],
        rng: Random,
    ) -> None:
        self._client, self._workspace, self._change, self._rng = client, workspace, change, rng
        self._shown: list[int] = []
        self._shown_of: tuple[str, str] | None = None
        self._analysis: StateAnalysis | None = None
        self.order: Callable[[SessionState], Int64Array | None] = lambda _: None
        """The queries that next and previous go through; None for all of them."""
        self._writer: int | None = None
        self._watched: list[Any] = []
        self._seen: tuple[SessionState | None, dict[int, Any]] = None, {}
        """What was read last and not written back yet, and the controls' values before."""
        self._reading = threading.Lock()
        gui = client.gui
        self._left = left = gui.add_panel()
        with left.add_tab("Query", viser.Icon.DRONE):
            self._build_query(gui, state)
        with left.add_tab("Parts", viser.Icon.ADJUSTMENTS):
            self._build_parts(gui, state)
        left.dock_left()
        left.set_width(LEFT)
        gui.set_panel_label("LPN Explorer")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT)
        self._build_answer(gui)
        self._add_keys(gui)

    def _build_query(self, gui: viser.GuiApi, state: SessionState) -> None:
        workspace = self._workspace
        self._task = gui.add_dropdown(
            "Task", tuple(workspace.tasks), initial_value=state.task, visible=len(workspace.tasks) > 1
        )
        walk = gui.add_button_group("Go to", ("‹ Previous", "Next ›", "Random", "Failure"))
        moves: dict[str, StateChange] = {
            "‹ Previous": self.previous,
            "Next ›": self.next,
            "Random": self.random,
            "Failure": self.failure,
        }
        walk.on_click(lambda _: self._change(moves.get(walk.value, lambda s: s)))
        gui.add_button("Failure laboratory", icon=viser.Icon.FLASK).on_click(lambda _: self._change(self.flip_lab))
        live = workspace.model is not None
        self._angle = gui.add_slider("Rotate", -180, 180, 1, state.angle, visible=live)
        self._reach = workspace.spec.input_size[1] // 2, workspace.spec.input_size[0] // 2
        with gui.add_folder("Shift and zoom", expand_by_default=False, visible=live):
            self._shift = gui.add_slider("Shift right", -self._reach[0], self._reach[0], 1, state.shift)
            self._down = gui.add_slider("Shift down", -self._reach[1], self._reach[1], 1, state.down)
            self._zoom = gui.add_slider("Zoom", 1 / session_state.MAX_ZOOM, session_state.MAX_ZOOM, 0.05, state.zoom)
            gui.add_html(pages.note(pages.SHIFT_NOTE))
        if live:  # a hidden upload button would still be shown
            self._upload = gui.add_upload_button(
                "Use my own picture", mime_type="image/jpeg,image/png,image/webp", icon=viser.Icon.UPLOAD
            )
            self._upload.on_upload(self._uploaded)
            uploads.BUTTONS[str(self._upload._impl.uuid)] = self._upload
        with gui.add_folder("Pictures"):
            self._find = gui.add_text("Find name", state.find)
            self._picker = Html(gui)
            bridges = [gui.add_button(f"picture {i}") for i in range(THUMBS)]
            bridges += [gui.add_button("earlier"), gui.add_button("later")]
            for slot, button in enumerate(bridges[:THUMBS]):
                button.on_click(self._pick(slot))
            bridges[-2].on_click(lambda _: self._change(lambda s: replace(s, page=s.page - 1)))
            bridges[-1].on_click(lambda _: self._change(lambda s: replace(s, page=s.page + 1)))
            self._picker_buttons = [_uuid(button) for button in bridges]
            gui.add_html(pages.hidden(self._picker_buttons))
        with gui.add_folder("Look"):
            self._rings = gui.add_checkbox("Rings", state.rings)
            self._exploded = gui.add_checkbox("Take apart", state.exploded)
            mapped = any(task.places is not None for task in workspace.tasks.values())
            self._map = gui.add_checkbox("Map", state.map, visible=mapped)
            self._city = gui.add_checkbox("City", state.city, visible=False)
            self._heat = gui.add_checkbox("Heatmap", state.heat, visible=live)
            first = next(iter(HEAT))
            self._kind = gui.add_dropdown("Shows", tuple(HEAT), visible=live, initial_value=first, hint=pages.HEAT_NOTE)
            choices = (ALL_PARTS, *workspace.part_names)
            self._heat_part = gui.add_dropdown("Heat of", choices, visible=live, initial_value=ALL_PARTS)
            self._opacity = gui.add_slider("Opacity", 0.0, 1.0, 0.05, state.opacity, visible=live)
            if not live:
                gui.add_html(pages.note(pages.SAVED_NOTE, "lpn-saved"))
        self._watch(self._task, self._angle, self._rings, self._exploded, self._heat, self._heat_part, self._opacity)
        self._watch(self._find, self._map, self._city, self._shift, self._down, self._zoom, self._kind)

    def _build_parts(self, gui: viser.GuiApi, state: SessionState) -> None:
        gui.add_html(pages.note(pages.PARTS_NOTE))
        self._enabled, self._weights = [], []
        for name, on, weight in zip(self._workspace.part_names, state.enabled, state.weights, strict=True):
            self._enabled.append(gui.add_checkbox(f"Part {name}", on))
            self._weights.append(gui.add_slider(f"Weight {name}", 0.0, session_state.MAX_WEIGHT, 0.05, weight))
        reset = gui.add_button("All parts equal")
        reset.on_click(lambda _: self._change(lambda s: replace(s, weights=(), enabled=())))
        self._watch(*self._enabled, *self._weights)

    def _build_answer(self, gui: viser.GuiApi) -> None:
        self._header = Html(gui)
        self._verdict = Html(gui)
        self._shown_status: pages.Shown | None = None
        self._status = Html(gui, pages.status(None))
        with gui.add_folder("Matches"):
            self._matches = Html(gui)
            rows = [gui.add_button(f"match {i + 1}") for i in range(SHOWN)]
            for slot, button in enumerate(rows):
                button.on_click(self._compare(slot))
            rows.append(gui.add_button("true tile"))
            rows[-1].on_click(lambda _: self._change(lambda s: replace(s, selected=session_state.TRUTH)))
            self._match_buttons = [_uuid(button) for button in rows]
            gui.add_html(pages.hidden(self._match_buttons))
        with gui.add_folder("Compared pair"):
            self._table = Html(gui)
            why = gui.add_button(
                "Why this tile?", icon=viser.Icon.ZOOM_QUESTION, visible=self._workspace.model is not None
            )
            why.on_click(lambda _: self._change(self.flip_why))
        gui.add_html(pages.keys())

    def _add_keys(self, gui: viser.GuiApi) -> None:
        commands: list[tuple[str, Any, StateChange]] = [
            ("Next picture", "N", self.next),
            ("Previous picture", "P", self.previous),
            ("Random picture", "R", self.random),
            ("Random failure", "F", self.failure),
            ("Turn left 5°", "J", lambda s: session_state.turn(s, 5)),
            ("Turn right 5°", "L", lambda s: session_state.turn(s, -5)),
            ("Upright and whole", "K", session_state.upright),
            ("Heatmap on or off", "H", lambda s: replace(s, heat=not s.heat)),
            ("Rings on or off", "G", lambda s: replace(s, rings=not s.rings)),
            ("Compare the true tile", "T", lambda s: replace(s, selected=session_state.TRUTH)),
            ("Take the rings apart", "X", lambda s: replace(s, exploded=not s.exploded)),
            ("Map or pair", "M", self.flip_map),
            ("Why: evidence for the compared pair", "Y", self.flip_why),
            ("Failure laboratory: all queries", "B", self.flip_lab),
            ("Heatmap: activation or evidence", "V", self.flip_kind),
            ("City on the map or tiles", "C", self.flip_city),
        ]
        for label, key, change in commands:
            gui.add_command(label, hotkey=key).on_trigger(self._does(change))
        for slot in range(9):
            gui.add_command(f"Compare match {slot + 1}", hotkey=cast(Any, str(slot + 1))).on_trigger(
                self._compare(slot)
            )

    def read(self, state: SessionState) -> SessionState:
        """The state with every control's value, none of them trusted (a page may send anything)."""
        seen = {id(handle): handle.value for handle in self._watched}
        read = self._read(state)
        self._seen = read, seen
        return read

    def _read(self, state: SessionState) -> SessionState:
        task = self._task.value if self._task.value in self._workspace.tasks else state.task
        names = self._workspace.part_names
        part = names.index(self._heat_part.value) if self._heat_part.value in names else None
        read = replace(
            state,
            angle=session_state.number(self._angle.value, -180, 180, state.angle),
            shift=round(session_state.number(self._shift.value, -self._reach[0], self._reach[0], state.shift)),
            down=round(session_state.number(self._down.value, -self._reach[1], self._reach[1], state.down)),
            zoom=session_state.number(self._zoom.value, 1 / session_state.MAX_ZOOM, session_state.MAX_ZOOM, state.zoom),
            heat_kind=HEAT.get(self._kind.value, state.heat_kind),
            rings=bool(self._rings.value),
            exploded=bool(self._exploded.value),
            map=bool(self._map.value),
            city=bool(self._city.value),
            heat=bool(self._heat.value),
            heat_part=part,
            opacity=session_state.number(self._opacity.value, 0, 1, state.opacity),
            enabled=tuple(bool(box.value) for box in self._enabled),
            weights=tuple(
                session_state.number(slider.value, 0, session_state.MAX_WEIGHT, weight)
                for slider, weight in zip(self._weights, state.weights, strict=True)
            ),
        )
        find = str(self._find.value)[:200]
        if find != state.find:
            read = self._searched(replace(read, find=find, page=0))
        return session_state.take_task(read, task)

    def write(self, state: SessionState) -> None:
        """Put a state into the controls that differ from it; what the page sent since the state was read stays."""
        (read, seen), self._seen = self._seen, (None, {})
        self._writer = threading.get_ident()  # viser calls back at once, when only some of them are written
        try:
            self._write(state, seen if state == read else {})
        finally:
            self._writer = None

    def _write(self, state: SessionState, seen: dict[int, Any]) -> None:
        pairs: list[tuple[Any, Any]] = [
            (self._task, state.task),
            (self._angle, state.angle),
            (self._opacity, state.opacity),
            (self._rings, state.rings),
            (self._exploded, state.exploded),
            (self._map, state.map),
            (self._city, state.city),
            (self._heat, state.heat),
            (self._shift, state.shift),
            (self._down, state.down),
            (self._zoom, state.zoom),
            (self._kind, next(name for name, kind in HEAT.items() if kind == state.heat_kind)),
            (self._heat_part, ALL_PARTS if state.heat_part is None else self._workspace.part_names[state.heat_part]),
            *zip(self._enabled, state.enabled, strict=True),
            *zip(self._weights, state.weights, strict=True),
        ]
        for handle, value in pairs:
            now = handle.value
            if now != value and now == seen.get(id(handle), now):  # else it is newer, and will be read
                handle.value = value
        stands = self._has_city(state)
        if self._city.visible != stands:
            self._city.visible = stands

    def show(self, analysis: StateAnalysis, sequence: int, started: float) -> None:
        """Show an answer; `started` is when drawing began, by `time.perf_counter`."""
        workspace = self._workspace
        self._analysis = analysis
        with self._client.atomic():
            self._header.show(pages.header(workspace, analysis.task))
            self._verdict.show(pages.verdict(analysis, workspace))
            self._matches.show(pages.matches(analysis, workspace, self._match_buttons))
            self._table.show(pages.parts_table(analysis, workspace))
            self._show_picker(analysis)
            self._shown_status = pages.Shown(analysis, sequence, time.perf_counter() - started)
            self._status.show(pages.status(self._shown_status))

    def show_results(self, task: Task) -> None:
        """Say how good the model is on a task, or how far the ranking is that says so."""
        with self._client.atomic():
            self._header.show(pages.header(self._workspace, task))

    def busy(self) -> None:
        """Show that the next answer is being computed; the one that is shown stays until then."""
        self._status.show(pages.status(self._shown_status, "computing"))

    def full(self) -> None:
        """Show that too many people ask, and that this page will ask again; what it shows stays."""
        self._status.show(pages.status(self._shown_status, "full"))

    def fail(self, text: str) -> None:
        """Say that there is no answer; the one before stays."""
        self._status.show(pages.status(self._shown_status))
        self.say("No answer", text)

    @property
    def finder(self) -> str:
        """The id that the label of the field for a picture's name has in the page."""
        return str(self._find._impl.uuid)

    def fit(self, small: bool) -> None:
        """Leave the stage its room: on a small screen the left panel is a strip, and unfolds when it is pressed."""
        self._client.gui.main_panel.set_width(NARROW if small else RIGHT)
        self._left.minimize() if small else self._left.expand()

    def say(self, title: str, text: str) -> None:
        """Show an error as a notification that stays until it is closed."""
        self._client.add_notification(title, text, color="red", auto_close_seconds=None)

    def next(self, state: SessionState) -> SessionState:
        """The next query."""
        return self._step(state, 1)

    def previous(self, state: SessionState) -> SessionState:
        """The previous query."""
        return self._step(state, -1)

    def _step(self, state: SessionState, by: int) -> SessionState:
        order = self.order(state)
        queries = self._queries(state)
        return (
            session_state.step(state, by, queries) if order is None else session_state.walk(state, by, order, queries)
        )

    def random(self, state: SessionState) -> SessionState:
        """Any other query."""
        return session_state.random_query(state, self._queries(state), self._rng)

    def failure(self, state: SessionState) -> SessionState | None:
        """Any other query whose true tile is not first."""
        task = self._workspace.tasks[state.task]
        if task.found is None:
            self._client.add_notification(
                "Not known yet", "All queries are still being ranked; ask again when they are."
            )
            return None
        failed = session_state.random_failure(state, task.ranks.tolist(), self._rng)
        if failed is None:
            self._client.add_notification("No failure", "Every query of this task finds its true tile first.")
        return failed

    def flip_map(self, state: SessionState) -> SessionState:
        """Map in place of pair, or back, where positions are known."""
        return replace(state, map=not state.map and self._workspace.tasks[state.task].places is not None)

    def flip_why(self, state: SessionState) -> SessionState:
        """The window of reasons, open or closed."""
        return replace(state, why=not state.why)

    def flip_lab(self, state: SessionState) -> SessionState:
        """The failure laboratory, open or closed."""
        return replace(state, lab=not state.lab)

    def flip_kind(self, state: SessionState) -> SessionState:
        """What heatmaps show: one, then the other."""
        return replace(state, heat=True, heat_kind="evidence" if state.heat_kind == "activation" else "activation")

    def flip_city(self, state: SessionState) -> SessionState:
        """The city in three dimensions or the tiles, where the map is shown and has both."""
        return replace(state, city=not state.city) if self._has_city(state) else state

    def _has_city(self, state: SessionState) -> bool:
        return state.map and self._workspace.city is not None and self._workspace.tasks[state.task].places is not None

    def _queries(self, state: SessionState) -> int:
        return len(self._workspace.tasks[state.task].queries)

    def _searched(self, state: SessionState) -> SessionState:
        """A name typed in full is chosen at once."""
        names = self._workspace.tasks[state.task].names
        hits = session_state.found(names, state.find) if state.find.strip() else []
        return session_state.choose(state, hits[0], len(names)) if len(hits) == 1 else state

    def _show_picker(self, analysis: StateAnalysis) -> None:
        state, task = analysis.state, analysis.task
        hits = session_state.found(task.names, state.find)
        last = max(-(-len(hits) // THUMBS), 1)
        page = state.page % last
        self._shown, self._shown_of = hits[page * THUMBS : (page + 1) * THUMBS], (state.task, state.find)
        query = None if state.upload else state.query
        self._picker.show(pages.picker(self._workspace, task, self._shown, query, page, last, self._picker_buttons))

    def _pick(self, slot: int) -> Callable[[Any], None]:
        def picked(_: Any) -> None:
            shown, of = self._shown, self._shown_of
            if slot < len(shown):
                query = shown[slot]
                self._change(
                    lambda s: session_state.choose(s, query, self._queries(s)) if (s.task, s.find) == of else s
                )

        return picked

    def _does(self, change: StateChange) -> Callable[[Any], None]:
        return lambda _: self._change(change)

    def _compare(self, slot: int) -> Callable[[Any], None]:
        def compared(_: Any) -> None:
            analysis = self._analysis
            if analysis is not None and slot < len(analysis.matches):
                index = analysis.matches[slot].index
                self._change(lambda s: session_state.compare(s, analysis.state, index))

        return compared

    def _uploaded(self, _: Any) -> None:
        if not self._reading.acquire(blocking=False):
            self.say("Picture not taken", "The one before it is still being read; send it again.")
            return
        # Not on viser's few threads for callbacks: pictures wait for one another, and everybody's controls would wait with them.
        thread = threading.Thread(target=self._read_upload, name="explorer-upload", daemon=True)
        try:
            thread.start()
        except BaseException:
            self._reading.release()
            raise

    def _read_upload(self) -> None:
        try:
            file = self._upload.value
            if not file.name:  # two came at once, and the later has been read in place of both
                return
            self._upload._impl.value = UploadedFile("", b"")  # viser would keep the bytes
            taken = uploads.read(file.name, file.content)
        except LPNError as error:
            self.say("Picture not taken", str(error))
            return
        finally:
            self._reading.release()
        self._change(lambda s: replace(session_state.upright(s), upload=taken, selected=None))

    def _watch(self, *handles: Any) -> None:
        """Any control that changes makes all be read: the page may have merged two changes into one."""
        self._watched.extend(handles)
        for handle in handles:
            handle.on_update(lambda _: None if self._writer == threading.get_ident() else self._change(self.read))


def _uuid(button: viser.GuiButtonHandle) -> str:
    """The id a button has in the page, which viser keeps private."""
    return str(button._impl.uuid)
