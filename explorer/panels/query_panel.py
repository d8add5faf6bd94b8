"""The panel Query: the query picture, and how the stage draws it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import session_state
from explorer.browse.feeds import Feeds
from explorer.browse.messages import BrowseMessage, PickQuery
from explorer.browse.own_pictures import HandedOver, OwnPictures
from explorer.browse.query_list import QueryList
from explorer.panels import pages
from explorer.panels.controls import Controls
from explorer.panels.navigation import Navigation
from explorer.session_state import MAX_ZOOM, SessionState, StateChange
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.descriptors.weather import WEATHERS
from lpn.library.analyser import OwnPicture

_HEAT_KINDS = {"Activation": "activation", "Evidence": "evidence"}
_MAX_FIND = 200


class QueryPanel:
    """One browser's controls of the query.

    Args:
        change: updates the browser's state with a function.
        notify_error: shows an error with a title and a text.

    Attributes:
        compare_models: called to compare with another model.
        own: the user's own pictures; None without a network to describe them.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        workspace: Workspace,
        feeds: Feeds,
        controls: Controls,
        navigation: Navigation,
        change: Callable[[StateChange], None],
        notify_error: Callable[[str, str], None],
    ) -> None:
        self._workspace = workspace
        has_model = workspace.model is not None
        height, width = workspace.contract.input_size
        moves: dict[str, StateChange] = {
            "‹ Previous": navigation.previous,
            "Next ›": navigation.next,
            "Random": navigation.random,
            "Failure": navigation.failure,
        }
        buttons = gui.add_button_group("Go to", tuple(moves))
        buttons.on_click(lambda _: change(moves.get(buttons.value, lambda state: state)))
        laboratory = gui.add_button("All pictures in a table", icon=viser.Icon.FLASK)
        laboratory.on_click(lambda _: change(session_state.flip_lab))
        if workspace.has_flight:
            flight = gui.add_button("Flight over its map", icon=viser.Icon.MAP_2)
            flight.on_click(lambda _: change(session_state.flip_flight))
        self.compare_models: Callable[[], None] = lambda: None
        if workspace.beside:
            other = workspace.beside[0].label if len(workspace.beside) == 1 else "other models"
            compare = gui.add_button(f"Compare with {other}", icon=viser.Icon.COLUMNS_2)
            compare.on_click(lambda _: self.compare_models())
        controls.slider("Rotate", "angle", -180, 180, 1, visible=has_model)
        if has_model:
            gui.add_html(render("panels/turn_note"))
        with gui.add_folder("Weather", expand_by_default=False, visible=has_model):
            controls.dropdown(
                "Kind", "weather", {name.capitalize(): name for name in WEATHERS}, hint=pages.WEATHER_NOTE
            )
            controls.slider("Strength", "weather_strength", 0.0, 1.0, 0.05)
        with gui.add_folder("Shift and zoom", expand_by_default=False, visible=has_model):
            controls.slider("Shift right", "shift", -(width // 2), width // 2, 1, whole=True)
            controls.slider("Shift down", "down", -(height // 2), height // 2, 1, whole=True)
            controls.slider("Zoom", "zoom", 1 / MAX_ZOOM, MAX_ZOOM, 0.05)
            gui.add_html(pages.note(pages.SHIFT_NOTE))
        self.own: OwnPictures | None = None
        if has_model:
            gui.add_html(render("browse/choose"))
            self.own = OwnPictures(gui, feeds, change, notify_error, workspace.key)
            navigation.step_own = self.own.step
        with gui.add_folder("Pictures"):
            self.find_box = gui.add_text("Find name", "")
            self.list = QueryList(gui, workspace, feeds, change)
        # Inputs are read in order. The search comes after the sliders, because it resets them when it finds a query.
        controls.bind("find", self.find_box, self._search)
        with gui.add_folder("Look"):
            fixed = any(workspace.contract.partition(view) is not None for view in workspace.contract.views)
            drawn = workspace.has_parts and (has_model or fixed)
            controls.checkbox(f"{workspace.contract.part_noun.capitalize()}s", "rings", visible=drawn)
            controls.checkbox("Take apart", "exploded", visible=drawn)
            has_places = any(task.geometry is not None for task in workspace.tasks.values())
            controls.checkbox("Map", "map", visible=has_places, apply=session_state.show_map)
            self._city = controls.checkbox("Relief" if workspace.has_flight else "City", "city", visible=False)
            self._cameras = controls.checkbox("Cameras of the flight", "cameras", visible=False)
            has_cells = not workspace.without_cells
            controls.checkbox("Heatmap", "heat", visible=has_cells)
            controls.dropdown("Heat type", "heat_kind", _HEAT_KINDS, visible=has_cells, hint=pages.HEAT_NOTE)
            parts = {"All parts": None} | {name: part for part, name in enumerate(workspace.part_names)}
            controls.dropdown("Heat of", "heat_part", parts, visible=has_cells and workspace.has_parts)
            controls.slider("Opacity", "opacity", 0.0, 1.0, 0.05, visible=has_cells)
            if not has_model:
                more = pages.RINGS_NOTE if fixed else pages.ARRAYS_NOTE
                gui.add_html(pages.note(f"{pages.SAVED_NOTE} {more}", "lpn-saved"))
            elif not has_cells:
                gui.add_html(pages.note(workspace.without_cells, "lpn-without-cells"))

    def update(self, state: SessionState) -> None:
        """Show the checkboxes only if the state has a city or a relief to show, or the map of a flight."""
        for checkbox, visible in (
            (self._city, city_available(self._workspace, state)),
            (self._cameras, state.map and self._workspace.has_flight),
        ):
            if checkbox.visible != visible:
                checkbox.visible = visible

    def show(self, analysis: StateAnalysis) -> None:
        """Show the list of pictures around the state's query, and the user's own."""
        self.list.show(analysis)
        if self.own is not None:
            self.own.show(analysis.state)

    def find_own(self, key: str) -> OwnPicture | None:
        """Return the user's own picture of a key, see `OwnPictures.find`."""
        return None if self.own is None else self.own.find(key)

    def hand_over(self) -> HandedOver | None:
        """Return the user's own pictures for `take_over`; None where there is no model to describe them."""
        return None if self.own is None else self.own.hand_over()

    def take_over(self, over: HandedOver | None) -> None:
        """Hold the own pictures of the page's session before this one."""
        if self.own is not None and over is not None:
            self.own.take_over(over)

    def receive(self, message: BrowseMessage) -> None:
        """Do what a message of a list of pictures asks for."""
        if isinstance(message, PickQuery):
            self.list.pick(message)
        elif self.own is not None:
            self.own.receive(message)

    def leave(self) -> None:
        """Serve nothing more to a browser that left, and forget its pictures."""
        self.list.leave()
        if self.own is not None:
            self.own.leave()

    def _search(self, state: SessionState, value: Any) -> SessionState:
        """Filter the pictures by name; if exactly one name matches, choose that query."""
        find = str(value)[:_MAX_FIND]
        if find == state.find:
            return state
        state = replace(state, find=find)
        names = self._workspace.tasks[state.task].query_names
        hits = session_state.matching_names(names, find) if find.strip() else []
        return session_state.choose_query(state, hits[0], len(names)) if len(hits) == 1 else state


def city_available(workspace: Workspace, state: SessionState) -> bool:
    """Return True if the map is shown and has a 3-D city model."""
    return state.map and workspace.city is not None and workspace.tasks[state.task].geometry is not None
