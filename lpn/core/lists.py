"""Lists of pictures in files: text, JSON, and tables of separated values. Errors name the damaged line."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lpn.core.errors import DataError
from lpn.core.files import printable

# The largest list that is read, in bytes.
MAX_LIST_BYTES = 100_000_000
# Maximum of characters of a line in a message.
_SHOWN = 200
# Excel saves a table in UTF-16 with tabs. If Excel writes semicolons, the first line has no comma and no tab.
_SEPARATORS = ",\t"
# Excel's first line that names the separator.
_NAMED_SEPARATOR = re.compile(r"\"?sep=([,;\t])\"?\r?\n", re.IGNORECASE)


def read_text(path: Path, name: str, errors: str = "strict", most: int = MAX_LIST_BYTES) -> str:
    """Return the text of a file.

    Args:
        errors: handling of decoding errors; "surrogateescape" keeps the bytes of a file name that is not UTF-8.

    Raises:
        DataError: if the file cannot be read, has more than `most` bytes, or is neither UTF-8 nor UTF-16.
    """
    try:
        if path.stat().st_size > most:
            raise DataError(f"{name} has more than {most // 1_000_000} MB; expected a list of pictures as text.")
        return decoded(path.read_bytes(), name, errors)
    except OSError as error:
        raise DataError(f"{name} cannot be read ({error.strerror or error}); check that it is readable.") from error


def decoded(data: bytes, name: str, errors: str = "strict") -> str:
    """Decode a file's contents in UTF-8 or UTF-16, with or without a byte order mark; DataError for others.

    Args:
        errors: handling of errors in UTF-8, see `read_text`.
    """
    # Every other byte of a list in UTF-16 is 0, as its letters are mostly ASCII.
    head = data[:1000]
    try:
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            return data.decode("utf-16")
        if len(head) > 1 and head.count(0) > len(head) // 3:
            return data.decode("utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be")
        return data.decode("utf-8-sig", errors)
    except UnicodeDecodeError as error:
        raise DataError(f"{name} is not text in UTF-8 or UTF-16; expected a list of pictures.") from error


def numbered_lines(path: Path, name: str) -> Iterator[tuple[str, str]]:
    """Yield the lines that are not blank, each after "Line <number> of <name>"; errors as for `read_text`."""
    for number, line in enumerate(read_text(path, name).splitlines(), 1):
        if line.strip():
            yield f"Line {number} of {name}", line


def read_json(path: Path, name: str, most: int = MAX_LIST_BYTES) -> Any:
    """Read the value of a JSON file of at most `most` bytes; DataError as for `read_text`, or if the file is not JSON."""
    try:
        return json.loads(read_text(path, name, most=most))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{printable(name)} is not JSON; save it again, or unpack it again.") from error


def read_rows(path: Path, name: str, errors: str = "strict") -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not blank, each with its line number from 1.

    Errors are those of `read_text` and `separated`.
    """
    yield from separated(read_text(path, name, errors), name).rows


class SeparatedValues(NamedTuple):
    """A text of separated values.

    Attributes:
        decimal_comma: whether numbers may have a decimal comma, because no comma separates values.
        rows: the rows that are not blank, each with its line number from 1; raises DataError if values cannot be separated.
    """

    decimal_comma: bool
    rows: Iterator[tuple[int, list[str]]]


def separated(text: str, name: str, strict: bool = False) -> SeparatedValues:
    """Split a text at commas or tabs, the more frequent in the first line, or as a line such as `sep=;` says.

    A first line with semicolons and neither commas nor tabs is split at semicolons.

    Args:
        strict: refuse unclosed quotes, as in a truncated file.
    """
    named = _NAMED_SEPARATOR.match(text)
    first = text.lstrip("\r\n").partition("\n")[0]
    separator = max(_SEPARATORS, key=first.count) if named is None else named[1]
    if named is None and separator not in first and ";" in first:
        separator = ";"
    start, skipped = (0, 0) if named is None else (named.end(), 1)
    lines = csv.reader(io.StringIO(text[start:], newline=""), delimiter=separator, strict=strict)

    def rows() -> Iterator[tuple[int, list[str]]]:
        line = 0
        try:
            for values in lines:
                if any(value.strip() for value in values):
                    line = lines.line_num + skipped
                    yield line, values
        except csv.Error as error:
            raise DataError(f"Line {line + 1} of {name} is not comma-separated values ({error}); mend it.") from error

    return SeparatedValues(separator != ",", rows())


def mixed_separators(header: Sequence[str]) -> str:
    """Return a remark for the error about an unreadable first line, if it contains semicolons; else ""."""
    mixed = " Semicolons stand beside commas or tabs in it; separate all values by the same character."
    return mixed if any(";" in column for column in header) else ""


def table(
    text: str,
    name: str,
    fits: Callable[[list[str]], bool],
    expected: str,
    decimals: Collection[str] = (),
    tidy: Callable[[str], str] = str.lower,
) -> tuple[list[str], Iterator[tuple[str, dict[str, str]]]]:
    """Read a table whose first line names its columns.

    Args:
        fits: returns whether a list of columns is valid.
        expected: the expected columns, for messages.
        decimals: columns in which a decimal comma becomes a point, if no comma separates values.
        tidy: normalises a column's name.

    Returns:
        The columns, and the values of each line by column, after "Line <number> of <name>".

    Raises:
        DataError: if the columns do not fit, or a line has more or fewer values.
    """
    decimal_comma, lines = separated(text, name)
    header = [tidy(column.strip()) for column in next(lines, (0, []))[1]]
    if not fits(header):
        found = printable(",".join(header)[:_SHOWN])
        raise DataError(
            f"The first line of {name} is {found or 'empty'}; expected {expected}.{mixed_separators(header)}"
        )

    def rows() -> Iterator[tuple[str, dict[str, str]]]:
        for number, values in lines:
            where = f"Line {number} of {name}"
            if len(values) != len(header):
                raise DataError(f"{where} should have {len(header)} values, {','.join(header)}, and has {len(values)}.")
            row = {column: value.strip() for column, value in zip(header, values, strict=True)}
            if decimal_comma:
                row |= {column: row[column].replace(",", ".", 1) for column in decimals if column in row}
            yield where, row

    return header, rows()
