"""One browser's choices as plain data, and pure functions that change them; no viser here."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, Final, Literal

import numpy as np

from explorer import lab_choices
from explorer.lab_choices import LabChoices
from lpn.core.arrays import BoolArray, Int64Array
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import Weather, WeatherName
from lpn.drawing.theme import DARK, LIGHT, Palette
from lpn.library.analyser import OwnPicture
from lpn.tasks.task import Scoring, scored_key

MAX_WEIGHT = 2.0
MAX_ZOOM = 4.0
# The value of `selected` that follows the nearest positive; links contain it.
POSITIVE: Final = "truth"
HeatKind = Literal["activation", "evidence"]
# The changes that alter the ranking of a query.
Alteration = Literal["region", "weights", "weather", "rotation", "shift", "zoom"]
# Tabs of the explain window. "best" becomes the one that answers why the top match is first, when the pair is analysed.
WhyTab = Literal["best", "evidence", "heatmaps", "comparison", "sweep", "region", "models"]


@dataclass(frozen=True)
class SessionState:
    """One browser's choices.

    Attributes:
        task: name of the task, such as "drone-to-satellite".
        query: position among the task's queries.
        upload: the user's own picture, which replaces the query.
        angle: rotation of the query in degrees counter-clockwise, -180 .. 180.
        weights: weight of each part, 0 .. 2.
        enabled: True for each part that is switched on.
        scoring: how the gallery is ranked.
        selected: the tile to compare with: a gallery position, POSITIVE for the nearest positive, or None for the top
            match. The last two follow the ranking.
        shift, down: translation of the rotated query to the right and down, in pixels of the network's input.
        zoom: scale of the rotated query.
        weather, weather_strength: drawn on the query before it is rotated, and its share in the picture, 0 .. 1.
        region: cells of the query's feature map to search by, row by row; empty for the whole query.
        why: True while the explain window is open.
        why_tab: its tab.
        beside: which of the models beside the workspace's own is compared, from 0.
        lab: True while the failure laboratory is open.
        laboratory: what it shows.
        flight: True while the flight window is open; it is visible while neither of the two other windows is.
        heat: True while heatmaps are drawn.
        heat_kind: the heatmap's values: one picture's activation, or the compared pair's evidence.
        heat_part: the part that the heatmap shows; None for all parts.
        heat_over: True if heatmaps of the parts lie over their pictures in the tab Heatmaps.
        same_scale: True if query and tile share one colour scale for each part in the tab Heatmaps.
        opacity: of the heatmap, 0 .. 1.
        rings: True while part boundaries are drawn.
        exploded: True while the rings are lifted apart.
        map: True to show the gallery as a map in place of the compared pair.
        city: True to show the 3-D city on the map, where there is one, in place of tiles.
        cameras: True to show the cameras of a flight's photos on the map.
        find: filter of the list of queries.
        dark: True for the dark theme.
        plain: True for plain words, see `lpn.drawing.words`.
        start_plain: True if the first screen speaks plain words, whatever the workbench speaks; no address has it.
        first_screen: True while the page shows one query and its answer only; `why` explains it there.
        fails: True while the first screen shows the wrong answers, one after the other.
        came_from: the query and the own picture that were shown before `fails`; no address has it.
        under_flight: True while the flight window stands in the laboratory's place, to which its end leads; no address has it.
        map_alone: True while the flight window fills the page with map and photo, without the workbench.
        from_first_screen: True while something is open that was opened there, so that its end leads back; addresses have it of
            `map_alone` only.
    """

    task: str
    n_parts: int
    query: int = 0
    upload: OwnPicture | None = None
    angle: float = 0.0
    weights: tuple[float, ...] = ()
    enabled: tuple[bool, ...] = ()
    scoring: Scoring = "plain"
    selected: int | Literal["truth"] | None = None
    shift: int = 0
    down: int = 0
    zoom: float = 1.0
    weather: WeatherName = "normal"
    weather_strength: float = 1.0
    region: tuple[int, ...] = ()
    why: bool = False
    why_tab: WhyTab = "evidence"
    beside: int = 0
    lab: bool = False
    laboratory: LabChoices = field(default_factory=LabChoices)
    flight: bool = False
    heat: bool = True
    heat_kind: HeatKind = "activation"
    heat_part: int | None = None
    heat_over: bool = False
    same_scale: bool = False
    opacity: float = 0.6
    rings: bool = True
    exploded: bool = False
    map: bool = False
    city: bool = True
    cameras: bool = True
    find: str = ""
    dark: bool = True
    plain: bool = False
    start_plain: bool = True
    first_screen: bool = False
    fails: bool = False
    came_from: tuple[int, OwnPicture | None] | None = None
    under_flight: bool = False
    map_alone: bool = False
    from_first_screen: bool = False

    def __post_init__(self) -> None:
        if not self.weights:
            object.__setattr__(self, "weights", (1.0,) * self.n_parts)
        if not self.enabled:
            object.__setattr__(self, "enabled", (True,) * self.n_parts)

    def part_values(self) -> tuple[float, ...]:
        """Return the effective weight of each part: 0 where it is off, and equal weights where none is left."""
        values = tuple(w if on else 0.0 for w, on in zip(self.weights, self.enabled, strict=True))
        return values if any(values) else (1.0,) * self.n_parts

    @property
    def ranking_key(self) -> str:
        """The key of the ranking that is shown, see `Task.key`."""
        return scored_key(self.task, self.scoring)

    @property
    def parts_off(self) -> frozenset[int]:
        """The parts that do not count."""
        return frozenset(part for part, weight in enumerate(self.part_values()) if not weight)

    @property
    def windows(self) -> tuple[bool, ...]:
        """Everything that can be closed again: each window, the map, and the pulled rings; True for each that is open."""
        return self.why, self.lab or self.under_flight, self.flight, self.map, self.exploded

    @property
    def shows_window(self) -> bool:
        """Return True if any of `windows` is open."""
        return any(self.windows)

    @property
    def screen(self) -> tuple[bool, ...]:
        """The first screen and each of the windows; True for each that the page shows."""
        return self.first_screen, self.why, self.lab, self.flight, self.map

    @property
    def shows_reasons(self) -> bool:
        """Return True if the explain window is open, which the first screen has no room for."""
        return self.why and not self.first_screen

    @property
    def change(self) -> Change:
        """The transformation of the query before it is described."""
        weather = Weather(self.weather, self.weather_strength)
        return Change(self.angle, self.shift, self.zoom, self.down, weather=weather)

    @property
    def palette(self) -> Palette:
        """The colours of captions."""
        return DARK if self.dark else LIGHT

    @property
    def altered_weights(self) -> bool:
        """Return True if the parts do not count alike."""
        return len(set(self.part_values())) > 1

    def parts_left(self) -> bool:
        """Return True if any part is on with a weight above 0."""
        return any(w > 0 and on for w, on in zip(self.weights, self.enabled, strict=True))


# Fields that the first screen does not show.
_BEYOND_FIRST_SCREEN = (
    "selected",
    "lab",
    "flight",
    "heat",
    "heat_kind",
    "heat_part",
    "heat_over",
    "same_scale",
    "opacity",
    "rings",
    "exploded",
    "map",
    "city",
    "cameras",
)

# A pure change of the state; None leaves the state as it is.
StateChange = Callable[[SessionState], SessionState | None]


def with_field(state: SessionState, field: str, value: Any) -> SessionState:
    """Return the state with one field replaced, which is known by its name at run time only."""
    return replace(state, **{field: value})


def with_windows(state: SessionState, other: SessionState) -> SessionState:
    """Return a state with the explain window's tab and the laboratory of another one: an analysis depends on neither."""
    return replace(state, laboratory=other.laboratory, why_tab=other.why_tab)


