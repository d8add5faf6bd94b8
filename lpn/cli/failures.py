"""The command failures: the queries on which a model fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from lpn.core.arrays import Int64Array
from lpn.core.consoles import Console, wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, write_atomic
from lpn.core.text_tables import TextTable
from lpn.core.texts import counted
from lpn.core.views import TaskName
from lpn.models.adapters import Kind
from lpn.sources import Advanced, SourceOptions, source_of
from lpn.sources.opened import open_with_notes

if TYPE_CHECKING:
    from lpn.core.tables import Table
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class FailuresCommand(SourceOptions):
    """List the queries of a source with rank, margin, and the deciding part, and count the failures by their properties."""

    where: str = ""
    """Filter of the queries, such as 'rank > 1 and margin < -0.1 and name ~ 0012'; all by default."""
    sort: str = "margin"
    """Column to sort by, lowest first; by default the worst failures come first."""
    descending: Advanced[bool] = False
    """Highest first."""
    top: int = 20
    """Maximum number of listed queries, and of lines of each other table."""
    notes: Advanced[Path | None] = None
    """File of tags and notes; by default notes.csv in the folder of the queries."""
    csv: Path | None = None
    """CSV file to write: all queries that match --where, with all columns, tags, and notes."""
    beside: Path | None = None
    """Second trained model on the same queries; adds the columns rank A (of --model) and rank B, also for --where and --sort."""
    beside_kind: Advanced[Kind | None] = None
    """Method of the model of --beside; see --kind."""
    beside_pooling: Advanced[str | None] = None
    """Pooling of the model of --beside; see --pooling."""

    def run(self) -> None:
        from lpn.datasets import metadata
        from lpn.tasks.query_outcomes import OUTCOME_COLUMNS, RANK_A, compared_ranks

        if self.top < 1:
            raise InputError(f"The number of queries listed is {self.top}; expected 1 or more.")
        check_outputs((self.csv, ".csv"))
        for option, given in (("--beside-kind", self.beside_kind), ("--beside-pooling", self.beside_pooling)):
            if given is not None and self.beside is None:
                raise InputError(f"{option} needs --beside.")
        source = source_of(self)
        task = open_with_notes(source, self.notes).task
        table = task.table
        if self.beside is not None:
            second = replace(self, model=self.beside, kind=self.beside_kind, pooling=self.beside_pooling)
            if {"task", "calibrate"} <= source.takes:  # rank the second model alike, whichever calibration ships
                second = replace(second, task=cast(TaskName, task.name), calibrate=task.calibration is not None)
            table = table.with_columns(compared_ranks(table, source_of(second).open().task.outcomes.rank))
        rows = table.sort(table.filter(table.rows(), self.where), self.sort, self.descending)
        console = wide_console()
        named = [name for name in table.columns if name in f"{self.where} {self.sort}"]
        columns = dict.fromkeys([*OUTCOME_COLUMNS, metadata.TAGS, *named])
        if RANK_A in table.columns:  # each model has its own rank
            del columns["rank"]
        _print(console, table, rows, list(columns), self.top)
        scored = [] if task.calibration is None else [task.calibration.describe()]
        scored += [f"re-ranked by CSLS over {task.neighbours} nearest queries"] if task.neighbours else []
        if scored:
            console.print(f"{task.model_name} is {', '.join(scored)}.", highlight=False, markup=False)
        if len(rows):
            _print_breakdown(console, task, rows, self.top)
        if self.csv is not None:
            write_atomic(self.csv, table.to_csv(rows))


def _print(console: Console, table: Table, rows: Int64Array, names: list[str], top: int) -> None:
    """Print the first rows, with the columns in which anything is known."""
    columns = [table.columns[name] for name in names if name in table.columns]
    columns = [column for column in columns if column.name != "false" and column.known[rows].any()]
    head = [f"{column.name} ({column.unit})" if column.unit else column.name for column in columns]
    cells = [[column.text(row) for column in columns] for row in rows[:top]]
    after = f"{len(rows)} of {counted(len(table), 'query')}, {min(top, len(rows))} listed."
    align = "".join("r" if column.kind == "number" else "l" for column in columns)
    TextTable(head, cells, after=after, align=align).print(console)


def _print_breakdown(console: Console, task: Task, rows: Int64Array, top: int) -> None:
    """Print the common properties of the failures among some rows."""
    from lpn.analysis import breakdown
    from lpn.tasks.query_outcomes import picture_columns

    table, outcomes, part_names = task.table, task.outcomes, task.part_names
    failures = int(outcomes.failed[rows].sum())
    if failures:
        if len(part_names) > 1:
            blamed = [*zip(part_names, map(str, breakdown.blame(outcomes, rows)), strict=True)]
            title = f"The part that lowers the margin most, in {failures} failures"
            TextTable(("part", "failures"), blamed, title).print(console)
        pairs = breakdown.confusions(outcomes, task.query_labels, task.gallery_labels, rows)
        truth, answer = table.column("truth"), table.column("answer")
        counts = [
            (
                f"{truth.text(one.queries[0]) or one.place} taken for {answer.text(one.queries[0])}",
                str(len(one.queries)),
            )
            for one in pairs[:top]
        ]
        listed = f", {top} listed" if len(pairs) > top else ""
        title = f"Places taken for others ({len(pairs)} pairs{listed})"
        TextTable(("place", "failures"), counts, title).print(console)
    # Among failures alone, every rate is 100 %.
    looked = rows if 0 < failures < len(rows) else table.rows()
    for column in picture_columns(table):
        rates = breakdown.rates(outcomes.failed, column, rows=looked)
        if column.name not in ("latitude", "longitude") and len(rates) > 1:
            of = f"{'all ' if len(looked) == len(table) else ''}{counted(len(looked), 'query')}"
            listed = f"; {top} of {len(rates)} values" if len(rates) > top else ""
            figures = []
            for rate in rates[:top]:
                low, high = (100 * bound for bound in rate.interval)
                shares = (f"{100 * rate.share:.1f} %", f"{low:.1f} to {high:.1f} %")
                figures.append((rate.name, str(rate.queries), str(rate.failures), *shares))
            head = (column.name, "queries", "failures", "share", "95 % interval")
            TextTable(head, figures, f"Failures by {column.name}, of {of}{listed}").print(console)
