"""The state that a client's page must reach, derived from the controls' documented effect and not from the app's code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, Protocol
from urllib.parse import parse_qsl


@dataclass(frozen=True, eq=False)
class UploadedPicture:
    """An uploaded picture: a unique file name and the file's bytes."""

    name: str
    content: bytes


@dataclass(frozen=True)
class ClientState:
    """The choices of one client that its ranking depends on, and its open windows.

    Attributes:
        task: a task's name, such as "drone-to-satellite".
        query: position among the task's queries; it stays while an uploaded picture is shown.
        own_picture: an uploaded picture, shown in place of the query.
        angle, right, down, zoom: the query's rotation in degrees, shifts in pixels of the network's input, and scale factor.
        weights: weight of each part, 0 .. 2.
        on: True for each part that is switched on.
        tile: gallery position of the compared tile, "truth" for the positive, or None for the top match.
        why: True while the explain window is open.
        lab: True while the failure laboratory is open.
    """

    task: str
    query: int
    weights: tuple[float, ...]
    on: tuple[bool, ...]
    own_picture: UploadedPicture | None = None
    angle: float = 0.0
    right: int = 0
    down: int = 0
    zoom: float = 1.0
    tile: int | Literal["truth"] | None = None
    why: bool = False
    lab: bool = False

    def picked(self, query: int) -> ClientState:
        """Choose a query, without any transform."""
        return replace(self.upright(), query=query, own_picture=None, tile=None)

    def sent(self, own_picture: UploadedPicture) -> ClientState:
        """Show an uploaded picture, without any transform."""
        return replace(self.upright(), own_picture=own_picture, tile=None)

    def turned_to(self, task: str, query: int) -> ClientState:
        """Choose another task at one of its queries, without any transform."""
        return replace(self.upright(), task=task, query=query, own_picture=None, tile=None)

    def upright(self) -> ClientState:
        """Undo all transforms of the query."""
        return replace(self, angle=0.0, right=0, down=0, zoom=1.0)

    def weighed(self, part: int, weight: float) -> ClientState:
        """Set the weight of a part."""
        return replace(self, weights=(*self.weights[:part], weight, *self.weights[part + 1 :]))

    def switched(self, part: int) -> ClientState:
        """Switch a part on or off."""
        return replace(self, on=(*self.on[:part], not self.on[part], *self.on[part + 1 :]))

    def values(self) -> tuple[float, ...]:
        """Effective part weights; all equal when every part is off or has weight 0."""
        found = tuple(weight if on else 0.0 for weight, on in zip(self.weights, self.on, strict=True))
        return found if any(found) else (1.0,) * len(found)

    def address(self) -> dict[str, str]:
        """The parameters of the page's URL, without the names of query and tile."""
        found = {"task": self.task}
        numbers = (("angle", self.angle, 0), ("shift", self.right, 0), ("down", self.down, 0), ("zoom", self.zoom, 1))
        found |= {key: f"{value:.10g}" for key, value, usual in numbers if value != usual}
        if set(self.weights) != {1.0}:
            found["weights"] = ",".join(f"{weight:.10g}" for weight in self.weights)
        if not all(self.on):
            found["off"] = ",".join(str(part + 1) for part, on in enumerate(self.on) if not on)
        found |= {key: "1" for key, open_ in (("why", self.why), ("lab", self.lab)) if open_}
        return found


class PictureNames(Protocol):
    """Gives the names of pictures."""

    def label(self, state: ClientState) -> str:
        """The name of the shown query."""

    def address(self, state: ClientState) -> dict[str, str]:
        """All parameters of the page's URL."""


# Parameters of the page's URL. No client sets those of the second line, so they must never appear.
KEYS = (
    "task", "query", "with", "angle", "shift", "down", "zoom", "weights", "off", "why", "lab",
    "region", "map", "city", "apart", "rings", "heat", "shows", "part", "opacity", "theme",
)  # fmt: skip


def shows_state(names: PictureNames, state: ClientState, link: str | None, status: dict[str, str]) -> bool:
    """Return True when the page's URL and the attributes of its status line agree with the state."""
    if link is None:
        return False
    shown = (status.get("query"), status.get("name"), status.get("angle"))
    wanted = (str(state.query), names.label(state), f"{state.angle:g}")
    return shown == wanted and _given(link) == names.address(state)


def unexpected_links(names: PictureNames, states: Iterable[ClientState], links: Iterable[str]) -> list[str]:
    """URL parameters with values that no state has, such as "angle=20", or "no angle" where the parameter is missing.

    Parameters are compared one by one: the app reads its controls in turn, so one of two moving controls may be a step ahead.
    """
    addresses = [names.address(one) for one in states]
    known = {key: {address.get(key) for address in addresses} for key in KEYS}
    odd = [(key, given.get(key)) for given in map(_given, links) for key in KEYS if given.get(key) not in known[key]]
    return [f"no {key}" if value is None else f"{key}={value}" for key, value in odd]


def _given(link: str) -> dict[str, str]:
    given = dict(parse_qsl(link.removeprefix("?"), keep_blank_values=True))
    return {key: given[key] for key in KEYS if key in given}
