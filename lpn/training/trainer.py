"""Training of an LPN (section III-A of the paper, "Optimization objective") by a recipe; a resumed run has the same losses."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from lpn.core.consoles import Console
from lpn.core.errors import DivergedError, InputError, ModelFileError
from lpn.core.files import check_writable
from lpn.core.progress import ended, report_progress
from lpn.core.shutdown import uninterrupted
from lpn.core.texts import counted
from lpn.core.views import views_of
from lpn.datasets import Dataset
from lpn.flight.maps import Map
from lpn.models import checkpoints
from lpn.models.lpn import LPN
from lpn.models.pretrained_weights import AUTO, find_weights
from lpn.models.shipped import model_file
from lpn.training.learner import Learner, build_network
from lpn.training.loader import Loader, TrainingBatch
from lpn.training.map_windows import MapWindows
from lpn.training.model_selection import EpochMetrics, HeldOut, TestSplit, best_epoch
from lpn.training.recipe import Recipe
from lpn.training.run_folder import ResumeState, RunFile, begin, epoch_line, read_run, read_state, save_log
from lpn.training.training_set import Fold, TrainingSet

# A training has diverged if its mean loss exceeds this multiple of the first step's loss (about chance).
_EXPLODED = 10.0
# The mean is checked from this step of an epoch on, or at the end of a shorter epoch.
_SURE_AFTER = 100


class Trainer:
    """A training run in a folder; docs/training.md lists its files.

    Args:
        source: the data set with the training pictures, or the map to train on.
        out: the run's folder.
        recipe: every setting of the training.
        init: a file of pretrained backbone weights, the name of a shipped model, or "auto" for weights that
            `lpn.models.pretrained_weights` finds. Tensors that do not fit are skipped. Needed unless `from_scratch` or `resume`.
        from_scratch: start from random weights instead.
        resume: continue after the last whole epoch in `out`, with the losses of an uninterrupted run.
        evaluate_every: number of epochs between tests; the best tested model is saved. 0 tests only at the end.
        workers: number of threads that prepare pictures, without effect on the result; 0 chooses it.
        validate: share of the places held out to choose the best epoch, or a held-out fold.
        device: the device to train on; by default the GPU if there is one.
        test: measure the last model on the test split.
        window_sizes: smallest and largest side in metres of the windows of a map; None chooses them.
        given: options of the command, for run.json.

    Raises:
        DataError: when the data set cannot be trained on.
        InputError: when torchrun started several processes, `out` holds another run, or there is nothing to resume.
        ModelFileError: when `init` cannot be used.
        OutputError: when `out` cannot be written.
    """

    def __init__(
        self,
        source: Dataset | Map,
        out: Path,
        recipe: Recipe,
        init: Path | None = None,
        resume: bool = False,
        evaluate_every: int = 0,
        console: Console | None = None,
        workers: int = 0,
        validate: float | Fold = 0.0,
        device: torch.device | None = None,
        test: bool = True,
        from_scratch: bool = False,
        window_sizes: tuple[float, float] | None = None,
        given: Mapping[str, Any] | None = None,
    ) -> None:
        check_single_process("lpn train")
        self.console, self.device = console or Console(), device or checkpoints.best_device()
        self.out, self.recipe, self.evaluate_every = out, recipe, evaluate_every
        held = self._open_places(source, window_sizes, validate)
        there = [name for name in ("state.pt", "last.safetensors", "log.csv") if (out / name).exists()]
        if init is not None and from_scratch:
            raise InputError("--init and --from-scratch exclude each other; give one of them.")
        if init is None and not from_scratch and not resume:
            raise InputError(
                "Every recipe starts from a backbone trained on ImageNet; give its weights with --init FILE, let --init auto "
                "find them, or say --from-scratch to start from random weights."
            )
        if not resume and there:
            raise InputError(
                f"{out} holds {there[0]} of a training run already; add --resume to continue it, or choose another --out."
            )
        if evaluate_every < 0:
            raise InputError(f"--evaluate-every is {evaluate_every}; expected 0 or more.")
        if held and not evaluate_every and not isinstance(validate, Fold):
            raise InputError("--validate chooses among tested epochs, but none is tested; give --evaluate-every, too.")
        self.loader = Loader(self.places, recipe, self.device, workers)
        self.steps = self.loader.steps
        check_writable(out / "last.safetensors")
        torch.manual_seed(recipe.seed)
        network = build_network(recipe, self.places.views, len(self.places))
        if init is not None and not resume:
            self._load_init(network, init)
        self.learner = Learner(network, recipe, self.device)
        self.history: list[EpochMetrics] = []
        self.first_loss = math.nan
        self.test_split: TestSplit | None = None
        if isinstance(source, Dataset):
            tasks = [task for task in source.tasks() if set(views_of(task)) <= set(self.places.views)]
            if tasks and (test or (evaluate_every and not held)):
                self.test_split = TestSplit(source, tasks, recipe.zoom)
        self.validator = HeldOut(held, recipe.zoom) if held else self.test_split
        self._given, self._places_digest = given or {}, self.places.digest()
        self._run_file: RunFile | None = None
        if resume:
            self._resume()

    @property
    def network(self) -> LPN:
        """The network that is trained."""
        return self.learner.network

    @property
    def updates(self) -> int:
        """The number of weight updates that `run` will make; for a resumed run, the remaining ones."""
        return self.steps * (self.recipe.epochs - len(self.history))

    def plan(self) -> str:
        """Describe in one sentence the training data of `run`, and its steps and updates."""
        recipe = self.recipe
        if isinstance(self.places, MapWindows):
            what, rows = f"{counted(len(self.places), 'window')} of {self.name} an epoch", "windows"
        else:
            what = f"{counted(len(self.places), 'place')} in {', '.join(self.places.files)}"
            rows = "places" if recipe.sampling == "places" else "pictures of each set"
        ends = f" (ended by {self.loader.shortest}, which has the fewest pictures)" if self.loader.shortest else ""
        resumed = f", of which {self.updates:,} are left" if self.history else ""
        steps, epochs = counted(self.steps, "step"), counted(recipe.epochs, "epoch")
        return (
            f"Training on {what}: {steps} of {recipe.batch} {rows} an epoch{ends}, {epochs}, so "
            f"{counted(self.steps * recipe.epochs, 'update')}{resumed}."
        )

    def run(self) -> Path:
        """Train to the last epoch, test, and return the path of the model.

        Raises:
            DivergedError: when the training diverges.
            LPNError: when a picture cannot be read, or a file cannot be written.
        """
        self._print_setup()
        if self._run_file is None:
            self._run_file = begin(self.out, self.recipe, self._given)
        done, epochs = len(self.history), self.recipe.epochs
        if done:
            self._save()
        stream = self.loader.stream(done, epochs)
        with closing(cast(Any, stream)):
            # The run may have been interrupted while its last epoch was tested.
            self._select()
            for epoch in range(done, epochs):
                with ended():
                    self.history.append(self._epoch(epoch, islice(stream, self.steps)))
                self._save()
                self._select()
                self.console.print(epoch_line(self.history, epochs), highlight=False, soft_wrap=True)
        self._finish()
        return self.out / "last.safetensors"

    def _epoch(self, epoch: int, batches: Iterator[TrainingBatch]) -> EpochMetrics:
        self.network.train()
        # One seed for each epoch, so that a resumed run repeats an uninterrupted one.
        torch.manual_seed(self.recipe.seed * 100_003 + epoch)
        started, total, pictures, rate = time.perf_counter(), 0.0, 0, 0.0
        previous: Tensor | None = None
        terms: dict[str, Tensor] = {}
        for step, batch in enumerate(batches):
            found, rate = self.learner.step(batch, epoch * self.steps + step, self.steps)
            loss = found.pop("loss")
            terms = {name: terms.get(name, 0.0) + of.double() for name, of in found.items()}
            pictures += batch.pictures
            # Read the loss of the previous step, so that the GPU need not wait.
            if previous is not None:
                total += self._check_loss(float(previous), total, epoch, step)
                speed = pictures / (time.perf_counter() - started)
                stage = f"Epoch {epoch + 1}/{self.recipe.epochs}, loss {total / step:.3f}, {speed:.1f} images/s"
                report_progress(stage, epoch * self.steps + step, self.recipe.epochs * self.steps)
            previous = loss
        assert previous is not None
        total += self._check_loss(float(previous), total, epoch, self.steps)
        if not all(bool(tensor.isfinite().all()) for tensor in self.network.state_dict().values()):
            raise self._diverged("A weight is no longer a number", epoch, self.steps)
        seconds = time.perf_counter() - started
        return {
            "epoch": epoch + 1,
            "loss": total / self.steps,
            **{f"loss {name}": float(of) / self.steps for name, of in terms.items()},
            "lr": rate,
            "seconds": seconds,
            "images_per_second": pictures / seconds,
        }

    def _check_loss(self, loss: float, total: float, epoch: int, step: int) -> float:
        """Return the loss of a step (from 1); raise if the training diverged. `total` is the sum of earlier losses."""
        if not math.isfinite(loss):
            raise self._diverged(f"The loss became {loss}", epoch, step)
        if math.isnan(self.first_loss):
            self.first_loss = loss
        mean, first = (total + loss) / step, self.first_loss
        # Ten times a loss near 0 is not a divergence.
        if step >= min(_SURE_AFTER, self.steps) and mean > _EXPLODED * max(first, 1.0):
            raise self._diverged(
                f"The loss rose to {mean:.3g} on average, from {first:.3g} at the first step,", epoch, step
            )
        return loss

    def _diverged(self, reason: str, epoch: int, step: int) -> DivergedError:
        model = f"{self.out} keeps the model of epoch {epoch}; " if epoch else ""
        return DivergedError(
            f"{reason} in epoch {epoch + 1}, step {step}; {model}start again with a smaller --lr in another --out."
        )

    def _select(self) -> None:
        """Test the last epoch if a test is due, and save its model if it is the best so far."""
        epoch, last, validator = len(self.history), len(self.history) == self.recipe.epochs, self.validator
        due = self.evaluate_every and epoch and (epoch % self.evaluate_every == 0 or last)
        if not due or validator is None or validator.column in self.history[-1]:
            return
        self.history[-1] |= validator.measure(self._load("last"), self.console if last else None)
        best = best_epoch(self.history, validator.column)
        if best is not None and best[0] == epoch:
            more = {"epoch": str(epoch), "score": f"{best[1]:.4f}", "chosen by": validator.description}
            self.learner.save_model(self.out / "best.safetensors", self._metadata() | more)
        self._save()

    def _finish(self) -> None:
        """Test the last epoch unless it was tested, and print the best epoch."""
        split, validator = self.test_split, self.validator
        if split is not None and split.column not in self.history[-1]:
            self.history[-1] |= split.measure(self._load("last"), self.console)
            self._save()
        best = best_epoch(self.history, validator.column) if validator is not None else None
        if validator is None or best is None or not self.evaluate_every:
            return
        chosen = f"best.safetensors is the model of epoch {best[0]}, chosen by {validator.description}: {best[1]:.2f}."
        self.console.print(chosen, soft_wrap=True)
        if split is not None and validator is not split and best[0] < len(self.history):
            self.console.print("Its metrics on the test split:")
            split.measure(self._load("best"), self.console)

    def _load(self, name: str) -> checkpoints.TorchModel:
        return checkpoints.load_torch(self.out / f"{name}.safetensors", self.device)

    def _print_setup(self) -> None:
        precision, count = self.learner.mixed_precision, counted(self.loader.workers, "thread")
        instead = " (float16 needs a CUDA device)" if precision.fell_back else ""
        lines = [
            f"Computing in {precision.name} on {self.device.type}{instead}; pictures are prepared by {count}.",
            self.plan(),
        ]
        decay, epochs = self.recipe.decay_epoch, self.recipe.epochs
        if self.recipe.schedule == "step" and decay >= epochs:
            lines.append(
                f"The learning rate never decays, as --decay-epoch is {decay} and the training has {epochs} epochs."
            )
        if epochs <= self.recipe.warmup_epochs:
            lines.append(
                f"The warm-up of {self.recipe.warmup_epochs} epochs fills the training of {epochs}; lower --warmup-epochs, or "
                "train longer."
            )
        if self.evaluate_every and self.validator is None:
            lines.append(f"{self.name} has no test split, so no epoch is tested.")
        for line in lines:
            self.console.print(line, soft_wrap=True)

    def _open_places(
        self, source: Dataset | Map, window_sizes: tuple[float, float] | None, validate: float | Fold
    ) -> dict[int, dict[str, list[Path]]]:
        """Open the training data, and return the held-out places."""
        self.places: TrainingSet | MapWindows
        recipe = self.recipe
        if isinstance(source, Map):
            if self.evaluate_every or validate:
                raise InputError(
                    "A map has no places to test on; leave --evaluate-every and --validate out, and use lpn locate."
                )
            self.name, self.places = source.name, MapWindows(source, recipe, window_sizes)
            return {}
        if recipe.windows:
            raise InputError("The recipe trains on map windows; give --map in place of --data, or another --recipe.")
        self.name, self.places = source.root.resolve().name, TrainingSet(source, self.console, recipe.sets)
        if (recipe.compares_drones or recipe.ground_ratio != 1) and "drone" not in self.places.views:
            raise InputError(
                f"The recipe's {recipe.metric if recipe.compares_drones else 'ground_ratio'} needs drone pictures, and "
                f"{self.name} has none to train on; choose another --method, or set --ground-ratio to 1."
            )
        return self.places.hold_out(validate, recipe.seed)

    def _load_init(self, network: LPN, init: Path) -> None:
        if str(init) == AUTO and not init.is_file():
            init, place = find_weights(self.recipe.backbone)
            self.console.print(f"--init {AUTO} takes {init}, of {place}.", soft_wrap=True, markup=False)
        named, init = init, model_file(init, trained=True)
        filled, total, missing = checkpoints.load_backbone(network, init)
        rest = (
            f"; these are missing or incomplete, and start from random values: {', '.join(missing)}" if missing else ""
        )
        self.console.print(f"{named.name} fills {filled} of the backbone's {total} tensors{rest}.")
        # Windows of a map have no classes, so training starts from the descriptors of a trained model.
        if isinstance(self.places, MapWindows):
            self.console.print(checkpoints.load_heads(network, init))

    def _save(self) -> None:
        """Write the state, then model and log, which a resumed run writes again."""
        with uninterrupted():
            state = ResumeState(self.history, self.first_loss, self.learner.state())
            state.write(self.out / "state.pt", self.recipe, self._places_digest)
            self.learner.save_model(self.out / "last.safetensors", self._metadata())
            save_log(self.out, self.history)

    def _metadata(self) -> dict[str, str]:
        run = {"run": self._run_file.metadata()} if self._run_file else {}
        return {"recipe": self.recipe.to_json(), "epochs": str(len(self.history)), "data": self.name, **run}

    def _resume(self) -> None:
        path = self.out / "state.pt"
        state = read_state(path, self.recipe, self._places_digest)
        try:
            self.learner.restore(state.tensors)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ModelFileError(
                f"{path} is damaged: its state does not fit its recipe; start anew in another --out."
            ) from error
        self.history, self.first_loss = state.history, state.first_loss
        self._run_file = read_run(self.out)
        self.console.print(f"Resuming after epoch {len(self.history)} of {self.recipe.epochs}.")


def check_single_process(command: str) -> None:
    """Raise InputError if torchrun started several processes, which would write to the same files."""
    processes = os.environ.get("WORLD_SIZE", "1")
    if processes != "1":
        raise InputError(f"{command} is one process, and WORLD_SIZE is {processes}; start it without torchrun.")
