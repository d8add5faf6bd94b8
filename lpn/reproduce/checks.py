"""Checks before the first training, of anything that would stop a reproduction later or mislabel its figures."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lpn.core.errors import InputError
from lpn.core.views import View, views_of
from lpn.models.base import Model
from lpn.models.spec import ModelSpec
from lpn.reproduce.sources import TASKS
from lpn.reproduce.tables import PaperTable, Scale, TableRow, Training
from lpn.reproduce.trainings import TrainingJob


@dataclass(frozen=True)
class NetworkUse:
    """A use of a network, by a row of a table or by a figure.

    Attributes:
        training: the network.
        used_by: the row or figure.
        views: the views that the network must describe.
        carried: its features are carried over to landmarks (Table VI).
    """

    training: Training
    used_by: str
    views: frozenset[View]
    carried: bool = False

    @staticmethod
    def of_row(table: PaperTable, row: TableRow, training: Training) -> NetworkUse:
        """Make the use of a table's row."""
        views = {row.branch} if row.branch else {view for task in TASKS[table.measure] for view in views_of(task)}
        return NetworkUse(training, f"{table.title}, {row.label}", frozenset(views), table.measure == "landmarks")

    @staticmethod
    def of_figure(name: str, training: Training) -> NetworkUse:
        """Make the use of a drawn figure."""
        ground: View = "drone" if training.role == "places" else "street"
        return NetworkUse(training, name, frozenset((ground, "satellite")))

    def check_views(self, available: Collection[View], source: str) -> None:
        """Raise InputError if a needed view is missing from those of `source`."""
        lacking = sorted(self.views - set(available))
        if lacking:
            raise InputError(f"{self.used_by} needs the view {lacking[0]}; {source} has {', '.join(available)}.")


def check_fits(model: Model, file: Path, use: NetworkUse, scale: Scale) -> None:
    """Raise InputError if a given network is not of the kind that it stands for; backbone and weights are free."""
    use.check_views(model.views, file.name)
    spec, name, recipe = model.spec, use.training.name, scale.recipe(use.training, 0)
    if spec is None:
        raise InputError(f"{file.name} is {model.contract.method}, and {name} needs an LPN; give one, or leave it out.")
    compared = {
        "n_parts": (spec.n_parts, recipe.n_parts),
        "input size": tuple(" x ".join(map(str, size)) for size in (spec.input_size, recipe.input_size)),
        "pooling": (spec.pooling, recipe.pooling),
        "polar": (spec.polar, recipe.polar),
    }
    if recipe.n_parts > 1 and recipe.pooling == "average":
        compared["layout"] = (spec.layout, recipe.layout)
    for what, (actual, expected) in compared.items():
        if actual != expected:
            read = what == "input size" and file.suffix == ".pth" and not file.with_name("opts.yaml").is_file()
            hint = " (no opts.yaml is beside it, and without one a .pth is read as 256 x 256)" if read else ""
            size = None if read or what != "input size" else _size_options(spec, use.training, scale)
            remedy = "give it under the name of a network of its own kind, or leave it out"
            if size is not None:
                remedy = f"give {size}, which holds for every network without a size of its own, or leave the file out"
            raise InputError(
                f"{file.name} has {what} {actual}{hint}, and {name} needs {what} {expected} in {use.used_by}; {remedy}."
            )


def _size_options(spec: ModelSpec, training: Training, scale: Scale) -> str | None:
    """Return the options by which a training gets the input size of a network, such as "--size 128"; None if it has its own."""
    height, width = spec.input_size
    changes = {**scale.changes, "size": height, "width": 0 if width == height else width}
    try:
        changed = replace(scale, changes=changes).recipe(training, 0)
    except InputError:
        return None
    if changed.input_size != spec.input_size:
        return None
    return f"--size {height}" if width == height else f"--size {height} --width {width}"


def check_used(models: Mapping[str, Path], uses: Sequence[NetworkUse]) -> None:
    """Raise InputError if a given network is not used."""
    used = sorted({use.training.name for use in uses})
    for name, file in models.items():
        if name not in used:
            raise InputError(
                f"--model gives {file.name} as {name}, which no requested row uses; the rows use "
                f"{', '.join(used) or 'no network'}, so name one of them, or leave it out."
            )


def check_starts(starts: Mapping[str, Path], backbones: Collection[str]) -> None:
    """Raise InputError if no training starts from some of the given weights."""
    for backbone, file in starts.items():
        if backbone not in backbones:
            rather = f"the backbones are {', '.join(sorted(backbones))}" if backbones else "nothing is left to train"
            raise InputError(
                f"--init gives {file.name}, which holds a {backbone}, and no requested row starts from it: {rather}; leave it "
                "out, or give other weights."
            )


def check_pretrained(jobs: Sequence[TrainingJob], from_scratch: bool) -> None:
    """Raise InputError unless each training has pretrained weights, or all are to start from random ones."""
    lacking = lacking_weights(jobs)
    files = sorted({job.start.name for job in jobs if job.start is not None})
    if from_scratch and files:
        lack = f" Weights are lacking of {lacking}." if lacking else ""
        raise InputError(f"--init ({', '.join(files)}) and --from-scratch exclude each other; give one of them.{lack}")
    if lacking and not from_scratch:
        raise InputError(
            f"Every recipe starts from a backbone trained on ImageNet, and no --init has the weights of {lacking}; give its "
            "weights with --init FILE, once for each backbone, or say --from-scratch to start all from random weights."
        )


def lacking_weights(jobs: Sequence[TrainingJob]) -> str:
    """List the backbones without pretrained weights, each with its trainings; empty if there are none."""
    lacking: dict[str, dict[str, None]] = {}
    for job in jobs:
        if job.start is None:
            lacking.setdefault(job.recipe.backbone, {})[job.training.name] = None
    return "; ".join(f"{backbone} for {', '.join(names)}" for backbone, names in lacking.items())


def check_trainings(jobs: Sequence[TrainingJob], uses: Sequence[NetworkUse]) -> None:
    """Check that trainings can run, and that their networks can be measured.

    Raises:
        DataError: when there is nothing to train on.
        InputError: when there are fewer places than a batch has, or a measured view is not trained.
    """
    for job in jobs:
        places, batch = job.source.places(job.recipe.sets), job.recipe.batch
        if not job.done and len(places) < batch:
            raise InputError(
                f"{job.training.name} takes {batch} places a step, and {job.source.name} has {len(places)} to train on; give "
                "more places, or at most as many with --batch."
            )
        for use in uses:
            if use.training.name == job.training.name:
                use.check_views(places.views, f"{job.source.name}, on which {job.training.name} is trained,")