def leave_first_screen(before: SessionState, after: SessionState) -> SessionState:
    """Return what follows the first screen, see `_left`.

    A map that stood alone does so no more under another window, or in the field's terms.
    """
    left = _left(before, after)
    alone = left.map_alone and left.plain and left.flight and left.from_first_screen and not (left.why or left.lab)
    return replace(left, map_alone=alone)


def _left(before: SessionState, after: SessionState) -> SessionState:
    """Return `after` without the first screen if the change from `before` is to something that it does not show.

    A change of the query shows the query's top match, whatever was compared before. The end of the last window that was opened
    from the first screen leads back to it, unless another one took its place; the end of the flight window that took the
    laboratory's place leads back to the laboratory.
    """
    if after.fails and after.upload is not None:
        after = replace(after, fails=False, came_from=None)
    if after.under_flight and not after.flight:
        after = replace(after, lab=not after.first_screen, under_flight=False)
    if not before.first_screen and not after.first_screen:
        ended = before.from_first_screen and before.shows_window and not after.shows_window
        stays = any(then and now for then, now in zip(before.windows, after.windows, strict=True))
        stays = stays or (after.map_alone and not before.map_alone)  # by an address
        return (
            _only_first_screen(after) if ended else replace(after, from_first_screen=after.from_first_screen and stays)
        )
    left = _without_first_screen(before, after)
    return replace(left, from_first_screen=not left.first_screen and left.shows_window)


