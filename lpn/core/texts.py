"""Texts for readers."""

from __future__ import annotations

from collections.abc import Sequence


def listed(words: Sequence[str], conjunction: str = "and") -> str:
    """Join one word or more into a list in a sentence: "a", "a and b", "a, b, and c"."""
    *before, last = words
    if len(before) < 2:
        return f" {conjunction} ".join(words)
    return f"{', '.join(before)}, {conjunction} {last}"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 photo", "2 photos", "1,000 queries"."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number:,} {noun if number == 1 else plural}"


def ordinal(rank: int) -> str:
    """Return 1st, 2nd, 3rd, 4th, ..."""
    suffix = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{suffix}"
