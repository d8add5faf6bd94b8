"""A client over a websocket, which moves controls as viser's page does, and sends hostile messages among them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from tools.fixtures.websocket_client import CHUNK, WebSocketClient
from tools.soak.client import BOUND, PARTS, FaultError, SoakClient
from tools.soak.page import ClientState, read_status


class WebSocketSoakClient(SoakClient):
    """A user of all controls."""

    _talker: WebSocketClient

    def _acts(self) -> dict[Callable[[], None], float]:
        return {
            self._drag: 15, self._pick: 5, self._switch: 2, self._compare: 2, self._why: 2, self._laboratory: 1,
            self._take: 2, self._upload: 2, self._hostile: 2, self._vanish: 1,
        }  # fmt: skip

    def _open(self, link: str) -> None:
        """Connect, send a camera, and greet as the page does."""
        self._talker = talker = WebSocketClient(self._url, origin=self._url, open_timeout=BOUND)
        # The query that each task showed when this page left it.
        self._last_queries: dict[str, int] = {}
        self._before: list[ClientState] = []
        talker.camera()

        def greet() -> None:
            if talker.find("page") is not None:  # while another place is opened, the page has no controls
                talker.tell("hello", {"search": f"?{link}", "small": False})

        # Repeat the greeting, as the page does: the app may not be listening yet.
        self._until(lambda: talker.link is not None, "a first answer", greet)

    def _drag(self) -> None:
        """Drag a slider, or two in turns, as two fingers do."""
        sliders, paths = self._reference.sliders(), {}
        for label in self._rng.sample([*sliders], self._rng.choice([1, 1, 1, 2])):
            values, speed = sliders[label], self._rng.choice([1, 2, 5])
            start, count = self._rng.randrange(len(values)), self._rng.randint(4, 20)
            path = dict.fromkeys(values[(start + speed * i) % len(values)] for i in range(count))
            # Without the value that is there already, so that the answer to the last one is unmistakable.
            paths[label] = [value for value in path if value != self._state.controls[label]]
        self._begin(f"dragged {paths}")
        state, passed = self._state, []
        for step in zip(*paths.values(), strict=False):
            for label, value in zip(paths, step, strict=True):
                self._send(partial(self._talker.set, label, value))
                state = state.with_control(label, value)
                passed.append(state)
                self._rest(0.05)  # as long as viser's page waits
        self._settle("drag", state, passed)

    def _pick(self) -> None:
        """Choose any query."""
        query = self._rng.randrange(len(self._reference.tasks[self._state.task].queries))
        kind = "lab-open" if self._state.lab else "query"
        self._act("pick", lambda: self._talker.tell(kind, query), self._state.showing(query=query))

    def _switch(self) -> None:
        """Switch a part on or off."""
        label = f"Part {self._rng.choice(self._reference.names)}"
        on = not self._state.controls[label]
        self._act("parts", lambda: self._talker.set(label, on), self._state.with_control(label, float(on)))

    def _compare(self) -> None:
        """Compare with any tile, or with the positive."""
        tile = self._rng.randrange(len(self._reference.tasks[self._state.task].gallery))
        if tile % 3:
            self._act("compare", lambda: self._talker.tell("compare", tile), replace(self._state, tile=tile))
        else:
            self._act("compare", lambda: self._talker.set("true tile", True), replace(self._state, tile="truth"))

    def _take(self) -> None:
        """Choose a task."""
        task = self._rng.choice(list(self._reference.tasks))
        if task != self._state.task:
            self._last_queries[self._state.task] = self._state.query
            query = self._reference.same_place(self._state, task, self._last_queries.get(task, 0))
            self._act("task", lambda: self._talker.tell("task", task), self._state.showing(task=task, query=query))

    def _upload(self) -> None:
        """Upload a unique picture."""
        own = self._reference.own_picture(self._rng, f"{self._name} {self._visit} {self._step}".replace(" ", "-"))
        send = partial(self._talker.upload, own.name, own.content, transfer=own.name)
        self._act("upload", send, self._state.showing(own_picture=own))

    def _why(self) -> None:
        """Open or close the explain window; sometimes start a sweep there, and leave it."""
        state = replace(self._state, why=not self._state.why)
        self._act("why", lambda: self._talker.set("Why this answer?", True), state)
        if state.why and self._rng.random() < 0.5:
            self._talker.tell("sweep", self._rng.choice(["rotation", "shift", "zoom"]))
            self._rest(self._rng.uniform(0, 2))
            self._talker.tell("cancel", None)

    def _laboratory(self) -> None:
        """Open or close the failure laboratory, and click through its tabs."""
        state = replace(self._state, lab=not self._state.lab)
        self._act("laboratory", lambda: self._talker.set("All pictures in a table", True), state)
        if state.lab:
            self._until(lambda: "lpn-lab-table" in self._talker.elements, "the laboratory's table")
            self._talker.tell("lab-outcome", "failed")
            self._talker.tell("lab-tab", self._rng.choice(["breakdown", "table"]))

    def _vanish(self) -> None:
        """Vanish in the middle of a drag and an upload, and come back."""
        self._begin("vanished")
        self._talker.set("Rotate", 77)
        self._talker.begin_upload(f"{self._name} {self._visit} {self._step}", CHUNK, 3)
        self._talker.abort()
        self._enter()

    def _hostile(self) -> None:
        """Send invalid messages, which must change nothing, or garbage, which must end the connection."""
        self._begin("sent what no page would")
        choose = self._rng.choice
        for _ in range(self._rng.randint(2, 12)):
            value = choose(["abc", None, [1, 2], {"a": 1}, math.nan, math.inf, 1e300, b"x"])
            self._send(choose(self._attacks(choose(["Rotate", "Zoom", "Opacity"]), value)))
        if self._rng.random() < 0.2:
            self._begin("sent garbage")
            self._talker.raw(choose([b"\xff" * 1000, b"\x91" * 2000, b""]) if self._step % 4 else "text")
            if not self._talker.gone(BOUND):
                raise FaultError("garbage", f"the connection still stands {BOUND:g} s after a frame that is no message")
            self._enter()
        else:
            self._drag()

    def _attacks(self, label: str, value: object) -> list[Callable[[], None]]:
        talker, long = self._talker, "x" * self._rng.randint(1, 59_000)
        return [
            lambda: talker.set(label, value),
            lambda: talker.tell("task", "../../etc"),
            lambda: talker.set("Heat of", long),
            lambda: talker.set(label, "x", "removed"),
            lambda: talker.tell("no such kind", long[:2000]),
            lambda: talker.tell("region", [value]),
            lambda: talker.tell("lab-where", {"a": long[:500]}),
            lambda: talker.send("ShareUrlRequest"),
            lambda: talker.send("GuiUpdateMessage", uuid=long[:100], updates={"value": 77}),
            lambda: talker.camera(position=[0, 0]),
            lambda: talker.upload("../../etc/passwd", b"no picture", transfer=f"{self._name} {time.monotonic()}"),
        ]

    def _leave(self) -> None:
        with suppress(AttributeError):  # it never came in
            self._talker.close()

    def _look(self) -> tuple[str, list[str]]:
        return self._talker.link or "", [self._talker.elements.get(part, "") for part in PARTS]

    def _wait(self, holds: Callable[[], bool]) -> bool:
        done = self._talker.until(holds, 0.5)
        if not done and self._talker.closed.is_set():
            raise FaultError("disconnected", "the server ended the connection while an answer was awaited")
        return done

    def _check(self, states: Sequence[ClientState]) -> None:
        talker, known, self._before = self._talker, [*states, *self._before], [self._state]
        lines, talker.statuses, notices, talker.notices = talker.statuses, [], talker.notices, []
        if refused := [text for title, text in notices if title == "No answer"]:
            raise FaultError("refused", " ".join(refused))
        odd = [line for line in map(read_status, lines) if line and not any(self._shows(one, line) for one in known)]
        if states and odd:
            raise FaultError("foreign state", f"the page showed {odd}, which was not asked for")