def _without_first_screen(before: SessionState, after: SessionState) -> SessionState:
    if not (before.first_screen and after.first_screen):
        return after
    beyond = [field for field in _BEYOND_FIRST_SCREEN if getattr(before, field) != getattr(after, field)]
    stays = not beyond or (beyond == ["selected"] and after.selected is None)
    return after if stays else replace(after, first_screen=False)


def number(value: Any, low: float, high: float, default: float) -> float:
    """Clamp an untrusted value to low .. high; returns the default unless it is a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return default
    return min(max(float(value), low), high)


def apply_point(
    state: SessionState,
    angle: float,
    right: float,
    down: float,
    zoom: float,
    size: tuple[int, int],
    weather: WeatherName = "normal",
) -> SessionState:
    """Transform the query as a point of a sweep says, within the limits of the sliders.

    Args:
        size: (height, width) of the network's input in pixels, which limits the shifts.
        weather: of the point; its strength is that of the state.
    """
    height, width = size
    return replace(
        state,
        angle=wrap(angle),
        shift=min(max(round(right), -(width // 2)), width // 2),
        down=min(max(round(down), -(height // 2)), height // 2),
        zoom=min(max(zoom, 1 / MAX_ZOOM), MAX_ZOOM),
        weather=weather,
    )


def wrap(angle: float) -> float:
    """Return an equivalent angle in degrees, above -180 and up to 180."""
    turned = angle % 360.0
    return turned - 360.0 if turned > 180.0 else turned


def choose_query(state: SessionState, query: int, queries: int) -> SessionState:
    """Choose a query: upright, and compared with its top match."""
    if not 0 <= query < queries:
        return state
    return replace(leave_upload(state), query=query, fails=False, came_from=None)


def show_fails(state: SessionState, query: int, queries: int) -> SessionState:
    """Show one of the wrong answers, as all parts count alike; the end of that leads back to what was shown before."""
    came_from = state.came_from if state.fails else (state.query, state.upload)
    chosen = choose_query(equal_parts(state), query, queries)
    return replace(chosen, first_screen=True, why=False, fails=True, came_from=came_from)


def start_place(state: SessionState, query: int, queries: int) -> SessionState:
    """Show a place on its first screen as when it is opened: its first picture, unexplained, as all parts count alike."""
    return replace(choose_query(equal_parts(state), query, queries), why=False)


def leave_upload(state: SessionState) -> SessionState:
    """Go from the user's own picture back to the chosen query: upright, and compared with its top match."""
    return replace(upright(state), upload=None, selected=None)


def choose_task(state: SessionState, task: str, query: int = 0) -> SessionState:
    """Choose another task and one of its queries: upright, and compared with its top match."""
    if task == state.task:
        return state
    state = choose_query(state, query, query + 1)
    return replace(state, task=task, laboratory=lab_choices.for_any_task(state.laboratory))


