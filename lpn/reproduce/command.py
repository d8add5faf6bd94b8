"""`lpn reproduce`: trains what a table needs, measures it, and writes the table."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

import lpn
from lpn.errors import InputError
from lpn.files import alone, check_writable, write_whole
from lpn.model import Model
from lpn.reproduce import pictures, report, runs, starts
from lpn.reproduce.measure import Notebook, shared_protocol
from lpn.reproduce.paper import LANDMARKS, Values
from lpn.reproduce.report import Column
from lpn.reproduce.sources import TASKS, Sources, open_sources
from lpn.reproduce.tables import SCALES, Row, Scale, Table, Training, find, tables
from lpn.spec import views_of

_SHOWN = {"figure7": ("instance", "lpn"), "figure8": ("lpn",)}
"""The trainings of Table I that each drawn figure shows."""
_APART = {
    "table1": (
        "Losses on distances compare satellites with drone and with street pictures, both ways; pairs and triplets are mined in "
        "the batch: each place's own pictures are true, all others of the batch are wrong.",
    ),
    "table2": ("SAFA and SAFA + LPN are described without their mirror.",),
    "table4": ("Queries are turned counter-clockwise by the degrees named, on their own canvas, corners black.",),
    "table5": ("The parts named, counted from the centre, are compared and no others.",),
    "table6": (
        "Both sides are described by the branch named; ImageNet alone: the mean over the last feature map. Baseline and LPN are "
        "trained alike, both without google.",
    ),
}
"""What a reader of one table must know."""
KEYS = (*tables(SCALES["paper"]), *_SHOWN)
"""Everything that can be reproduced."""


@dataclass
class Reproduction:
    """One call of `lpn reproduce`.

    Args:
        data: data set folders, or "world".
        out: folder for runs, measurements, and tables.
        models: networks given, by the name of the training they stand for; "" is the LPN.
        init: files of weights the backbones start from, one for each backbone.
        seeds: a training of each is made, and their mean is reported.
        scale: of `SCALES`.
        changes: of the recipe, for every row alike.
        train: train what is missing; otherwise such rows are not run.
        queries: queries shown in figures 7 and 8.
    """

    data: Sequence[str]
    out: Path
    models: Mapping[str, Path]
    init: Sequence[Path]
    seeds: Sequence[int]
    scale: Scale
    changes: Mapping[str, Any]
    train: bool = True
    queries: Sequence[str] = ()
    console: Console = field(default_factory=Console)

    def run(self, keys: Sequence[str]) -> list[Path]:
        """Make the tables and figures named and return the files written.

        Raises:
            LPNError: when data, models, or settings do not fit, which is found out before anything is trained, or when
                another process works in `out`.
        """
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError(
                "lpn reproduce is one process; train with torchrun -m lpn.cli train, and give it with --model."
            )
        wanted = [find(key, self.scale) for key in keys if key not in _SHOWN]
        check_writable(self.out / "measured.json")
        with alone(self.out, wait=False):
            return self._run(wanted, [key for key in keys if key in _SHOWN])

    def _run(self, wanted: Sequence[Table], drawn: Sequence[str]) -> list[Path]:
        self._sources: Sources = open_sources(self.data, self.out)
        self._starts = starts.by_backbone(self.init)
        self._given = self._load(wanted)
        self._check(wanted, drawn)
        self._jobs = self._planned(wanted, drawn)
        for job in self._jobs:
            job.check_same()
        if self.train:
            runs.train(self._jobs, self.console)
        written: list[Path] = []
        for table in wanted:
            files = self._table(table)
            self.console.print(files[0].read_text(), markup=False)
            written += files
        return written + [self._figure(key) for key in drawn]

    def _load(self, wanted: Sequence[Table]) -> dict[str, Model]:
        """The networks given, by training; each is opened, and fits the rows it is for."""
        known = {training.name for table in tables(self.scale).values() for training in table.trainings}
        found: dict[str, Model] = {}
        for name, file in self.models.items():
            training = name or "lpn"
            if training not in known:
                raise InputError(f"--model names {name!r}; the networks are called {', '.join(sorted(known))}.")
            model = found[training] = lpn.load(file)
            for table in wanted:
                for row in table.rows:
                    if row.training and row.training.name == training:
                        _check_fits(model, file, table, row)
        return found

    def _check(self, wanted: Sequence[Table], drawn: Sequence[str]) -> None:
        """Find out what would stop the work later."""
        for measure in dict.fromkeys(table.measure for table in wanted):
            for source in self._sources.of(measure):
                source.check(measure)
        if drawn:
            places = self._sources.role("places")
            places.check("both ways")
            pictures.named(places.dataset, self.queries)

    def _planned(self, wanted: Sequence[Table], drawn: Sequence[str]) -> list[runs.Job]:
        """The trainings that no given network stands for."""
        names = {name for key in drawn for name in _SHOWN[key]}
        needed = [training for training in find("table1", self.scale).trainings if training.name in names]
        needed += [training for table in wanted for training in table.trainings if not self._is_copy(table, training)]
        jobs = []
        for seed in self.seeds:
            for training in {training.name: training for training in needed}.values():
                if training.name not in self._given:
                    recipe = self.scale.recipe(training, seed, self.changes)
                    folder = self.out / "runs" / f"{training.name}-seed{seed}"
                    source, start = self._sources.role(training.role), self._starts.get(recipe.backbone)
                    jobs.append(runs.Job(training, seed, recipe, folder, source, start))
        return jobs

    def _is_copy(self, table: Table, training: Training) -> bool:
        """Whether a row of Table I would be the one above it again: there is no google to train with."""
        known = training.name == "lpn" and training.name not in self._given
        return table.key == "table1" and known and not self._sources.role("places").has_google

    def _models(self, table: Table, row: Row) -> dict[str, Model]:
        """The networks of a row by seed, or the one given."""
        training = row.training
        if training is None:
            recipe = replace(self.scale.places, **self.changes)
            start = self._starts.get(recipe.backbone)
            return {} if start is None else {"given": starts.features_alone(recipe, start)}
        return {} if self._is_copy(table, training) else self._networks(training.name)

    def _networks(self, name: str) -> dict[str, Model]:
        """The networks of a training by seed, or the one given."""
        if name in self._given:
            return {"given": self._given[name]}
        own = [job for job in self._jobs if job.training.name == name and job.done]
        return {f"seed {job.seed}": lpn.load(job.model) for job in own}

    def _table(self, table: Table) -> list[Path]:
        notebook = Notebook(self.out / "measured.json")
        data = self._sources.of(table.measure)
        measured: dict[str, dict[str, Values]] = {}
        protocols: list[str] = []
        for row in table.rows:
            found = {
                name: notebook.figures(row, table.measure, model, data)
                for name, model in self._models(table, row).items()
            }
            if found:
                measured[row.label] = {name: figures.values for name, figures in found.items()}
                protocols += [figures.protocol for figures in found.values()]
        foot = [shared_protocol(protocols), *_APART.get(table.key, ()), *self._foot(table)]
        return report.write(table, measured, self._columns(table), foot, self.out)

    def _columns(self, table: Table) -> list[Column]:
        """What is measured, and which of the paper's columns stands beside it."""
        data = self._sources.of(table.measure)
        if table.measure != "landmarks":
            # CVACT is not what the paper's Table II is of.
            same = data[0].dataset.kind != "CVACT"
            return [Column(title, index if same else None) for index, title in enumerate(table.columns)]
        of_kind = {"Oxford5k": LANDMARKS.index("Oxford mAP"), "Paris6k": LANDMARKS.index("Paris mAP")}
        return [Column(f"{source.name} mAP", of_kind.get(source.dataset.kind)) for source in data]

    def _foot(self, table: Table) -> list[str]:
        """What a reader must know of how the figures came about."""
        said: list[str] = []
        data = self._sources.of(table.measure)
        if any(source.rendered for source in data):
            said.append(
                "**Data: the rendered world, not the paper's data sets**; its figures compare with one another only."
            )
        else:
            said.append(f"Data: {', '.join(f'{source.name} ({source.dataset.kind})' for source in data)}.")
        names = {row.training.name for row in table.rows if row.training}
        given = sorted(f"{name} = {self.models.get(name) or self.models['']}" for name in names & set(self._given))
        if given:
            said.append(f"Networks given: {', '.join(given)}.")
        own = [job for job in self._jobs if job.training.name in names]
        if any(job.done for job in own):
            said.append(self.scale.said)
            of = {job.recipe.backbone: job.start for job in own}
            begin = [f"{name} from {start.name if start else 'random weights'}" for name, start in of.items()]
            said.append(f"Before training: {', '.join(begin)}.")
            if self.changes:
                said.append(f"Changed: {', '.join(f'{name} = {value}' for name, value in self.changes.items())}.")
            if len(self.seeds) > 1:
                said.append(
                    "Mean of the seeds trained so far, ± half of the distance between the lowest and the highest."
                )
        if lost := [job.name for job in own if job.diverged]:
            said.append(f"Diverged, and given up: {', '.join(lost)}.")
        own_lpn = table.measure == "both ways" and "lpn" in names and "lpn" not in self._given
        if own_lpn and not self._sources.role("places").has_google:
            said.append("There is no train/google, so LPN is trained without it.")
        return said

    def _figure(self, key: str) -> Path:
        of = {name: self._networks(name) for name in _SHOWN[key]}
        missing = [name for name, networks in of.items() if not networks]
        if missing:
            raise InputError(
                f"{key} needs the network {missing[0]}; give it with --model {missing[0]}=FILE, or train it."
            )
        places = self._sources.role("places").dataset
        shown = [(name, next(iter(networks.values()))) for name, networks in of.items()]
        if key == "figure7":
            data = pictures.heatmaps(shown, places, self.queries)
        else:
            data = pictures.retrievals(shown[0][1], places, self.queries)
        write_whole(self.out / f"{key}.png", data)
        return self.out / f"{key}.png"


def _check_fits(model: Model, file: Path, table: Table, row: Row) -> None:
    """Raise InputError where a given network cannot be measured for a row."""
    needed = {row.branch} if row.branch else {view for task in TASKS[table.measure] for view in views_of(task)}
    lacking = sorted(str(view) for view in needed - set(model.views))
    if lacking:
        raise InputError(
            f"{table.title} needs the view {lacking[0]} for {row.label}; {file.name} has {', '.join(model.views)}."
        )
    if row.parts and max(row.parts) > model.n_parts:
        raise InputError(
            f"{table.title} needs {max(row.parts)} parts for {row.label}; {file.name} has {model.n_parts}."
        )
