"""CSV files that a spreadsheet may open: no text is run as a formula, and every line break stays within its cell.

A spreadsheet computes a cell that begins with =, +, -, or @; some skip a tab or a line break before it. Such a text gets an
apostrophe in front. So do its parts after a semicolon, a tab, or a line break, where a spreadsheet may end the cell.
`unescape` removes these apostrophes. Numbers are unchanged, negative ones too.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

from lpn.core.files import printable

# The last four are the full-width forms of the first four, which some Asian editions of spreadsheets treat alike.
_SIGN = "=+\\-@\uff1d\uff0b\uff0d\uff20"
_BEFORE = rf"(?:^(?={{}}[{_SIGN}\t\r\n])|(?<=[;\t\r\n])(?={{}}[{_SIGN}]))"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?:\Z|(?=[;\t\r\n]))"
_FORMULA = re.compile(_BEFORE.format("'*", "'*") + f"(?!{_NUMBER})")
_ESCAPED = re.compile(_BEFORE.format("'+", "'+") + "'")


def escape_formula(text: str) -> str:
    """Put an apostrophe before each part of a text that a spreadsheet would compute."""
    return _FORMULA.sub("'", text)


def unescape(text: str) -> str:
    """Invert `escape_formula`."""
    return _ESCAPED.sub("", text)


def csv_bytes(rows: Iterable[Iterable[object]], *, keep: str = "\n\t", own: bool = False) -> bytes:
    """Encode rows as comma-separated values in UTF-8, with texts by `escape_formula` and `printable`, and None as an empty cell.

    Args:
        keep: see `printable`.
        own: True for a file that lpn reads back; its texts keep all characters, also bytes of file names that are not UTF-8.
    """
    shown = str if own else partial(printable, keep=keep)
    lines: list[str] = []
    # The writer quotes a carriage return in a cell only with this terminator.
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")
    for row in rows:
        writer.writerow([escape_formula(shown(str(cell))) if isinstance(cell, str | Path) else cell for cell in row])
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode("utf-8", "surrogateescape")
