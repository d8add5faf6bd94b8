"""The command report: an HTML report about some queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import lpn
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import TaskName
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from lpn.analysis.task import Task
    from lpn.datasets import Picture


@dataclass
class ReportCommand:
    """Write a printable, self-contained HTML report about some queries: matches, parts, evidence, counterfactuals."""

    data: Path
    """Data set in any layout of docs/data.md."""
    model: Path
    """Trained LPN: .onnx (needs no torch), .safetensors, or .pth."""
    out: Path
    """HTML file to write."""
    kind: Kind | None = None
    """Method of a published .pth whose entries do not tell it, such as dac; see docs/models.md."""
    calibrate: bool = False
    """Choose the zoom at which drone pictures and tiles show the same ground, and subtract each view's mean, without labels."""
    task: TaskName | None = None
    """Views of query and gallery; by default the first task of the data set that the model supports."""
    query: tuple[str, ...] = ()
    """Names of queries, as the explorer's picker shows them, such as 0005/01."""
    failures: int | None = None
    """Maximum number of failures, lowest margin first; 20 if no query is named."""
    where: str = ""
    """Filter of the queries, such as 'district = "Dock 3" and rank > 10'; with --failures the worst of them."""
    matches: int = 5
    """Number of listed tiles for each query."""
    profile: bool = False
    """Also rotate each query by the full circle: 24 more forward passes each."""
    step: float = 15.0
    """Degrees between two of these rotations."""
    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first."""
    weights: str | None = None
    """Weight of each part, such as 1,1,0,1; equal by default."""
    notes: Path | None = None
    """File of tags and notes; by default notes.csv in the data set's folder."""

    def run(self) -> None:
        from rich.console import Console
        from rich.progress import Progress

        from lpn import report
        from lpn.analysis.notes import read_notes
        from lpn.analysis.task import calibrated, choose_task, open_task
        from lpn.cli.explain import part_values
        from lpn.core.files import check_writable, write_atomic
        from lpn.core.views import views_of
        from lpn.datasets import open_dataset
        from lpn.descriptors.transforms import Change

        if self.query and (self.failures is not None or self.where):
            raise InputError("Queries are named, and --failures or --where chooses others; leave one of them out.")
        if self.failures is not None and self.failures < 1:
            raise InputError(f"The number of failures is {self.failures}; expected 1 or more.")
        options = report.Options(self.matches, self.profile, self.step, Change(rotate=self.rotate))
        check_writable(self.out)
        model, dataset = lpn.load(self.model, kind=self.kind), open_dataset(self.data)
        name = choose_task(model, dataset, self.task)
        # Before pictures are described, which may take long.
        named = _named(self.query, dataset.queries(views_of(name)[0]), dataset.root.name)
        task = open_task(
            model,
            self.model.name,
            dataset,
            name,
            part_values(self.weights),
            read_notes(self.notes) if self.notes else None,
            calibrated(model, dataset) if self.calibrate else None,
        )
        chosen, selection = (named, "chosen by name") if named else self._chosen(task)
        options = report.Options(self.matches, self.profile, self.step, Change(rotate=self.rotate), selection=selection)
        console = Console()
        with Progress(console=console, transient=True) as bar:
            shown = bar.add_task("Reporting", total=None)
            page = report.build(task, chosen, options, lambda done, of: bar.update(shown, completed=done, total=of))
        write_atomic(self.out, page)
        count = f"{len(chosen)} {'query' if len(chosen) == 1 else 'queries'}"
        console.print(f"{self.out}: {count}, {len(page) / 1e6:.1f} MB", highlight=False, markup=False, soft_wrap=True)

    def _chosen(self, task: Task) -> tuple[list[int], str]:
        """Positions of the queries that --failures and --where choose, the worst first, and how they were chosen."""
        from lpn.report.page import MOST

        table = task.table
        rows = table.sort(table.filter(table.rows(), self.where), "margin")
        among = f" of those with {self.where}" if self.where else ""
        if self.where and self.failures is None:
            if not len(rows):
                raise InputError(f"No query is one with {self.where}; change --where.")
            if len(rows) > MOST:
                raise InputError(
                    f"{len(rows)} queries are ones with {self.where}; a report holds {MOST}, so narrow it, or take the worst "
                    "with --failures 20."
                )
            return rows.tolist(), f"all with {self.where}, lowest margin first"
        failed = rows[task.outcomes.failed[rows]]
        if not len(failed):
            raise InputError(f"No query failed{among}; choose some with --query or --where.")
        worst = failed[: 20 if self.failures is None else self.failures]
        if len(worst) > MOST:
            raise InputError(f"{len(worst)} failures are wanted; a report holds {MOST}, so ask for fewer.")
        return worst.tolist(), f"the worst of {len(failed):,} failures{among}, lowest margin first"


def _named(names: Sequence[str], queries: Sequence[Picture], data: str) -> list[int]:
    """Return the positions of queries by their names, each once."""
    places = {entry.name: place for place, entry in reversed(list(enumerate(queries)))}
    for name in names:
        if name not in places:
            near = get_close_matches(name, places, 3, 0.5) or [queries[0].name]
            raise InputError(
                f"{printable(data)} has no query {printable(name)}; did you mean {' or '.join(map(printable, near))}?"
            )
    return [places[name] for name in dict.fromkeys(names)]
