"""Cross-validation of recipes for little data: named trials, each trained on all folds of the training places but one.

    python -m tools.crossval --data ROOT --out runs/crossval --table table.json --trial base --trial wide:ground_ratio=2

Only training pictures are read. Every trial has the same folds, so each trial and seed finds or misses each place once, and two
trials are compared place by place. A stopped training resumes, and several processes may share the work.
"""

from __future__ import annotations

import copy
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import msgspec
import numpy as np
import tyro
from rich import box
from rich.table import Table

import lpn
from lpn import descriptors
from lpn.analysis.statistics import RESAMPLES, intervals
from lpn.cli.train import flag_value
from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.consoles import Console, wide_console
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, fingerprint, printable, write_atomic, write_json
from lpn.core.formats import decode_json
from lpn.datasets import Dataset, open_dataset
from lpn.models.base import Model
from lpn.models.pretrained_weights import AUTO, find_weights
from lpn.reproduce import jobs
from lpn.reproduce.jobs import TrainingJob, by_backbone
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Training
from lpn.retrieval import metrics
from lpn.retrieval.calibration import MIN_PICTURES, calibrate, centred
from lpn.training import recipes
from lpn.training.recipe import Recipe
from lpn.training.run_folder import Provenance, here
from lpn.training.training_set import Fold, paired_pictures

FORMAT = "lpn-cross-validation/1"
_FOLD_FORMAT = "lpn-fold/2"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
# The seed of the bootstrap over places.
_SEED = 0


@dataclass(frozen=True)
class RecipeTrial:
    """A named recipe of a cross-validation.

    Attributes:
        name: also of its runs' folders.
        changes: settings that differ from the common recipe.
    """

    name: str
    changes: Mapping[str, Any]


def parse_trial(text: str, recipe: Recipe) -> RecipeTrial:
    """Read a trial, "NAME" or "NAME:setting=value,setting=value", and check it with the common recipe.

    Raises:
        InputError: if the name, a setting, or a value is invalid, or settings exclude each other.
    """
    name, _, rest = text.partition(":")
    if not _NAME.fullmatch(name):
        raise InputError(
            f"The trial {printable(text)[:80]!r} has no valid name; expected NAME or NAME:setting=value,setting=value, with "
            "letters, digits, dots, hyphens, and underscores in the name."
        )
    types, changes = get_type_hints(Recipe), {}
    for pair in filter(None, rest.split(",")):
        setting, equals, value = pair.partition("=")
        setting = setting.strip().replace("-", "_")
        if not equals or setting not in types or setting == "seed":
            more = (
                "; seeds are given with --seeds"
                if setting == "seed"
                else ", a setting of lpn train --help and its value"
            )
            raise InputError(f"The trial {name} has {printable(pair)[:80]!r}; expected setting=value{more}.")
        try:
            changes[setting] = msgspec.convert(value.strip(), types[setting], strict=False)
        except msgspec.ValidationError as error:
            raise InputError(f"The trial {name} has {printable(pair)[:80]!r} ({error}); give another value.") from error
    replace(recipe, **changes)
    return RecipeTrial(name, changes)


class _FoldFile(msgspec.Struct):
    """The answers of a trained network for the places of its fold.

    Attributes:
        model: fingerprint of the trained network.
        labels: for each task, the place of each query.
        first: for each task and reading, the 0-based rank of each query's first true match.
        precision: for each task and reading, the average precision of each query, from 0 to 1.
    """

    model: str
    labels: dict[str, list[int]]
    first: dict[str, dict[str, list[int]]]
    precision: dict[str, dict[str, list[float]]]
    made: Provenance
    format: str = _FOLD_FORMAT


