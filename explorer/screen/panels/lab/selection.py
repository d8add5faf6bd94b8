"""A user's choices in the laboratory, as rows of the table of fields, and the queries that they select."""

from __future__ import annotations

import base64
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from explorer.parameters import UnusableError
from explorer.screen.fields import FieldKind, Line, OneOf, PanelField, ScreenState
from explorer.screen.panels.lab.service import LabFindings
from explorer.workspace import Workspace
from lpn.core.arrays import BoolArray, Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column
from lpn.tasks.query_outcomes import RANK_A, RANK_B
from lpn.tasks.task import Task

# Characters of the filter and of the columns' names.
_LONGEST = 1000
# Maximum of characters of picked queries in an address; a longer text is left out.
_LONGEST_PICKED = 1500
# A near miss is a failure whose truth is among this many first tiles.
_NEAR = 5
_FIXED = ("name", RANK_A, RANK_B, "rank", "margin", "part", "answer", "distance")
# Columns shown until the user chooses others; columns without any value are left out.
_DEFAULT = ("altitude", "district", "verdict", "tags")


@dataclass(frozen=True)
class Picked(FieldKind):
    """A set of queries as a short text, see `encode`; empty for no choice."""

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> str:
        if not isinstance(value, str):
            raise UnusableError("expected the queries of a lasso.")
        decode(value, workspace.tasks[state.task])
        return value

    def write(self, value: str, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        return value if len(value) <= _LONGEST_PICKED else ""


TAB = PanelField("lab_tab", OneOf(("table", "charts", "map")), "table", "lab")
SHOW = PanelField("lab_show", OneOf(("all", "missed", "near", "found", "only A", "only B")), "all", "rows")
WHERE = PanelField("lab_where", Line(_LONGEST), "", "where")
PICKED = PanelField("lab_picked", Picked(), "", "picked")
SORT = PanelField("lab_sort", Line(_LONGEST), "margin", "sort")
COLUMNS = PanelField("lab_columns", Line(_LONGEST), "", "columns")
# The number of a model of the place, as in `ScreenState.model`.
SECOND = PanelField("lab_second", OneOf("models", optional=True), "", "ranks-of")
MAP = PanelField("lab_map", OneOf(("", "ground", "pca", "umap")), "", "points")
COLOUR = PanelField("lab_colour", Line(_LONGEST), "", "colour")
FIELDS = (TAB, SHOW, WHERE, PICKED, SORT, COLUMNS, SECOND, MAP, COLOUR)


def encode(rows: Int64Array, task: Task) -> str:
    """Encode queries of a task: four digits of the task, and a packed mask, compressed, in base 64."""
    mask = np.zeros(len(task.queries), bool)
    mask[rows] = True
    return _digits(task) + base64.urlsafe_b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")


def decode(text: str, task: Task) -> Int64Array:
    """Return the queries of an encoded text, ascending, (N,); all queries for an empty text.

    Raises:
        UnusableError: when the text encodes no queries of this task.
    """
    queries = len(task.queries)
    if not text:
        return np.arange(queries)
    size, packed = (queries + 7) // 8, b""
    unpacking = zlib.decompressobj()
    with suppress(ValueError, zlib.error):
        packed = unpacking.decompress(base64.urlsafe_b64decode(text[4:].encode("ascii")), size + 1)
    if len(packed) != size or not unpacking.eof or text[:4] != _digits(task):
        raise UnusableError("expected the queries of a lasso on this task.")
    return np.flatnonzero(np.unpackbits(np.frombuffer(packed, np.uint8))[:queries])


def _digits(task: Task) -> str:
    return f"{zlib.crc32(f'{task.name} {len(task.queries)}'.encode()):08x}"[:4]


def outcome_masks(findings: LabFindings) -> dict[str, BoolArray]:
    """Return the mask of queries, (Q,), of each choice of `SHOW`; choices about two models need a second one."""
    graded, second = findings.graded, findings.second
    near = graded.failed & (graded.rank > 0) & (graded.rank < _NEAR)
    masks = {"all": np.ones(len(graded), bool), "missed": graded.failed, "near": near, "found": graded.hits}
    if second is not None:
        of_second = graded.known & second.hits
        masks |= {"only A": graded.hits & ~of_second, "only B": of_second & ~graded.hits}
    return masks


@dataclass(frozen=True)
class LabSelection:
    """The queries that a state selects among findings.

    Attributes:
        where: the filter in force: the state's filter, or the last valid one.
        error: the reason for which the state's filter is not in force; empty if it is.
    """

    findings: LabFindings
    state: ScreenState
    where: str
    error: str = ""

    @classmethod
    def of(cls, findings: LabFindings, state: ScreenState, before: str) -> LabSelection:
        """Return the selection of a state; `before` stays in force if the state's filter cannot be read."""
        table, where, error = findings.table, state[WHERE], ""
        try:
            table.filter(table.rows(), where)
        except InputError as failure:
            where, error = before, str(failure)
            try:  # a filter of another task may name columns that this one lacks
                table.filter(table.rows(), where)
            except InputError:
                where = ""
        return cls(findings, state, where, error)

    def rows(self, where: str | None = None, any_outcome: bool = False, any_picked: bool = False) -> Int64Array:
        """Return the selected queries, ascending.

        Args:
            where: a filter in place of the one in force.
            any_outcome: ignore the choice of an outcome.
            any_picked: ignore the picked queries.
        """
        table, state = self.findings.table, self.state
        rows = table.rows() if any_picked else self.picked
        rows = table.filter(rows, self.where if where is None else where)
        mask = None if any_outcome else outcome_masks(self.findings).get(state[SHOW])
        return rows if mask is None else rows[mask[rows]]

    @cached_property
    def picked(self) -> Int64Array:
        """The picked queries, ascending; all queries if none are picked, or if the choice is of another task."""
        try:
            return decode(self.state[PICKED], self.findings.task)
        except UnusableError:
            return self.findings.table.rows()

    @property
    def sort(self) -> tuple[str, bool]:
        """The column that orders the queries, and whether it descends."""
        name = self.state[SORT].removeprefix("-")
        known = name in self.findings.table.columns
        return (name, self.state[SORT].startswith("-")) if known else ("margin", False)

    def ordered(self) -> Int64Array:
        """Return the selected queries in the table's order."""
        return self.findings.table.sort(self.rows(), *self.sort)

    def columns(self) -> list[Column]:
        """Return the columns of the table: the fixed ones, and the chosen ones."""
        columns = self.findings.table.columns
        without = "rank" if self.findings.second is not None else ""
        fixed = [name for name in _FIXED if name in columns and name != without]
        chosen = [name for name in self.state[COLUMNS].split(",") if name in columns]
        if not self.state[COLUMNS]:
            chosen = [name for name in _DEFAULT if name in columns and columns[name].known.any()]
        return [columns[name] for name in dict.fromkeys([*fixed, *chosen])]

    def further_columns(self) -> list[str]:
        """Return the columns that a user may add to the fixed ones."""
        return [name for name in self.findings.table.columns if name not in _FIXED]
