"""The record of a measured table: everything that its page needs, and where each figure comes from."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import msgspec
import torch

import lpn
from lpn.analysis.statistics import half_interval
from lpn.reproduce.paper_values import PrintedValues, Values


class Provenance(msgspec.Struct, frozen=True, omit_defaults=True):
    """Where a figure comes from.

    Attributes:
        command: the command line.
        version: of lpn, with the commit where the package lies in a checkout.
        machine: kind of processors and accelerator.
        date: year, month, and day.
    """

    command: str
    version: str
    machine: str
    date: str


class RowRecord(msgspec.Struct, frozen=True, omit_defaults=True):
    """A row of a measured table.

    Attributes:
        label: the name by which claims refer to the row.
        mean: for each column; empty if the row was not run.
        paper: the paper's values, empty if it has no such row.
        note: printed after the label.
        quoted: the paper quotes the row from other work, and nothing is measured.
        networks: number of networks that were measured.
        values: for each network, "seed 0" or "given", its value in each column.
        trained, measured: for each network, where it and its figures come from.
        reason: why the row was not run; empty if it was.
    """

    label: str
    mean: Values = ()
    paper: PrintedValues = ()
    note: str = ""
    quoted: bool = False
    networks: int = 1
    values: dict[str, Values] = {}
    trained: dict[str, Provenance] = {}
    measured: dict[str, Provenance] = {}
    reason: str = ""

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
        alone: titles of the paper's columns that no measured column stands beside, by index.
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
        return next((row for row in self.rows if row.label == label and row.mean), None)


def row_record(
    label: str,
    values: Mapping[str, Values],
    paper: PrintedValues = (),
    note: str = "",
    trained: Mapping[str, Provenance] | None = None,
    measured: Mapping[str, Provenance] | None = None,
    quoted: bool = False,
    reason: str = "",
) -> RowRecord:
    """Make the record of a row from the values of its networks."""
    columns: list[Sequence[float]] = list(zip(*values.values(), strict=True))
    return RowRecord(
        label,
        tuple(sum(column) / len(column) for column in columns),
        paper,
        note,
        quoted,
        len(values),
        dict(values),
        dict(trained or {}),
        dict(measured or {}),
        reason,
    )


@cache
def here() -> Provenance:
    """Return the provenance of figures that this process measures."""
    program = Path(sys.argv[0]).name
    # `python -m lpn` runs a file of another name.
    arguments = ["lpn" if program == "__main__.py" else program, *map(_without_folders, sys.argv[1:])]
    return Provenance(shlex.join(arguments), _version(), machine(), time.strftime("%Y-%m-%d"))


def _without_folders(argument: str) -> str:
    """Shorten an absolute path to its name, also after "=", so that a page does not show a machine's folders."""
    before, equals, value = argument.rpartition("=")
    return before + equals + Path(value).name if Path(value).is_absolute() else argument


def machine() -> str:
    """Describe processors and accelerator, such as "AMD EPYC 7763, 2 cores" or the same with a GPU's name."""
    name, info = "CPU", Path("/proc/cpuinfo")
    if info.is_file():
        models = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        name = models[0] if models else name
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{name}, {cores} cores{gpu}"


def _version() -> str:
    """Return the version, and the commit of the checkout that the package lies in."""
    root = Path(lpn.__file__).parents[1]
    if not (root / ".git").exists():
        return lpn.__version__
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return lpn.__version__
    return f"{lpn.__version__}, commit {done.stdout.strip()}"
