"""What a soak found: figures, bounds, and the table that says both."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tools.soak.record import CHANGES, Fault, Time
from tools.soak.server import ResourceSample

# Seconds in which caches fill, and the memory that so many clients need at once is taken; half of a run that is shorter
# than two minutes.
FIRST_MINUTE = 60.0
# Seconds whose median stands for the memory at a moment: it goes up and down by tens of megabytes with what is being
# drawn.
WHILE = 30.0
# Megabytes that the server may grow after that: what the caches of tiles, cards, and pictures (explorer.workspace)
# still lack. Ten minutes of visits, of which each kept a megabyte, are more.
GROWTH = 64.0
# Threads that viser keeps for callbacks; it makes them as they are needed, and keeps them for good.
CALLBACKS = 32
# Threads and file handles more than before the clients came that the server may have after they left: a thread of the
# server's own may be at work at that moment, and a handle of a picture be open. Every client has several of each.
LEFT_THREADS, LEFT_HANDLES = 2, 2
# How many times the median of all a client's own may be, of clients with so many answers at least: of fewer it says
# little.
SLOWEST, ENOUGH = 3.0, 20
SHOWN_FAULTS = 12


@dataclass(frozen=True)
class Spread:
    """Of times, in seconds; NaN without any."""

    count: int
    median: float
    p95: float
    longest: float

    @staticmethod
    def of(seconds: Sequence[float]) -> Spread:
        """Of some times."""
        if not seconds:
            return Spread(0, float("nan"), float("nan"), float("nan"))
        return Spread(len(seconds), *(float(value) for value in np.percentile(seconds, [50, 95, 100])))


@dataclass(frozen=True)
class Memory:
    """The server's resources; None where they were not seen.

    Attributes:
        empty: before anybody came.
        before: after one client came and went.
        minute: after the first minute of all clients, the sample of median memory of some seconds.
        end: before they left, likewise.
        left: after they left.
        growth: of memory after the first minute, megabytes an hour, along a line through all samples; None for a run that
            is too short to say.
        samples: all that were taken while all clients were there.
    """

    empty: ResourceSample | None
    before: ResourceSample | None
    minute: ResourceSample | None
    end: ResourceSample | None
    left: ResourceSample | None
    growth: float | None
    samples: tuple[ResourceSample, ...] = ()

    @staticmethod
    def of(
        empty: ResourceSample | None,
        before: ResourceSample | None,
        during: Sequence[ResourceSample],
        left: ResourceSample | None,
    ) -> Memory:
        """From samples taken while all clients were there."""
        if not during:
            return Memory(empty, before, None, None, left, None)
        began, ended = during[0].at, during[-1].at
        later = [sample for sample in during if sample.at >= began + min(FIRST_MINUTE, (ended - began) / 2)]
        growth = None
        if later[-1].at - later[0].at >= FIRST_MINUTE:
            line = np.polyfit([sample.at for sample in later], [sample.megabytes for sample in later], 1)
            growth = float(3600 * line[0])
        length = min(WHILE, (later[-1].at - later[0].at) / 2)
        minute = _usual([sample for sample in later if sample.at <= later[0].at + length])
        end = _usual([sample for sample in later if sample.at >= later[-1].at - length])
        return Memory(empty, before, minute, end, left, growth, tuple(during))

    @property
    def warm(self) -> float:
        """Seconds of all clients before the sample `minute`."""
        return self.minute.at - self.samples[0].at if self.minute and self.samples else 0.0

    def failures(self) -> list[str]:
        """What grew past its bound."""
        found = []
        for text, here in (("the end", self.end), ("when all had left", self.left)):
            if here and self.minute and here.megabytes > self.minute.megabytes + GROWTH:
                grown = here.megabytes - self.minute.megabytes
                found.append(
                    f"Memory grew by {grown:.0f} MB after the first minute to {text}; expected {GROWTH:g} MB or less."
                )
        if self.left:
            for what, now, most in (
                ("Threads", self.left.threads, self.most()[0]),
                ("File handles", self.left.handles, self.most()[1]),
            ):
                if now > most:
                    found.append(f"{what} after all left: {now}; expected at most {most}.")
        return found

    def most(self) -> tuple[int, int]:
        """Threads and file handles that may be left."""
        return bounds(self.empty, self.before)


def _usual(samples: Sequence[ResourceSample]) -> ResourceSample:
    """The sample of median memory."""
    return sorted(samples, key=lambda sample: sample.megabytes)[len(samples) // 2]


def bounds(empty: ResourceSample | None, before: ResourceSample | None) -> tuple[int, int]:
    """Threads and file handles that the server may have when nobody is there; arguments as in `Memory`."""
    known = [sample for sample in (empty, before) if sample is not None]
    threads = [sample.threads for sample in known] + [sample.threads + CALLBACKS for sample in known[:1]]
    return max(threads, default=0) + LEFT_THREADS, max((sample.handles for sample in known), default=0) + LEFT_HANDLES


@dataclass(frozen=True)
class SoakFigures:
    """All that a soak found."""

    seed: int
    clients: int
    pages: int
    seconds: float
    visits: int
    checked: int
    wrong: int
    unchecked: int
    faults: list[Fault]
    tracebacks: list[str]
    times: list[Time]
    memory: Memory

    def spread(self, phase: str, client_name: str = "client", kinds: Sequence[str] = CHANGES) -> Spread:
        """Times of one client, or of all whose name begins so."""
        found = [
            time.seconds
            for time in self.times
            if time.phase == phase
            and time.kind in kinds
            and (time.client_name == client_name or time.client_name.rpartition(" ")[0] == client_name)
        ]
        return Spread.of(found)

    def fairness(self, least: int = 1) -> tuple[float, float]:
        """The slowest client's median and 95th percentile over the median of all, of clients with so many answers at least;
        NaN without any."""
        each = [self.spread("together", client_name) for client_name in self._names("client")]
        each = [spread for spread in each if spread.count >= least]
        usual = self.spread("together").median
        if not each:
            return float("nan"), float("nan")
        return max(spread.median for spread in each) / usual, max(spread.p95 for spread in each) / usual

    def failures(self) -> list[str]:
        """Why the run has failed; nothing where it has not."""
        kinds = Counter(fault.kind for fault in self.faults)
        found = [f"{count} x {kind}." for kind, count in kinds.most_common()]
        found += [f"{len(self.tracebacks)} tracebacks in the server's log."] if self.tracebacks else []
        found += [] if self.checked else ["No answer was checked."]
        found += [f"{self.unchecked:,} answers were not checked."] if self.unchecked else []
        median, _ = self.fairness(ENOUGH)
        if median > SLOWEST:
            found.append(
                f"The slowest client's median is {median:.2f} times that of all; expected {SLOWEST:g} or less."
            )
        return found + self.memory.failures()

    def json(self) -> bytes:
        """For a file."""
        clients = {
            client_name: asdict(self.spread("together", client_name))
            for kind in ("client", "page")
            for client_name in self._names(kind)
        }
        kinds = sorted({time.kind for time in self.times})
        of_kind = {
            phase: {kind: asdict(self.spread(phase, kinds=[kind])) for kind in kinds} for phase in ("alone", "together")
        }
        median, p95 = self.fairness()
        text: dict[str, Any] = {
            **{key: value for key, value in asdict(self).items() if key != "times"},
            "alone": asdict(self.spread("alone")),
            "together": asdict(self.spread("together")),
            "pages together": asdict(self.spread("together", "page")),
            "by client": clients,
            "by act": of_kind,
            "slowest median / median": median,
            "slowest p95 / median": p95,
            "flaws": self.failures(),
        }
        return json.dumps(_plain(text), indent=1).encode()

    def show(self, console: Console) -> None:
        """Print the table, and what went wrong."""
        table = Table(
            title=f"{self.clients} clients and {self.pages} pages, {self.seconds / 60:.1f} minutes, seed {self.seed}"
        )
        table.add_column("what")
        table.add_column("", justify="right")
        for what, value in self._lines():
            table.add_row(what, value)
        console.print(table)
        for fault in self.faults[:SHOWN_FAULTS]:
            where = f"{fault.client_name}, step {fault.step}, {fault.text}" if fault.client_name else fault.text
            console.print(f"✗ {fault.kind}: {where}", markup=False, highlight=False)
        if len(self.faults) > SHOWN_FAULTS:
            console.print(f"… and {len(self.faults) - SHOWN_FAULTS} more; --out has all.")
        for traceback in self.tracebacks[:3]:
            console.print(traceback, markup=False, highlight=False)
        for flaw in self.failures():
            console.print(f"✗ {flaw}", markup=False, highlight=False)
        if not self.failures():
            console.print("✓ No wrong answer, no error, nothing left behind.")

    def _lines(self) -> list[tuple[str, str]]:
        alone, together = self.spread("alone"), self.spread("together")
        median, p95 = self.fairness()
        memory = self.memory
        lines = [
            ("pages opened", f"{self.visits:,}"),
            ("answers checked", f"{self.checked:,}"),
            ("wrong answers", f"{self.wrong:,}"),
            ("errors", f"{len(self.faults) - self.wrong + len(self.tracebacks):,}"),
            ("one client alone: median, p95, longest", _said(alone)),
            ("all clients: median, p95, longest", _said(together)),
            ("p95 of all over p95 alone", f"{together.p95 / alone.p95:.1f}"),
            ("slowest client's median, p95 over the median of all", f"{median:.2f}, {p95:.2f}"),
        ]
        if self.pages:
            lines.append(("pages in Chromium: median, p95, longest", _said(self.spread("together", "page"))))
        if memory.empty is None:
            return [*lines, ("memory, threads, handles", "not known: this system has no /proc")]
        for what, sample in (
            ("after one client left", memory.before),
            (f"after the first {memory.warm:.0f} s of all", memory.minute),
            ("at the end", memory.end),
            ("after all left", memory.left),
        ):
            if sample is not None:
                text = f"{sample.megabytes:.0f} MB, {sample.threads} threads, {sample.handles} handles"
                lines.append((f"server {what} ({sample.clients} there)", text))
        if memory.growth is not None:
            lines.append(("memory after the first minute", f"{memory.growth:+.0f} MB an hour"))
        return lines

    def _names(self, kind: str) -> list[str]:
        found = {
            time.client_name
            for time in self.times
            if time.client_name.rpartition(" ")[0] == kind and time.phase == "together"
        }
        return sorted(found, key=lambda client_name: int(client_name.rpartition(" ")[2]))


def _said(spread: Spread) -> str:
    return (
        f"{spread.median:.2f}, {spread.p95:.2f}, {spread.longest:.2f} s ({spread.count:,})" if spread.count else "none"
    )


def _plain(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