class CrossValidation:
    """Trials of a recipe on the folds of a data set's training places.

    Args:
        dataset: only its training pictures are read.
        out: folder of all runs, `TRIAL-seedS-foldF`.
        recipe: the common settings.
        trials: the others are compared with the first one.
        init: files of ImageNet's weights or of trained models, at most one for each backbone; "auto" finds the missing ones.
        folds: number of parts that the places are split into.
        run_folds: number of folds that are trained, from the first; 0 for all.
        seeds: of the trainings; the split is the same for all of them.
        from_scratch: start from random weights.

    Raises:
        InputError: if trials share a name, weights of a backbone are missing, or the runs on disk differ.
        DataError: if the data set has no training places.
    """

    def __init__(
        self,
        dataset: Dataset,
        out: Path,
        recipe: Recipe,
        trials: Sequence[RecipeTrial],
        init: Sequence[Path] = (),
        folds: int = 5,
        run_folds: int = 0,
        seeds: Sequence[int] = (0,),
        from_scratch: bool = False,
        console: Console | None = None,
    ) -> None:
        names = [trial.name for trial in trials]
        if not trials or len(set(names)) < len(names):
            raise InputError(
                f"The trials are {', '.join(names) or 'none'}; give at least one, each with a name of its own."
            )
        if folds < 2:
            raise InputError(f"The number of folds is {folds}; expected 2 or more.")
        if not 0 <= run_folds <= folds or not seeds or len(set(seeds)) < len(seeds):
            raise InputError(
                f"Of {folds} folds, {run_folds} are to be trained with the seeds {', '.join(map(str, seeds)) or 'none'}; "
                f"expected 0 for all folds, or up to {folds}, and at least one seed, each once."
            )
        self.console = console or wide_console()
        self.out, self.trials, self.folds = out, tuple(trials), folds
        self.source = Source(dataset, rendered=False)
        changed = {trial.name: replace(recipe, **trial.changes) for trial in trials}
        starts = {} if from_scratch else self._starts(init, {one.backbone for one in changed.values()})
        # All trials of a fold come in succession, so that a stopped run has whole comparisons.
        self.jobs = [
            TrainingJob(
                Training(trial.name, "lpn"),
                seed,
                replace(changed[trial.name], seed=seed),
                out / f"{trial.name}-seed{seed}-fold{number}",
                self.source,
                starts.get(changed[trial.name].backbone),
                fold=Fold(number, folds),
            )
            for seed in seeds
            for number in range(run_folds or folds)
            for trial in trials
        ]
        for job in self.jobs:
            self._held_out(job)
            job.check_same()

    def run(self, table: Path) -> dict[str, Any]:
        """Train and measure the remaining jobs, write the table as JSON after each fold, and return the last one.

        Raises:
            InputError: if the table's name does not end in .json.
            LPNError: as `lpn.training.trainer.Trainer`, except for a divergence, which leaves a trial without that fold.
        """
        check_outputs((table, ".json"))
        for step in dict.fromkeys(map(_step, self.jobs)):
            jobs.train([job for job in self.jobs if _step(job) == step], self.console)
            values = self.table()
            write_json(table, values, ensure_ascii=False)
        self.console.print(summary(values))
        return values

    def table(self) -> dict[str, Any]:
        """Return the figures of all finished trainings as plain data for JSON."""
        runs = {trial.name: [(job, self._measured(job)) for job in self.jobs if job.training.name == trial.name and job.done]
                 for trial in self.trials}  # fmt: skip
        first = self.trials[0].name
        places = self.source.places(self.jobs[0].recipe.sets)
        return {
            "format": FORMAT,
            **msgspec.to_builtins(here()),
            "data": self.source.name,
            "places": len(places),
            "folds": self.folds,
            "trained folds": len({job.fold for job in self.jobs}),
            "seeds": sorted({job.seed for job in self.jobs}),
            "recipe": msgspec.to_builtins(self.jobs[0].recipe),
            "trials": {trial.name: self._trial(trial, runs[trial.name]) for trial in self.trials},
            "against": first,
            "differences": {
                trial.name: _differences(runs[trial.name], runs[first]) for trial in self.trials if trial.name != first
            },
        }

    def _trial(self, trial: RecipeTrial, runs: Sequence[tuple[TrainingJob, _FoldFile]]) -> dict[str, Any]:
        job = next(job for job in self.jobs if job.training.name == trial.name)
        figures = {
            task: {
                reading: _figures([file for _, file in runs], task, reading)
                for reading in _readings([file for _, file in runs], task)
            }
            for task in (runs[0][1].labels if runs else ())
        }
        start = None if job.start is None else {"file": job.start.name, "fingerprint": fingerprint(job.start)}
        return {
            "changes": dict(trial.changes),
            "start": start,
            "runs": len(runs),
            "diverged": [
                one.folder.name for one in self.jobs if one.training.name == trial.name and one.ended == "diverged"
            ],
            "training seconds of a run": float(np.mean([sum(one.seconds()) for one, _ in runs])) if runs else None,
            "figures": figures,
        }

    def _measured(self, job: TrainingJob) -> _FoldFile:
        """Return the ranks of a trained network on its fold, read from its folder if they are there."""
        path, model = job.folder / "fold.json", fingerprint(job.model)
        try:
            file = decode_json(path.read_bytes(), _FoldFile, path, _FOLD_FORMAT, InputError)
            if file.model == model:
                return file
        except (OSError, ValueError, InputError):
            pass  # not measured yet, or stopped meanwhile
        file = _measure(lpn.load(job.model), self._held_out(job), model)
        write_atomic(path, msgspec.json.encode(file) + b"\n")
        # The state that a run is resumed from takes three times the space of its model.
        (job.folder / "state.pt").unlink(missing_ok=True)
        return file

    def _held_out(self, job: TrainingJob) -> dict[int, dict[str, list[Path]]]:
        return copy.copy(self.source.places(job.recipe.sets)).hold_out(_fold(job), 0)

    def _starts(self, init: Sequence[Path], backbones: set[str]) -> dict[str, Path]:
        auto = any(str(file) == AUTO for file in init)
        starts = by_backbone([file for file in init if str(file) != AUTO])
        for backbone in sorted(backbones - set(starts)):
            if not auto:
                raise InputError(
                    f"There are no weights of {backbone}; give them with --init FILE, let --init {AUTO} find them, or say "
                    "--from-scratch."
                )
            starts[backbone], place = find_weights(backbone)
            self.console.print(
                f"{backbone} starts from {starts[backbone].name}, of {place}.", soft_wrap=True, markup=False
            )
        return starts


