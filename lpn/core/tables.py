"""A table that is sorted, filtered, and searched by index arrays, without copies of it.

A filter is one or more conditions joined by `and`:

    rank > 1 and margin < -0.1 and district = "Dock 3" and name ~ 0012

`=`, `!=`, `<`, `<=`, `>`, `>=` compare numbers. `=`, `!=` compare texts, `~`, `!~` test whether a text contains another; case is
ignored. `none` stands for an unknown value. An unknown number satisfies no other comparison.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, BoolArray, Float64Array, Int64Array, ObjectArray
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError
from lpn.core.files import TYPED, printable

_COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
# Any visitor can type a filter, so these patterns must not backtrack catastrophically.
_QUOTED = re.compile(r'"[^"]*"?')
_AND = re.compile(r"(?<!\s)\s+and(?:\s+|$)", re.IGNORECASE)
_OPERATOR = re.compile(r"<=|>=|!=|!~|=|<|>|~")
# Names of columns, and values outside of quotes, exclude these.
OPERATOR_CHARACTERS = frozenset('<>=!~"')
_MAX_LENGTH = 1000
ColumnType = Literal["number", "text"]


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a table.

    Attributes:
        name: unique in its table, without the operators of a filter.
        kind: of its values.
        values: (N,) float64, NaN if unknown, or (N,) object of str, "" if unknown.
        unit: of numbers, such as "m"; may be empty.
        about: the meaning of the values, in words; may be empty.
    """

    name: str
    kind: ColumnType
    values: AnyArray
    unit: str = ""
    about: str = ""

    def text(self, row: int) -> str:
        """Return a value as text: numbers with up to four decimals, "" if unknown."""
        value = self.values[row]
        if self.kind == "text":
            return str(value)
        return "" if np.isnan(value) else f"{value:.4f}".rstrip("0").rstrip(".").replace("-", "−")

    @cached_property
    def known(self) -> BoolArray:
        """A mask of the known values, (N,)."""
        return np.asarray(~np.isnan(self.values) if self.kind == "number" else self.values != "", bool)

    @cached_property
    def folded(self) -> ObjectArray:
        """The texts, case-folded for comparison, (N,)."""
        return np.array([value.casefold() for value in self.values], object)

    @cached_property
    def keys(self) -> Float64Array:
        """Sort keys, NaN if unknown, (N,)."""
        if self.kind == "number":
            return self.values
        places = {text: i for i, text in enumerate(sorted(set(self.folded.tolist())))}
        order = np.array([places[text] for text in self.folded], np.float64)
        return np.where(self.known, order, np.nan)


def number_column(name: str, values: npt.ArrayLike, unit: str = "", about: str = "") -> Column:
    """Return a column of numbers (N,), NaN if unknown; for the rest see `Column`."""
    return Column(name, "number", np.asarray(values, np.float64), unit, about)


def text_column(name: str, values: Iterable[str], about: str = "") -> Column:
    """Return a column of texts (N,), "" if unknown; for the rest see `Column`."""
    return Column(name, "text", np.array(list(values), object), about=about)


