"""What one client does: a person's acts in an order that its seed decides, and now and then what no person would do."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from random import Random

from tools.soak.asked import Asked
from tools.soak.chromium import Tab
from tools.soak.hand import FaultError, Hand, Socket, StoppedError
from tools.soak.record import OWN_ERROR, Answer, Fault, Record
from tools.soak.reference import Reference

PAUSE = 1.0
"""Seconds that a client rests between two acts, at most; one act in ten is followed by a longer rest."""
LABORATORY = 60.0
"""Seconds within which the laboratory has its table."""
GARBAGE = ("text", b"\xff" * 1000, b"\x91" * 2000, b"")
"""Frames that end the connection."""
_ENTER_AT_ONCE = 0.4


class Client:
    """One client, who comes and goes until the soak ends.

    Args:
        who: its name, such as "client 3"; with the seed it decides all that it does.
        hand: at its page.
        stays: whether it never leaves, so that its answers are those of a server that nobody else uses.
    """

    def __init__(
        self, who: str, seed: int, hand: Hand, reference: Reference, record: Record, stop: threading.Event, stays: bool
    ) -> None:
        self._who, self._hand, self._reference, self._record = who, hand, reference, record
        self._rng, self._stop, self._stays = Random(f"{seed} {who}"), stop, stays
        self._visit = self._step = 0
        self._did = ""
        self._asked = reference.first()

    def run(self) -> None:
        """Visit again and again. Whatever goes wrong ends a visit, not the client."""
        try:
            while not self._stop.is_set():
                self._visit += 1
                self._visited()
                self._stop.wait(0.0 if self._rng.random() < _ENTER_AT_ONCE else self._rng.uniform(0, 3))
        except StoppedError:
            pass
        finally:
            self._hand.leave("close")

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
            said = f"visit {self._visit}, {self._did}: {fault.text}"
            self._record.fault(Fault(fault.kind, self._who, self._step, said))
            self._hand.leave("vanish")
        except StoppedError:
            raise
        except Exception as error:
            said = "".join(traceback.format_exception(error))
            self._record.fault(Fault(OWN_ERROR, self._who, self._step, f"{self._did}: {said}"))
            self._hand.leave("vanish")

    def _enter(self) -> None:
        """Open the page by a link."""
        rng, first = self._rng, self._reference.first()
        task = rng.choice(list(self._reference.sides))
        asked = replace(first, task=task, query=rng.randrange(len(self._reference.sides[task].queries)))
        if rng.random() < 0.5:
            asked = replace(asked, angle=float(rng.randint(-180, 180)), zoom=rng.choice([1.0, 1.5, 0.75]))
        if rng.random() < 0.3:
            asked = asked.weighed(rng.randrange(self._reference.parts), rng.choice([0.0, 0.5, 2.0]))
        link = "&".join(f"{key}={value}" for key, value in asked.address().items()) + f"&query=~{asked.query}"
        self._begin(f"opened ?{link}")
        self._hand.enter(link)
        self._asked = asked
        self._settle("open", asked, [first])  # which a page may be shown until it is heard

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
        if isinstance(self._hand, Socket):
            acts += [(3, self._drag_two), (2, self._compare), (1, self._find), (2, self._hostile)]
        self._rng.choices([act for _, act in acts], [weight for weight, _ in acts])[0]()

    def _drag(self) -> None:
        """One slider, moved back and forth, or a number typed beside it."""
        label = self._rng.choice(["Rotate", "Rotate", "Zoom", *self._more()])
        values = self._path(label, self._rng.randint(4, 40))
        if isinstance(self._hand, Tab) and self._rng.random() < 0.3:
            self._begin(f"typed {values[-1]:g} beside {label}")
            self._hand.fill(label, values[-1])
            before = self._asked
            mistyped = [
                self._moved(before, label, value) for value in self._values(label)
            ]  # see tools.soak.chromium.TYPINGS
            self._settle("drag", self._moved(before, label, values[-1]), mistyped)
        else:
            self._dragged(label, values)

    def _more(self) -> list[str]:
        return ["Shift right", "Shift down"] if isinstance(self._hand, Socket) else []

    def _dragged(self, label: str, values: list[float]) -> None:
        self._begin(f"dragged {label} {len(values)} times to {values[-1]:g}")
        before = self._asked
        left = self._hand.drag(label, values)
        # What a mouse passes is a matter of pixels.
        passed = self._values(label) if isinstance(self._hand, Tab) else values
        self._settle("drag", self._moved(before, label, left), [self._moved(before, label, value) for value in passed])

    def _drag_two(self) -> None:
        """Two sliders by turns, as two fingers do."""
        one, other = self._rng.sample(["Rotate", "Zoom", "Shift right", "Shift down"], 2)
        paths = {label: self._path(label, 10) for label in (one, other)}
        self._begin(f"dragged {one} to {paths[one][-1]:g} and {other} to {paths[other][-1]:g} by turns")
        asked, path = self._asked, []
        for at in range(10):
            for label in (one, other):
                asked = self._moved(asked, label, self._hand.drag(label, [paths[label][at]]))
                path.append(asked)
        self._settle("drag", asked, path)

    def _path(self, label: str, count: int) -> list[float]:
        """Values of a drag, which ends where the slider was at no time of it."""
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
        asked = self._asked
        if label in self._weights():
            return asked.weights[self._weights().index(label)]
        return {"Rotate": asked.angle, "Zoom": asked.zoom, "Shift right": asked.right, "Shift down": asked.down}[label]

    def _moved(self, asked: Asked, label: str, value: float) -> Asked:
        if label in self._weights():
            return asked.weighed(self._weights().index(label), value)
        if label in ("Shift right", "Shift down"):
            return replace(asked, **{"right" if label == "Shift right" else "down": round(value)})  # type: ignore[arg-type]
        return replace(asked, **{"angle" if label == "Rotate" else "zoom": value})  # type: ignore[arg-type]

    def _weights(self) -> list[str]:
        return [f"Weight {name}" for name in self._reference.names]

    def _weigh(self) -> None:
        """A part's weight dragged, or a part switched on or off."""
        part = self._rng.randrange(self._reference.parts)
        if isinstance(self._hand, Tab):
            self._hand.open_tab("Parts")
        if self._rng.random() < 0.6:
            label = self._weights()[part]
            self._dragged(label, self._path(label, self._rng.randint(4, 20)))
        else:
            self._begin(f"switched part {part + 1}")
            self._hand.switch(f"Part {self._reference.names[part]}", not self._asked.on[part])
            self._settle("parts", self._asked.switched(part))
        if isinstance(self._hand, Tab):
            self._hand.open_tab("Query")

    def _pick(self) -> None:
        """Another query: the next, the one before, or any."""
        queries = len(self._reference.sides[self._asked.task].queries)
        if not self._asked.lab and (isinstance(self._hand, Tab) or self._rng.random() < 0.5):
            option, by = self._rng.choice([("Next ›", 1), ("‹ Previous", -1)])
            self._begin(f"pressed {option}")
            self._hand.choose("Go to", option)
            query = (self._asked.query + by) % queries
        elif isinstance(self._hand, Socket):
            query = self._rng.randrange(queries)
            kind = "lab-open" if self._asked.lab else "query"
            self._begin(f"picked query {query} by {kind}")
            self._hand.tell(kind, query)
        else:
            return
        self._settle("pick", self._asked.picked(query))

    def _find(self) -> None:
        """A query by its name, typed in full."""
        side = self._reference.sides[self._asked.task]
        if not side.unique or not isinstance(self._hand, Socket):
            return
        query = self._rng.choice(side.unique)
        self._begin(f"typed the name of query {query}")
        # The same name twice would be no change, so spaces follow that do not count.
        self._hand.set("Find name", side.queries[query].name + " " * (self._step % 50))
        self._settle("pick", self._asked.picked(query))

    def _compare(self) -> None:
        """Another tile of those that are ranked, or the true one."""
        assert isinstance(self._hand, Socket)
        side = self._reference.sides[self._asked.task]
        if self._rng.random() < 0.3:
            self._begin("compared the true tile")
            self._hand.press("true tile")
            self._settle("compare", replace(self._asked, tile="truth"))
            return
        index = self._rng.randrange(len(side.gallery))
        self._begin(f"compared tile {index}")
        self._hand.tell("compare", index)
        self._settle("compare", replace(self._asked, tile=index))

    def _turn_to(self) -> None:
        """Another direction, where there is one."""
        others = [task for task in self._reference.sides if task != self._asked.task]
        if others:
            task = self._rng.choice(others)
            self._begin(f"took {task}")
            self._hand.choose("Task", task)
            self._settle("pick", self._asked.turned_to(task))

    def _upload(self) -> None:
        """A picture that no other client has, turned."""
        own = self._reference.own(self._rng, f"{self._who} {self._visit} {self._step}".replace(" ", "-"))
        self._begin(f"uploaded {own.name}")
        self._hand.send(own)
        self._settle("upload", self._asked.sent(own))
        self._dragged("Rotate", self._path("Rotate", self._rng.randint(4, 20)))

    def _why(self) -> None:
        """The window of reasons opened, a profile begun there, and closed again."""
        self._begin("opened or closed Why")
        self._hand.press("Why this tile?")
        self._settle("why", replace(self._asked, why=not self._asked.why))
        if self._asked.why and isinstance(self._hand, Socket) and self._rng.random() < 0.5:
            self._hand.tell("sweep", self._rng.choice(["rotation", "shift", "zoom"]))
            self._rest(self._rng.uniform(0, 2))
            if self._rng.random() < 0.7:
                self._hand.tell("cancel", None)

    def _laboratory(self) -> None:
        """The laboratory opened, looked through, and closed again."""
        self._begin("opened or closed the laboratory")
        self._hand.press("Failure laboratory")
        self._settle("laboratory", replace(self._asked, lab=not self._asked.lab))
        if not self._asked.lab or not isinstance(self._hand, Socket):
            return
        talker, deadline = self._hand.talker, time.monotonic() + LABORATORY
        while "lpn-lab-table" not in talker.elements:
            self._rest(0.1)
            if time.monotonic() > deadline:
                raise FaultError("no answer", f"the laboratory has no table after {LABORATORY:g} s")
        for kind, value in (("lab-outcome", "failed"), ("lab-page", 1), ("lab-tab", "breakdown"), ("lab-tab", "table")):
            if self._rng.random() < 0.5:
                self._hand.tell(kind, value)
                self._rest(0.1)

    def _hostile(self) -> None:
        """What no page sends; none of it may matter, and garbage ends the connection."""
        hand, rng = self._hand, self._rng
        assert isinstance(hand, Socket)
        self._begin("sent what no page would")
        for _ in range(rng.randint(1, 6)):
            label = rng.choice(["Rotate", "Zoom", "Opacity"])
            value = rng.choice(["abc", None, [1, 2], {"a": 1}, math.nan, math.inf, 1e300, b"x"])
            for act in rng.sample(self._attacks(hand, label, value), 2):
                act()
        if rng.random() < 0.2:
            self._begin("sent garbage")
            hand.raw(rng.choice(GARBAGE))
            if not hand.gone(30):
                raise FaultError("garbage", "the connection still stands 30 s after a frame that is no message")
            hand.leave("vanish")
            self._enter()
            return
        self._dragged("Rotate", self._path("Rotate", 3))

    def _attacks(self, hand: Socket, label: str, value: object) -> list[Callable[[], None]]:
        talker, long = hand.talker, "x" * self._rng.randint(1, 59_000)
        return [
            lambda: hand.set(label, value),
            lambda: hand.set("Task", "../../etc"),
            lambda: hand.set("Heat of", long),
            lambda: hand.set(label, "x", "removed"),
            lambda: hand.tell("no such kind", long[:2000]),
            lambda: hand.tell("region", [value]),
            lambda: hand.tell("lab-where", {"a": long[:500]}),
            lambda: talker.send("ShareUrlRequest"),
            lambda: talker.send("GuiUpdateMessage", uuid=long[:100], updates={"value": 77}),
            lambda: talker.camera(position=[0, 0]),
            lambda: talker.upload("../../etc/passwd", b"no picture", transfer=f"{self._who} {time.monotonic()}"),
        ]

    def _leave(self) -> None:
        """Close the page, or be gone in the middle of something."""
        how = self._rng.choice(["close", "vanish", "vanish in a drag", "vanish in an upload"])
        self._begin(f"left: {how}")
        if isinstance(self._hand, Socket) and how == "vanish in a drag":
            self._hand.drag("Rotate", self._path("Rotate", 6))
        if isinstance(self._hand, Socket) and how == "vanish in an upload":
            self._hand.begin_upload(f"{self._who} {self._visit}")
        self._hand.leave("close" if how == "close" else "vanish")

    def _begin(self, did: str) -> None:
        if self._stop.is_set():
            raise StoppedError
        self._step += 1
        self._did = did

    def _settle(self, kind: str, asked: Asked, path: list[Asked] | None = None) -> None:
        same, self._asked = asked == self._asked and kind != "open", asked
        settled = self._hand.settle(asked, path or ())
        seconds = None if same else settled.seconds  # what is there already is no answer
        said = f"visit {self._visit}, {self._did}"
        self._record.answer(Answer(kind, self._who, self._step, said, asked, settled.shown, seconds))

    def _rest(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise StoppedError
