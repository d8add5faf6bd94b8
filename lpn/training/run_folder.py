"""The files of a run's folder beside its models: run.json, log.csv, and state.pt, the basis of a resumed run."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

import lpn
from lpn.core.checksums import check_entries
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import write_atomic, write_json
from lpn.core.formats import UPGRADE, decode_json
from lpn.training.model_selection import EpochMetrics
from lpn.training.recipe import Recipe

RUN_FORMAT = "lpn-run/1"
STATE_FORMAT = 5
_ANEW = "start the run again without --resume, in another --out"


class Provenance(msgspec.Struct, frozen=True, omit_defaults=True):
    """The origin of a model or a figure.

    Attributes:
        command: the command line.
        version: of lpn, with the commit if the package lies in a checkout.
        machine: kind of processors and accelerator.
        date: year, month, and day.
    """

    command: str
    version: str
    machine: str
    date: str


@cache
def here() -> Provenance:
    """Return the provenance of results of this process."""
    program = Path(sys.argv[0]).name
    # `python -m lpn` runs a file of another name.
    arguments = ["lpn" if program == "__main__.py" else program, *map(_without_folders, sys.argv[1:])]
    return Provenance(shlex.join(arguments), _version(), _machine(), time.strftime("%Y-%m-%d"))


def _without_folders(argument: str) -> str:
    """Shorten an absolute path to its name, also after "=", so that a page does not show a machine's folders."""
    before, equals, value = argument.rpartition("=")
    return before + equals + Path(value).name if Path(value).is_absolute() else argument


def _machine() -> str:
    """Describe processors and accelerator, such as "AMD EPYC 7763, 2 cores", with a GPU's name if there is one."""
    name, info = "CPU", Path("/proc/cpuinfo")
    if info.is_file():
        name = next(
            (line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line), name
        )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{name}, {cores} cores{gpu}"


def _version() -> str:
    """Return the version, with the commit of the package's checkout, if any."""
    root = Path(lpn.__file__).parents[1]
    if not (root / ".git").exists():
        return lpn.__version__
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return lpn.__version__
    return f"{lpn.__version__}, commit {done.stdout.strip()}"


class RunFile(msgspec.Struct, frozen=True):
    """run.json: the start of a run.

    Attributes:
        made: command, version with commit, machine, and date.
        packages: versions of Python and of the packages that affect the numbers.
        recipe: every setting of the training.
        given: the other options of `lpn train`, which a bare `--resume` reuses.
    """

    made: Provenance
    packages: dict[str, str]
    recipe: dict[str, Any]
    given: dict[str, Any] = {}
    format: str = RUN_FORMAT

    def metadata(self) -> str:
        """Return the provenance as JSON for a model's file, without the paths of this machine."""
        return json.dumps({**msgspec.to_builtins(self.made), "packages": self.packages}, ensure_ascii=False)


def begin(out: Path, recipe: Recipe, given: Mapping[str, Any]) -> RunFile:
    """Write run.json into a run's folder and return it."""
    packages = {"python": platform.python_version(), "torch": str(torch.__version__), "numpy": np.__version__}
    file = RunFile(here(), packages, json.loads(recipe.to_json()), dict(given))
    write_json(out / "run.json", msgspec.to_builtins(file), ensure_ascii=False)
    return file


def read_run(out: Path) -> RunFile | None:
    """Read run.json of a run's folder; None without one.

    Raises:
        InputError: if it is damaged, or a later version of lpn wrote it.
    """
    path = out / "run.json"
    try:
        return decode_json(path.read_bytes(), RunFile, path, RUN_FORMAT, InputError)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged; {_ANEW}.") from error


def save_log(out: Path, history: Sequence[EpochMetrics]) -> None:
    """Write log.csv from the rows of all epochs, so that a resumed run neither repeats nor loses one."""
    log = io.StringIO()
    writer = csv.DictWriter(log, list(dict.fromkeys(key for row in history for key in row)))
    writer.writeheader()
    writer.writerows(history)
    write_atomic(out / "log.csv", log.getvalue().encode())


def epoch_line(history: Sequence[EpochMetrics], epochs: int) -> str:
    """Return one line about the last epoch."""
    row = history[-1]
    tested = [f"  {key.replace('recall@1', 'R@1')} {row[key]:.2f}" for key in row if key.startswith("recall@1")]
    terms = [f"  {key.removeprefix('loss ')} {row[key]:.3f}" for key in row if key.startswith("loss ")]
    return (
        f"Epoch {len(history)}/{epochs}  loss {row['loss']:.3f}{''.join(terms) if len(terms) > 1 else ''}  "
        f"rate {row['lr']:.1e}  {row['images_per_second']:.1f} images/s{''.join(tested)}"
    )


@dataclass(frozen=True)
class ResumeState:
    """The state of a training after a whole epoch.

    Attributes:
        history: the metrics of each epoch.
        first_loss: loss of the very first step, the reference for divergence.
        tensors: state dicts of network, average, optimizer, and scaler.
    """

    history: list[EpochMetrics]
    first_loss: float
    tensors: dict[str, Any]

    def write(self, path: Path, recipe: Recipe, places: str) -> None:
        """Write the file atomically; `places` is the digest of the training pictures."""
        said = {"format": STATE_FORMAT, "recipe": recipe.to_json(), "places": places, "first_loss": self.first_loss}
        data = io.BytesIO()
        torch.save({**said, "history": json.dumps(self.history), **self.tensors}, data)
        write_atomic(path, data.getvalue())


def read_state(path: Path, recipe: Recipe, places: str) -> ResumeState:
    """Read the state of this training.

    Raises:
        InputError: when there is none, or it has another recipe or other training pictures.
        ModelFileError: when it is damaged, or another version of lpn wrote it.
    """
    if not path.is_file():
        raise InputError(f"There is no {path.name} in {path.parent} to resume from; start without --resume.")
    check_entries(path, _ANEW)
    try:
        values: Any = torch.load(path, map_location="cpu", weights_only=True)
        if (version := values.get("format")) != STATE_FORMAT:
            later = f"{UPGRADE}, or " if isinstance(version, int) and version > STATE_FORMAT else ""
            raise ModelFileError(
                f"{path} has the format {version}, and this version of lpn knows {STATE_FORMAT}; {later}{_ANEW}."
            )
        saved: dict[str, Any] = dict(json.loads(values["recipe"]))
        history, digest = json.loads(values["history"]), values["places"]
        tensors = {name: values[name] for name in ("network", "average", "optimizer", "scaler")}
        state = ResumeState(history, float(values["first_loss"]), tensors)
    except ModelFileError:
        raise
    except Exception as error:  # the unpickler raises any exception on unknown data
        raise ModelFileError(f"{path} is damaged; {_ANEW}.") from error
    settings = json.loads(recipe.to_json())
    differs = [name for name in {**settings, **saved} if saved.get(name) != settings.get(name)]
    if differs:
        raise InputError(
            f"The run in {path.parent} was started with another {', '.join(differs)}; resume it with the same values."
        )
    if digest != places:
        raise InputError(
            f"The run in {path.parent} was started with other training pictures; give the same --data or --map, "
            "--window-sizes, and --validate, or start anew in another --out."
        )
    return state
