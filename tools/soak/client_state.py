"""What a client has asked for: what its page must come to show, by what the controls say they do, not by the app's code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, Protocol
from urllib.parse import parse_qsl


@dataclass(frozen=True, eq=False)
class OwnPicture:
    """A picture of a client's own: the name it goes by, which no other has, and the file."""

    name: str
    content: bytes


@dataclass(frozen=True)
class ClientState:
    """All choices of one client that its ranking depends on, and which windows it has open.

    Attributes:
        task: such as "drone-to-satellite".
        query: position in the task's queries; kept under an own picture.
        own: shown in place of the query.
        angle, right, down, zoom: degrees, pixels of the network's input twice, and a factor, done to the query.
        weights, on: of each part, 0 .. 2, and whether it is switched on.
        tile: gallery position that is compared, "truth", or None for the top match.
        why, lab: whether the windows are open.
    """

    task: str
    query: int
    weights: tuple[float, ...]
    on: tuple[bool, ...]
    own_picture: OwnPicture | None = None
    angle: float = 0.0
    right: int = 0
    down: int = 0
    zoom: float = 1.0
    tile: int | Literal["truth"] | None = None
    why: bool = False
    lab: bool = False

    def picked(self, query: int) -> ClientState:
        """Another query: its own picture, upright and whole."""
        return replace(self.upright(), query=query, own_picture=None, tile=None)

    def sent(self, own_picture: OwnPicture) -> ClientState:
        """A picture of one's own, upright and whole."""
        return replace(self.upright(), own_picture=own_picture, tile=None)

    def turned_to(self, task: str) -> ClientState:
        """Another direction: its first query."""
        return self if task == self.task else replace(self, task=task, query=0, own_picture=None, tile=None)

    def upright(self) -> ClientState:
        """The query as it was taken."""
        return replace(self, angle=0.0, right=0, down=0, zoom=1.0)

    def weighed(self, part: int, weight: float) -> ClientState:
        """Another weight of a part."""
        return replace(self, weights=(*self.weights[:part], weight, *self.weights[part + 1 :]))

    def switched(self, part: int) -> ClientState:
        """A part on or off."""
        return replace(self, on=(*self.on[:part], not self.on[part], *self.on[part + 1 :]))

    def values(self) -> tuple[float, ...]:
        """What each part counts; all alike where nothing is left."""
        found = tuple(weight if on else 0.0 for weight, on in zip(self.weights, self.on, strict=True))
        return found if any(found) else (1.0,) * len(found)

    def address(self) -> dict[str, str]:
        """What the page's address must say of it, but for the names of query and tile."""
        text = {"task": self.task}
        numbers = (("angle", self.angle, 0), ("shift", self.right, 0), ("down", self.down, 0), ("zoom", self.zoom, 1))
        text |= {key: f"{value:.10g}" for key, value, usual in numbers if value != usual}
        if set(self.weights) != {1.0}:
            text["weights"] = ",".join(f"{weight:.10g}" for weight in self.weights)
        if not all(self.on):
            text["off"] = ",".join(str(part + 1) for part, on in enumerate(self.on) if not on)
        text |= {key: "1" for key, open_ in (("why", self.why), ("lab", self.lab)) if open_}
        return text


class PictureNames(Protocol):
    """Knows the pictures' names."""

    def label(self, state: ClientState) -> str:
        """The name of the query."""

    def address(self, state: ClientState) -> dict[str, str]:
        """What the page's address must say of it."""


# What the page's address says of a state. No client asks for those of the second line, so they may never be there.
KEYS = (
    "task", "query", "with", "angle", "shift", "down", "zoom", "weights", "off", "why", "lab",
    "region", "map", "city", "apart", "rings", "heat", "shows", "part", "opacity", "theme",
)  # fmt: skip


def shows_state(names: PictureNames, state: ClientState, link: str | None, status: dict[str, str]) -> bool:
    """Whether a page's address and the attributes of its status line say that it shows what was asked for."""
    if link is None:
        return False
    shown = (status.get("query"), status.get("name"), status.get("angle"))
    wanted = (str(state.query), names.label(state), f"{state.angle:g}")
    return shown == wanted and _given(link) == names.address(state)


def unexpected_links(names: PictureNames, state: Iterable[ClientState], links: Iterable[str]) -> list[str]:
    """What a page's addresses say that nothing of what was asked for has, such as "angle=20"; "no angle" where one says none.

    Each key by itself: the app reads its controls one after the other, so of two that move one may be a step ahead.
    """
    text = [names.address(one) for one in state]
    known = {key: {one.get(key) for one in text} for key in KEYS}
    odd = [(key, given.get(key)) for given in map(_given, links) for key in KEYS if given.get(key) not in known[key]]
    return [f"no {key}" if value is None else f"{key}={value}" for key, value in odd]


def _given(link: str) -> dict[str, str]:
    given = dict(parse_qsl(link.removeprefix("?"), keep_blank_values=True))
    return {key: given[key] for key in KEYS if key in given}
