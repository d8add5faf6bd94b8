"""Consoles, progress bars, and streams; no control character of a name or message reaches the terminal through them."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import IO, Any, TextIO

from rich import console as rich_console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.segment import Segment

from lpn.core.files import printable
from lpn.core.progress import at_intervals, listening

_LAYOUT = "\n\t"
_COLUMNS = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
_COLOUR = re.compile(r"(\x1b\[[0-9;]*m)")


class Console(rich_console.Console):
    """A console that replaces the control characters of texts, and keeps its colours and bars."""

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Yield the base class's segments, with their texts made `printable`."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text, _LAYOUT), style, control)

    @property
    def file(self) -> IO[str]:
        """The terminal's stream. A running bar wraps the stream of `plain_streams`, and `rich` unwraps only one layer."""
        file = super().file
        return getattr(file, "rich_proxied_file", file)

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file


class _PlainStream:
    """A stream that makes texts `printable`; `rich`'s consoles write to the stream behind it.

    A carriage return is hidden, too: it would let a name overwrite the line. With `colours`, colours pass.
    """

    def __init__(self, stream: TextIO, colours: bool) -> None:
        self.rich_proxied_file: TextIO = getattr(stream, "rich_proxied_file", stream)
        self._colours = colours

    def write(self, text: str) -> int:
        pieces = _COLOUR.split(text) if self._colours else [text]
        pieces[::2] = [printable(piece, _LAYOUT) for piece in pieces[::2]]
        return self.rich_proxied_file.write("".join(pieces))

    def writelines(self, lines: Iterable[str]) -> None:
        self.write("".join(lines))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextmanager
def plain_streams(colours: bool = False) -> Iterator[None]:
    """Let no control character from a name, a path, or an error message reach the terminal while the context is open.

    Args:
        colours: let colours through, for a library that prints them.
    """
    out, err = (stream and _PlainStream(stream, colours) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield


def wide_console(least: int = 120) -> Console:
    """Return a console of at least `least` columns, so that a narrow terminal or a pipe does not break the cells of a table."""
    return Console(width=max(least, Console().width))


def terminal() -> Console:
    """Return a console on standard error; in a notebook, which is no terminal, it prints lines without animation."""
    return Console(stderr=True, force_jupyter=False, force_terminal=sys.stderr.isatty())


# Seconds between two printed lines of progress, if there is no terminal for a bar.
_LINES = 30.0


@contextmanager
def progress_bars() -> Iterator[None]:
    """Draw this thread's progress on standard error: a bar of the stage, deleted at its end.

    Without a terminal, a line about the stage is printed every half minute.
    """
    console = terminal()
    if not console.is_terminal:
        with listening(at_intervals(_LINES, _print_line)):
            yield
        return
    bars = Bars(*_COLUMNS, console=console, transient=True, redirect_stdout=False)

    def clear() -> None:
        for task in bars.task_ids:
            bars.remove_task(task)
        if bars.live.is_started:  # otherwise an empty line is printed
            bars.stop()

    def draw(stage: str, done: int, total: int) -> None:
        if done >= total:
            clear()
        else:
            (task,) = bars.task_ids or [bars.add_task(stage, completed=done)]
            bars.update(task, description=stage, completed=done, total=total)
            bars.start()

    try:
        with listening(draw):
            yield
    finally:
        clear()


def _print_line(stage: str, done: int, total: int) -> None:
    if done < total:
        print(f"{stage}: {done:,} of {total:,}", file=sys.stderr, flush=True)