def _step(job: TrainingJob) -> tuple[int, Fold]:
    """Return the seed and fold that the trainings of one step share."""
    return job.seed, _fold(job)


def _fold(job: TrainingJob) -> Fold:
    assert job.fold is not None
    return job.fold


def summary(values: Mapping[str, Any]) -> Table:
    """Return the R@1 of each trial, and how it differs from the first trial, as a table for the terminal.

    Args:
        values: a result of `CrossValidation.table`.
    """
    table = Table(
        "trial", "task", "reading", "R@1", "spread", f"against {values['against']}", "runs", "min", box=box.SIMPLE_HEAD
    )
    for name, trial in values["trials"].items():
        for task, of_task in trial["figures"].items():
            for reading, figures in of_task.items():
                one, against = (
                    figures["R@1"],
                    values["differences"].get(name, {}).get(task, {}).get(reading, {}).get("R@1"),
                )
                spread = "" if one["spread"] is None else f"{one['spread']:.1f}"
                low, high = against["interval"] if against else (0.0, 0.0)
                differs = f"{against['difference']:+.1f} ({low:+.1f} to {high:+.1f})" if against else ""
                minutes = f"{trial['training seconds of a run'] / 60:.1f}"
                table.add_row(name, task, reading, f"{one['mean']:.1f}", spread, differs, str(trial["runs"]), minutes)
    return table


def _measure(model: Model, held: Mapping[int, Mapping[str, Sequence[Path]]], fingerprint_of_model: str) -> _FoldFile:
    """Rank the held-out places both ways, by drone or, without drones, by street pictures.

    Descriptors are compared in two or three readings: as they are (plain), each view's mean subtracted first (centred), and
    calibrated without labels, where there are as many pictures as that needs.
    """
    pictures = paired_pictures(held)
    views = tuple(pictures)
    plain = {view: descriptors.temporary_descriptors(model, pictures[view], view) for view in views}
    labels = {view: np.array([picture.label for picture in pictures[view]]) for view in views}
    read = {"plain": plain, "centred": {view: centred(plain[view]) for view in views}}
    if min(map(len, pictures.values())) >= MIN_PICTURES:
        calibration = calibrate(model, {view: [pictures[view]] for view in views}, descriptors.temporary_descriptors)
        read["calibrated"] = {
            view: calibration.read(model, pictures[view], view, descriptors.temporary_descriptors) for view in views
        }
    made = _FoldFile(fingerprint_of_model, {}, {}, {}, here())
    for query, gallery in (views, views[::-1]):
        task = f"{query}-to-{gallery}"
        made.labels[task] = labels[query].tolist()
        ranked = {
            reading: metrics.retrieve(of[query], labels[query], of[gallery], labels[gallery])
            for reading, of in read.items()
        }
        made.first[task] = {reading: one.first.tolist() for reading, one in ranked.items()}
        made.precision[task] = {reading: one.precision.tolist() for reading, one in ranked.items()}
    return made


