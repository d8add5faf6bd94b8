"""A simulated user: random acts in an order that the seed decides, with hostile messages among them."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from random import Random

from tools.soak.browser_driver import BrowserDriver
from tools.soak.client_state import ClientState
from tools.soak.record import OWN_ERROR, Fault, Record, SoakAnswer
from tools.soak.reference import Reference
from tools.soak.websocket_driver import FaultError, PageDriver, StoppedError, WebSocketDriver

# Longest rest between two acts in seconds; a tenth of the rests may be four times as long.
PAUSE = 1.0
# Seconds to wait for the failure laboratory's table.
LABORATORY = 60.0
# Frames that must end the connection.
GARBAGE = ("text", b"\xff" * 1000, b"\x91" * 2000, b"")
_ENTER_AT_ONCE = 0.4


class SoakClient:
    """One client, which visits the page again and again until the soak ends.

    Args:
        client_name: such as "client 3"; with the seed it decides every act.
        driver: operates the client's page.
        stays: True to stay on the first visit.
    """

    def __init__(
        self,
        client_name: str,
        seed: int,
        driver: PageDriver,
        reference: Reference,
        record: Record,
        stop: threading.Event,
        stays: bool,
    ) -> None:
        self._client_name, self._driver, self._reference, self._record = client_name, driver, reference, record
        self._rng, self._stop, self._stays = Random(f"{seed} {client_name}"), stop, stays
        self._visit = self._step = 0
        self._did = ""
        self._state = reference.first()
        # The query that each task showed when this page left it.
        self._last_queries: dict[str, int] = {}

    def run(self) -> None:
        """Visit again and again; a fault ends the visit, not the client."""
        try:
            while not self._stop.is_set():
                self._visit += 1
                self._visited()
                self._stop.wait(0.0 if self._rng.random() < _ENTER_AT_ONCE else self._rng.uniform(0, 3))
        except StoppedError:
            pass
        finally:
            self._driver.leave("close")

    def _visited(self) -> None:
        try:
            with self._record.connected():
                self._enter()
                for _ in range(10**9 if self._stays else self._rng.randint(5, 18)):
                    self._act()
                    longer = self._rng.random() < 0.1
                    self._rest(self._rng.uniform(0, 4 * PAUSE if longer else PAUSE))
                self._leave()
        except FaultError as fault:
            text = f"visit {self._visit}, {self._did}: {fault.text}"
            self._record.fault(Fault(fault.kind, self._client_name, self._step, text))
            self._driver.leave("vanish")
        except StoppedError:
            raise
        except Exception as error:
            text = "".join(traceback.format_exception(error))
            self._record.fault(Fault(OWN_ERROR, self._client_name, self._step, f"{self._did}: {text}"))
            self._driver.leave("vanish")

    def _enter(self) -> None:
        """Open the page by a link."""
        rng, first = self._rng, self._reference.first()
        task = rng.choice(list(self._reference.sides))
        state = replace(first, task=task, query=rng.randrange(len(self._reference.sides[task].queries)))
        if rng.random() < 0.5:
            state = replace(state, angle=float(rng.randint(-180, 180)), zoom=rng.choice([1.0, 1.5, 0.75]))
        if rng.random() < 0.3:
            state = state.weighed(rng.randrange(self._reference.parts), rng.choice([0.0, 0.5, 2.0]))
        link = "&".join(f"{key}={value}" for key, value in state.address().items()) + f"&query=~{state.query}"
        self._begin(f"opened ?{link}")
        self._driver.enter(link)
        self._state, self._last_queries = state, {}
        self._settle("open", state, [first])  # the page may show the initial state before its greeting arrives

    def _act(self) -> None:
        acts: list[tuple[float, Callable[[], None]]] = [
            (10, self._drag),
            (4, self._pick),
            (4, self._weigh),
            (2, self._why),
            (1, self._laboratory),
            (2, self._upload),
            (2, self._turn_to),
        ]
        if isinstance(self._driver, WebSocketDriver):
            acts += [(3, self._drag_two), (2, self._compare), (1, self._find), (2, self._hostile)]
        self._rng.choices([act for _, act in acts], [weight for weight, _ in acts])[0]()

    def _drag(self) -> None:
        """Drag a slider, or type into its number box."""
        label = self._rng.choice(["Rotate", "Rotate", "Zoom", *self._more()])
        values = self._path(label, self._rng.randint(4, 40))
        if isinstance(self._driver, BrowserDriver) and self._rng.random() < 0.3:
            self._begin(f"typed {values[-1]:g} beside {label}")
            self._driver.fill(label, values[-1])
            before = self._state
            mistyped = [
                self._moved(before, label, value) for value in self._values(label)
            ]  # see tools.soak.browser_driver.TYPINGS
            self._settle("drag", self._moved(before, label, values[-1]), mistyped)
        else:
            self._dragged(label, values)

    def _more(self) -> list[str]:
        return ["Shift right", "Shift down"] if isinstance(self._driver, WebSocketDriver) else []

    def _dragged(self, label: str, values: list[float]) -> None:
        self._begin(f"dragged {label} {len(values)} times to {values[-1]:g}")
        before = self._state
        left = self._driver.drag(label, values)
        # A mouse passes values that depend on the slider's width in pixels.
        passed = self._values(label) if isinstance(self._driver, BrowserDriver) else values
        self._settle("drag", self._moved(before, label, left), [self._moved(before, label, value) for value in passed])

    def _drag_two(self) -> None:
        """Drag two sliders in turns, as two fingers do."""
        one, other = self._rng.sample(["Rotate", "Zoom", "Shift right", "Shift down"], 2)
        paths = {label: self._path(label, 10) for label in (one, other)}
        self._begin(f"dragged {one} to {paths[one][-1]:g} and {other} to {paths[other][-1]:g} by turns")
        state, path = self._state, []
        for at in range(10):
            for label in (one, other):
                state = self._moved(state, label, self._driver.drag(label, [paths[label][at]]))
                path.append(state)
        self._settle("drag", state, path)

    def _path(self, label: str, count: int) -> list[float]:
        """Values of a drag; the last one occurs only once, so its answer is unmistakable."""
        known = self._values(label)
        start, speed = self._rng.randrange(len(known)), self._rng.choice([1, 2, 5])
        values = [known[(start + speed * i) % len(known)] for i in range(count)]
        taken = {*values[:-1], self._value(label)}
        while values[-1] in taken:
            values[-1] = known[self._rng.randrange(len(known))]
        return values

    def _values(self, label: str) -> list[float]:
        """All values of a slider."""
        right, down = self._reference.reach
        low, high, unit = {
            "Rotate": (-180, 180, 1.0), "Zoom": (0.25, 4.0, 0.05), "Shift right": (-right, right, 1.0),
            "Shift down": (-down, down, 1.0),
        }.get(label, (0.0, 2.0, 0.05))  # fmt: skip
        return [round(low + unit * step, 2) for step in range(round((high - low) / unit) + 1)]

    def _value(self, label: str) -> float:
        state = self._state
        if label in self._weights():
            return state.weights[self._weights().index(label)]
        return {"Rotate": state.angle, "Zoom": state.zoom, "Shift right": state.right, "Shift down": state.down}[label]

    def _moved(self, state: ClientState, label: str, value: float) -> ClientState:
        if label in self._weights():
            return state.weighed(self._weights().index(label), value)
        if label in ("Shift right", "Shift down"):
            return replace(state, **{"right" if label == "Shift right" else "down": round(value)})  # type: ignore[arg-type]
        return replace(state, **{"angle" if label == "Rotate" else "zoom": value})  # type: ignore[arg-type]

    def _weights(self) -> list[str]:
        return [f"Weight {name}" for name in self._reference.names]

    def _weigh(self) -> None:
        """Drag a part's weight, or switch a part on or off."""
        part = self._rng.randrange(self._reference.parts)
        if isinstance(self._driver, BrowserDriver):
            self._driver.open_tab("Parts")
        if self._rng.random() < 0.6:
            label = self._weights()[part]
            self._dragged(label, self._path(label, self._rng.randint(4, 20)))
        else:
            self._begin(f"switched part {part + 1}")
            self._driver.switch(f"Part {self._reference.names[part]}", not self._state.on[part])
            self._settle("parts", self._state.switched(part))
        if isinstance(self._driver, BrowserDriver):
            self._driver.open_tab("Query")

    def _pick(self) -> None:
        """Choose the next query, the previous one, or any."""
        queries = len(self._reference.sides[self._state.task].queries)
        steps = not self._state.lab and self._state.own_picture is None  # the buttons would step through own pictures
        if steps and (isinstance(self._driver, BrowserDriver) or self._rng.random() < 0.5):
            option, by = self._rng.choice([("Next ›", 1), ("‹ Previous", -1)])
            self._begin(f"pressed {option}")
            self._driver.choose("Go to", option)
            query = (self._state.query + by) % queries
        elif isinstance(self._driver, WebSocketDriver):
            query = self._rng.randrange(queries)
            kind = "lab-open" if self._state.lab else "query"
            self._begin(f"picked query {query} by {kind}")
            self._driver.tell(kind, query)
        else:
            return
        self._settle("pick", self._state.picked(query))

    def _find(self) -> None:
        """Type a query's full name."""
        side = self._reference.sides[self._state.task]
        if not side.unique or not isinstance(self._driver, WebSocketDriver):
            return
        query = self._rng.choice(side.unique)
        self._begin(f"typed the name of query {query}")
        # The app ignores trailing spaces; they make the same name a change of the control.
        self._driver.set("Find name", side.queries[query].name + " " * (self._step % 50))
        self._settle("pick", self._state.picked(query))

    def _compare(self) -> None:
        """Compare with any tile, or with the positive."""
        assert isinstance(self._driver, WebSocketDriver)
        side = self._reference.sides[self._state.task]
        if self._rng.random() < 0.3:
            self._begin("compared the true tile")
            self._driver.press("true tile")
            self._settle("compare", replace(self._state, tile="truth"))
            return
        index = self._rng.randrange(len(side.gallery))
        self._begin(f"compared tile {index}")
        self._driver.tell("compare", index)
        self._settle("compare", replace(self._state, tile=index))

    def _turn_to(self) -> None:
        """Choose another task where there is one."""
        others = [task for task in self._reference.sides if task != self._state.task]
        if others:
            task = self._rng.choice(others)
            self._begin(f"took {task}")
            self._last_queries[self._state.task] = self._state.query
            query = self._reference.same_place(self._state, task, self._last_queries.get(task, 0))
            self._driver.take(task)
            self._settle("pick", self._state.turned_to(task, query))

    def _upload(self) -> None:
        """Upload a unique picture, then rotate it."""
        own_picture = self._reference.own_picture(
            self._rng, f"{self._client_name} {self._visit} {self._step}".replace(" ", "-")
        )
        self._begin(f"uploaded {own_picture.name}")
        self._driver.send(own_picture)
        self._settle("upload", self._state.sent(own_picture))
        self._dragged("Rotate", self._path("Rotate", self._rng.randint(4, 20)))

    def _why(self) -> None:
        """Open or close the explain window; sometimes start a sweep there."""
        self._begin("opened or closed Why")
        self._driver.press("Why this answer?")
        self._settle("why", replace(self._state, why=not self._state.why))
        if self._state.why and isinstance(self._driver, WebSocketDriver) and self._rng.random() < 0.5:
            self._driver.tell("sweep", self._rng.choice(["rotation", "shift", "zoom"]))
            self._rest(self._rng.uniform(0, 2))
            if self._rng.random() < 0.7:
                self._driver.tell("cancel", None)

    def _laboratory(self) -> None:
        """Open or close the failure laboratory, and click through its tabs."""
        self._begin("opened or closed the laboratory")
        self._driver.press("All pictures in a table")
        self._settle("laboratory", replace(self._state, lab=not self._state.lab))
        if not self._state.lab or not isinstance(self._driver, WebSocketDriver):
            return
        talker, deadline = self._driver.talker, time.monotonic() + LABORATORY
        while "lpn-lab-table" not in talker.elements:
            self._rest(0.1)
            if time.monotonic() > deadline:
                raise FaultError("no answer", f"the laboratory has no table after {LABORATORY:g} s")
        for kind, value in (("lab-outcome", "failed"), ("lab-tab", "breakdown"), ("lab-tab", "table")):
            if self._rng.random() < 0.5:
                self._driver.tell(kind, value)
                self._rest(0.1)

    def _hostile(self) -> None:
        """Send invalid messages, which must change nothing, or garbage, which must end the connection."""
        driver, rng = self._driver, self._rng
        assert isinstance(driver, WebSocketDriver)
        self._begin("sent what no page would")
        for _ in range(rng.randint(1, 6)):
            label = rng.choice(["Rotate", "Zoom", "Opacity"])
            value = rng.choice(["abc", None, [1, 2], {"a": 1}, math.nan, math.inf, 1e300, b"x"])
            for act in rng.sample(self._attacks(driver, label, value), 2):
                act()
        if rng.random() < 0.2:
            self._begin("sent garbage")
            driver.raw(rng.choice(GARBAGE))
            if not driver.gone(30):
                raise FaultError("garbage", "the connection still stands 30 s after a frame that is no message")
            driver.leave("vanish")
            self._enter()
            return
        self._dragged("Rotate", self._path("Rotate", 3))

    def _attacks(self, driver: WebSocketDriver, label: str, value: object) -> list[Callable[[], None]]:
        talker, long = driver.talker, "x" * self._rng.randint(1, 59_000)
        return [
            lambda: driver.set(label, value),
            lambda: driver.tell("task", "../../etc"),
            lambda: driver.set("Heat of", long),
            lambda: driver.set(label, "x", "removed"),
            lambda: driver.tell("no such kind", long[:2000]),
            lambda: driver.tell("region", [value]),
            lambda: driver.tell("lab-where", {"a": long[:500]}),
            lambda: talker.send("ShareUrlRequest"),
            lambda: talker.send("GuiUpdateMessage", uuid=long[:100], updates={"value": 77}),
            lambda: talker.camera(position=[0, 0]),
            lambda: talker.upload(
                "../../etc/passwd", b"no picture", transfer=f"{self._client_name} {time.monotonic()}"
            ),
        ]

    def _leave(self) -> None:
        """Close the page, or vanish in the middle of an act."""
        how = self._rng.choice(["close", "vanish", "vanish in a drag", "vanish in an upload"])
        self._begin(f"left: {how}")
        if isinstance(self._driver, WebSocketDriver) and how == "vanish in a drag":
            self._driver.drag("Rotate", self._path("Rotate", 6))
        if isinstance(self._driver, WebSocketDriver) and how == "vanish in an upload":
            self._driver.begin_upload(f"{self._client_name} {self._visit}")
        self._driver.leave("close" if how == "close" else "vanish")

    def _begin(self, did: str) -> None:
        if self._stop.is_set():
            raise StoppedError
        self._step += 1
        self._did = did

    def _settle(self, kind: str, state: ClientState, path: list[ClientState] | None = None) -> None:
        same, self._state = state == self._state and kind != "open", state
        settled = self._driver.settle(state, path or ())
        seconds = None if same else settled.seconds  # nothing changed, so there is no answer to time
        text = f"visit {self._visit}, {self._did}"
        self._record.answer(SoakAnswer(kind, self._client_name, self._step, text, state, settled.shown, seconds))

    def _rest(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise StoppedError
