"""A client over the channel, which sets fields and does actions like the page, with hostile messages in between."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from websockets.exceptions import ConnectionClosed

from tools.fixtures.screen_tab import PART, ScreenTab
from tools.soak.client import BOUND, FaultError, SoakClient
from tools.soak.reference import ClientState, PageContent, ShownTile


class WebSocketSoakClient(SoakClient):
    """A user of all fields."""

    _tab: ScreenTab

    def _acts(self) -> dict[Callable[[], None], float]:
        return {
            self._drag: 15, self._pick: 5, self._weigh: 3, self._compare: 2, self._heat: 2, self._take: 2,
            self._upload: 2, self._hostile: 2, self._vanish: 1,
        }  # fmt: skip

    def _open(self, link: str) -> None:
        self._tab = ScreenTab(self._url, origin=self._url.partition("?")[0].rstrip("/"), open_timeout=BOUND)
        self._before = self._state
        self._tab.act("open", search=f"?{link}")

    def _drag(self) -> None:
        """Turn the photo by many angles, of which the server may leave some out."""
        start, speed = self._rng.randint(-180, 180), self._rng.choice([1, 2, 5])
        angles = [float((start + speed * i + 180) % 360 - 180) for i in range(self._rng.randint(4, 20))]
        angles = [angle for angle in dict.fromkeys(angles) if angle != self._state.angle]
        self._begin(f"dragged by {angles}")
        passed = [replace(self._state, angle=angle) for angle in angles]
        for state in passed:
            self._send(partial(self._tab.set, angle=state.angle))
            self._rest(0.03)
        self._settle("drag", passed[-1], passed)

    def _pick(self) -> None:
        query = self._rng.randrange(len(self._reference.tasks[self._state.task].queries))
        shown = query == self._state.query and not self._state.own  # it stays as it is
        state = self._state if shown else self._state.showing(query=query)
        self._act("pick", lambda: self._tab.set(query=query, own=""), state)

    def _weigh(self) -> None:
        weights = self._weights() if self._rng.random() < 0.7 else ()
        self._act("parts", lambda: self._tab.set(weights=list(weights)), replace(self._state, weights=weights))

    def _compare(self) -> None:
        tile = self._rng.randrange(len(self._reference.tasks[self._state.task].gallery))
        self._act("compare", lambda: self._tab.set(compare=tile), replace(self._state, compare=tile))

    def _heat(self) -> None:
        heat = self._rng.choice(["activation", "evidence", "occlusion"])
        self._act("heat", lambda: self._tab.set(heat=heat), self._state)

    def _take(self) -> None:
        task = self._rng.choice(list(self._reference.tasks))
        if task != self._state.task:
            state = self._state.showing(task=task, query=0)
            self._act("task", lambda: self._tab.set(task=task, scoring="plain"), state)

    def _upload(self) -> None:
        own = self._reference.own_picture(self._rng, f"{self._name} {self._visit} {self._step}".replace(" ", "-"))
        self._act("upload", lambda: self._tab.upload(own.name, own.content), self._state.showing(own=own))

    def _vanish(self) -> None:
        """Vanish in the middle of a drag and an upload, and come back."""
        self._begin("vanished")
        self._tab.set(angle=77)
        self._tab.act("upload", name="half.jpg", size=3 * PART)
        self._tab.socket.send(bytes(PART))
        self._tab.abort()
        self._enter()

    def _hostile(self) -> None:
        """Send invalid messages, which must change nothing, or a frame that is too large, which ends the connection."""
        self._begin("sent what no page would")
        for _ in range(self._rng.randint(2, 12)):
            self._send(self._rng.choice(self._attacks()))
        if self._rng.random() < 0.2:
            self._begin("sent too much")
            self._tab.socket.send("x" * 2_000_000)
            if not self._tab.closed(BOUND):
                raise FaultError("garbage", f"the connection still stands {BOUND:g} s after a frame of 2 MB")
            self._enter()
        else:
            self._drag()

    def _attacks(self) -> list[Callable[[], object]]:
        tab, choose, long = self._tab, self._rng.choice, "x" * self._rng.randint(1, 15_000)
        value = choose(["abc", None, [1, 2], {"a": 1}, math.nan, math.inf, 1e300, -1])
        name = choose(["angle", "query", "weights", "compare", "task", "place", "heat"])
        return [
            lambda: tab.socket.send(long),
            lambda: tab.send({"set": value}),
            lambda: tab.send({"do": long, "args": {}}),
            lambda: tab.set(task="../../etc", removed=long),
            lambda: tab.set(**{name: {"a": long}}),
            lambda: tab.send({"do": "upload", "args": {"name": "../../etc/passwd", "size": value}}),
            lambda: tab.act("upload", name=long, size=10**12),
            lambda: tab.act("pick", x=value, y=value),
            lambda: tab.act("hover", part=value),
            lambda: tab.socket.send(b"bytes that belong to nothing"),
            lambda: tab.set(query=-1),
        ]

    def _leave(self) -> None:
        with suppress(AttributeError):  # it never came in
            self._tab.close()

    def _shows(self, state: ClientState) -> bool:
        result = self._tab.last.get("result")
        return (
            result is not None
            and _of(result["state"]) == _fields(state)
            and (result["photo"]["name"] == state.own.name if state.own else not result["state"]["own"])
        )

    def _look(self) -> PageContent:
        result = self._tab.last["result"]
        tiles = [result["tiles"][str(index)] for index in result["strip"]]
        shown = [ShownTile(int(tile["rank"]), tile["name"], float(tile["distance"])) for tile in tiles]
        return PageContent(result["photo"]["name"], shown, result["tiles"][str(result["answer"])]["shares"])

    def _said(self) -> str:
        last = {name: self._tab.last.get(name) for name in ("error", "busy", "note", "state")}
        return f"; it says {last}, and shows {self._tab.last.get('result', {}).get('state')}"

    def _wait(self, holds: Callable[[], bool]) -> bool:
        if holds():
            return True
        try:
            self._tab.receive(0.5)
        except ConnectionClosed as error:
            raise FaultError("disconnected", "the server ended the connection while a result was awaited") from error
        return holds()

    def _check(self, states: Sequence[ClientState]) -> None:
        known, self._before = [*states, self._state, self._before], self._state
        odd = [found for found in map(_of, self._tab.results) if found not in map(_fields, known)]
        self._tab.results = []
        if states and odd:
            raise FaultError("foreign state", f"the page showed {odd}, which was not asked for")


# The fields that an answer's numbers depend on; the query does not matter while an own photo is shown.
_FIELDS = ("task", "query", "angle", "weights", "compare")


def _fields(state: ClientState) -> dict[str, Any]:
    return _of(vars(state)) | {"weights": list(state.weights)}


def _of(state: dict[str, Any]) -> dict[str, Any]:
    return {name: state[name] for name in _FIELDS}
