"""The trainings of a reproduction, each in its own folder and resumable.

Several processes may share the trainings: each takes a free one, and finally waits for the other processes.
"""

from __future__ import annotations

import copy
import json
import shutil
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from lpn.core.consoles import Console
from lpn.core.errors import DivergedError, InputError, OutputError
from lpn.core.files import exclusive_lock, fingerprint, write_json
from lpn.core.formats import decode_json
from lpn.models import checkpoints
from lpn.models.shipped import model_file
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Training
from lpn.training.loader import Loader
from lpn.training.recipe import Recipe
from lpn.training.trainer import Trainer
from lpn.training.training_set import Fold

FORMAT = "lpn-job/3"
# Seconds between two looks at trainings of other processes.
_POLL = 5.0


class _JobFile(msgspec.Struct):
    ended: Literal["finished", "diverged"] | None
    identity: dict[str, Any]
    format: str = FORMAT


@dataclass(frozen=True)
class TrainingJob:
    """One training with one seed.

    Attributes:
        folder: of the run.
        source: the training data.
        start: pretrained weights of its backbone, None for random ones.
        fold: the held-out fold of the training places, which `tools.crossval` measures.
    """

    training: Training
    seed: int
    recipe: Recipe
    folder: Path
    source: Source
    start: Path | None
    fold: Fold | None = None

    @property
    def name(self) -> str:
        """Name such as "lpn, seed 0"; with a fold, the name of the folder."""
        return self.folder.name if self.fold else f"{self.training.name}, seed {self.seed}"

    @property
    def ended(self) -> Literal["finished", "diverged"] | None:
        """The end of the training; None before. Another process may change it."""
        file = self._file()
        return file.ended if file is not None else None

    @property
    def done(self) -> bool:
        """True if the training is finished."""
        return self.ended == "finished"

    @property
    def model(self) -> Path:
        """Path of the trained network."""
        return self.folder / "last.safetensors"

    @property
    def epochs_done(self) -> int:
        """The number of epochs on disk."""
        log = self.folder / "log.csv"
        return len(log.read_text("utf-8").splitlines()[1:]) if log.is_file() else 0

    @cached_property
    def steps(self) -> int:
        """Updates of an epoch; LPNError if the training cannot run on its pictures."""
        places = copy.copy(self.source.places(self.recipe.sets))
        places.hold_out(self.fold or 0.0, self.recipe.seed)
        try:
            return Loader(places, self.recipe, torch.device("cpu"), 1).steps
        except InputError as error:
            raise InputError(f"{self.training.name} cannot be trained on {self.source.name}. {error}") from None

    def identity(self) -> dict[str, Any]:
        """Everything that decides the result of the training."""
        return {
            **json.loads(self.recipe.to_json()),
            "pictures": self.source.training_digest(self.recipe.sets),
            "start": fingerprint(self.start) if self.start else None,
            "fold": list(self.fold) if self.fold else None,
        }

    def check_same(self) -> None:
        """Check that the run on disk, if there is any, is this training; InputError if not."""
        if not any((self.folder / name).is_file() for name in ("job.json", "state.pt")):
            return
        file = self._file()
        if file is None:
            raise InputError(
                f"{self.folder} does not say what is trained there; delete it to train again, or give another --out."
            )
        identity = self.identity()
        differs = [key for key in {**identity, **file.identity} if file.identity.get(key) != identity.get(key)]
        if differs:
            raise InputError(
                f"{self.folder} was trained with other values of {', '.join(differs)}; give the same data and settings, or "
                "another --out."
            )

    def train(self, console: Console) -> None:
        """Train to the last epoch, from the last whole one on disk; a diverging training is given up.

        Raises:
            LPNError: as `lpn.training.trainer.Trainer`, except for a divergence.
        """
        resume = (self.folder / "state.pt").is_file()
        if not resume:
            # The run was killed before its first epoch was on disk. The folder stays, as its lock is held.
            for path in self.folder.iterdir():
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()
        self._write(None)
        ended: Literal["finished", "diverged"] = "finished"
        try:
            Trainer(
                self.source.dataset,
                self.folder,
                self.recipe,
                self.start,
                resume,
                console=console,
                validate=self.fold or 0.0,
                test=False,
                from_scratch=self.start is None,
            ).run()
        except DivergedError as error:
            ended = "diverged"
            console.print(f"{self.name} is given up. {error}", markup=False)
        self._write(ended)

    def _write(self, ended: Literal["finished", "diverged"] | None) -> None:
        file = msgspec.to_builtins(_JobFile(ended, self.identity()))
        write_json(self.folder / "job.json", file, ensure_ascii=False)

    def _file(self) -> _JobFile | None:
        path = self.folder / "job.json"
        try:
            return decode_json(path.read_bytes(), _JobFile, path, FORMAT, InputError)
        except (OSError, ValueError, RecursionError):
            return None


def train(jobs: Sequence[TrainingJob], console: Console) -> None:
    """Run the missing trainings one by one, and wait for those of other processes.

    Raises:
        LPNError: as `lpn.training.trainer.Trainer`, except for a divergence.
    """
    announced = False
    while left := [job for job in jobs if not job.ended]:
        if any(_train_alone(job, jobs, console) for job in left):
            continue
        if not announced:
            console.print(f"Waiting for another process, which trains {', '.join(job.name for job in left)}.")
            announced = True
        time.sleep(_POLL)


def _train_alone(job: TrainingJob, jobs: Sequence[TrainingJob], console: Console) -> bool:
    """Train unless another process does; return whether the job was free."""
    job.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(job.folder, wait=False))
        except OutputError:
            return False
        if not job.ended:
            ended = sum(bool(other.ended) for other in jobs)
            console.rule(f"{job.name} ({ended + 1} of {len(jobs)} trainings)")
            job.train(console)
    return True


def by_backbone(files: Sequence[Path]) -> dict[str, Path]:
    """Return the files of --init by the names of their backbones.

    Raises:
        ModelFileError: when a file cannot be read or holds no known backbone.
        InputError: when two files hold the same backbone.
    """
    files_of: dict[str, Path] = {}
    for weights in files:
        file = model_file(weights, trained=True)
        name = checkpoints.backbone_in(file)
        if name in files_of:
            raise InputError(f"{files_of[name]} and {file} both hold a {name}; give one of them with --init.")
        files_of[name] = file
    return files_of
