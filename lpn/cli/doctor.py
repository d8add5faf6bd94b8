"""The command that checks a machine or a data set: doctor."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lpn.core.demo import DEMO
from lpn.core.errors import InputError

if TYPE_CHECKING:
    pass


@dataclass
class DoctorCommand:
    """Say what this machine lacks, or, of a data set, what it holds and what is broken; ends with status 1 at damage."""

    data: Path | None = None
    """Data set in any layout of docs/data.md; without it, machine, packages, and demo are looked at."""
    quick: bool = False
    """Read the headers and ends of the pictures only, and do not decode them."""
    json: Path | None = None
    """File to write everything found to, with every name."""

    def run(self) -> int:
        from lpn.core.files import check_writable, write_atomic

        if self.json is not None:
            check_writable(self.json)
        if self.data is None:
            return self._machine()  # which needs no package

        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from lpn.datasets import open_dataset
        from lpn.doctor.dataset_check import examine, show

        console = Console(width=max(120, Console().width))
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("Reading pictures", total=None)
            dataset = open_dataset(self.data)
            report = examine(dataset, not self.quick, lambda done, of: bar.update(task, completed=done, total=of))
        show(report, console)
        if self.json is not None:
            write_atomic(self.json, (json.dumps(report.to_dict(), indent=1) + "\n").encode())
        return 0 if report.healthy else 1

    def _machine(self) -> int:
        from lpn.core.files import write_atomic
        from lpn.doctor import environment_check

        if self.quick:
            raise InputError("--quick is about the pictures of a data set; give one with --data.")
        findings = []
        for finding in environment_check.look(DEMO):
            findings.append(finding)
            print(finding.line, flush=True)
        healthy = environment_check.healthy(findings)
        print("Nothing that is needed is broken." if healthy else "Something is broken: see the problems above.")
        if self.json is not None:
            write_atomic(self.json, (json.dumps(environment_check.to_dict(findings), indent=1) + "\n").encode())
        return 0 if healthy else 1
