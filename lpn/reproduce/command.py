"""The work of `lpn reproduce`: train the networks of tables, measure them, and write the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import lpn
from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.core.files import check_writable, exclusive_lock, write_atomic
from lpn.models.base import Model
from lpn.reproduce import checks, footnotes, paper_figures, plan, pretrained, report, trainings
from lpn.reproduce.checks import NetworkUse
from lpn.reproduce.measure import MeasuredFigures, MeasurementStore
from lpn.reproduce.paper_values import LANDMARKS
from lpn.reproduce.record import Provenance, RowRecord, TableRecord, row_record
from lpn.reproduce.sources import Source, Sources, open_sources
from lpn.reproduce.tables import DRAWN, SCALES, SHOWN, PaperTable, Scale, TableRow, Training, find, tables
from lpn.reproduce.trainings import TrainingJob
from lpn.retrieval import transfer
from lpn.training.trainer import check_single_process

# All tables and figures that can be reproduced.
KEYS = tuple(dict.fromkeys((*tables(SCALES["paper"]), *DRAWN)))


@dataclass
class Reproduction:
    """One call of `lpn reproduce`.

    Args:
        data: data set folders.
        out: folder for runs, measurements, and tables.
        models: given networks, by the name of the training they replace.
        init: files of pretrained weights, one for each backbone.
        seeds: seeds of each training; tables report the mean.
        scale: one of `SCALES`, with the user's changes of its recipes.
        train: train missing networks; otherwise their rows are not run.
        queries: queries shown in figures 7 and 8; Figure 1 shows the first.
        from_scratch: train from random weights, without `init`.
        partial: a row whose data set is not given says so in its place; otherwise its table is refused.
    """

    data: Sequence[str]
    out: Path
    models: Mapping[str, Path]
    init: Sequence[Path]
    seeds: Sequence[int]
    scale: Scale
    train: bool = True
    queries: Sequence[str] = ()
    from_scratch: bool = False
    partial: bool = False
    console: Console = field(default_factory=Console)

    def run(self, keys: Sequence[str]) -> list[Path]:
        """Make the named tables and figures, and return the written files.

        Several processes may make the same ones in the same folder; they share the trainings.

        Raises:
            LPNError: when data, models, or settings do not fit, before anything is trained.
        """
        check_single_process("lpn reproduce")
        check_writable(self.out / "measured.json")
        wanted, drawn, uses = self._prepare(keys)
        left = self._check_work(uses)
        checks.check_pretrained(left, self.from_scratch)
        self._say_ahead(left, drawn)
        for backbone, start in {job.recipe.backbone: job.start for job in left}.items():
            self.console.print(
                f"{backbone} starts from {start.name if start else 'random weights'}.", markup=False, soft_wrap=True
            )
        if self.train:
            trainings.train(self._jobs, self.console)
        lock = self.out / ".tables"
        lock.mkdir(exist_ok=True)
        # A second process waits, and then finds all figures in measured.json.
        with exclusive_lock(lock, wait=True):
            return self._write(wanted, drawn)

    def _prepare(self, keys: Sequence[str]) -> tuple[list[PaperTable], list[str], list[NetworkUse]]:
        """Open data and networks, plan the trainings, and print which rows can be made; return tables, pictures, and uses."""
        wanted = [find(key, self.scale) for key in keys if key in tables(self.scale) or key not in DRAWN]
        with exclusive_lock(self.out, wait=True):
            self._store = MeasurementStore(self.out / "measured.json")
            self._sources: Sources = open_sources(self.data)
        self._starts = pretrained.by_backbone(self.init)
        drawn = self._drawn(keys)
        uses = self._uses(wanted, drawn)
        self._loaded = self._load(uses)
        self._check(wanted, drawn)
        self._plan_jobs(wanted, uses)
        for table in wanted:
            reasons = {row.label: self._reason(table, row) for row in table.rows}
            self.console.print(plan.rows(table, reasons), markup=False, highlight=False, soft_wrap=True)
        return wanted, drawn, uses

    def _write(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> list[Path]:
        self._store.reload()
        written = [self._table(table) for table in wanted]
        figures = [file for name in drawn if (file := self._figure(name)) is not None]
        # Print last: an error of the terminal must not keep a file from being written.
        for files in written:
            self.console.print(files[0].read_text(encoding="utf-8"), markup=False)
        return [file for files in written for file in files] + figures

    def _drawn(self, keys: Sequence[str]) -> list[str]:
        """Return the pictures to draw, and print which ones lack their data set."""
        names = [name for key in keys for name in DRAWN.get(key, ())]
        lacking = [name for name in names if SHOWN[name][0].role not in self._sources.roles]
        # Without places there is nothing of the figure, which is an error unless `partial`; panoramas are a part of it.
        absent = [name for name in lacking if self.partial or SHOWN[name][0].role == "panoramas"]
        for role in dict.fromkeys(SHOWN[name][0].role for name in absent):
            without = ", ".join(name for name in absent if SHOWN[name][0].role == role)
            self.console.print(f"{without} not drawn: no {role} are given with --data.")
        return [name for name in names if name not in absent]

    def _uses(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> list[NetworkUse]:
        """List the networks that tables and figures need."""
        uses = [NetworkUse.of_figure(name, training) for name in drawn for training in SHOWN[name]]
        return uses + [
            NetworkUse.of_row(table, row, row.training)
            for table in wanted
            for row in table.rows
            if row.training and not self._lacks_data(table, row) and not self._is_copy(row.training)
        ]

    def _load(self, uses: Sequence[NetworkUse]) -> dict[str, Model]:
        """Load the given networks by training, and check that each is used and is what it stands for."""
        known = {training.name for table in tables(self.scale).values() for training in table.trainings}
        for name in self.models:
            if name not in known:
                raise InputError(f"--model names {name!r}; the networks are called {', '.join(sorted(known))}.")
        checks.check_used(self.models, uses)
        loaded = {name: lpn.load(file) for name, file in self.models.items()}
        for use in uses:
            if use.training.name in loaded:
                checks.check_fits(loaded[use.training.name], self.models[use.training.name], use, self.scale)
                if self.scale.released and use.carried:
                    transfer.check_model(loaded[use.training.name])
        return loaded

    def _check(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> None:
        """Check the data before any work."""
        possible = [t for t in wanted if not self.partial or not self._sources.lacking(t.measure)]
        for measure in dict.fromkeys(table.measure for table in possible):
            for source in self._sources.of(measure):
                source.check(measure)
        if not self.partial:
            for row in (row for table in wanted for row in table.rows):
                if row.training and row.training.name not in self._loaded:
                    self._sources.role(row.training.role)
        for role in dict.fromkeys(SHOWN[name][0].role for name in drawn):
            source = self._sources.role(role)
            source.check("both ways" if role == "places" else "ground")
            if role == "places":
                paper_figures.named(source.dataset, "drone", self.queries)

    def _plan_jobs(self, wanted: Sequence[PaperTable], uses: Sequence[NetworkUse]) -> None:
        """Plan the trainings, and check what they start from."""
        self._jobs = self._planned(uses)
        ours = {job.recipe.backbone for job in self._jobs}
        rows = [row for table in wanted for row in table.rows if row.training is None and not row.quoted]
        untrained = [self.scale.base.backbone for _ in rows]
        checks.check_starts(self._starts, ours.union(untrained))

    def _check_work(self, uses: Sequence[NetworkUse]) -> list[TrainingJob]:
        """Check that the trainings can run, and return those that are left."""
        for job in self._jobs:
            job.check_same()
        to_come = [job for job in self._jobs if self.train and not job.diverged]
        checks.check_trainings([job for job in self._jobs if job.done or job in to_come], uses)
        return [job for job in to_come if not job.done]

    def _planned(self, uses: Sequence[NetworkUse]) -> list[TrainingJob]:
        """Plan the trainings of networks that are not given."""
        jobs = []
        for seed in self.seeds:
            for training in {use.training.name: use.training for use in uses}.values():
                if training.name not in self._loaded:
                    recipe = self.scale.recipe(training, seed)
                    folder = self.out / "runs" / f"{training.name}-seed{seed}"
                    source, start = self._sources.role(training.role), self._starts.get(recipe.backbone)
                    jobs.append(TrainingJob(training, seed, recipe, folder, source, start))
        return jobs

    def _say_ahead(self, left: Sequence[TrainingJob], drawn: Sequence[str]) -> None:
        """Print the trainings that are left, and which figures are drawn."""
        if left:
            epochs = sum(job.recipe.epochs - len(job.seconds()) for job in left)
            self.console.print(
                f"Plan: {len(left)} of {len(self._jobs)} trainings are left: {epochs} epochs, "
                f"{trainings.said_left(left, self._jobs)} for one process. A second process with the same command shares them.",
                soft_wrap=True,
            )
            for job in left:
                done = len(job.seconds())
                begun = f", {done} epochs done" if done else ""
                steps, epochs = job.steps, job.recipe.epochs
                self.console.print(
                    f"  {job.name}: {epochs} epochs of {steps} updates, {epochs * steps:,} in all{begun}", markup=False,
                    highlight=False,
                )  # fmt: skip
            if self.scale.changes:
                changes = footnotes.changed(self.scale, [job.training for job in left])
                self.console.print(changes, markup=False, soft_wrap=True)
        if not self.train:
            there = {*self._loaded, *(job.training.name for job in self._jobs if job.done)}
            for name in drawn:
                self._say_lacking(name, [network.name for network in SHOWN[name] if network.name not in there])

    def _say_lacking(self, figure: str, lacking: Sequence[str]) -> None:
        if lacking:
            how = "not drawn" if len(lacking) == len(SHOWN[figure]) else "drawn with the others"
            self.console.print(
                f"{figure} {how}: there is no network {' or '.join(lacking)}; give it as --model {lacking[0]}=FILE, or train "
                "it.",
                markup=False, soft_wrap=True,
            )  # fmt: skip

    def _lacks_data(self, table: PaperTable, row: TableRow) -> str:
        """Say which data set a row lacks; empty if none."""
        trained = row.training is not None and row.training.name not in self.models
        return self._sources.lacking(table.measure, row.training.role if row.training and trained else None)

    def _reason(self, table: PaperTable, row: TableRow) -> str:
        """Say why a row cannot be made; empty if it can be, or is quoted."""
        if row.quoted:
            return ""
        if lacking := self._lacks_data(table, row):
            return lacking
        if row.training is None:
            backbone = self.scale.base.backbone
            return "" if backbone in self._starts else f"no --init has the weights of {backbone}"
        name = row.training.name
        jobs = [job for job in self._jobs if job.training.name == name]
        if name in self._loaded or any(job.done for job in jobs):
            return ""
        if self._is_copy(row.training):
            return "without train/google it would be the network of LPN"
        if all(job.diverged for job in jobs):
            return "its training diverged"
        return "" if self.train else f"no --model gives {name}, and --no-train trains none"

    def _is_copy(self, training: Training) -> bool:
        """Check whether a network would repeat the LPN, for lack of google pictures."""
        return training.name == "lpn-without-google" and not self._sources.role("places").has_google

    def _models(self, row: TableRow) -> dict[str, Model]:
        """Return the networks of a row by seed, or the given one."""
        if row.quoted:
            return {}
        if row.training is None:
            base = self.scale.base
            start = self._starts.get(base.backbone)
            return {} if start is None else {"given": pretrained.features_alone(base, start)}
        return self._networks(row.training.name)

    def _networks(self, name: str) -> dict[str, Model]:
        """Return the networks of a training by seed, or the given one."""
        if name in self._loaded:
            return {"given": self._loaded[name]}
        return {f"seed {job.seed}": lpn.load(job.model) for job in self._own(name)}

    def _own(self, name: str) -> list[TrainingJob]:
        return [job for job in self._jobs if job.training.name == name and job.done]

    def _table(self, table: PaperTable) -> list[Path]:
        data = self._data(table)
        rows: list[RowRecord] = []
        protocols: dict[str, str] = {}
        for row in table.rows:
            figures_of = {
                name: self._store.figures(row, table.measure, model, data, self.scale.released)
                for name, model in (self._models(row) if data else {}).items()
            }
            rows.append(self._row(table, row, figures_of))
            if figures_of:
                protocols[row.label] = next(iter(figures_of.values())).protocol
        columns, beside, alone = self._columns(table)
        title = table.title if table.measure == "landmarks" or not data else f"{table.title}, on {data[0].kind}"
        notes = [footnotes.protocol(protocols), *footnotes.about(table, data, self.scale), *self._of_networks(table)]
        record = TableRecord(table.key, title, columns, beside, tuple(rows), tuple(notes), alone)
        self._store.keep(record)
        return report.write(record, self.out)

    def _data(self, table: PaperTable) -> list[Source]:
        """Return the data sets that a table is measured on, none if they are not given."""
        return [] if self._sources.lacking(table.measure) else self._sources.of(table.measure)

    def _row(self, table: PaperTable, row: TableRow, figures_of: Mapping[str, MeasuredFigures]) -> RowRecord:
        trained: dict[str, Provenance] = {}
        if row.training is not None and row.training.name not in self._loaded:
            trained = {f"seed {job.seed}": job.made for job in self._own(row.training.name) if job.made}
        values = {name: figures.values for name, figures in figures_of.items()}
        made = {name: figures.made for name, figures in figures_of.items()}
        reason = "" if values else self._reason(table, row)
        return row_record(row.label, values, row.paper, row.note, trained, made, row.quoted, reason)

    def _columns(self, table: PaperTable) -> tuple[tuple[str, ...], tuple[int | None, ...], dict[int, str]]:
        """Return the measured columns, each with its column of the paper, and the paper's others."""
        data = self._data(table)
        if table.measure == "centre":
            return table.columns, (None,) * len(table.columns), {}
        if table.measure != "landmarks" or not data:
            # CVACT is not what the paper's Table II is of.
            same = not data or data[0].dataset.kind != "CVACT"
            return table.columns, tuple(index if same else None for index in range(len(table.columns))), {}
        of_kind = {"Oxford5k": LANDMARKS.index("Oxford mAP"), "Paris6k": LANDMARKS.index("Paris mAP")}
        beside = tuple(of_kind.get(source.dataset.kind) for source in data)
        alone = {index: title for index, title in enumerate(table.columns) if index not in beside}
        return tuple(f"{source.name} mAP" for source in data), beside, alone

    def _of_networks(self, table: PaperTable) -> list[str]:
        """Describe where the table's networks come from."""
        names = {row.training.name for row in table.rows if row.training}
        listed = [
            f"{n} = {self.models[n].name} ({self._loaded[n].describe()})" for n in sorted(names & set(self._loaded))
        ]
        notes = [f"Networks given: {', '.join(listed)}."] if listed else []
        notes += footnotes.networks([job for job in self._jobs if job.training.name in names], self.scale, self.seeds)
        of_places = table.measure in ("both ways", "centre") and self._data(table)
        if of_places and names - set(self._loaded) and not self._sources.role("places").has_google:
            notes.append("There is no train/google, so all networks are trained without it.")
        return notes

    def _figure(self, name: str) -> Path | None:
        """Draw a figure with the available networks, and return its file; None without any."""
        of = {network.name: networks for network in SHOWN[name] if (networks := self._networks(network.name))}
        if self.train:
            self._say_lacking(name, [network.name for network in SHOWN[name] if network.name not in of])
        if not of:
            return None
        dataset = self._sources.role(SHOWN[name][0].role).dataset
        drawn = [(network, next(iter(networks.values()))) for network, networks in of.items()]
        if name == "figure1":
            data = paper_figures.heatmaps(drawn, dataset, "drone", self.queries[:1], count=1)
        elif name == "figure7a":
            data = paper_figures.heatmaps(drawn, dataset, "drone", self.queries)
        elif name == "figure7b":
            data = paper_figures.heatmaps(drawn, dataset, "street")
        elif name == "figure8":
            data = paper_figures.retrievals(drawn[0][1], dataset, ("drone", "satellite"), self.queries)
        else:
            data = paper_figures.retrievals(drawn[0][1], dataset, ("street",), top=3)
        write_atomic(self.out / f"{name}.png", data)
        return self.out / f"{name}.png"
