"""Cross-validation of recipes for little data: named trials, each trained on all folds of the training places but one.

    python -m tools.crossval --data ROOT --out runs/crossval --table table.json --trial base --trial wide:ground_ratio=2

Only training pictures are read. Every trial has the same folds, so each trial and seed finds or misses each place once, and two
trials are compared query by query. A stopped training resumes, and several processes may share the work.
"""

from __future__ import annotations

import copy
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import msgspec
import numpy as np
import tyro

import lpn
from lpn import descriptors
from lpn.analysis.statistics import RESAMPLES, intervals
from lpn.cli.train import flag_value
from lpn.core.consoles import wide_console
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, printable, write_atomic, write_json
from lpn.core.formats import decode_json
from lpn.datasets import Dataset, open_dataset
from lpn.reproduce import jobs
from lpn.reproduce.jobs import TrainingJob, by_backbone
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Training
from lpn.retrieval import metrics
from lpn.retrieval.calibration import MIN_PICTURES, calibrate
from lpn.training import recipes
from lpn.training.recipe import Recipe
from lpn.training.run_folder import here
from lpn.training.training_set import Fold, paired_pictures

FORMAT = "lpn-cross-validation/2"
_FOLD_FORMAT = "lpn-fold/3"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
# The seed of the bootstrap over places.
_SEED = 0


class FoldAnswers(msgspec.Struct):
    """The answers of a trained network for the places of its fold.

    Attributes:
        labels: for each task, the place of each query.
        values: for each task, reading, and measure ("R@1" or "AP"), the value of each query, from 0 to 1.
    """

    labels: dict[str, list[int]]
    values: dict[str, dict[str, dict[str, list[float]]]]
    format: str = _FOLD_FORMAT


def parse_trial(text: str, recipe: Recipe) -> tuple[str, Recipe]:
    """Read a trial, "NAME" or "NAME:setting=value,setting=value"; return its name and the recipe with these settings.

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
        found = f"The trial {name} has {printable(pair)[:80]!r}"
        if setting == "seed":
            raise InputError(f"{found}; seeds are given with --seeds.")
        if not equals or setting not in types:
            raise InputError(f"{found}; expected setting=value, a setting of lpn train --help and its value.")
        try:
            changes[setting] = msgspec.convert(value.strip(), types[setting], strict=False)
        except msgspec.ValidationError as error:
            raise InputError(f"{found} ({error}); give another value.") from error
    return name, replace(recipe, **changes)


def plan(
    dataset: Dataset,
    out: Path,
    trials: Sequence[tuple[str, Recipe]],
    folds: int = 5,
    seeds: Sequence[int] = (0,),
    init: Sequence[Path] | None = (),
) -> list[TrainingJob]:
    """Return all trainings, those of one seed and fold in succession.

    Args:
        dataset: only its training pictures are read.
        out: folder of all runs, `TRIAL-seedS-foldF`.
        trials: names and recipes; the others are compared with the first one.
        folds: number of parts that the places are split into.
        seeds: of the trainings; the split is the same for all of them.
        init: files of ImageNet's weights or of trained models, one for each backbone; None starts from random weights.

    Raises:
        InputError: if trials share a name, weights of a backbone are missing, or the runs on disk differ.
        DataError: if the data set has no training places.
    """
    names = [name for name, _ in trials]
    if not trials or len(set(names)) < len(names):
        raise InputError(
            f"The trials are {', '.join(names) or 'none'}; give at least one, each with a name of its own."
        )
    if folds < 2:
        raise InputError(f"The number of folds is {folds}; expected 2 or more.")
    if not seeds or len(set(seeds)) < len(seeds):
        raise InputError(f"The seeds are {', '.join(map(str, seeds)) or 'none'}; expected at least one, each once.")
    starts = by_backbone(init or ())
    missing = {recipe.backbone for _, recipe in trials} - set(starts)
    if init is not None and missing:
        raise InputError(
            f"There are no weights of {', '.join(sorted(missing))}; give them with --init FILE, or say --from-scratch."
        )
    source = Source(dataset, rendered=False)
    planned = [
        TrainingJob(
            Training(name, "lpn"),
            seed,
            replace(recipe, seed=seed),
            out / f"{name}-seed{seed}-fold{number}",
            source,
            starts.get(recipe.backbone),
            fold=Fold(number, folds),
        )
        for seed in seeds
        for number in range(folds)
        for name, recipe in trials
    ]
    for job in planned:
        _held_out(job)
        job.check_same()
    return planned


def run(planned: Sequence[TrainingJob], table: Path) -> dict[str, Any]:
    """Train and measure the remaining jobs, write the table as JSON after each fold, and return the last one.

    Raises:
        InputError: if the table's name does not end in .json.
        LPNError: as `lpn.training.trainer.Trainer`, except for a divergence, which leaves a trial without that fold.
    """
    check_outputs((table, ".json"))
    values: dict[str, Any] = {}
    for _, step in groupby(planned, lambda job: (job.seed, job.fold)):
        jobs.train(list(step), wide_console())
        values = _table(planned)
        write_json(table, values, ensure_ascii=False)
    return values


def _table(planned: Sequence[TrainingJob]) -> dict[str, Any]:
    trials: dict[str, list[TrainingJob]] = {}
    for job in planned:
        trials.setdefault(job.training.name, []).append(job)
    measured = {name: {(job.seed, job.fold): _measured(job) for job in of if job.done} for name, of in trials.items()}
    first = planned[0]
    return {
        "format": FORMAT,
        **msgspec.to_builtins(here()),
        "data": first.source.name,
        "places": len(first.source.places(first.recipe.sets)),
        "folds": len({job.fold for job in planned}),
        "seeds": sorted({job.seed for job in planned}),
        "trials": {
            name: {
                "start": of[0].identity()["start"],
                "recipe": msgspec.to_builtins(of[0].recipe),
                "diverged": [job.folder.name for job in of if job.ended == "diverged"],
                "runs": len(measured[name]),
                "figures": _figures(list(measured[name].values())),
            }
            for name, of in trials.items()
        },
        "against": first.training.name,
        "differences": {name: _differences(measured[name], measured[first.training.name]) for name in list(trials)[1:]},
    }


def _held_out(job: TrainingJob) -> dict[int, dict[str, list[Path]]]:
    assert job.fold is not None
    return copy.copy(job.source.places(job.recipe.sets)).hold_out(job.fold, 0)


def _measured(job: TrainingJob) -> FoldAnswers:
    """Return the answers of a trained network for its fold, read from its folder if they are there."""
    path = job.folder / "fold.json"
    try:
        return decode_json(path.read_bytes(), FoldAnswers, path, _FOLD_FORMAT, InputError)
    except (OSError, ValueError, InputError):
        answers = _measure(job)
    write_atomic(path, msgspec.json.encode(answers) + b"\n")
    # The state that a run is resumed from takes three times the space of its model.
    (job.folder / "state.pt").unlink(missing_ok=True)
    return answers


def _measure(job: TrainingJob) -> FoldAnswers:
    """Rank the held-out places both ways, by drone or, without drones, by street pictures.

    Descriptors are read as they are (plain) and calibrated without labels, where there are as many pictures as that needs.
    """
    model, pictures = lpn.load(job.model), paired_pictures(_held_out(job))
    views = tuple(pictures)
    described = descriptors.temporary_descriptors
    read = {"plain": {view: described(model, pictures[view], view) for view in views}}
    if min(map(len, pictures.values())) >= MIN_PICTURES:
        calibration = calibrate(model, {view: [pictures[view]] for view in views}, described)
        read["calibrated"] = {view: calibration.read(model, pictures[view], view, described) for view in views}
    labels = {view: np.array([picture.label for picture in pictures[view]]) for view in views}
    answers = FoldAnswers({}, {})
    for query, gallery in (views, views[::-1]):
        task = f"{query}-to-{gallery}"
        answers.labels[task], answers.values[task] = labels[query].tolist(), {}
        for reading, of in read.items():
            found = metrics.retrieve(of[query], labels[query], of[gallery], labels[gallery])
            hits = (found.first == 0).astype(np.float64)
            answers.values[task][reading] = {"R@1": hits.tolist(), "AP": found.precision.tolist()}
    return answers


def _readings(answers: Sequence[FoldAnswers]) -> list[tuple[str, str]]:
    """Return the tasks and readings that all folds have: one fold may have a place too few for a calibration."""
    of_first = [(task, reading) for one in answers[:1] for task, readings in one.values.items() for reading in readings]
    return [(task, reading) for task, reading in of_first if all(reading in one.values[task] for one in answers)]


def _figures(answers: Sequence[FoldAnswers]) -> dict[str, Any]:
    """Return mean, spread (standard deviation between runs), and each run's value, in percent."""
    figures: dict[str, Any] = {}
    for task, reading in _readings(answers):
        figures.setdefault(task, {})[reading] = measured = {}
        for measure in answers[0].values[task][reading]:
            runs = [100 * float(np.mean(one.values[task][reading][measure])) for one in answers]
            spread = float(np.std(runs, ddof=1)) if len(runs) > 1 else None
            measured[measure] = {"mean": float(np.mean(runs)), "spread": spread, "runs": runs}
    return figures


