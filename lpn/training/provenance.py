"""Where a model or a figure comes from: command, version, machine, and date."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import msgspec
import torch

import lpn


class Provenance(msgspec.Struct, frozen=True, omit_defaults=True):
    """Where a model or a figure comes from.

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


@cache
def here() -> Provenance:
    """Return the provenance of what this process makes."""
    program = Path(sys.argv[0]).name
    # `python -m lpn` runs a file of another name.
    arguments = ["lpn" if program == "__main__.py" else program, *map(_without_folders, sys.argv[1:])]
    return Provenance(shlex.join(arguments), _version(), _machine(), time.strftime("%Y-%m-%d"))


def _without_folders(argument: str) -> str:
    """Shorten an absolute path to its name, also after "=", so that a page does not show a machine's folders."""
    before, equals, value = argument.rpartition("=")
    return before + equals + Path(value).name if Path(value).is_absolute() else argument


def _machine() -> str:
    """Describe processors and accelerator, such as "AMD EPYC 7763, 2 cores" or the same with a GPU's name."""
    name, info = "CPU", Path("/proc/cpuinfo")
    if info.is_file():
        name = next(
            (line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line), name
        )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{name}, {cores} cores{gpu}"


def _version() -> str:
    """Return the version, and the commit of the checkout that the package lies in."""
    root = Path(lpn.__file__).parents[1]
    if not (root / ".git").exists():
        return lpn.__version__
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return lpn.__version__
    return f"{lpn.__version__}, commit {done.stdout.strip()}"
