"""The command report: an HTML report about some queries."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lpn.cli.parsing import part_values
from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, write_atomic
from lpn.core.progress import report_progress
from lpn.core.texts import counted
from lpn.sources import Advanced, SourceOptions, source_of
from lpn.sources.opened import open_with_notes, query_positions

if TYPE_CHECKING:
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class ReportCommand(SourceOptions):
    """Write a printable, self-contained HTML report about some queries: matches, parts, evidence, counterfactuals."""

    out: Path
    """File to write, ending in .html."""
    query: tuple[str, ...] = ()
    """Names of queries, as the explorer's picker shows them, such as 0005/01."""
    failures: int | None = None
    """Maximum number of failures, lowest margin first; 20 if no query is named."""
    where: str = ""
    """Filter of the queries, such as 'district = "Dock 3" and rank > 10'; with --failures, the worst queries that fit it."""
    matches: int = 5
    """Number of listed tiles for each query."""
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; equal by default."""
    notes: Advanced[Path | None] = None
    """File of tags and notes; by default notes.csv in the folder of the queries."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first."""
    register: bool = True
    """Lay each photo of a flight over the map, as lpn locate does, so that contradicted GPS tags do not count as truth;
    --no-register trusts all tags."""

    def run(self) -> None:
        from lpn import report
        from lpn.descriptors.transforms import Change

        if self.query and (self.failures is not None or self.where):
            raise InputError("Queries are named, and --failures or --where chooses others; leave one of them out.")
        if self.failures is not None and self.failures < 1:
            raise InputError(f"The number of failures is {self.failures}; expected 1 or more.")
        contents = report.Options(self.matches, Change(rotate=self.rotate))
        check_outputs((self.out, ".html", ".htm"))
        opened = open_with_notes(source_of(self), self.notes, self.query, part_values(self.weights))
        task, doubtful = opened.graded() if self.register else (opened.task, ())
        if self.query:
            chosen, selection = query_positions(self.query, task.queries, task.data_name), "chosen by name"
        else:
            chosen, selection = _chosen(task, self)
        contents = replace(contents, selection=selection, doubtful=doubtful)
        page = report.build(task, chosen, contents, partial(report_progress, "Reporting"))
        write_atomic(self.out, page)
        said = f"{self.out}: {counted(len(chosen), 'query')}, {len(page) / 1e6:.1f} MB"
        Console().print(said, highlight=False, markup=False, soft_wrap=True)


def _chosen(task: Task, options: ReportCommand) -> tuple[list[int], str]:
    """Return the queries that --failures and --where select, the worst first, and the selection in words."""
    from lpn.report.page import MOST

    table = task.table
    rows = table.sort(table.filter(table.rows(), options.where), "margin")
    among = f" of those with {options.where}" if options.where else ""
    if options.where and options.failures is None:
        if not len(rows):
            raise InputError(f"No query fits {options.where}; change --where.")
        if len(rows) > MOST:
            raise InputError(
                f"{len(rows)} queries fit {options.where}; a report holds {MOST}, so narrow it, or take the worst "
                "with --failures 20."
            )
        return rows.tolist(), f"all with {options.where}, lowest margin first"
    failed = rows[task.outcomes.failed[rows]]
    if not len(failed):
        raise InputError(f"No query failed{among}; choose some with --query or --where.")
    worst = failed[: 20 if options.failures is None else options.failures]
    if len(worst) > MOST:
        raise InputError(f"{len(worst)} failures are wanted; a report holds {MOST}, so ask for fewer.")
    return worst.tolist(), f"the worst of {len(failed):,} failures{among}, lowest margin first"
