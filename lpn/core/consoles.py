"""Consoles for tables."""

from __future__ import annotations

from rich.console import Console


def wide_console(least: int = 120) -> Console:
    """Return a console of at least so many columns, so that a narrow terminal or a pipe does not break the cells of a table."""
    return Console(width=max(least, Console().width))
