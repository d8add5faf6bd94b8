"""Parameters of a query string: how one choice of a state is written there, and read back; its texts are untrusted."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,12})?(e-\d{1,2})?")
# Key of the workspace that addresses without `show` mean.
DATA = "data"
# Characters of a text that an address holds.
LONGEST_TEXT = 200


class UnusableError(Exception):
    """An invalid value in an address; the message says what was expected."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of the query string: its value for a state (None: left out), and the state for a value."""

    key: str
    write: Callable[[Any], str | None]
    read: Callable[[Any, str], Any]


def ranges(numbers: Sequence[int]) -> str:
    """Format integers as "3-5,8"."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ",".join(str(low) if low == high else f"{low}-{high}" for low, high in runs)


def cells(text: str, count: int) -> tuple[int, ...]:
    """Parse "3-5,8" as integers below `count`, sorted; UnusableError for anything else."""
    numbers: set[int] = set()
    for piece in text.split(","):
        match = re.fullmatch(r"(\d{1,7})(?:-(\d{1,7}))?", piece)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not low <= high < count:
            raise UnusableError(f"expected cells 0 to {count - 1}, such as 3-5,8.")
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def format_number(value: float) -> str:
    """Format a number with ten digits at most."""
    return f"{value:.10g}"


def parse_number(text: str, low: float, high: float) -> float:
    """Parse a number from `low` to `high`; UnusableError for anything else."""
    value = float(text) if _NUMBER.fullmatch(text) else low - 1
    if not low <= value <= high:
        raise UnusableError(f"expected a number from {low:g} to {high:g}.")
    return value


def _default(state: Any, name: str) -> Any:
    return type(state).__dataclass_fields__[name].default


def number(name: str, low: float, high: float, whole: bool = False) -> Parameter:
    """Return the parameter of a field that holds a number."""

    def read(state: Any, text: str) -> Any:
        value = parse_number(text, low, high)
        return replace(state, **{name: round(value) if whole else value})

    return Parameter(
        name, lambda s: None if getattr(s, name) == _default(s, name) else format_number(getattr(s, name)), read
    )


def choice(name: str, values: dict[str, Any], key: str | None = None) -> Parameter:
    """Return the parameter of a field that holds one of several values, by their texts."""

    def write(state: Any) -> str | None:
        chosen = getattr(state, name)
        return (
            None if chosen == _default(state, name) else next(text for text, value in values.items() if value == chosen)
        )

    def read(state: Any, text: str) -> Any:
        if text not in values:
            raise UnusableError(f"expected {' or '.join(values)}.")
        return replace(state, **{name: values[text]})

    return Parameter(key or name, write, read)


def switch(name: str, key: str | None = None) -> Parameter:
    """Return the parameter of a field that is on or off."""
    return choice(name, {"0": False, "1": True}, key)


def text(name: str, key: str, longest: int = LONGEST_TEXT) -> Parameter:
    """Return the parameter of a field that holds one line of text."""

    def write(state: Any) -> str | None:
        text = getattr(state, name)
        return None if text == _default(state, name) or not is_line(text, longest) else text

    def read(state: Any, text: str) -> Any:
        if not is_line(text, longest):
            raise UnusableError(f"expected {longest:,} letters at most that can be printed.")
        return replace(state, **{name: text})

    return Parameter(key, write, read)


def is_line(text: str, longest: int) -> bool:
    """Return whether a text is not too long and can be printed."""
    return len(text) <= longest and text.isprintable()
