"""The command report: an HTML report about some queries."""

from __future__ import annotations

from abc import ABC
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from lpn.cli import by_source
from lpn.core.errors import InputError
from lpn.sources import Arrays, Data, Flown, Indexed, Published, TaskSource
from lpn.sources.opened import open_with_notes, query_positions

if TYPE_CHECKING:
    from lpn.report import Options
    from lpn.sources.opened import OpenedSource
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class ReportOptions:
    """The report."""

    out: Path
    """File to write, ending in .html."""
    query: tuple[str, ...] = ()
    """Names of queries, as the explorer's picker shows them, such as 0005/01."""
    failures: int | None = None
    """Maximum number of failures, lowest margin first; 20 if no query is named."""
    where: str = ""
    """Filter of the queries, such as 'district = "Dock 3" and rank > 10'; with --failures the worst of them."""
    matches: int = 5
    """Number of listed tiles for each query."""
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; equal by default."""
    notes: Path | None = None
    """File of tags and notes; by default notes.csv in the folder of the queries."""


@dataclass(kw_only=True)
class RotationOptions:
    """Rotated queries, which a network describes again."""

    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first."""


@dataclass(kw_only=True)
class ReportOfSource(ABC):
    """Write a printable, self-contained HTML report about some queries."""

    source: TaskSource
    report: ReportOptions

    def run(self) -> None:
        from lpn import report
        from lpn.cli.explain import part_values
        from lpn.core.consoles import Console
        from lpn.core.files import check_outputs, write_atomic
        from lpn.core.progress import report_progress

        options = self.report
        if options.query and (options.failures is not None or options.where):
            raise InputError("Queries are named, and --failures or --where chooses others; leave one of them out.")
        if options.failures is not None and options.failures < 1:
            raise InputError(f"The number of failures is {options.failures}; expected 1 or more.")
        contents = self._contents()
        check_outputs((options.out, ".html", ".htm"))
        task, doubtful = self._graded(
            open_with_notes(self.source, options.notes, options.query, part_values(options.weights))
        )
        if options.query:
            chosen, selection = query_positions(options.query, task.queries, task.data_name), "chosen by name"
        else:
            chosen, selection = _chosen(task, options)
        contents = replace(contents, selection=selection, doubtful=doubtful)
        page = report.build(task, chosen, contents, partial(report_progress, "Reporting"))
        write_atomic(options.out, page)
        count = f"{len(chosen)} {'query' if len(chosen) == 1 else 'queries'}"
        Console().print(
            f"{options.out}: {count}, {len(page) / 1e6:.1f} MB", highlight=False, markup=False, soft_wrap=True
        )

    def _contents(self) -> Options:
        from lpn.report import Options

        return Options(self.report.matches)

    def _graded(self, opened: OpenedSource) -> tuple[Task, Collection[int]]:
        """Return the task as it is graded, and the queries that are not, as no tile is right for certain."""
        return opened.task, ()


@dataclass(kw_only=True)
class ReportOfNetwork(ReportOfSource):
    """Write a printable, self-contained HTML report about some queries that a network describes."""

    rotation: RotationOptions = field(default_factory=RotationOptions)

    def _contents(self) -> Options:
        from lpn.descriptors.transforms import Change
        from lpn.report import Options

        return Options(self.report.matches, Change(rotate=self.rotation.rotate))


@dataclass(kw_only=True)
class ReportOfFlight(ReportOfNetwork):
    """Write a printable, self-contained HTML report about some photos of a flight; those of a doubtful judge are not graded."""

    register: bool = True
    """Lay each photo over the map, as lpn locate does, so that GPS tags that it contradicts judge nothing; --no-register leaves
    that out, and trusts all tags."""

    def _graded(self, opened: OpenedSource) -> tuple[Task, Collection[int]]:
        import numpy as np

        from lpn.locate.grades import doubtful_photos
        from lpn.locate.pipeline import registered
        from lpn.locate.task import stage_columns

        task, located = opened.task, opened.located
        assert located is not None
        if not self.register:
            return task, ()
        located = registered(located, opened.network)
        best, first = task.retrieved.best, task.retrieved.first
        doubtful = set(np.flatnonzero(doubtful_photos(located, task, best, first)).tolist())
        task = replace(task, columns=[*task.columns, *stage_columns(located)])
        return task.without_truth(doubtful), doubtful


@dataclass(kw_only=True)
class ReportCommand(ReportOfNetwork):
    """Write a printable, self-contained HTML report about some queries: matches, parts, evidence, counterfactuals."""

    SOURCES: ClassVar[dict[str, type[ReportOfSource]]] = {
        **by_source.of_sources(ReportOfSource, Published, Arrays),
        **by_source.of_sources(ReportOfNetwork, Indexed),
        **by_source.of_sources(ReportOfFlight, Flown),
    }

    source: Data


def _chosen(task: Task, options: ReportOptions) -> tuple[list[int], str]:
    """Return positions of the queries that --failures and --where choose, the worst first, and how they were chosen."""
    from lpn.report.page import MOST

    table = task.table
    rows = table.sort(table.filter(table.rows(), options.where), "margin")
    among = f" of those with {options.where}" if options.where else ""
    if options.where and options.failures is None:
        if not len(rows):
            raise InputError(f"No query is one with {options.where}; change --where.")
        if len(rows) > MOST:
            raise InputError(
                f"{len(rows)} queries are ones with {options.where}; a report holds {MOST}, so narrow it, or take the worst "
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
