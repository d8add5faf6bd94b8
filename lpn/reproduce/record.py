"""The record of a measured table: all data of its page, with the provenance of each figure."""

from __future__ import annotations

import msgspec

from lpn.analysis.statistics import half_interval
from lpn.reproduce.tables import PrintedValues, Values
from lpn.training.run_folder import Provenance


class RowRecord(msgspec.Struct, frozen=True, omit_defaults=True):
    """A row of a measured table.

    Attributes:
        label: the name by which claims refer to the row.
        values: for each network, "seed 0" or "given", its value in each column; empty if the row was not run.
        paper: the paper's values, empty if it has no such row.
        note: printed after the label.
        quoted: whether the paper quotes the row from other work, so that nothing is measured.
        trained, measured: for each network, the provenance of it and of its figures.
        reason: the reason why the row was not run; empty if it was.
    """

    label: str
    values: dict[str, Values] = {}
    paper: PrintedValues = ()
    note: str = ""
    quoted: bool = False
    trained: dict[str, Provenance] = {}
    measured: dict[str, Provenance] = {}
    reason: str = ""

    @property
    def mean(self) -> Values:
        """The mean over networks, for each column; empty if the row was not run."""
        return tuple(sum(column) / len(column) for column in zip(*self.values.values(), strict=True))

    @property
    def interval(self) -> Values:
        """Half the width of the 95 % interval of the mean over networks, for each column; 0 for one network."""
        return tuple(half_interval(column) for column in zip(*self.values.values(), strict=True))

    @property
    def title(self) -> str:
        """The label with its note."""
        return f"{self.label} ({self.note})" if self.note else self.label


class TableRecord(msgspec.Struct, frozen=True, omit_defaults=True):
    """A measured table.

    Attributes:
        key: such as "table1".
        title: with the data set.
        columns: titles of the measured columns.
        beside: for each measured column, the index of the paper's column beside it, None if there is none.
        alone: titles of the paper's columns without a measured column beside them, by index.
        notes: sentences below the table.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    beside: tuple[int | None, ...]
    rows: tuple[RowRecord, ...]
    notes: tuple[str, ...] = ()
    alone: dict[int, str] = {}

    def row(self, label: str) -> RowRecord | None:
        """Return a row that was run; None if it was not."""
        return next((row for row in self.rows if row.label == label and row.values), None)