def upright(state: SessionState) -> SessionState:
    """Undo weather, rotation, shift, zoom, and region."""
    clear = replace(state, weather="normal", weather_strength=1.0)
    return replace(clear, angle=0.0, shift=0, down=0, zoom=1.0, region=())


def compare(state: SessionState, drawn_state: SessionState, index: int) -> SessionState:
    """Compare with a gallery tile that was chosen while `drawn_state` was drawn, unless the query has changed since."""
    same = (state.task, state.query, state.upload) == (drawn_state.task, drawn_state.query, drawn_state.upload)
    return replace(state, selected=index) if same else state


def step(state: SessionState, by: int, queries: int) -> SessionState:
    """Go `by` queries further, around the end."""
    return choose_query(state, (state.query + by) % queries, queries)


def step_in_order(state: SessionState, by: int, order: Int64Array, queries: int) -> SessionState:
    """Go `by` queries further in an order, around the end; from a query outside the order, go to its first or last."""
    if not len(order):
        return state
    places = np.flatnonzero(order == state.query)
    at = int(places[0]) + by if len(places) else (0 if by > 0 else -1)
    return choose_query(state, int(order[at % len(order)]), queries)


def random_query(state: SessionState, queries: int, rng: Random) -> SessionState:
    """Choose any other query."""
    if queries < 2:
        return state
    return choose_query(state, (state.query + rng.randrange(1, queries)) % queries, queries)


def next_failure(state: SessionState, failed: BoolArray, order: Int64Array | None = None) -> SessionState | None:
    """Choose the failure that follows in the list of queries, the first one after the last, given which failed, (Q,).

    Args:
        order: failures of a lower number come first, (Q,); the list is then begun from its start.
    """
    failures = np.flatnonzero(failed)
    if not len(failures):
        return None
    if order is not None:
        failures = failures[np.argsort(order[failures], kind="stable")]
    before = np.flatnonzero(failures == state.query)
    if state.upload is None and len(before):
        at = int(before[0]) + 1
    elif order is not None:
        at = 0
    else:
        at = int(np.searchsorted(failures, state.query))
    return choose_query(state, int(failures[at % len(failures)]), len(failed))


def random_failure(state: SessionState, failed: BoolArray, rng: Random) -> SessionState | None:
    """Choose any other failure, given which queries failed, (Q,); None without any."""
    failures: list[int] = np.flatnonzero(failed).tolist()
    others = [i for i in failures if i != state.query or state.upload is not None]
    candidates = others or failures
    return choose_query(state, rng.choice(candidates), len(failed)) if candidates else None


def turn(state: SessionState, by: float) -> SessionState:
    """Rotate the query further by some degrees."""
    return replace(state, angle=wrap(state.angle + by))


def to_first_screen(state: SessionState) -> SessionState:
    """Open the first screen, which speaks its own words, and close all that it does not show.

    After the wrong answers it shows what it showed before.
    """
    if state.came_from is not None:
        query, upload = state.came_from
        state = replace(state, query=query, upload=upload, fails=False, came_from=None)
    return _only_first_screen(replace(state, fails=False))


def _only_first_screen(state: SessionState) -> SessionState:
    closed = replace(state, why=False, lab=False, flight=False, map=False, exploded=False, selected=None)
    return in_words(replace(closed, first_screen=True, from_first_screen=False), state.plain, state.start_plain)


def leave_stage_view(state: SessionState) -> SessionState:
    """Close the explain window, else the map, else put the pulled rings together; under another window, both stay."""
    if state.shows_reasons:
        return replace(state, why=False)
    if state.why or state.lab or state.flight:
        return state
    return replace(state, map=False) if state.map else replace(state, exploded=False)


def flip_why(state: SessionState) -> SessionState:
    """Close the explain window, or open it at the tab that answers why the top match is first."""
    return replace(state, why=not state.why, why_tab="evidence" if state.why else "best")


def show_map(state: SessionState, on: bool) -> SessionState:
    """Show or close the map on the stage; the explain window would hide a map that opens."""
    return replace(state, map=on, why=state.why and not (on and not state.map))


def flip_lab(state: SessionState) -> SessionState:
    """Open or close the failure laboratory."""
    return replace(state, lab=not state.lab)


