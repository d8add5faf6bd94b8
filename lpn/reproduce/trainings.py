"""The trainings of a reproduction: each in its own folder, resumable, with an estimate of the time left."""

from __future__ import annotations

import csv
import json
import shutil
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
from rich.console import Console

from lpn.core.errors import DivergedError, InputError
from lpn.core.files import fingerprint, write_atomic
from lpn.core.formats import decode_json
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Training
from lpn.training.recipes import Recipe
from lpn.training.trainer import Trainer

FORMAT = "lpn-job/1"
# Estimated time of a training step per pixel relative to ResNet-18, for the time left.
_COSTS = {"resnet18": 1.0, "resnet50": 2.3, "vgg16": 8.5, "vgg16_bn": 8.5}


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
    """

    training: Training
    seed: int
    recipe: Recipe
    folder: Path
    source: Source
    start: Path | None

    @property
    def name(self) -> str:
        """Name such as "lpn, seed 0"."""
        return f"{self.training.name}, seed {self.seed}"

    @property
    def done(self) -> bool:
        """True if the training is finished."""
        file = self._file()
        return file is not None and file.ended == "finished"

    @property
    def diverged(self) -> bool:
        """True if the training was given up."""
        file = self._file()
        return file is not None and file.ended == "diverged"

    @property
    def model(self) -> Path:
        """Path of the trained network."""
        return self.folder / "last.safetensors"

    @property
    def work(self) -> float:
        """Relative cost of an epoch on the same pictures."""
        height, width = self.recipe.input_size
        return height * width * _COSTS[self.recipe.backbone] / 1e6

    def seconds(self) -> list[float]:
        """Seconds of each epoch on disk."""
        if not (self.folder / "log.csv").is_file():
            return []
        with (self.folder / "log.csv").open(encoding="utf-8", newline="") as file:
            return [float(row["seconds"]) for row in csv.DictReader(file)]

    def identity(self) -> dict[str, Any]:
        """Everything that decides the result of the training."""
        return {
            **json.loads(self.recipe.to_json()),
            "pictures": self.source.training_digest(self.recipe.google),
            "start": fingerprint(self.start) if self.start else None,
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
        # A setting of a later version is not in the file, and had its default then.
        differs = [
            key for key, value in self.identity().items() if key in file.identity and file.identity[key] != value
        ]
        if differs:
            raise InputError(
                f"{self.folder} was trained with another {', '.join(differs)}; give the same data and settings, or another "
                "--out."
            )

    def write(self, ended: Literal["finished", "diverged"] | None) -> None:
        """Write job.json: what is trained in the folder, and how it ended, if it has."""
        values = {"format": FORMAT, "ended": ended, "identity": self.identity()}
        write_atomic(self.folder / "job.json", (json.dumps(values, indent=1) + "\n").encode())

    def _file(self) -> _JobFile | None:
        path = self.folder / "job.json"
        try:
            return decode_json(path.read_bytes(), _JobFile, path, FORMAT, InputError)
        except (OSError, ValueError, RecursionError):
            return None


def train(work: Sequence[TrainingJob], console: Console) -> None:
    """Train what is not trained yet, one after the other; a training that diverges is given up.

    Raises:
        LPNError: as `lpn.training.trainer.Trainer`, except for a divergence.
    """
    left = [job for job in work if not job.done and not job.diverged]
    for position, job in enumerate(left):
        console.rule(f"{job.name} ({position + 1} of {len(left)} trainings; {_said_left(left[position:], work)})")
        resume = (job.folder / "state.pt").is_file()
        if not resume:
            # The run was killed before its first epoch was on disk.
            shutil.rmtree(job.folder, ignore_errors=True)
        job.write(None)
        ended: Literal["finished", "diverged"] = "finished"
        try:
            Trainer(
                job.source.dataset,
                job.folder,
                job.recipe,
                job.start,
                resume=resume,
                console=console,
                test=False,
                from_scratch=job.start is None,
            ).run()
        except DivergedError as error:
            ended = "diverged"
            console.print(f"{job.name} is given up. {error}", markup=False)
        job.write(ended)


def seconds_left(left: Sequence[TrainingJob], known: Sequence[TrainingJob]) -> float | None:
    """Estimate the remaining seconds from the median speed of the epochs on disk; None if there are none."""
    speeds = [job.work / seconds for job in known for seconds in job.seconds()]
    if not speeds:
        return None
    return sum(job.work * (job.recipe.epochs - len(job.seconds())) for job in left) / statistics.median(speeds)


def _said_left(left: Sequence[TrainingJob], known: Sequence[TrainingJob]) -> str:
    seconds = seconds_left(left, known)
    if seconds is None:
        return "time left not known yet"
    return f"about {seconds / 3600:.1f} h left" if seconds > 5400 else f"about {max(seconds / 60, 1):.0f} min left"
