"""The results of a soak: figures, their bounds, and the table of both."""

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

# Warm-up in seconds, in which caches and pools grow to their size; at most half of a run.
FIRST_MINUTE = 60.0
# Seconds over which the median of memory is taken, since single samples vary by tens of megabytes.
WHILE = 30.0
# Megabytes of growth allowed after the warm-up, for caches that are not full yet. A leak of one megabyte a visit exceeds this
# within ten minutes.
GROWTH = 64.0
# Largest number of threads in viser's pool for callbacks, which never shrinks.
CALLBACKS = 32
# The largest number of threads that serve pictures, which begin with a browser's first picture and stay.
PICTURES = 2
# Threads and file handles allowed after all clients have left, above their number before: the server itself may be busy at that
# moment. Every client takes several of each.
LEFT_THREADS, LEFT_HANDLES = 2, 2
# Largest allowed ratio of one client's median time to that of all, for clients with at least ENOUGH answers.
SLOWEST, ENOUGH = 3.0, 20
SHOWN_FAULTS = 12


@dataclass(frozen=True)
class Spread:
    """Count, median, 95th percentile, and maximum of times in seconds; NaN without any."""

    count: int
    median: float
    p95: float
    longest: float

    @staticmethod
    def of(seconds: Sequence[float]) -> Spread:
        """Compute the spread of times in seconds."""
        if not seconds:
            return Spread(0, float("nan"), float("nan"), float("nan"))
        return Spread(len(seconds), *(float(value) for value in np.percentile(seconds, [50, 95, 100])))


@dataclass(frozen=True)
class Memory:
    """The server's resources; None where they were not measured.

    Attributes:
        empty: before the first client.
        before: after the single client has left.
        minute: after the warm-up with all clients; the sample of median memory in a window.
        end: before the clients leave; the same kind of sample.
        left: after the clients have left.
        growth: slope of memory after the warm-up in megabytes an hour; None for a short run.
        samples: all samples taken with all clients.
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
        """Compute the record from samples taken with all clients."""
        if not during:
            return Memory(empty, before, None, None, left, None)
        began, ended = during[0].at, during[-1].at
        later = [sample for sample in during if sample.at >= began + min(FIRST_MINUTE, (ended - began) / 2)]
        growth = None
        if later[-1].at - later[0].at >= FIRST_MINUTE:
            line = np.polyfit([sample.at for sample in later], [sample.megabytes for sample in later], 1)
            growth = float(3600 * line[0])
        length = min(WHILE, (later[-1].at - later[0].at) / 2)
        minute = _median_sample([sample for sample in later if sample.at <= later[0].at + length])
        end = _median_sample([sample for sample in later if sample.at >= later[-1].at - length])
        return Memory(empty, before, minute, end, left, growth, tuple(during))

    @property
    def warm(self) -> float:
        """Seconds with all clients before the sample `minute`."""
        return self.minute.at - self.samples[0].at if self.minute and self.samples else 0.0

    def failures(self) -> list[str]:
        """Violated bounds, one sentence each."""
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
        """Allowed threads and file handles after all clients have left."""
        return bounds(self.empty, self.before)


def _median_sample(samples: Sequence[ResourceSample]) -> ResourceSample:
    """The sample of median memory."""
    return sorted(samples, key=lambda sample: sample.megabytes)[len(samples) // 2]


def bounds(empty: ResourceSample | None, before: ResourceSample | None) -> tuple[int, int]:
    """Allowed threads and file handles without clients; arguments as in `Memory`."""
    known = [sample for sample in (empty, before) if sample is not None]
    threads = [sample.threads for sample in known] + [sample.threads + CALLBACKS + PICTURES for sample in known[:1]]
    return max(threads, default=0) + LEFT_THREADS, max((sample.handles for sample in known), default=0) + LEFT_HANDLES


@dataclass(frozen=True)
class SoakFigures:
    """The results of a soak."""

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
        """Spread of the times of one client, or of all clients of a kind, "client" or "page"."""
        found = [
            time.seconds
            for time in self.times
            if time.phase == phase
            and time.kind in kinds
            and (time.client_name == client_name or time.client_name.rpartition(" ")[0] == client_name)
        ]
        return Spread.of(found)

    def fairness(self, least: int = 1) -> tuple[float, float]:
        """Largest median and 95th percentile of a client, over the median of all; NaN without clients.

        Args:
            least: clients with fewer answers are left out.
        """
        each = [self.spread("together", client_name) for client_name in self._names("client")]
        each = [spread for spread in each if spread.count >= least]
        usual = self.spread("together").median
        if not each:
            return float("nan"), float("nan")
        return max(spread.median for spread in each) / usual, max(spread.p95 for spread in each) / usual

    def failures(self) -> list[str]:
        """Reasons why the run failed, one sentence each; empty for a pass."""
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
        """All figures as JSON."""
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
        """Print the table and all failures."""
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
        for failure in self.failures():
            console.print(f"✗ {failure}", markup=False, highlight=False)
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
            ("one client alone: median, p95, longest", _spread_text(alone)),
            ("all clients: median, p95, longest", _spread_text(together)),
            ("p95 of all over p95 alone", f"{together.p95 / alone.p95:.1f}"),
            ("slowest client's median, p95 over the median of all", f"{median:.2f}, {p95:.2f}"),
        ]
        if self.pages:
            lines.append(("pages in Chromium: median, p95, longest", _spread_text(self.spread("together", "page"))))
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


def _spread_text(spread: Spread) -> str:
    return (
        f"{spread.median:.2f}, {spread.p95:.2f}, {spread.longest:.2f} s ({spread.count:,})" if spread.count else "none"
    )


def _plain(value: Any) -> Any:
    """Replace NaN, which JSON lacks, by None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
