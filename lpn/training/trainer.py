"""Training of an LPN (section III-C of the paper) by a recipe, resumable to the same losses."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from lpn.core.errors import DivergedError, InputError, ModelFileError
from lpn.core.files import check_writable
from lpn.core.shutdown import uninterrupted
from lpn.core.views import views_of
from lpn.datasets import Dataset
from lpn.models import checkpoints
from lpn.models.backbones import CHANNELS
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from lpn.training.learner import Learner
from lpn.training.loader import Loader, TrainingBatch
from lpn.training.model_selection import HeldOut, Judge, Row, TestSplit, best
from lpn.training.multi_process import ProcessGroup, alone
from lpn.training.recipes import Recipe
from lpn.training.resume_state import ResumeState, read_state
from lpn.training.run_log import RunLog
from lpn.training.training_set import TrainingSet

_EXPLODED = 10.0
"""A mean loss this many times the first step's, which is about chance, is that of a training that has diverged."""
_SURE_AFTER = 100
"""Steps whose mean is trusted to tell that; an epoch of fewer is judged at its end."""


class Trainer:
    """One training run in a folder, see docs/training.md for its files.

    Args:
        dataset: with pictures to train on.
        out: the run's folder.
        recipe: every number of the training.
        init: weights for the backbone, loaded as far as they go.
        resume: go on from the last whole epoch in `out`, to the same losses as an uninterrupted run.
        evaluate_every: test every so many epochs, and keep the best; 0 for the end only.
        workers: threads that prepare pictures; 0 for what suits the machine. They change no result.
        validate: share of the places that are held out of the training, to choose the best epoch by.
        group: the processes that share the training; this one alone by default.
        test: measure the last model on the test split.

    Raises:
        DataError: when the data set cannot be trained on.
        InputError: when `out` holds another run, or there is nothing to resume.
        ModelFileError: when `init` cannot be used.
        OutputError: when nothing can be written to `out`.
    """

    def __init__(
        self,
        dataset: Dataset,
        out: Path,
        recipe: Recipe,
        init: Path | None = None,
        resume: bool = False,
        evaluate_every: int = 0,
        console: Console | None = None,
        workers: int = 0,
        validate: float = 0.0,
        group: ProcessGroup | None = None,
        test: bool = True,
    ) -> None:
        self.group = group or alone()
        self.console = (console or Console()) if self.group.leads else Console(quiet=True)
        self.dataset, self.out, self.recipe, self.evaluate_every = dataset, out, recipe, evaluate_every
        self.places, self.device = TrainingSet(dataset, self.console, recipe.google), self.group.device
        held = self.places.hold_out(validate, recipe.seed)
        there = [name for name in ("state.pt", "last.safetensors", "log.csv") if (out / name).exists()]
        if resume and there and "state.pt" not in there and _first_epoch_alone(out):
            self.console.print(f"The run in {out} was stopped before its first epoch was whole, so it starts anew.")
            resume = False
            there = []
        if not resume and there:
            raise InputError(
                f"{out} holds {there[0]} of a training run already; add --resume to go on with it, or choose another --out."
            )
        if evaluate_every < 0:
            raise InputError(f"The figures are asked for every {evaluate_every} epochs; expected 0 or more.")
        if held and not evaluate_every:
            raise InputError("Places held out choose among the epochs that are tested; say which by --evaluate-every.")
        share = self.group.share(recipe.batch)
        self.loader = Loader(self.places, recipe, self.device, share, workers, self.group.local_size)
        self.steps = self.loader.steps
        check_writable(out / "last.safetensors")
        torch.manual_seed(recipe.seed)
        network = LPN(_spec(recipe, self.places))
        if init is not None and not resume:
            self._load_init(network, init)
        self.learner = Learner(network, recipe, self.group)
        self.history: list[Row] = []
        self.first_loss = math.nan
        tasks = [task for task in dataset.tasks() if set(views_of(task)) <= set(self.places.views)]
        self.test_split = TestSplit(dataset, tasks) if tasks and (test or evaluate_every) else None
        self.judge: Judge | None = HeldOut(held) if held else self.test_split
        self._places_digest = self.places.digest(dataset.root)
        if resume:
            self._resume()

    @property
    def network(self) -> LPN:
        """The network in training."""
        return self.learner.network

    def run(self) -> Path:
        """Train to the last epoch, test, and return the path of the model.

        Raises:
            InputError: when the training diverges.
            LPNError: when a picture cannot be read, a file not be written, or another process stopped.
        """
        self.learner.share_out()
        self._say_how()
        logbook = RunLog(self.out, self.history, self.console) if self.group.leads else None
        try:
            with self.group.watch():
                self._train(logbook)
        finally:
            if logbook is not None:
                logbook.close()
        return self.out / "last.safetensors"

    def _train(self, logbook: RunLog | None) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(),
        )
        done, epochs = len(self.history), self.recipe.epochs
        stream = self.loader.stream(done, epochs)
        with closing(cast(Any, stream)), Progress(*columns, console=self.console, disable=not self.group.leads) as bar:
            task = bar.add_task("Training", total=epochs * self.steps, completed=done * self.steps, said="")
            # An epoch whose test was interrupted.
            self._choose(logbook)
            for epoch in range(done, epochs):
                bar.update(task, description=f"Epoch {epoch + 1}/{epochs}")
                batches = islice(stream, self.steps)
                self.history.append(self._epoch(epoch, batches, lambda said: bar.update(task, advance=1, said=said)))
                self._save(logbook)
                self._choose(logbook)
                if logbook is not None:
                    logbook.say_epoch(epochs)
        self._finish(logbook)

    def _epoch(self, epoch: int, batches: Iterator[TrainingBatch], report: Callable[[str], object]) -> Row:
        self.network.train()
        # Seeded by epoch, so that a resumed run repeats what an uninterrupted one does; and each process for itself.
        torch.manual_seed(self.recipe.seed * 100_003 + epoch + (self.group.rank << 50))
        started, total, seen, rate = time.perf_counter(), 0.0, 0, 0.0
        before: Tensor | None = None
        for step, batch in enumerate(batches):
            loss, rate = self.learner.step(batch, epoch * self.steps + step, self.steps)
            seen += len(batch.places) * len(batch.sets)
            # A step's loss is read when the next step is under way, so that a GPU need not wait for it.
            if before is not None:
                total += self._checked(float(before), total, epoch, step)
                speed = seen / (time.perf_counter() - started)
                report(f"loss {total / step:.3f}  {speed:.1f} images/s")
            before = loss
        assert before is not None
        total += self._checked(float(before), total, epoch, self.steps)
        report(f"loss {total / self.steps:.3f}")
        if self.group.leads and not self.learner.finite():
            raise self._diverged("A weight is no longer a number", epoch, self.steps)
        seconds = time.perf_counter() - started
        return {
            "epoch": epoch + 1,
            "loss": total / self.steps,
            "lr": rate,
            "seconds": seconds,
            "images_per_second": seen / seconds,
        }

    def _checked(self, loss: float, total: float, epoch: int, step: int) -> float:
        """The loss of the epoch's step number `step`, from 1, after steps whose losses sum to `total`."""
        if not math.isfinite(loss):
            raise self._diverged(f"The loss became {loss}", epoch, step)
        if math.isnan(self.first_loss):
            self.first_loss = loss
        mean, first = (total + loss) / step, self.first_loss
        # A loss near 0 has no tenfold that would mean anything.
        if step >= min(_SURE_AFTER, self.steps) and mean > _EXPLODED * max(first, 1.0):
            raise self._diverged(
                f"The loss rose to {mean:.3g} on average, from {first:.3g} at the first step,", epoch, step
            )
        return loss

    def _diverged(self, found: str, epoch: int, step: int) -> BaseException:
        kept = f"{self.out} keeps the model of epoch {epoch}; " if epoch else ""
        return self.group.said_once(
            DivergedError(
                f"{found} in epoch {epoch + 1}, step {step}; {kept}start again with a smaller --lr in another --out."
            )
        )

    def _choose(self, logbook: RunLog | None) -> None:
        """Where it is due, test the last epoch, and keep it apart if it is the best so far."""
        epoch = len(self.history)
        due = self.evaluate_every and epoch and (epoch % self.evaluate_every == 0 or epoch == self.recipe.epochs)
        judge = self.judge
        if not due or judge is None or judge.column in self.history[-1]:
            return
        path = self.out / "last.safetensors"
        say = {"console": self.console} if judge is self.test_split and epoch == self.recipe.epochs else {}
        row = self.group.led(lambda: judge.measure(checkpoints.load_torch(path, self.device), **say))
        self.history[-1] |= row
        chosen = best(self.history, judge.column)
        if chosen is not None and chosen[0] == epoch and self.group.leads:
            more = {"epoch": str(epoch), "score": f"{chosen[1]:.4f}", "chosen by": judge.said}
            self.learner.save_model(self.out / "best.safetensors", self._metadata() | more)
        self._save(logbook)

    def _finish(self, logbook: RunLog | None) -> None:
        """Test what has not been tested, and say which epoch was the best."""
        split, judge = self.test_split, self.judge
        chosen = best(self.history, judge.column) if judge is not None else None
        if split is not None and split.column not in self.history[-1]:
            last = self.out / "last.safetensors"
            row = self.group.led(lambda: split.measure(checkpoints.load_torch(last, self.device), self.console))
            self.history[-1] |= row
            self._save(logbook)
        self.group.led(lambda: self._conclude(cast(RunLog, logbook), chosen))

    def _conclude(self, logbook: RunLog, chosen: tuple[int, float] | None) -> None:
        """What the terminal shows at the end."""
        split, judge = self.test_split, self.judge
        logbook.say_curves(None if judge is None else judge.column)
        if judge is None or chosen is None or not self.evaluate_every:
            return
        epoch, score = chosen
        self.console.print(
            f"best.safetensors is of epoch {epoch}, chosen by {judge.said}: {score:.2f}.", soft_wrap=True
        )
        if split is not None and judge is not split and epoch < len(self.history):
            self.console.print("Its figures on the test split:")
            split.measure(checkpoints.load_torch(self.out / "best.safetensors", self.device), self.console)

    def _say_how(self) -> None:
        group, norm = self.group, ""
        if group.size > 1:
            batch = self.recipe.batch // group.size
            sees = "all of them" if self.device.type == "cuda" else "its own process's"
            norm = f" {group.size} processes take {batch} places of each batch; BatchNorm sees {sees}."
        self.console.print(
            f"Computing in {self.learner.arithmetic.name} on {self.device.type}; {self.loader.workers} "
            f"{'thread prepares' if self.loader.workers == 1 else 'threads prepare'} pictures.{norm}",
            soft_wrap=True,
        )
        if self.evaluate_every and self.judge is None:
            self.console.print(f"{self.dataset.root.name} has no test split, so no epoch is tested.")

    def _load_init(self, network: LPN, init: Path) -> None:
        filled, total, missing = checkpoints.load_backbone(network, init)
        rest = f"; not or not wholly in it, so as initialised: {', '.join(missing)}" if missing else ""
        self.console.print(f"{init.name} fills {filled} of the backbone's {total} tensors{rest}.")

    def _save(self, logbook: RunLog | None) -> None:
        """Model, logs, and last the state, which is what a resumed run trusts."""
        if logbook is None:
            return
        with uninterrupted():
            self.learner.save_model(self.out / "last.safetensors", self._metadata())
            logbook.save()
            state = ResumeState(self.history, self.first_loss, self.group.size, self.learner.state())
            state.write(self.out / "state.pt", self.recipe, self._places_digest)

    def _metadata(self) -> dict[str, str]:
        return {
            "recipe": self.recipe.to_json(),
            "epochs": str(len(self.history)),
            "data": self.dataset.root.resolve().name,
        }

    def _resume(self) -> None:
        path = self.out / "state.pt"
        state = read_state(path, self.recipe, self._places_digest)
        try:
            self.learner.restore(state.tensors)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ModelFileError(
                f"{path} does not fit its own recipe, so it is damaged; start anew in another --out."
            ) from error
        self.history, self.first_loss = state.history, state.first_loss
        if state.processes != self.group.size:
            self.console.print(
                f"The run had {state.processes} processes and goes on with {self.group.size}, so its losses will differ from "
                "those of an uninterrupted one.",
                soft_wrap=True,
            )
        self.console.print(f"Going on after epoch {len(self.history)} of {self.recipe.epochs}.")


def _first_epoch_alone(out: Path) -> bool:
    """Whether a folder without a state holds no more than the model and log of a first epoch, as a kill may leave them.

    A model of more epochs is somebody's work, which must not be written over.
    """
    rows = (out / "log.csv").read_bytes().count(b"\n") if (out / "log.csv").exists() else 0
    last = out / "last.safetensors"
    epochs = checkpoints.epochs_of(last) if last.exists() else 1
    return rows <= 2 and epochs == 1 and not (out / "best.safetensors").exists()


def _spec(recipe: Recipe, places: TrainingSet) -> ModelSpec:
    spec = ModelSpec(
        backbone=recipe.backbone,
        last_layer=recipe.last_layer,
        views=places.views,
        shared=recipe.shared and "drone" in places.views,
        n_parts=recipe.n_parts,
        layout=recipe.layout,
        weighting=recipe.weighting,
        classes=len(places),
        dropout=recipe.dropout,
        input_size=recipe.input_size,
        pooling=recipe.pooling,
        maps=recipe.maps,
        polar=recipe.polar,
    )
    if recipe.pooling == "safa":
        return replace(spec, embedding=spec.maps * CHANNELS[spec.backbone, spec.last_layer])
    return spec
