"""The work of `lpn reproduce`: train the networks of tables, measure them, and write the tables."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

import lpn
from lpn.core.errors import InputError
from lpn.core.files import check_writable, exclusive_lock, write_atomic
from lpn.models.base import Model
from lpn.reproduce import checks, footnotes, paper_figures, pretrained, report, trainings
from lpn.reproduce.checks import NetworkUse
from lpn.reproduce.measure import MeasurementStore
from lpn.reproduce.paper_values import LANDMARKS, Values
from lpn.reproduce.report import MeasuredColumn
from lpn.reproduce.sources import Sources, open_sources
from lpn.reproduce.tables import SCALES, PaperTable, Scale, TableRow, Training, find, tables
from lpn.training.recipes import Recipe

# The trainings of Table I that each picture shows.
_SHOWN = {"figure7": ("instance", "lpn"), "figure8": ("lpn",)}
# All tables and figures that can be reproduced.
KEYS = (*tables(SCALES["paper"]), *_SHOWN)


@dataclass
class Reproduction:
    """One call of `lpn reproduce`.

    Args:
        data: data set folders, or "world".
        out: folder for runs, measurements, and tables.
        models: given networks, by the name of the training they replace.
        init: files of pretrained weights, one for each backbone.
        seeds: seeds of each training; tables report the mean.
        scale: one of `SCALES`.
        changes: changes of all recipes.
        train: train missing networks; otherwise their rows are not run.
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
        """Make the named tables and figures, and return the written files.

        Raises:
            LPNError: when data, models, or settings do not fit, before anything is trained, or when another process works in
                `out`.
        """
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError(
                "lpn reproduce is one process; train with torchrun -m lpn train, and give it with --model."
            )
        wanted = [find(key, self.scale) for key in keys if key not in _SHOWN]
        check_writable(self.out / "measured.json")
        with exclusive_lock(self.out, wait=False):
            return self._run(wanted, [key for key in keys if key in _SHOWN])

    def _run(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> list[Path]:
        self._notebook = MeasurementStore(self.out / "measured.json")
        self._sources: Sources = open_sources(self.data, self.out)
        self._starts = pretrained.by_backbone(self.init)
        uses = self._uses(wanted, drawn)
        self._given = self._load(uses)
        self._check(wanted, drawn)
        self._jobs = self._planned(uses)
        ours = {job.recipe.backbone for job in self._jobs}
        untrained = [self._alone.backbone for table in wanted for row in table.rows if row.training is None]
        checks.check_starts(self._starts, ours.union(untrained))
        for job in self._jobs:
            job.check_same()
        to_come = [job for job in self._jobs if self.train and not job.diverged]
        checks.check_trainings([job for job in self._jobs if job.done or job in to_come], uses)
        self._say_ahead([job for job in to_come if not job.done], drawn)
        if self.train:
            trainings.train(self._jobs, self.console)
        written = [self._table(table) for table in wanted]
        figures = [file for key in drawn if (file := self._figure(key)) is not None]
        # Print last: an error of the terminal must not keep a file from being written.
        for files in written:
            self.console.print(files[0].read_text(encoding="utf-8"), markup=False)
        return [file for files in written for file in files] + figures

    def _uses(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> list[NetworkUse]:
        """List the networks that tables and figures need."""
        of_name = {training.name: training for training in find("table1", self.scale).trainings}
        uses = [NetworkUse.of_figure(key, of_name[name]) for key in drawn for name in _SHOWN[key]]
        return uses + [
            NetworkUse.of_row(table, row, row.training)
            for table in wanted
            for row in table.rows
            if row.training and not self._is_copy(table, row.training)
        ]

    def _load(self, uses: Sequence[NetworkUse]) -> dict[str, Model]:
        """Load the given networks by training, and check that each is used and is what it stands for."""
        known = {training.name for table in tables(self.scale).values() for training in table.trainings}
        for name in self.models:
            if name not in known:
                raise InputError(f"--model names {name!r}; the networks are called {', '.join(sorted(known))}.")
        checks.check_used(self.models, uses)
        found = {name: lpn.load(file) for name, file in self.models.items()}
        for use in uses:
            if use.training.name in found:
                recipe = self.scale.recipe(use.training, 0, self.changes)
                checks.check_fits(found[use.training.name], self.models[use.training.name], use, recipe)
        return found

    def _check(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> None:
        """Check the data before any work."""
        for measure in dict.fromkeys(table.measure for table in wanted):
            for source in self._sources.of(measure):
                source.check(measure)
        if drawn:
            places = self._sources.role("places")
            places.check("both ways")
            paper_figures.named(places.dataset, self.queries)

    def _planned(self, uses: Sequence[NetworkUse]) -> list[trainings.TrainingJob]:
        """Plan the trainings of networks that are not given."""
        jobs = []
        for seed in self.seeds:
            for training in {use.training.name: use.training for use in uses}.values():
                if training.name not in self._given:
                    recipe = self.scale.recipe(training, seed, self.changes)
                    folder = self.out / "runs" / f"{training.name}-seed{seed}"
                    source, start = self._sources.role(training.role), self._starts.get(recipe.backbone)
                    jobs.append(trainings.TrainingJob(training, seed, recipe, folder, source, start))
        return jobs

    def _say_ahead(self, to_come: Sequence[trainings.TrainingJob], drawn: Sequence[str]) -> None:
        """Print the pretrained weights of each training, and which figures cannot be drawn."""
        for backbone, start in {job.recipe.backbone: job.start for job in to_come}.items():
            self.console.print(
                f"{backbone} starts from {start.name if start else 'random weights'}.", markup=False, soft_wrap=True
            )
        if not self.train:
            there = {*self._given, *(job.training.name for job in self._jobs if job.done)}
            for key in drawn:
                self._say_lacking(key, [name for name in _SHOWN[key] if name not in there])

    def _say_lacking(self, key: str, lacking: Sequence[str]) -> None:
        if lacking:
            how = "not drawn" if len(lacking) == len(_SHOWN[key]) else "drawn with the others"
            self.console.print(
                f"{key} {how}: there is no network {' or '.join(lacking)}; give it as --model {lacking[0]}=FILE, or train it.",
                markup=False, soft_wrap=True,
            )  # fmt: skip

    @property
    def _alone(self) -> Recipe:
        """The recipe whose backbone is measured without training."""
        return replace(self.scale.places, **self.changes)

    def _is_copy(self, table: PaperTable, training: Training) -> bool:
        """Check whether a row of Table I would repeat the one above, for lack of google pictures."""
        ours = training.name == "lpn" and training.name not in self.models
        return table.key == "table1" and ours and not self._sources.role("places").has_google

    def _models(self, table: PaperTable, row: TableRow) -> dict[str, Model]:
        """Return the networks of a row by seed, or the given one."""
        training = row.training
        if training is None:
            start = self._starts.get(self._alone.backbone)
            return {} if start is None else {"given": pretrained.features_alone(self._alone, start)}
        return {} if self._is_copy(table, training) else self._networks(training.name)

    def _networks(self, name: str) -> dict[str, Model]:
        """Return the networks of a training by seed, or the given one."""
        if name in self._given:
            return {"given": self._given[name]}
        own = [job for job in self._jobs if job.training.name == name and job.done]
        return {f"seed {job.seed}": lpn.load(job.model) for job in own}

    def _table(self, table: PaperTable) -> list[Path]:
        data = self._sources.of(table.measure)
        measured: dict[str, dict[str, Values]] = {}
        protocols: dict[str, str] = {}
        for row in table.rows:
            found = {
                name: self._notebook.figures(row, table.measure, model, data)
                for name, model in self._models(table, row).items()
            }
            if found:
                measured[row.label] = {name: figures.values for name, figures in found.items()}
                protocols[row.label] = next(iter(found.values())).protocol
        if table.measure != "landmarks":
            table = replace(table, title=f"{table.title}, on {data[0].kind}")
        notes = [footnotes.protocol(protocols), *footnotes.about(table, data), *self._of_networks(table)]
        return report.write(table, measured, self._columns(table), notes, self.out)

    def _columns(self, table: PaperTable) -> list[MeasuredColumn]:
        """Return the measured columns, each with its column of the paper."""
        data = self._sources.of(table.measure)
        if table.measure != "landmarks":
            # CVACT is not what the paper's Table II is of.
            same = data[0].dataset.kind != "CVACT"
            return [MeasuredColumn(title, index if same else None) for index, title in enumerate(table.columns)]
        of_kind = {"Oxford5k": LANDMARKS.index("Oxford mAP"), "Paris6k": LANDMARKS.index("Paris mAP")}
        return [MeasuredColumn(f"{source.name} mAP", of_kind.get(source.dataset.kind)) for source in data]

    def _of_networks(self, table: PaperTable) -> list[str]:
        """Describe where the table's networks come from."""
        names = {row.training.name for row in table.rows if row.training}
        given = [f"{n} = {self.models[n]} ({self._given[n].describe()})" for n in sorted(names & set(self._given))]
        notes = [f"Networks given: {', '.join(given)}."] if given else []
        own = [job for job in self._jobs if job.training.name in names]
        notes += footnotes.networks(own, self.scale, self.changes, self.seeds)
        own_lpn = table.measure == "both ways" and "lpn" in names and "lpn" not in self._given
        if own_lpn and not self._sources.role("places").has_google:
            notes.append("There is no train/google, so LPN is trained without it.")
        return notes

    def _figure(self, key: str) -> Path | None:
        """Draw a figure with the available networks, and return its file; None without any."""
        of = {name: networks for name in _SHOWN[key] if (networks := self._networks(name))}
        if self.train:
            self._say_lacking(key, [name for name in _SHOWN[key] if name not in of])
        if not of:
            return None
        places = self._sources.role("places").dataset
        shown = [(name, next(iter(networks.values()))) for name, networks in of.items()]
        if key == "figure7":
            data = paper_figures.heatmaps(shown, places, self.queries)
        else:
            data = paper_figures.retrievals(shown[0][1], places, self.queries)
        write_atomic(self.out / f"{key}.png", data)
        return self.out / f"{key}.png"
