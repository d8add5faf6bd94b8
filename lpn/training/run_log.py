"""What a run's folder says about it: run.json, and log.csv with a row for each epoch."""

from __future__ import annotations

import csv
import io
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from lpn.core.errors import InputError
from lpn.core.files import write_atomic, write_json
from lpn.core.formats import decode_json
from lpn.training.model_selection import EpochMetrics
from lpn.training.provenance import Provenance, here
from lpn.training.recipe import Recipe

FORMAT = "lpn-run/1"


class RunFile(msgspec.Struct, frozen=True):
    """run.json: how a run was begun.

    Attributes:
        made: command, version with commit, machine, and date.
        packages: versions of Python and of what decides the numbers.
        recipe: every setting of the training.
        given: the other options of `lpn train`, which a bare `--resume` takes.
    """

    made: Provenance
    packages: dict[str, str]
    recipe: dict[str, Any]
    given: dict[str, Any] = {}
    format: str = FORMAT

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
        return decode_json(path.read_bytes(), RunFile, path, FORMAT, InputError)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged; start the run again without --resume, in another --out.") from error


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
