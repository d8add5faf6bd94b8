"""The command failures: the queries on which a model fails."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, cast

from rich.table import Table as Printed
from rich.text import Text

from lpn.cli import by_source
from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.views import TaskName
from lpn.models.adapters import Kind
from lpn.sources import NAMED, Data, TaskSource
from lpn.sources.opened import open_with_notes

if TYPE_CHECKING:
    from lpn.analysis.breakdown import Rate
    from lpn.core.consoles import Console
    from lpn.core.tables import Table
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class FailuresOptions:
    """The list."""

    where: str = ""
    """Filter of the queries, such as 'rank > 1 and margin < -0.1 and name ~ 0012'; all by default."""
    sort: str = "margin"
    """Column to sort by, lowest first; by default the worst failures come first."""
    descending: bool = False
    """Highest first."""
    top: int = 20
    """Maximum number of listed queries, and of lines of each other table."""
    notes: Path | None = None
    """File of tags and notes; by default notes.csv in the folder of the queries."""
    csv: Path | None = None
    """File to write all queries that match --where to, with all columns, tags, and notes, as CSV."""


@dataclass(kw_only=True)
class FailuresOfSource(ABC):
    """List the queries of a task with rank, margin, and the part that decides, and say what fails most."""

    source: TaskSource
    listing: FailuresOptions = field(default_factory=FailuresOptions)

    def run(self) -> None:
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, write_atomic
        from lpn.datasets import metadata
        from lpn.tasks.query_outcomes import OUTCOME_COLUMNS, RANK_A

        listing = self.listing
        if listing.top < 1:
            raise InputError(f"The number of queries listed is {listing.top}; expected 1 or more.")
        check_outputs((listing.csv, ".csv"))
        task = open_with_notes(self.source, listing.notes).task
        made = self._compared(task, task.table)
        rows = made.sort(made.filter(made.rows(), listing.where), listing.sort, listing.descending)
        console = wide_console()
        named = [name for name in made.columns if name in f"{listing.where} {listing.sort}"]
        columns = dict.fromkeys([*OUTCOME_COLUMNS, metadata.TAGS, *named])
        if RANK_A in made.columns:  # two models have a rank each
            del columns["rank"]
        _print(console, made, rows, list(columns), listing.top)
        scored = [] if task.calibration is None else [task.calibration.describe()]
        scored += [f"re-ranked by CSLS over {task.neighbours} nearest queries"] if task.neighbours else []
        if scored:
            console.print(f"{task.model_name} is {', '.join(scored)}.", highlight=False, markup=False)
        if len(rows):
            _print_breakdown(console, task, rows, listing.top)
        if listing.csv is not None:
            write_atomic(listing.csv, made.to_csv(rows))

    def _compared(self, task: Task, table: Table) -> Table:
        """Return the table with the ranks of a second model, where there is one."""
        del task
        return table


@dataclass(kw_only=True)
class FailuresCommand(FailuresOfSource):
    """List the queries of a task with rank, margin, and the part that decides, and say what fails most."""

    SOURCES: ClassVar[dict[str, type[FailuresOfSource]]] = by_source.of_sources(FailuresOfSource, *NAMED)

    source: Data
    beside: Path | None = None
    """Second trained model on the same queries; adds the columns rank A (of --model) and rank B, also for --where and --sort."""
    beside_kind: Kind | None = None
    """Method of --beside, as --kind is that of --model."""
    beside_pooling: str | None = None
    """Pooling of --beside, as --pooling is that of --model."""

    def _compared(self, task: Task, table: Table) -> Table:
        from lpn.tasks.query_outcomes import compared_ranks

        if self.beside is None:
            for option, given in (("--beside-kind", self.beside_kind), ("--beside-pooling", self.beside_pooling)):
                if given is not None:
                    raise InputError(f"{option} needs --beside.")
            return table
        model = replace(self.source.model, model=self.beside, kind=self.beside_kind, pooling=self.beside_pooling)
        scored = replace(self.source, calibrate=task.calibration is not None)  # alike, whatever ships for either
        second = replace(scored, model=model, task=cast(TaskName, task.name)).open().task
        return table.with_columns(compared_ranks(table, second.outcomes.rank))


def _print(console: Console, table: Table, rows: Int64Array, names: list[str], top: int) -> None:
    """The first rows, with those of some columns in which anything is known."""
    columns = [table.columns[name] for name in names if name in table.columns]
    columns = [column for column in columns if column.name != "false" and column.known[rows].any()]
    printed = Printed()
    for column in columns:
        title = f"{column.name} ({column.unit})" if column.unit else column.name
        printed.add_column(title, justify="right" if column.kind == "number" else "left")
    for row in rows[:top]:
        printed.add_row(*(Text(column.text(row)) for column in columns))
    console.print(printed, f"{len(rows)} of {len(table)} queries, {min(top, len(rows))} listed.")


def _print_breakdown(console: Console, task: Task, rows: Int64Array, top: int) -> None:
    """Print the common properties of the failures among some rows."""
    from lpn.analysis import breakdown
    from lpn.tasks.query_outcomes import picture_columns

    table, outcomes, part_names = task.table, task.outcomes, task.part_names
    task = task.current()
    failures = int(outcomes.failed[rows].sum())
    if failures:
        if len(part_names) > 1:
            blamed = zip(part_names, breakdown.blame(outcomes, rows).tolist(), strict=True)
            _print_counts(console, f"The part that lowers the margin most, in {failures} failures:", list(blamed))
        pairs = breakdown.confusions(outcomes, task.query_labels, task.gallery_labels, rows)
        truth, answer = table.column("truth"), table.column("answer")
        counts = [
            (f"{truth.text(one.queries[0]) or one.place} taken for {answer.text(one.queries[0])}", one.count)
            for one in pairs[:top]
        ]
        listed = f", {top} listed" if len(pairs) > top else ""
        _print_counts(console, f"Places taken for others ({len(pairs)} pairs{listed}):", counts)
    # Among failures alone, every rate is 100 %.
    looked = rows if 0 < failures < len(rows) else table.rows()
    for column in picture_columns(table):
        rates = breakdown.rates(outcomes.failed, column, rows=looked)
        if column.name not in ("latitude", "longitude") and len(rates) > 1:
            of = f"{'all ' if len(looked) == len(table) else ''}{len(looked)} queries"
            listed = f"; {top} of {len(rates)} values" if len(rates) > top else ""
            _print_rates(console, f"Failures by {column.name}, of {of}{listed}:", rates[:top])


def _print_counts(console: Console, title: str, counts: list[tuple[str, int]]) -> None:
    printed = Printed(show_header=False)
    printed.add_column()
    printed.add_column(justify="right")
    for name, count in counts:
        printed.add_row(Text(name), str(count))
    console.print("", Text(title), printed)


def _print_rates(console: Console, title: str, rates: list[Rate]) -> None:
    printed = Printed()
    for name in ("", "queries", "failures", "share", "95 % interval"):
        printed.add_column(name, justify="right" if name else "left")
    for rate in rates:
        low, high = rate.interval
        figures = (f"{100 * rate.share:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %")
        printed.add_row(Text(rate.name), str(rate.queries), str(rate.failures), *figures)
    console.print("", Text(title), printed)