def show_map_alone(state: SessionState) -> SessionState:
    """Open the flight window; in plain words without the workbench, see `leave_first_screen`."""
    return replace(state, flight=True, why=False, map_alone=True)


def flip_flight(state: SessionState) -> SessionState:
    """Open the flight window in place of the other windows, or close it."""
    if state.flight and not (state.why or state.lab):
        return replace(state, flight=False)
    return open_flight(state)


def open_flight(state: SessionState) -> SessionState:
    """Open the flight window in place of the other windows."""
    return replace(state, flight=True, why=False, lab=False, under_flight=state.lab or state.under_flight)


def flip_same_scale(state: SessionState) -> SessionState:
    """Give query and tile one colour scale for each part, or each its own."""
    return replace(state, same_scale=not state.same_scale)


def flip_heat_kind(state: SessionState) -> SessionState:
    """Switch heatmaps between activation and evidence, and show them."""
    return replace(state, heat=True, heat_kind="evidence" if state.heat_kind == "activation" else "activation")


def flip_part(state: SessionState, part: int) -> SessionState:
    """Switch a part, from 0, on or off."""
    return replace(state, enabled=tuple(on != (i == part) for i, on in enumerate(state.enabled)))


def equal_parts(state: SessionState) -> SessionState:
    """Switch all parts on with equal weights."""
    return replace(state, weights=(), enabled=())


def only_parts(state: SessionState, parts: Sequence[int]) -> SessionState:
    """Switch on some parts, from 1, with equal weights, and the others off."""
    return replace(state, weights=(), enabled=tuple(part in parts for part in range(1, state.n_parts + 1)))


def alterations(state: SessionState, cells: int) -> dict[Alteration, str]:
    """Name what alters the ranking of the plain query under equal weights: a label for each argument of `undo`.

    Args:
        cells: of the query's feature map.
    """
    values = state.part_values()
    percents = " : ".join(f"{100 * value / sum(values):.0f}" for value in values)
    labels: dict[Alteration, str] = {
        "region": f"search by {len(state.region)} of {cells} cells" if state.region else "",
        "weights": f"part weights {percents} %" if state.altered_weights else "",
        "weather": state.change.weather.describe(),
        "rotation": Change(state.angle).describe(),
        "shift": Change(shift=state.shift, down=state.down).describe(),
        "zoom": Change(scale=state.zoom).describe(),
    }
    return {kind: label for kind, label in labels.items() if label}


def undo(state: SessionState, kind: Alteration) -> SessionState:
    """Undo one of `alterations`."""
    match kind:
        case "region":
            return replace(state, region=())
        case "weights":
            return equal_parts(state)
        case "weather":
            return replace(state, weather="normal")
        case "rotation":
            return replace(state, angle=0.0)
        case "shift":
            return replace(state, shift=0, down=0)
        case "zoom":
            return replace(state, zoom=1.0)


def flip_dark(state: SessionState) -> SessionState:
    """Switch between the dark and the light theme."""
    return replace(state, dark=not state.dark)


def show_everything(state: SessionState) -> SessionState:
    """Leave the first screen for the workbench, and speak its terms."""
    return replace(state, first_screen=False, why=False, plain=False)


def flip_words(state: SessionState) -> SessionState:
    """Switch between plain words and the field's terms, on the first screen, too."""
    return in_words(state, not state.plain, not state.plain)


def in_words(state: SessionState, plain: bool, start_plain: bool) -> SessionState:
    """Return a state in the words of its screen: the first screen has its own, and all others share theirs.

    Args:
        plain: the others speak plain words.
        start_plain: the first screen does.
    """
    spoken = start_plain if state.first_screen else plain
    return replace(state, plain=spoken, start_plain=start_plain, map_alone=state.map_alone and spoken)


def matching_names(names: Sequence[str], text: str) -> list[int]:
    """Return the positions of the names that contain a text, ignoring case; all for an empty text."""
    wanted = text.strip().casefold()
    if not wanted:
        return list(range(len(names)))
    return [i for i, name in enumerate(names) if wanted in name.casefold()]