def _differences(of: Mapping[Any, FoldAnswers], against: Mapping[Any, FoldAnswers]) -> dict[str, Any]:
    """Compare two trials query by query on the folds and seeds that both have, with 95 % intervals (bootstrap over places)."""
    pairs = [(answers, against[run]) for run, answers in of.items() if run in against]
    differences: dict[str, Any] = {}
    for task, reading in _readings([answers for pair in pairs for answers in pair]):
        labels = np.concatenate([one.labels[task] for one, _ in pairs])
        rows = {
            measure: np.concatenate(
                [
                    np.subtract(one.values[task][reading][measure], other.values[task][reading][measure])
                    for one, other in pairs
                ]
            )
            for measure in pairs[0][0].values[task][reading]
        }
        estimates = intervals(np.stack([*rows.values()]), labels, _SEED, RESAMPLES)
        differences.setdefault(task, {})[reading] = {
            measure: {"difference": estimate.value, "interval": [estimate.low, estimate.high]}
            for measure, estimate in zip(rows, estimates, strict=True)
        }
    return differences


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
    """Weights to start from, ImageNet's or a trained model's, once for each backbone."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    folds: int = 5
    """Number of folds of the training places."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds: one training of each trial and fold for each."""
    settings: tyro.conf.OmitArgPrefixes[Recipe] = field(default_factory=lambda: recipes.RECIPES["small"])

    def run(self) -> None:
        if self.settings.windows:
            raise InputError("A map has no places to cross-validate on; choose a recipe for places.")
        trials = [parse_trial(text, self.settings) for text in self.trial or ("base",)]
        init = None if self.from_scratch else self.init
        values = run(plan(open_dataset(self.data), self.out, trials, self.folds, self.seeds, init), self.table)
        for name, trial in values["trials"].items():
            for task, readings in trial["figures"].items():
                for reading, figures in readings.items():
                    line = f"{name:12} {task:20} {reading:10} R@1 {figures['R@1']['mean']:5.1f}"
                    if other := values["differences"].get(name, {}).get(task, {}).get(reading, {}).get("R@1"):
                        low, high = other["interval"]
                        line += f", {other['difference']:+.1f} ({low:+.1f} to {high:+.1f}) against {values['against']}"
                    print(line)
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
