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
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

from lpn.core.files import printable

# The last four are the full-width forms of the first four, which some Asian editions of spreadsheets read as these.
_SIGN = "=+\\-@\uff1d\uff0b\uff0d\uff20"
_BEFORE = rf"(?:^(?={{}}[{_SIGN}\t\r\n])|(?<=[;\t\r\n])(?={{}}[{_SIGN}]))"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?:\Z|(?=[;\t\r\n]))"
_FORMULA = re.compile(_BEFORE.format("'*", "'*") + f"(?!{_NUMBER})")
_ESCAPED = re.compile(_BEFORE.format("'+", "'+") + "'")
# A table in UTF-16 that Excel saves has tabs. Where Excel writes semicolons, its first line has neither of them.
_DELIMITERS = ",\t"
# Excel's first line that names the delimiter.
_NAMED_DELIMITER = re.compile(r"\"?sep=([,;\t])\"?\r?\n", re.IGNORECASE)


def escape_formula(text: str) -> str:
    """Return a text with an apostrophe before each part of it that a spreadsheet would compute."""
    return _FORMULA.sub("'", text)


def unescape(text: str) -> str:
    """Return the text that `escape_formula` was given."""
    return _ESCAPED.sub("", text)


def csv_bytes(rows: Iterable[Iterable[object]], *, keep: str = "\n\t", own: bool = False) -> bytes:
    """Return rows as comma-separated values in UTF-8, texts by `escape_formula` and `printable`, None as an empty cell.

    Args:
        keep: see `printable`.
        own: of a file that is read back; texts keep all characters, also the bytes of a file name that is not UTF-8.
    """
    shown = str if own else partial(printable, keep=keep)
    lines: list[str] = []
    # Only with this terminator does the writer quote a carriage return in a cell.
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")
    for row in rows:
        writer.writerow([escape_formula(shown(str(cell))) if isinstance(cell, str | Path) else cell for cell in row])
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode("utf-8", "surrogateescape")


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decode a text in UTF-8 or UTF-16, with or without a byte order mark.

    Args:
        errors: of UTF-8; "surrogateescape" keeps the bytes of a file name that is not UTF-8.

    Raises:
        UnicodeDecodeError: if it is neither.
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16")
    # Every other byte of a list in UTF-16 is 0, as its letters are mostly ASCII.
    head = data[:1000]
    if len(head) > 1 and head.count(0) > len(head) // 3:
        return data.decode("utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be")
    return data.decode("utf-8-sig", errors)


def mixed_separators(first: str) -> str:
    """Return what to say after a sentence on a first line that cannot be read, if semicolons are in it; "" without them."""
    return (
        " Semicolons stand beside commas or tabs in it; separate all values by the same character."
        if ";" in first
        else ""
    )


class Delimited(NamedTuple):
    """A text of separated values.

    Attributes:
        decimal_comma: True if numbers may be written with a comma, as nothing else is separated by one.
        rows: the rows that are not blank, each with its line number from 1; raises csv.Error.
    """

    decimal_comma: bool
    rows: Iterator[tuple[int, list[str]]]


def delimited(text: str, strict: bool = False) -> Delimited:
    """Split a text at commas or tabs, whichever its first line has more of, or at what a first line such as `sep=;` names.

    A first line with semicolons and neither commas nor tabs is split at semicolons.

    Args:
        strict: refuse quotes that are not closed, as a file that was cut short has.
    """
    named = _NAMED_DELIMITER.match(text)
    first = text.lstrip("\r\n").partition("\n")[0]
    delimiter = max(_DELIMITERS, key=first.count) if named is None else named[1]
    if named is None and delimiter not in first and ";" in first:
        delimiter = ";"
    lines = csv.reader(io.StringIO(text[named.end() if named else 0 :], newline=""), delimiter=delimiter, strict=strict)
    skipped = 0 if named is None else 1
    rows = ((lines.line_num + skipped, values) for values in lines if any(value.strip() for value in values))
    return Delimited(delimiter != ",", rows)
