"""What one browser has chosen, as plain data, and the pure functions that change it. No viser here."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Any, Final, Literal

import numpy as np

from lpn.analysis.analyser import OwnPicture
from lpn.core.arrays import Int64Array
from lpn.descriptors.transforms import Change
from lpn.drawing.theme import DARK, LIGHT, Palette

MAX_WEIGHT = 2.0
# The value of `selected` that follows the nearest positive; links contain it.
POSITIVE: Final = "truth"
HeatKind = Literal["activation", "evidence"]
MAX_ZOOM = 4.0


@dataclass(frozen=True)
class SessionState:
    """One browser's choices.

    Attributes:
        task: name of the task, such as "drone-to-satellite".
        query: position in the task's queries.
        upload: the user's own picture, shown instead of `query` when given.
        angle: degrees counter-clockwise the query is turned, -180 .. 180.
        weights: of each part, 0 .. 2, as set by the sliders.
        enabled: which parts are switched on.
        selected: what the query is compared with: a gallery position, POSITIVE for its nearest true tile, or None for
            the top match; the last two are followed as the ranking changes.
        shift, down: pixels of the network's input the query is moved to the right and down, after it is turned.
        zoom: factor the query is zoomed by, after it is turned.
        region: cells of the query's feature map, row by row, that the search is by alone; empty for all of it.
        why: whether the window of reasons is open.
        lab: whether the failure laboratory is open.
        heat: whether heatmaps are drawn.
        heat_kind: what they show: what the network responds to in one picture, or the evidence of the compared pair.
        heat_part: the part whose heatmap is drawn, None for all together.
        opacity: of the heatmap, 0 .. 1.
        rings: whether part boundaries are drawn.
        exploded: whether the rings are lifted apart.
        map: whether the gallery is shown as a map in place of the compared pair.
        city: whether the map shows the 3-D model of the city, where there is one, in place of its tiles.
        find: text that picture names must contain in the picker.
        page: page of the picker.
        dark: whether the page is light on dark.
    """

    task: str
    n_parts: int
    query: int = 0
    upload: OwnPicture | None = None
    angle: float = 0.0
    weights: tuple[float, ...] = ()
    enabled: tuple[bool, ...] = ()
    selected: int | Literal["truth"] | None = None
    shift: int = 0
    down: int = 0
    zoom: float = 1.0
    region: tuple[int, ...] = ()
    why: bool = False
    lab: bool = False
    heat: bool = True
    heat_kind: HeatKind = "activation"
    heat_part: int | None = None
    opacity: float = 0.6
    rings: bool = True
    exploded: bool = False
    map: bool = False
    city: bool = True
    find: str = ""
    page: int = 0
    dark: bool = True

    def __post_init__(self) -> None:
        if not self.weights:
            object.__setattr__(self, "weights", (1.0,) * self.n_parts)
        if not self.enabled:
            object.__setattr__(self, "enabled", (True,) * self.n_parts)

    def part_values(self) -> tuple[float, ...]:
        """Weight of each part with switched-off parts at 0; equal weights when nothing is left on."""
        values = tuple(w if on else 0.0 for w, on in zip(self.weights, self.enabled, strict=True))
        return values if any(values) else (1.0,) * self.n_parts

    @property
    def change(self) -> Change:
        """What is done to the query before it is described."""
        return Change(self.angle, self.shift, self.zoom, self.down)

    @property
    def palette(self) -> Palette:
        """What captions are drawn with."""
        return DARK if self.dark else LIGHT

    def parts_left(self) -> bool:
        """Whether any part is on with a weight above 0."""
        return any(w > 0 and on for w, on in zip(self.weights, self.enabled, strict=True))


# A pure change of the state; None leaves the state as it is.
StateChange = Callable[[SessionState], SessionState | None]


def with_field(state: SessionState, field: str, value: Any) -> SessionState:
    """Return the state with one field replaced, which is known by its name at run time only."""
    return replace(state, **{field: value})


def number(value: Any, low: float, high: float, default: float) -> float:
    """A value from the page, trusted for nothing: a finite number within low .. high, else the default."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return default
    return min(max(float(value), low), high)


def whole(value: Any, low: int, high: int) -> int | None:
    """A value from the page as a whole number within low .. high, or None when it is none."""
    known = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
    return value if known else None


