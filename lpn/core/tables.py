"""A table of many rows that is sorted, filtered, searched, and paged by index arrays, so that it is never copied.

A filter is one or more conditions joined by `and`:

    rank > 1 and margin < -0.1 and district = "Dock 3" and name ~ 0012

`=`, `!=`, `<`, `<=`, `>`, `>=` compare numbers; `=`, `!=` compare texts and `~`, `!~` ask whether one contains another, case
ignored. `none` is what is unknown: no number, or no text. Otherwise, what is unknown fulfils no comparison of numbers.
"""

from __future__ import annotations

import csv
import io
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, Int64Array, ObjectArray
from lpn.core.errors import InputError
from lpn.core.files import printable

_COMPARED: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
# A filter is typed by anybody who sees the page: no pattern here may try one stretch of it from several of its letters.
_QUOTED = re.compile(r'"[^"]*"?')
_AND = re.compile(r"(?<!\s)\s+and\s+", re.IGNORECASE)
_SIGN = re.compile(r"<=|>=|!=|!~|=|<|>|~")
_SIGNS = frozenset('<>=!~"')
"""Of which neither a name nor a value outside of quotes has any."""
_LONGEST = 1000
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
Kind = Literal["number", "text"]


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a table.

    Attributes:
        name: unique in its table, without the signs of a filter.
        kind: of its values.
        values: (N,) float64 with NaN for what is unknown, or (N,) object of str with "" for it.
        unit: of numbers, such as "m"; may be empty.
    """

    name: str
    kind: Kind
    values: AnyArray
    unit: str = ""

    def text(self, row: int) -> str:
        """A value as it is shown to people: numbers with up to four digits after the point, "" for what is unknown."""
        value = self.values[row]
        if self.kind == "text":
            return str(value)
        return "" if np.isnan(value) else f"{value:.4f}".rstrip("0").rstrip(".")

    @cached_property
    def known(self) -> BoolArray:
        """Which values are known, (N,)."""
        return np.asarray(~np.isnan(self.values) if self.kind == "number" else self.values != "", bool)

    @cached_property
    def folded(self) -> ObjectArray:
        """Texts as they are compared, (N,)."""
        return np.array([value.casefold() for value in self.values], object)

    @cached_property
    def keys(self) -> Float64Array:
        """Numbers in the order of the values, NaN for what is unknown, (N,)."""
        if self.kind == "number":
            return self.values
        places = {text: i for i, text in enumerate(sorted(set(self.folded.tolist())))}
        order = np.array([places[text] for text in self.folded], np.float64)
        return np.where(self.known, order, np.nan)


def number_column(name: str, values: npt.ArrayLike, unit: str = "") -> Column:
    """A column of numbers (N,), NaN for what is unknown."""
    return Column(name, "number", np.asarray(values, np.float64), unit)


def text_column(name: str, values: Iterable[str]) -> Column:
    """A column of texts (N,), "" for what is unknown."""
    return Column(name, "text", np.array(list(values), object))


class Table:
    """Columns of equal length, of which the one called `name` says what each row is.

    Args:
        paths: what identifies each row, (N,): its picture's path in the data set.
        columns: at least `name`.
    """

    def __init__(self, paths: Sequence[str], columns: Sequence[Column]) -> None:
        self.paths = tuple(paths)
        self.columns = {column.name: column for column in columns}
        if len(self.columns) < len(columns) or any(len(column.values) != len(self.paths) for column in columns):
            raise InputError(
                f"The columns {', '.join(c.name for c in columns)} are not {len(columns)} names of {len(self.paths)} rows each."
            )

    def __len__(self) -> int:
        return len(self.paths)

    def with_columns(self, columns: Sequence[Column]) -> Table:
        """This table with more columns, in place of those of the same name."""
        return Table(self.paths, list((self.columns | {column.name: column for column in columns}).values()))

    def rows(self) -> Int64Array:
        """All rows, (N,)."""
        return np.arange(len(self))

    def column(self, name: str) -> Column:
        """A column by its name, case ignored.

        Raises:
            InputError: when there is none; the message says which there are.
        """
        for column in self.columns.values():
            if column.name.casefold() == name.strip().casefold():
                return column
        raise InputError(f"There is no column {name.strip()!r}; the columns are {', '.join(self.columns)}.")

    def sort(self, rows: Int64Array, column: str, descending: bool = False) -> Int64Array:
        """Rows in the order of a column; equal ones stay in their order, and what is unknown comes last either way."""
        keys = self.column(column).keys[rows]
        sorted_rows: Int64Array = rows[np.argsort(-keys if descending else keys, kind="stable")]
        return sorted_rows

    def filter(self, rows: Int64Array, where: str) -> Int64Array:
        """Those of some rows that fulfil a filter, in their order; all for an empty one.

        Raises:
            InputError: when the filter is not one, see above, or names a column that is not there.
        """
        if len(where) > _LONGEST:
            raise InputError(f"The filter has {len(where)} letters; expected {_LONGEST} at most.")
        for text in _conditions(where) if where.strip() else []:
            condition = _parted(text)
            if condition is None:
                raise InputError(
                    f"The condition {text.strip()!r} cannot be read; expected one such as rank > 1 or name ~ 0012, a value with "
                    f'signs or "and" in it within "", and the columns {", ".join(self.columns)}.'
                )
            name, sign, value = condition
            rows = rows[_fulfilled(self.column(name), sign, value)[rows]]
        return rows

    def search(self, rows: Int64Array, text: str) -> Int64Array:
        """Those of some rows whose name contains a text, case ignored."""
        wanted = text.strip().casefold()
        folded = self.columns["name"].folded
        found: Int64Array = rows[np.array([wanted in folded[row] for row in rows], bool)]
        return found

    def page(self, rows: Int64Array, start: int, count: int) -> Int64Array:
        """At most `count` of some rows from position `start` on; the last full page where there are not so many."""
        start = max(0, min(start, len(rows) - count))
        return rows[start : start + max(count, 0)]

    def to_csv(self, rows: Int64Array) -> bytes:
        """Some rows as comma-separated values in UTF-8: path and all columns, numbers in full, unknown ones empty.

        A text that a spreadsheet would take for a formula (it begins with =, +, -, @, or a control character) gets an
        apostrophe before it.
        """
        columns = list(self.columns.values())
        cells = [
            [("" if np.isnan(v) else f"{v:.9g}") for v in column.values[rows]]
            if column.kind == "number"
            else [harmless(text) for text in column.values[rows]]
            for column in columns
        ]
        file = io.StringIO(newline="")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["path", *(harmless(column.name) for column in columns)])
        writer.writerows(zip((harmless(self.paths[row]) for row in rows), *cells, strict=True))
        return file.getvalue().encode("utf-8", "replace")


def harmless(text: str) -> str:
    """A text that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(_FORMULA) else text


