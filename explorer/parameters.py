"""Parameters of a query string: how one choice of a state is written there, and read back; its texts are untrusted."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,12})?(e-\d{1,2})?")
# Key of the workspace that addresses without `show` mean.
DATA = "data"
# Characters of a text that an address holds.
LONGEST_TEXT = 200


class UnusableError(Exception):
    """An invalid value in an address; the message says what was expected."""


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


def is_line(text: str, longest: int) -> bool:
    """Return whether a text is not too long and can be printed."""
    return len(text) <= longest and text.isprintable()