class Table:
    """Columns of equal length; the column `name` names each row.

    Args:
        paths: the identity of each row, (N,): its picture's path in the data set.
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
        """Return this table with further columns, which replace those of the same name."""
        return Table(self.paths, list((self.columns | {column.name: column for column in columns}).values()))

    def rows(self) -> Int64Array:
        """Return all row indices, (N,)."""
        return np.arange(len(self))

    def column(self, name: str) -> Column:
        """Return a column by its name, case ignored.

        Raises:
            InputError: if there is none; the message lists the columns.
        """
        wanted = name.strip().casefold()
        for column in self.columns.values():
            if column.name.casefold() == wanted:
                return column
        raise InputError(f"There is no column {name.strip()!r}; the columns are {', '.join(self.columns)}.")

    def sort(self, rows: Int64Array, column: str, descending: bool = False) -> Int64Array:
        """Sort rows by a column, stably; unknown values come last in either direction."""
        keys = self.column(column).keys[rows]
        sorted_rows: Int64Array = rows[np.argsort(-keys if descending else keys, kind="stable")]
        return sorted_rows

    def filter(self, rows: Int64Array, where: str) -> Int64Array:
        """Return the rows that satisfy a filter (see the module), in their order; all rows for an empty filter.

        Raises:
            InputError: if the filter is malformed or names an unknown column.
        """
        if len(where) > _MAX_LENGTH:
            raise InputError(f"The filter has {len(where)} letters; expected {_MAX_LENGTH} at most.")
        for text in _conditions(where) if where.strip() else []:
            if not text.strip():
                raise InputError(
                    'The filter has nothing before or after an "and"; expected a condition there, such as rank > 1.'
                )
            condition = _split(text)
            if condition is None:
                raise InputError(
                    f"The condition {text.strip()!r} cannot be read; expected one such as rank > 1 or name ~ 0012, a value with "
                    f'signs or "and" in it within "", and the columns {", ".join(self.columns)}.'
                )
            name, sign, value = condition
            rows = rows[_satisfied(self.column(name), sign, value)[rows]]
        return rows

    def search(self, rows: Int64Array, text: str) -> Int64Array:
        """Return the rows whose name contains a text, case ignored."""
        wanted = text.strip().casefold()
        folded = self.columns["name"].folded
        matching: Int64Array = rows[np.array([wanted in folded[row] for row in rows], bool)]
        return matching

    def to_csv(self, rows: Int64Array) -> bytes:
        """Return rows as CSV in UTF-8: path and all columns, unknown values empty.

        A text that a spreadsheet would read as a formula gets an apostrophe in front, see `lpn.core.csv_cells`.
        """
        columns = list(self.columns.values())
        cells = [
            ["" if np.isnan(value) else f"{value:.9g}" for value in column.values[rows]]
            if column.kind == "number"
            else column.values[rows].tolist()
            for column in columns
        ]
        header = ["path", *(column.name for column in columns)]
        return csv_bytes([header, *zip((printable(self.paths[row]) for row in rows), *cells, strict=True)], keep=TYPED)


def _unquoted(text: str) -> str:
    """Replace quoted text by quotes of its length, so that operators are found outside of quotes only."""
    return _QUOTED.sub(lambda match: '"' * len(match[0]), text)


def _conditions(where: str) -> list[str]:
    """Split a filter at each `and` outside of quotes."""
    conditions, start = [], 0
    for between in _AND.finditer(_unquoted(where)):
        conditions.append(where[start : between.start()])
        start = between.end()
    return [*conditions, where[start:]]


def _split(condition: str) -> tuple[str, str, str] | None:
    """Split a condition into name, operator, and value; None if it is malformed."""
    sign = _OPERATOR.search(_unquoted(condition))
    if sign is None:
        return None
    name, value = condition[: sign.start()].strip(), condition[sign.end() :].strip()
    quoted = len(value) > 1 and value[0] == value[-1] == '"' and value.count('"') == 2
    if not name or OPERATOR_CHARACTERS & set(name) or (OPERATOR_CHARACTERS & set(value) and not quoted):
        return None
    return name, sign[0], value


def _satisfied(column: Column, sign: str, value: str) -> BoolArray:
    """Return which rows satisfy one condition, (N,)."""
    quoted, wanted = value.startswith('"'), value.strip('"').strip()
    if not wanted:
        raise InputError(f"There is nothing to compare {column.name} with; expected a value after {sign}, or none.")
    if wanted.casefold() == "none" and not quoted and sign in ("=", "!="):
        return column.known if sign == "!=" else ~column.known
    if column.kind == "text":
        if sign in ("=", "!="):
            return np.asarray((column.folded == wanted.casefold()) == (sign == "="), bool)
        if sign in ("~", "!~"):
            return np.array([(wanted.casefold() in text) == (sign == "~") for text in column.folded], bool)
        raise InputError(
            f"{column.name} holds texts, which {sign} does not compare; expected = or != for the whole text, ~ or !~ for a "
            "part."
        )
    try:
        number = float(wanted.replace("−", "-"))
    except ValueError:
        number = np.nan
    if np.isnan(number) or sign not in _COMPARISONS:
        raise InputError(
            f"{column.name} holds numbers, and {sign} {printable(wanted)} does not fit them; expected one of "
            f"{' '.join(_COMPARISONS)} and a number, or = none."
        )
    fulfilled: BoolArray = _COMPARISONS[sign](column.values, number) & column.known
    return fulfilled
