"""The trainings of a reproduction: each in its own folder, resumable, with an estimate of the time left.

Several processes may work on the same trainings: each takes one that no other process has, and at the end waits for theirs.
"""

from __future__ import annotations

import copy
import csv
import json
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, cast

import msgspec

from lpn.core.consoles import Console
from lpn.core.errors import DivergedError, InputError, OutputError
from lpn.core.files import exclusive_lock, fingerprint, write_json
from lpn.core.formats import decode_json
from lpn.reproduce.record import Provenance, here
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Training
from lpn.training.loader import steps_per_epoch
from lpn.training.recipe import Recipe
from lpn.training.trainer import Trainer
from lpn.training.training_set import Fold

FORMAT = "lpn-job/2"
# Estimated time of a training step per pixel of its pictures relative to ResNet-18, for the time left.
_COSTS = {"resnet18": 1.0, "resnet50": 2.3, "vgg16": 8.5, "vgg16_bn": 8.5}
_UNKNOWN_COST = 1.0
# Seconds between two looks at trainings that other processes have.
_POLL = 5.0


class _JobFile(msgspec.Struct):
    ended: Literal["finished", "diverged"] | None
    identity: dict[str, Any]
    made: Provenance
    format: str = FORMAT


@dataclass(frozen=True)
class TrainingJob:
    """One training with one seed.

    Attributes:
        folder: of the run.
        source: the training data.
        start: pretrained weights of its backbone, None for random ones.
        fold: a fold of the training places that is held out, and measured by `tools.crossval`.
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
        """Name such as "lpn, seed 0", or that of a trial's folder."""
        return self.folder.name if self.fold else f"{self.training.name}, seed {self.seed}"

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
    def made(self) -> Provenance | None:
        """Where the training was begun; None before."""
        file = self._file()
        return file.made if file is not None else None

    @property
    def model(self) -> Path:
        """Path of the trained network."""
        return self.folder / "last.safetensors"

    @property
    def work(self) -> float:
        """Relative cost of an epoch."""
        height, width = self.recipe.input_size
        pictures = self.steps * self.recipe.batch * len(self.source.places(self.recipe.sets).files)
        return pictures * height * width * _COSTS.get(self.recipe.backbone, _UNKNOWN_COST) / 1e6

    @property
    def steps(self) -> int:
        """Updates of an epoch."""
        places = copy.copy(self.source.places(self.recipe.sets))
        places.hold_out(self.fold or 0.0, self.recipe.seed)
        return steps_per_epoch(places, self.recipe)

    def seconds(self) -> list[float]:
        """Seconds of each epoch on disk."""
        return [float(row["seconds"]) for row in self._log()]

    def epoch_seconds(self) -> float:
        """Estimate the seconds of one epoch by timing its second step."""
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(
                self.source.dataset,
                Path(folder),
                self.recipe,
                console=Console(quiet=True),
                test=False,
                from_scratch=True,
            )
            trainer.network.train()
            with closing(cast(Any, trainer.loader.stream(0, 1))) as stream:
                # The first step of a process is slower.
                for number, batch in enumerate(islice(stream, 2)):
                    started = time.perf_counter()
                    loss, _ = trainer.learner.step(batch, number, trainer.steps)
                    # Reading the loss waits for a GPU.
                    float(loss)
            return (time.perf_counter() - started) * trainer.steps

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

    def write(self, ended: Literal["finished", "diverged"] | None) -> None:
        """Write job.json: what is trained in the folder, and how it ended, if it has."""
        file = _JobFile(ended, self.identity(), self.made or here())
        write_json(self.folder / "job.json", msgspec.to_builtins(file), ensure_ascii=False)

    def train(self, console: Console) -> None:
        """Train to the last epoch, from the last whole one on disk; a training that diverges is given up.

        Raises:
            LPNError: as `lpn.training.trainer.Trainer`, except for a divergence.
        """
        resume = (self.folder / "state.pt").is_file()
        if not resume:
            # The run was killed before its first epoch was on disk. The folder stays, as its lock is held.
            for path in self.folder.iterdir():
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()
        self.write(None)
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
        self.write(ended)

    def _log(self) -> list[dict[str, str]]:
        if not (self.folder / "log.csv").is_file():
            return []
        with (self.folder / "log.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    def _file(self) -> _JobFile | None:
        path = self.folder / "job.json"
        try:
            return decode_json(path.read_bytes(), _JobFile, path, FORMAT, InputError)
        except (OSError, ValueError, RecursionError):
            return None


def train(work: Sequence[TrainingJob], console: Console) -> None:
    """Train what is not trained yet, one after the other, and wait for what other processes train.

    Raises:
        LPNError: as `lpn.training.trainer.Trainer`, except for a divergence.
    """
    announced = False
    while left := [job for job in work if not job.done and not job.diverged]:
        if any(_train_alone(job, work, console) for job in left):
            continue
        if not announced:
            console.print(f"Waiting for another process, which trains {', '.join(job.name for job in left)}.")
            announced = True
        time.sleep(_POLL)


def _train_alone(job: TrainingJob, work: Sequence[TrainingJob], console: Console) -> bool:
    """Train unless another process does, and return whether it was free."""
    job.folder.mkdir(parents=True, exist_ok=True)
    with suppress(_TakenError):
        with _own(job.folder):
            if not job.done and not job.diverged:
                left = [other for other in work if not other.done and not other.diverged]
                place = len(work) - len(left) + 1
                console.rule(f"{job.name} ({place} of {len(work)} trainings; {said_left(left, work)})")
                job.train(console)
        return True
    return False


class _TakenError(Exception):
    """Another process has the training."""


@contextmanager
def _own(folder: Path) -> Iterator[None]:
    """Lock a training's folder; _TakenError if another process has it."""
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(folder, wait=False))
        except OutputError as error:
            raise _TakenError from error
        yield


def seconds_left(left: Sequence[TrainingJob], known: Sequence[TrainingJob]) -> float:
    """Estimate the remaining seconds from the median speed of the epochs on disk, or from a step of the first training."""
    timed = [(job.work, seconds) for job in known if (seconds := job.seconds())]
    speeds = [work / seconds for work, of_job in timed for seconds in of_job]
    speed = statistics.median(speeds) if speeds else left[0].work / left[0].epoch_seconds()
    return sum(job.work * (job.recipe.epochs - len(job.seconds())) for job in left) / speed


def said_left(left: Sequence[TrainingJob], known: Sequence[TrainingJob]) -> str:
    """Say about how much time one process needs for the trainings that are left."""
    seconds = seconds_left(left, known)
    return f"about {seconds / 3600:.1f} h left" if seconds > 5400 else f"about {max(seconds / 60, 1):.0f} min left"
