"""The file `state.pt` of a run, and the checks before a run is resumed from it."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lpn.core.checksums import check_entries
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import write_atomic
from lpn.core.formats import newer_version
from lpn.training.model_selection import EpochMetrics
from lpn.training.recipe import Recipe

FORMAT = 5


@dataclass(frozen=True)
class ResumeState:
    """A training after a whole epoch.

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
        values = {
            "format": FORMAT,
            "recipe": recipe.to_json(),
            "places": places,
            "history": json.dumps(self.history),
            "first_loss": self.first_loss,
            **self.tensors,
        }
        data = io.BytesIO()
        torch.save(values, data)
        write_atomic(path, data.getvalue())


def read_state(path: Path, recipe: Recipe, places: str) -> ResumeState:
    """Read the state of the same training.

    Raises:
        InputError: when there is none, or it has another recipe or other training pictures.
        ModelFileError: when it is damaged, or another version of lpn wrote it.
    """
    if not path.is_file():
        raise InputError(f"There is no {path.name} in {path.parent} to resume from; start without --resume.")
    anew = "start the run again without --resume, in another --out"
    check_entries(path, anew)
    try:
        values: Any = torch.load(path, map_location="cpu", weights_only=True)
        version = values.get("format")
        if isinstance(version, int) and version > FORMAT:
            raise ModelFileError(newer_version(path, str(version), str(FORMAT)))
        if version != FORMAT:
            raise ModelFileError(f"{path} has the format {version}; expected {FORMAT}, so start anew in another --out.")
        saved: dict[str, Any] = dict(json.loads(values["recipe"]))
        history, digest = json.loads(values["history"]), values["places"]
        tensors = {name: values[name] for name in ("network", "average", "optimizer", "scaler")}
        state = ResumeState(history, float(values["first_loss"]), tensors)
    except ModelFileError:
        raise
    except Exception as error:  # the unpickler raises any exception on unknown data
        raise ModelFileError(f"{path} is damaged; {anew}.") from error
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