def _unquoted(text: str) -> str:
    """A text of the same length in which nothing within quotes is a sign, a space, or a letter that means something."""
    return _QUOTED.sub(lambda found: '"' * len(found[0]), text)


def _conditions(where: str) -> list[str]:
    """The conditions of a filter, parted at each `and` outside of quotes."""
    found, start = [], 0
    for between in _AND.finditer(_unquoted(where)):
        found.append(where[start : between.start()])
        start = between.end()
    return [*found, where[start:]]


def _parted(condition: str) -> tuple[str, str, str] | None:
    """A condition's name, sign, and value, as it was typed; None where it is none."""
    sign = _SIGN.search(_unquoted(condition))
    if sign is None:
        return None
    name, value = condition[: sign.start()].strip(), condition[sign.end() :].strip()
    quoted = len(value) > 1 and value[0] == value[-1] == '"' and value.count('"') == 2
    if not name or _SIGNS & set(name) or (_SIGNS & set(value) and not quoted):
        return None
    return name, sign[0], value


def _fulfilled(column: Column, sign: str, value: str) -> BoolArray:
    """Which rows fulfil one condition, (N,)."""
    quoted, wanted = value.startswith('"'), value.strip('"').strip()
    if not wanted:
        raise InputError(f"There is nothing to compare {column.name} with; expected a value after {sign}, or none.")
    if wanted.casefold() == "none" and not quoted and sign in ("=", "!="):
        return column.known if sign == "!=" else ~column.known
    if column.kind == "text":
        return _text_fulfilled(column, sign, wanted.casefold())
    try:
        number = float(wanted)
    except ValueError:
        number = np.nan
    if np.isnan(number) or sign not in _COMPARED:
        raise InputError(
            f"{column.name} holds numbers, and {sign} {printable(wanted)} does not fit them; expected one of "
            f"{' '.join(_COMPARED)} and a number, or = none."
        )
    fulfilled: BoolArray = _COMPARED[sign](column.values, number) & column.known
    return fulfilled


def _text_fulfilled(column: Column, sign: str, wanted: str) -> BoolArray:
    if sign in ("=", "!="):
        return np.asarray((column.folded == wanted) == (sign == "="), bool)
    if sign in ("~", "!~"):
        return np.array([(wanted in text) == (sign == "~") for text in column.folded], bool)
    raise InputError(
        f"{column.name} holds texts, which {sign} does not compare; expected = or != for the whole text, ~ or !~ for a part."
    )
