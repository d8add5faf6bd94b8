"""The command failures: the queries on which a model fails."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table as Printed
from rich.text import Text

import lpn
from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.views import TaskName
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from rich.console import Console

    from lpn.analysis.breakdown import Rate
    from lpn.analysis.task import Task
    from lpn.core.tables import Table


@dataclass
class FailuresCommand:
    """List the queries of a task with rank, margin, and the part that decides, and say what fails most."""

    data: Path
    """Data set in any layout of docs/data.md."""
    model: Path
    """Trained LPN: .onnx, .safetensors, or .pth."""
    kind: Kind | None = None
    """Method of a published .pth whose entries do not tell it, such as dac; see docs/models.md."""
    calibrate: bool = False
    """Choose the zoom at which drone pictures and tiles show the same ground, and subtract each view's mean, without labels."""
    task: TaskName | None = None
    """Views of query and gallery; by default the first task of the data set that the model supports."""
    where: str = ""
    """Filter of the queries, such as 'rank > 1 and margin < -0.1 and name ~ 0012'; all by default."""
    sort: str = "margin"
    """Column to sort by, lowest first; by default the worst failures come first."""
    descending: bool = False
    """Highest first."""
    top: int = 20
    """Maximum number of listed queries, and of lines of each other table."""
    notes: Path | None = None
    """File of tags and notes; by default notes.csv in the data set's folder."""
    beside: Path | None = None
    """Second trained model on the same queries; adds the columns rank A (of --model) and rank B, also for --where and --sort."""
    beside_kind: Kind | None = None
    """Method of --beside, as --kind is that of --model."""
    csv: Path | None = None
    """File to write all queries that match --where to, with all columns, tags, and notes."""

    def run(self) -> None:
        from lpn.analysis.notes import read_notes
        from lpn.analysis.query_outcomes import OUTCOME_COLUMNS, compared_ranks
        from lpn.analysis.task import calibrated, open_task
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_writable, write_atomic
        from lpn.datasets import metadata, open_dataset

        if self.top < 1:
            raise InputError(f"The number of queries listed is {self.top}; expected 1 or more.")
        if self.beside_kind is not None and self.beside is None:
            raise InputError(
                "This kind is that of the second model; give --beside-kind with --beside, or leave it out."
            )
        if self.csv is not None:
            check_writable(self.csv)
        model, dataset = lpn.load(self.model, kind=self.kind), open_dataset(self.data)
        task = open_task(
            model,
            self.model.name,
            dataset,
            self.task,
            tags_and_notes=read_notes(self.notes) if self.notes else None,
            calibration=calibrated(model, dataset) if self.calibrate else None,
        )
        made = task.table
        if self.beside is not None:
            second = lpn.load(self.beside, kind=self.beside_kind)
            other = open_task(
                second,
                self.beside.name,
                dataset,
                task.name,
                tags_and_notes={},
                calibration=calibrated(second, dataset) if self.calibrate else None,
            )
            made = made.with_columns(compared_ranks(made, other.outcomes.rank))
        rows = made.sort(made.filter(made.rows(), self.where), self.sort, self.descending)
        console = wide_console()
        shown = [
            *OUTCOME_COLUMNS,
            metadata.TAGS,
            *(name for name in made.columns if name in f"{self.where} {self.sort}"),
        ]
        if self.beside is not None:
            shown = [name for name in shown if name != "rank"]
        _print(console, made, rows, list(dict.fromkeys(shown)), self.top)
        if task.calibration is not None:
            console.print(f"{task.model_name} is {task.calibration.describe()}.", highlight=False, markup=False)
        if len(rows):
            _print_breakdown(console, task, rows, self.top)
        if self.csv is not None:
            write_atomic(self.csv, made.to_csv(rows))


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
    from lpn.analysis.query_outcomes import picture_columns

    table, outcomes, part_names = task.table, task.outcomes, task.part_names
    failures = int(outcomes.failed[rows].sum())
    if failures:
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
        found = breakdown.rates(outcomes.failed, column, rows=looked)
        if column.name not in ("latitude", "longitude") and len(found) > 1:
            of = f"{'all ' if len(looked) == len(table) else ''}{len(looked)} queries"
            listed = f"; {top} of {len(found)} values" if len(found) > top else ""
            _print_rates(console, f"Failures by {column.name}, of {of}{listed}:", found[:top])


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
