"""The records of the clients, the server's resources, and the bounds of both."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# Kinds of acts whose times are reported: each needs at most one description and one ranking.
CHANGES = ("drag", "parts", "pick", "turn", "compare")
# The kind of fault for an error of the soak itself, which leaves something unchecked.
OWN_ERROR = "the soak's own error"
# Seconds of warm-up, in which caches and pools grow; at most half of a run.
FIRST_MINUTE = 60.0
# Seconds over which the median of memory is taken, since single samples vary by tens of megabytes.
WHILE = 30.0
# Megabytes that caches may still grow by after the warm-up. A leak of one a visit exceeds this within ten minutes.
GROWTH = 64.0
# Threads that stay once started: viser's pool for callbacks has 32, and two serve pictures.
POOLS = 34
# Threads and file handles of a busy server, above those of an idle one. Every client takes several of each.
LEFT = 2
# Largest allowed ratio of one client's median time to that of all, for clients with at least ENOUGH answers.
SLOWEST, ENOUGH = 3.0, 20


class Fault(NamedTuple):
    """A violation: its kind, the client and the number of its act, which the seed repeats, and what was found."""

    kind: str
    client: str
    step: int
    text: str


class ResourceSample(NamedTuple):
    """A process's resources at a time in seconds: resident memory in megabytes, threads, file handles."""

    at: float
    megabytes: float
    threads: int
    handles: int


def sample(pid: int) -> ResourceSample | None:
    """Sample the resources of a process; None on a system without /proc, and after its end."""
    process = Path(f"/proc/{pid}")
    try:
        lines = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
        memory, handles = int(lines["VmRSS"].split()[0]) / 1024, len(list((process / "fd").iterdir()))
        return ResourceSample(time.monotonic(), memory, int(lines["Threads"]), handles)
    except (OSError, KeyError):
        return None


class Record:
    """Answers and faults of all clients, and the server's resources; all threads may append to its lists.

    Attributes:
        phase: "alone" or "together".
        answers: phase, client, and kind of act of each compared answer, and its seconds if something had changed.
        faults: all of them.
        resources: of the server "before" the first client, "after one client", and "after all left", on systems with /proc.
        samples: resources with all clients.
    """

    def __init__(self) -> None:
        self.phase = "alone"
        self.answers: list[tuple[str, str, str, float | None]] = []
        self.faults: list[Fault] = []
        self.resources: dict[str, ResourceSample] = {}
        self.samples: list[ResourceSample] = []

    def times(self, phase: str, names: str = "client ") -> dict[str, float]:
        """Number, median, 95th percentile, and longest of the seconds of one client, or of all whose names begin so."""
        found = [
            seconds
            for of, name, kind, seconds in self.answers
            if of == phase and f"{name} ".startswith(names) and kind in CHANGES and seconds is not None
        ]
        values = np.percentile(found, [50, 95, 100]).tolist() if found else []
        return dict(zip(("count", "median", "p95", "longest"), (len(found), *values), strict=False))

    def slowest(self) -> float | None:
        """The largest median of a client with enough answers, over the median of all; None without one."""
        each = [self.times("together", f"{name} ") for name in {name for _, name, *_ in self.answers if name[0] == "c"}]
        medians = [times["median"] for times in each if times["count"] >= ENOUGH]
        return max(medians) / self.times("together")["median"] if medians else None

    def most(self) -> tuple[float, float]:
        """Threads and file handles that may stay after all clients have left."""
        known = [one for name, one in self.resources.items() if name != "after all left"]
        threads = [one.threads for one in known] + [known[0].threads + POOLS] if known else [np.inf]
        return max(threads) + LEFT, max((one.handles for one in known), default=np.inf) + LEFT

    def memory(self) -> list[float]:
        """Megabytes after the warm-up and at the end, each a median over a while; nothing without samples."""
        if not self.samples:
            return []
        began, ended = self.samples[0].at, self.samples[-1].at
        warm = min(began + FIRST_MINUTE, (began + ended) / 2)
        length = min(WHILE, (ended - warm) / 2)
        spans = (
            [one.megabytes for one in self.samples if 0 <= one.at - low <= length] for low in (warm, ended - length)
        )
        return [float(np.median(megabytes)) for megabytes in spans if megabytes]

    def failures(self) -> list[str]:
        """Reasons why the run failed, one sentence each; empty for a pass."""
        found = [f"{count} x {kind}." for kind, count in Counter(fault.kind for fault in self.faults).most_common()]
        found += [] if self.answers else ["No answer was checked."]
        if (slowest := self.slowest()) and slowest > SLOWEST:
            found.append(f"The slowest client's median is {slowest:.2f} times that of all, not at most {SLOWEST:g}.")
        left = self.resources.get("after all left")
        first, *later = [*self.memory(), *([left.megabytes] if left else [])] or [0.0]
        if (grown := max(later, default=0.0) - first) > GROWTH:
            found.append(f"Memory grew by {grown:.0f} MB after the warm-up, not by at most {GROWTH:g} MB.")
        for what, here, most in zip(("Threads", "File handles"), (left or ())[2:4], self.most(), strict=False):
            if here > most:
                found.append(f"{what} after all left: {here}; expected at most {most}.")
        return found

    def figures(self) -> dict[str, Any]:
        """All figures by their names."""
        return {
            "pages opened": sum(kind == "open" for _, _, kind, _ in self.answers),
            "answers checked": len(self.answers),
            "faults": Counter(fault.kind for fault in self.faults),
            "one client alone, s": self.times("alone"),
            "all clients, s": self.times("together"),
            "pages in Chromium, s": self.times("together", "page "),
            "slowest client's median over that of all": self.slowest(),
            "MB after the warm-up and at the end": self.memory(),
            **{name: one._asdict() for name, one in self.resources.items()},
        }