def painted(value: Any, cells: int) -> tuple[int, ...] | None:
    """A list of cells from the page, in order and each once, or None when it is no such list."""
    if not isinstance(value, list) or len(value) > cells:
        return None
    found = [whole(cell, 0, cells - 1) for cell in value]
    return None if None in found else tuple(sorted({cell for cell in found if cell is not None}))


def taken(state: SessionState, value: Any, size: tuple[int, int]) -> SessionState:
    """The query turned, shifted, and zoomed as a point of a profile says: [degrees, right, down, factor]."""
    if not isinstance(value, list) or len(value) != 4:
        return state
    height, width = size
    return replace(
        state,
        angle=wrap(number(value[0], -360, 360, state.angle)),
        shift=round(number(value[1], -width // 2, width // 2, state.shift)),
        down=round(number(value[2], -height // 2, height // 2, state.down)),
        zoom=number(value[3], 1 / MAX_ZOOM, MAX_ZOOM, state.zoom),
    )


def wrap(angle: float) -> float:
    """The same direction within -180 .. 180 degrees (exclusive of -180)."""
    turned = angle % 360.0
    return turned - 360.0 if turned > 180.0 else turned


def choose(state: SessionState, query: int, queries: int) -> SessionState:
    """Take another query: its own picture, not turned, compared with its top match."""
    if not 0 <= query < queries:
        return state
    return replace(upright(state), query=query, upload=None, selected=None)


def take_task(state: SessionState, task: str) -> SessionState:
    """Turn to another task: its first query, compared with its top match."""
    if task == state.task:
        return state
    return replace(state, task=task, query=0, upload=None, selected=None, region=(), page=0)


def upright(state: SessionState) -> SessionState:
    """The whole query as it was taken: not turned, shifted, or zoomed, and no region painted."""
    return replace(state, angle=0.0, shift=0, down=0, zoom=1.0, region=())


def compare(state: SessionState, shown: SessionState, index: int) -> SessionState:
    """Compare with a tile chosen from the answer to `shown`, unless another query has been taken since."""
    same = (state.task, state.query, state.upload) == (shown.task, shown.query, shown.upload)
    return replace(state, selected=index) if same else state


def step(state: SessionState, by: int, queries: int) -> SessionState:
    """The next or previous query, around the end."""
    return choose(state, (state.query + by) % queries, queries)


def walk(state: SessionState, by: int, order: Int64Array, queries: int) -> SessionState:
    """The next or previous query in an order, around the end; from outside of it, its first or its last."""
    if not len(order):
        return state
    places = np.flatnonzero(order == state.query)
    at = int(places[0]) + by if len(places) else (0 if by > 0 else -1)
    return choose(state, int(order[at % len(order)]), queries)


def random_query(state: SessionState, queries: int, rng: Random) -> SessionState:
    """Any other query."""
    if queries < 2:
        return state
    return choose(state, (state.query + rng.randrange(1, queries)) % queries, queries)


def random_failure(state: SessionState, ranks: Sequence[int], rng: Random) -> SessionState | None:
    """Any other query whose true match is not first, or None when there is none; -1 ranks have no true match."""
    failures = [i for i, rank in enumerate(ranks) if rank > 0]
    others = [i for i in failures if i != state.query or state.upload is not None]
    candidates = others or failures
    return choose(state, rng.choice(candidates), len(ranks)) if candidates else None


def turn(state: SessionState, by: float) -> SessionState:
    """Turn the query further, around the circle."""
    return replace(state, angle=wrap(state.angle + by))


def flip_why(state: SessionState) -> SessionState:
    """Open or close the explain window."""
    return replace(state, why=not state.why)


def flip_lab(state: SessionState) -> SessionState:
    """Open or close the failure laboratory."""
    return replace(state, lab=not state.lab)


def flip_heat_kind(state: SessionState) -> SessionState:
    """Switch heatmaps between activation and evidence, and show them."""
    return replace(state, heat=True, heat_kind="evidence" if state.heat_kind == "activation" else "activation")


def equal_parts(state: SessionState) -> SessionState:
    """Switch all parts on with equal weights."""
    return replace(state, weights=(), enabled=())


def flip_dark(state: SessionState) -> SessionState:
    """Light on dark, or dark on light."""
    return replace(state, dark=not state.dark)


def found(names: Sequence[str], text: str) -> list[int]:
    """Positions of the names that contain a text, upper and lower case alike."""
    wanted = text.strip().casefold()
    if not wanted:
        return list(range(len(names)))
    return [i for i, name in enumerate(names) if wanted in name.casefold()]