def _readings(files: Sequence[_FoldFile], task: str) -> list[str]:
    """Return the readings that all folds have: one fold may have a place too few for a calibration."""
    return [reading for reading in files[0].first[task] if all(reading in file.first[task] for file in files)]


def _values(file: _FoldFile, task: str, reading: str) -> dict[str, Float64Array]:
    first = np.array(file.first[task][reading])
    hits = {f"R@{depth}": ((first >= 0) & (first < depth)).astype(np.float64) for depth in (1, 5)}
    return {**hits, "AP": np.array(file.precision[task][reading])}


def _figures(files: Sequence[_FoldFile], task: str, reading: str) -> dict[str, Any]:
    """Return mean, spread (standard deviation between runs), and each run's value, in percent."""
    runs = [{name: 100 * float(of.mean()) for name, of in _values(file, task, reading).items()} for file in files]
    return {
        name: {
            "mean": float(np.mean([run[name] for run in runs])),
            "spread": float(np.std([run[name] for run in runs], ddof=1)) if len(runs) > 1 else None,
            "runs": [run[name] for run in runs],
        }
        for name in runs[0]
    }


def _differences(
    runs: Sequence[tuple[TrainingJob, _FoldFile]], other: Sequence[tuple[TrainingJob, _FoldFile]]
) -> dict[str, Any]:
    """Compare two trials query by query on the folds and seeds that both have, with 95 % intervals (bootstrap over places)."""
    against = {(job.seed, job.fold): file for job, file in other}
    pairs = [(file, against[job.seed, job.fold]) for job, file in runs if (job.seed, job.fold) in against]
    result: dict[str, Any] = {}
    for task in pairs[0][0].labels if pairs else ():
        labels: Int64Array = np.concatenate([np.array(one.labels[task]) for one, _ in pairs])
        result[task] = {}
        for reading in _readings([file for pair in pairs for file in pair], task):
            values = [(_values(one, task, reading), _values(two, task, reading)) for one, two in pairs]
            names = list(values[0][0])
            rows = np.stack([np.concatenate([one[name] - two[name] for one, two in values]) for name in names])
            result[task][reading] = {
                name: {
                    "difference": estimate.value,
                    "interval": [estimate.low, estimate.high],
                    "better": int((row > 0).sum()),
                    "worse": int((row < 0).sum()),
                }
                for name, row, estimate in zip(names, rows, intervals(rows, labels, _SEED, RESAMPLES), strict=True)
            }
    return result


@dataclass
class CrossvalCommand:
    """Compare recipes by cross-validation on the training places; resumable."""

    data: Path
    """Data set with pictures to train on, in any layout of docs/data.md. Its test split is not read."""
    out: Path
    """Folder of all runs."""
    table: Path
    """File to write the table to, as JSON, after each fold."""
    trial: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A recipe to try, NAME or NAME:setting=value,setting=value with settings of lpn train --help; once for each. The first is
    the baseline of the others; without any, the recipe alone is measured as base."""
    recipe: str = "small"
    """Recipe of all trials; its settings are flags as well."""
    init: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Weights to start from, ImageNet's or a trained model's, once for each backbone; auto searches for those not given."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    folds: int = 5
    """Number of folds of the training places."""
    run_folds: int = 0
    """Train the first so many folds only; 0 trains all."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds: one training of each trial and fold for each."""
    settings: tyro.conf.OmitArgPrefixes[Recipe] = field(default_factory=lambda: recipes.RECIPES["small"])

    def run(self) -> None:
        if self.settings.windows:
            raise InputError("A map has no places to cross-validate on; choose a recipe for places.")
        trials = [parse_trial(text, self.settings) for text in self.trial or ("base",)]
        CrossValidation(
            open_dataset(self.data),
            self.out,
            self.settings,
            trials,
            self.init,
            self.folds,
            self.run_folds,
            self.seeds,
            self.from_scratch,
        ).run(self.table)
        print(f"Wrote {self.table}.")


def main(arguments: list[str]) -> int:
    """Run the command line; the recipe sets the defaults of the other flags. Return the exit status, 2 after an error."""
    try:
        name = flag_value(arguments, "--recipe") or "small"
        default = CrossvalCommand(tyro.MISSING, tyro.MISSING, tyro.MISSING, recipe=name, settings=recipes.find(name))
        tyro.cli(CrossvalCommand, args=arguments, prog="python -m tools.crossval", default=default).run()
    except LPNError as error:
        print(f"crossval: {printable(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("crossval: Stopped. Whole epochs and measurements are kept; the same command goes on.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
