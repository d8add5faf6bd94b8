"""Consoles for tables, and progress bars."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from lpn.core.progress import CountProgress, Progress, at_intervals


def wide_console(least: int = 120) -> Console:
    """Return a console of at least so many columns, so that a narrow terminal or a pipe does not break the cells of a table."""
    return Console(width=max(least, Console().width))


@contextmanager
def counting_bar(title: str, console: Console | None = None, transient: bool = False) -> Iterator[CountProgress]:
    """Show a bar with the number of things that are done and the remaining time; a `transient` one is deleted at its end."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Bars(*columns, console=console, transient=transient) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


# Seconds between two lines about a stage where there is no terminal to draw a bar on.
_LINES = 30.0


@contextmanager
def stage_bars(console: Console, title: str = "{}") -> Iterator[Progress]:
    """Show a bar for each stage, with the stage in place of the braces of `title`; all are deleted at the end.

    Without a terminal, standard error gets a line about a stage every half minute.
    """
    if not console.is_terminal:
        yield _stage_lines(title)
        return
    bars = Bars(console=console, transient=True)
    stages: dict[str, TaskID] = {}

    def report(stage: str, done: int, total: int) -> None:
        bars.start()
        if stage not in stages:
            stages[stage] = bars.add_task(title.format(stage), total=total)
        bars.update(stages[stage], completed=done)

    try:
        yield report
    finally:
        if stages:  # bars that never started would print an empty line
            bars.stop()


def _stage_lines(title: str) -> Progress:
    """Return what writes a line about a stage every half minute."""
    lines: dict[str, CountProgress] = {}

    def report(stage: str, done: int, total: int) -> None:
        if stage not in lines:
            lines[stage] = at_intervals(_LINES, partial(_write_line, title.format(stage)))
        lines[stage](done, total)

    return report


def _write_line(stage: str, done: int, total: int) -> None:
    print(f"{stage}: {done:,} of {total:,}", file=sys.stderr, flush=True)
