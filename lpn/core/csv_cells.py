"""CSV files that a spreadsheet may open: no text is run as a formula, and every line break stays within its cell.

A spreadsheet computes a cell that begins with =, +, -, or @; some skip a tab or a line break before it. Such a text gets an
apostrophe in front. So do its parts after a semicolon, a tab, or a line break, which end a cell if semicolons separate values.
`unescape` removes these apostrophes. Numbers are unchanged, negative ones too.
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

# The last four are the full-width forms of the first four, which some Asian editions of spreadsheets treat alike.
_SIGN = "=+\\-@\uff1d\uff0b\uff0d\uff20"
_BEFORE = rf"(?:^(?={{}}[{_SIGN}\t\r\n])|(?<=[;\t\r\n])(?={{}}[{_SIGN}]))"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?:\Z|(?=[;\t\r\n]))"
_FORMULA = re.compile(_BEFORE.format("'*", "'*") + f"(?!{_NUMBER})")
_ESCAPED = re.compile(_BEFORE.format("'+", "'+") + "'")
# Excel saves a table in UTF-16 with tabs. If Excel writes semicolons, its first line has neither of these two.
_DELIMITERS = ",\t"
# Excel's first line that names the delimiter.
_NAMED_DELIMITER = re.compile(r"\"?sep=([,;\t])\"?\r?\n", re.IGNORECASE)


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
        own: the file is read back; texts keep all characters, also the bytes of a file name that is not UTF-8.
    """
    shown = str if own else partial(printable, keep=keep)
    lines: list[str] = []
    # The writer quotes a carriage return in a cell only with this terminator.
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")
    for row in rows:
        writer.writerow([escape_formula(shown(str(cell))) if isinstance(cell, str | Path) else cell for cell in row])
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode("utf-8", "surrogateescape")


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decode a text in UTF-8 or UTF-16, with or without a byte order mark.

    Args:
        errors: of UTF-8; "surrogateescape" keeps the bytes of a file name that is not UTF-8.

    Raises:
        UnicodeDecodeError: if the text is neither UTF-8 nor UTF-16.
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16")
    # Every other byte of a list in UTF-16 is 0, as its letters are mostly ASCII.
    head = data[:1000]
    if len(head) > 1 and head.count(0) > len(head) // 3:
        return data.decode("utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be")
    return data.decode("utf-8-sig", errors)


def mixed_separators(first: str) -> str:
    """Return a remark for the error about an unreadable first line, if it contains semicolons; else ""."""
    return (
        " Semicolons stand beside commas or tabs in it; separate all values by the same character."
        if ";" in first
        else ""
    )


class Delimited(NamedTuple):
    """A text of separated values.

    Attributes:
        decimal_comma: whether numbers may have a decimal comma, because commas separate nothing else.
        rows: the rows that are not blank, each with its line number from 1; raises csv.Error.
    """

    decimal_comma: bool
    rows: Iterator[tuple[int, list[str]]]


def delimited(text: str, strict: bool = False) -> Delimited:
    """Split a text at its first line's more frequent separator, comma or tab, or at the one named by a line such as `sep=;`.

    A first line with semicolons and neither commas nor tabs is split at semicolons.

    Args:
        strict: refuse unclosed quotes, as in a truncated file.
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
