"""CSV files that a spreadsheet may open: no text in them is run as a formula, and every line break stays within its cell.

A spreadsheet computes a cell that begins with =, +, -, or @, and some skip a tab or a line break before it. Such a text gets an
apostrophe in front; also within it, after a semicolon, a tab, or a line break, which end a cell where semicolons separate values.
`unescape` removes these apostrophes. Numbers stay as they are, negative ones too.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator
from types import SimpleNamespace

# The last four are the full-width forms of the first four, which some Asian editions of spreadsheets read as these.
_SIGN = "=+\\-@\uff1d\uff0b\uff0d\uff20"
_BEFORE = rf"(?:^(?={{}}[{_SIGN}\t\r\n])|(?<=[;\t\r\n])(?={{}}[{_SIGN}]))"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?:\Z|(?=[;\t\r\n]))"
_FORMULA = re.compile(_BEFORE.format("'*", "'*") + f"(?!{_NUMBER})")
_ESCAPED = re.compile(_BEFORE.format("'+", "'+") + "'")


def escape_formula(text: str) -> str:
    """Return a text with an apostrophe before each part of it that a spreadsheet would compute."""
    return _FORMULA.sub("'", text)


def unescape(text: str) -> str:
    """Return the text that `escape_formula` was given."""
    return _ESCAPED.sub("", text)


def csv_bytes(rows: Iterable[Iterable[object]], errors: str = "replace") -> bytes:
    """Return rows as comma-separated values in UTF-8, texts by `escape_formula`, None as an empty cell.

    Args:
        errors: of the encoding; "surrogateescape" keeps the bytes of a file name that is not UTF-8.
    """
    lines: list[str] = []
    # Only with this terminator does the writer quote a carriage return in a cell.
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")
    for row in rows:
        writer.writerow([escape_formula(cell) if isinstance(cell, str) else cell for cell in row])
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode("utf-8", errors)


def csv_rows(text: str, strict: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Yield each row with the number of its last line, from 1; texts are as in the file.

    Raises:
        csv.Error: if a row cannot be read.
    """
    reader = csv.reader(io.StringIO(text, newline=""), strict=strict)
    for values in reader:
        yield reader.line_num, values
