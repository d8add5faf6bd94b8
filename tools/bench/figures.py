"""A measured figure, and the table of all figures."""

from __future__ import annotations

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

# Seconds before each measurement, in which threads of the one before go to sleep; until then they spin, on cores it
# wants.
PAUSE = 0.1
# Seconds below which a task runs once unmeasured after the pause: what it uses lies in no cache then, and its threads
# sleep.
QUICK = 0.5


@dataclass(frozen=True)
class Figure:
    """One line of the table.

    Attributes:
        what: the step and its size.
        ours: as measured, in `unit`.
        unit: "ms", "pictures/s", "GB", ...
        peer: of the same work done the peer's way, measured in the same run; None without one.
        limit: a bound for any program of this kind, measured in the same run; None without one.
        more: whether more is better.
    """

    what: str
    ours: float
    unit: str
    peer: float | None = None
    limit: float | None = None
    more: bool = False

    @property
    def gain(self) -> float | None:
        """Ratio by which the figure beats the peer."""
        if self.peer is None:
            return None
        return self.ours / self.peer if self.more else self.peer / self.ours

    @property
    def excess(self) -> float | None:
        """Ratio of the figure to the limit."""
        if self.limit is None:
            return None
        return self.limit / self.ours if self.more else self.ours / self.limit


def take_turns(tasks: Mapping[str, Callable[[], object]], rounds: int, warm: int = 1) -> dict[str, list[float]]:
    """Seconds of each task in each round. Tasks take turns, so that a busy moment affects all of them; `warm` rounds go first."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    last = dict.fromkeys(tasks, QUICK)
    for round_ in range(rounds + warm):
        for name, task in tasks.items():
            time.sleep(PAUSE)
            if last[name] < QUICK:
                task()
            started = time.perf_counter()
            task()
            last[name] = time.perf_counter() - started
            if round_ >= warm:
                times[name].append(last[name])
    return times


def medians(tasks: Mapping[str, Callable[[], object]], rounds: int = 15) -> dict[str, float]:
    """Median milliseconds of each task, see `take_turns`; two rounds warm up."""
    return {name: 1000 * statistics.median(values) for name, values in take_turns(tasks, rounds, 2).items()}


def show(title: str, figures: Iterable[Figure]) -> None:
    table = Table(title=f"{title}; {machine()}")
    for column in ("what", "peer", "ours", "limit", "times better", "of the limit"):
        table.add_column(column, justify="left" if column == "what" else "right", no_wrap=column != "what")
    for figure in figures:
        table.add_row(
            figure.what,
            _number(figure.peer, figure.unit),
            _number(figure.ours, figure.unit),
            _number(figure.limit, figure.unit),
            "" if figure.gain is None else f"{figure.gain:.2f}",
            "" if figure.excess is None else f"{figure.excess:.2f}",
        )
    Console(width=150).print(table)


def machine() -> str:
    """The machine, such as "2 cores, AMD EPYC", with its GPU if torch is in use and finds one."""
    name = platform.processor() or platform.machine()
    if (info := Path("/proc/cpuinfo")).is_file():
        named = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = named[0] if named else name
    torch = sys.modules.get("torch")
    gpu = f", {torch.cuda.get_device_name()}" if torch is not None and torch.cuda.is_available() else ""
    return f"{os.cpu_count()} cores, {name}{gpu}"


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return ""
    return f"{value:,.{2 if abs(value) < 10 else 1 if abs(value) < 100 else 0}f} {unit}"
