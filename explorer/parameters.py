"""Values of an address: how they are written and read; its texts are untrusted."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,12})?(e-\d{1,2})?")
# Key of the workspace that an address without `show` opens.
DATA = "data"
# Maximum of characters of a text in an address.
LONGEST_TEXT = 200


class UnusableError(Exception):
    """An invalid value in an address; the message says what was expected."""


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
