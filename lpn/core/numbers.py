"""Numbers as readers see them: in sentences, tables, and drawings."""

from __future__ import annotations


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, "+" or the minus sign "−" (U+2212), and some digits; zero is positive."""
    text = f"{value:+.{digits}f}"
    return text.replace("-", "−") if float(text) else f"+{0:.{digits}f}"
