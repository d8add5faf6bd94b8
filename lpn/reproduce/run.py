"""The work of `lpn reproduce`: train the networks of tables, measure them, and write the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import lpn
from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.core.files import check_writable, exclusive_lock, write_atomic
from lpn.core.texts import counted
from lpn.core.views import View, views_of
from lpn.drawing import network_figures
from lpn.models.base import Model
from lpn.models.spec import METHODS
from lpn.reproduce import figures, jobs, report
from lpn.reproduce.jobs import TrainingJob
from lpn.reproduce.measure import MeasurementStore, features_alone
from lpn.reproduce.record import RowRecord, TableRecord
from lpn.reproduce.sources import LAYOUTS, MEASURED_ON, TASKS, Source, open_sources
from lpn.reproduce.tables import DRAWN, SHOWN, DataRole, PaperTable, Scale, TableRow, Training, find, tables
from lpn.retrieval import transfer
from lpn.training.learner import network_spec
from lpn.training.run_folder import read_run
from lpn.training.trainer import check_single_process


@dataclass(frozen=True)
class NetworkUse:
    """A use of a network, by a row of a table or by a figure.

    Attributes:
        training: the network.
        used_by: the row or figure.
        views: the views that the network must describe.
        carried: whether its features are carried over to landmarks (Table VI).
    """

    training: Training
    used_by: str
    views: frozenset[View]
    carried: bool = False

    def check(self, available: Sequence[View], source: str) -> None:
        """Raise InputError if `source`, with the views `available`, lacks a needed view."""
        lacking = sorted(self.views - set(available))
        if lacking:
            raise InputError(f"{self.used_by} needs the view {lacking[0]}; {source} has {', '.join(available)}.")


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
        train: whether to train missing networks; otherwise their rows are not run.
        queries: queries shown in figures 7 and 8; Figures 1, 3, and 4 show the first.
        from_scratch: whether to train from random weights, without `init`.
        partial: whether a row may lack its data set, and then says so; otherwise its table is refused.
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

        Several processes may run in one folder; they share the trainings.

        Raises:
            LPNError: when data, models, or settings do not fit, before anything is trained.
        """
        check_single_process("lpn reproduce")
        check_writable(self.out / "measured.json")
        wanted, drawn = self._prepare(keys)
        if self.train:
            jobs.train(self._jobs, self.console)
        lock = self.out / ".tables"
        lock.mkdir(exist_ok=True)
        # A second process waits, and then finds all figures in measured.json.
        with exclusive_lock(lock, wait=True):
            self._store.reload()
            written = [self._table(table) for table in wanted]
            pictures = [file for name in drawn if (file := self._figure(name)) is not None]
            # Print last: an error of the terminal must not keep a file from being written.
            for files in written:
                self._say(files[0].read_text(encoding="utf-8"), wrap=True)
        return [file for files in written for file in files] + pictures

    def _say(self, text: str, wrap: bool = False) -> None:
        self.console.print(text, markup=False, highlight=False, soft_wrap=not wrap)

    def _prepare(self, keys: Sequence[str]) -> tuple[list[PaperTable], list[str]]:
        """Open data and networks, check everything, and print the plan; return the tables and the pictures to draw."""
        wanted = [find(key, self.scale) for key in keys if key in tables(self.scale) or key not in DRAWN]
        with exclusive_lock(self.out, wait=True):
            self._store = MeasurementStore(self.out / "measured.json")
            self._sources = open_sources(self.data)
        self._starts = jobs.by_backbone(self.init)
        drawn = self._drawn(keys)
        uses = self._uses(wanted, drawn)
        self._loaded = self._load(uses)
        self._check_data(wanted, drawn)
        self._jobs = self._planned(uses)
        starting = {job.recipe.backbone for job in self._jobs}
        if any(row.training is None and not row.quoted for table in wanted for row in table.rows):
            starting.add(self.scale.base.backbone)
        for backbone in self._starts.keys() - starting:
            self._say(
                f"{self._starts[backbone].name} of --init is not used: no requested row starts from a {backbone}."
            )
        for table in wanted:
            self._say(self._planned_rows(table))
        left = self._check_jobs(uses)
        self._print_plan(left, drawn)
        return wanted, drawn

    def _drawn(self, keys: Sequence[str]) -> list[str]:
        """Return the pictures to draw, and print those that lack their data set."""
        names = [name for key in keys for name in DRAWN.get(key, ())]
        absent: dict[DataRole, list[str]] = {}
        for name in names:
            if (role := SHOWN[name][0].role) not in self._sources:
                absent.setdefault(role, []).append(name)
        # Without places a figure is empty; without panoramas it lacks a part.
        if "places" in absent and not self.partial:
            raise InputError(f"{absent['places'][0]} needs {LAYOUTS['places']}; give them with --data.")
        for role, without in absent.items():
            self._say(f"{', '.join(without)} not drawn: no {role} are given with --data.")
        return [name for name in names if SHOWN[name][0].role in self._sources]

    def _uses(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> list[NetworkUse]:
        uses = []
        for name in drawn:
            for training in SHOWN[name]:
                ground: View = "drone" if training.role == "places" else "street"
                uses.append(NetworkUse(training, name, frozenset((ground, "satellite"))))
        for table in wanted:
            of_tasks = {view for task in TASKS[table.measure] for view in views_of(task)}
            for row in table.rows:
                if row.training and not self._lacks_data(table, row) and not self._is_copy(row.training):
                    views = frozenset({row.branch} if row.branch else of_tasks)
                    used_by = f"{table.title}, {row.label}"
                    uses.append(NetworkUse(row.training, used_by, views, table.measure == "landmarks"))
        return uses

    def _load(self, uses: Sequence[NetworkUse]) -> dict[str, Model]:
        """Load the given networks by training; InputError if one is not used, or replaces another kind."""
        known = sorted({training.name for table in tables(self.scale).values() for training in table.trainings})
        used = sorted({use.training.name for use in uses})
        for name, file in self.models.items():
            if name not in known:
                raise InputError(f"--model names {name!r}; the networks are called {', '.join(known)}.")
            if name not in used:
                raise InputError(
                    f"--model gives {file.name} as {name}, which no requested row uses; the rows use "
                    f"{', '.join(used) or 'no network'}, so name one of them, or leave it out."
                )
        loaded = {name: lpn.load(file) for name, file in self.models.items()}
        for use in uses:
            if (name := use.training.name) in loaded:
                use.check(loaded[name].views, self.models[name].name)
                self._check_fits(loaded[name], self.models[name], use)
                if self.scale.released and use.carried:
                    transfer.check_model(loaded[name])
        return loaded

    def _check_fits(self, model: Model, file: Path, use: NetworkUse) -> None:
        """Raise InputError if a given network is of another kind than the training; backbone and weights are free."""
        contract, name, recipe = model.contract, use.training.name, self.scale.recipe(use.training, 0)
        expected = network_spec(recipe, contract.views, 1).contract()
        if contract.method not in METHODS:
            raise InputError(f"{file.name} is {contract.method}, and {name} needs an LPN; give one, or leave it out.")
        compared = ["n_parts", "method", "input_size", "polar"]
        if recipe.n_parts > 1 and recipe.pooling == "average":
            compared.append("partitions")
        for what in compared:
            found, needed = (_shown(getattr(one, what)) for one in (contract, expected))
            if found != needed:
                raise InputError(
                    f"{file.name} has {what} {found}, and {name} needs {what} {needed} in {use.used_by}; give it under the name "
                    "of a network of the same kind, or leave it out. Without an opts.yaml beside it a .pth is read as 256 x 256; "
                    "--size changes the size of all networks whose table states none."
                )

    def _check_data(self, wanted: Sequence[PaperTable], drawn: Sequence[str]) -> None:
        for table in wanted:
            for row in table.rows:
                if not self.partial and not row.quoted and (lacking := self._lacks_data(table, row)):
                    raise InputError(
                        f"{table.title}: {lacking}; give them, or run lpn reproduce all, which leaves such rows out."
                    )
        for measure in dict.fromkeys(table.measure for table in wanted):
            for source in self._sources.get(MEASURED_ON[measure], ()):
                source.check(measure)
        for role in dict.fromkeys(SHOWN[name][0].role for name in drawn):
            (source,) = self._sources[role]
            source.check("both ways" if role == "places" else "ground")
            if role == "places":
                figures.named(source.dataset, "drone", self.queries)

    def _planned(self, uses: Sequence[NetworkUse]) -> list[TrainingJob]:
        trainings = {use.training.name: use.training for use in uses if use.training.name not in self._loaded}
        planned = []
        for seed, (name, training) in product(self.seeds, trainings.items()):
            recipe, source = self.scale.recipe(training, seed), self._sources[training.role][0]
            folder, start = self.out / "runs" / f"{name}-seed{seed}", self._starts.get(recipe.backbone)
            planned.append(TrainingJob(training, seed, recipe, folder, source, start))
        return planned

    def _check_jobs(self, uses: Sequence[NetworkUse]) -> list[TrainingJob]:
        """Check that trainings can run and their networks can be measured; return the remaining ones."""
        for job in self._jobs:
            job.check_same()
        left = [job for job in self._jobs if self.train and not job.ended]
        for job in (job for job in self._jobs if job.done or job in left):
            for use in uses:
                if use.training.name == job.training.name:
                    views = job.source.places(job.recipe.sets).views
                    use.check(views, f"{job.source.name}, on which {job.training.name} is trained,")
        # Computing the number of steps raises an error if the training cannot run.
        for job in left:
            _ = job.steps
        lacking: dict[str, dict[str, None]] = {}
        for job in left:
            if job.start is None:
                lacking.setdefault(job.recipe.backbone, {})[job.training.name] = None
        without = "; ".join(f"{backbone} for {', '.join(names)}" for backbone, names in lacking.items())
        if self.from_scratch and (files := sorted({job.start.name for job in left if job.start is not None})):
            raise InputError(f"--init ({', '.join(files)}) and --from-scratch exclude each other; give one of them.")
        if without and not self.from_scratch:
            raise InputError(
                f"Every recipe starts from a backbone trained on ImageNet, and no --init has the weights of {without}; give its "
                "weights with --init FILE, once for each backbone, or say --from-scratch to start all from random weights."
            )
        return left

    def _print_plan(self, left: Sequence[TrainingJob], drawn: Sequence[str]) -> None:
        """Print the remaining trainings, and the figures to draw."""
        if left:
            epochs = sum(job.recipe.epochs - job.epochs_done for job in left)
            self._say(
                f"Plan: {len(left)} of {len(self._jobs)} trainings are left: {counted(epochs, 'epoch')}. A second process with "
                "the same command shares them."
            )
            for job in left:
                steps, epochs = job.steps, job.recipe.epochs
                begun = f", {counted(job.epochs_done, 'epoch')} done" if job.epochs_done else ""
                begun = f"{counted(steps, 'update')}, {epochs * steps:,} in all{begun}"
                self._say(f"  {job.name}: {counted(epochs, 'epoch')} of {begun}")
            if self.scale.changes:
                self._say(report.changes_note(self.scale, [job.training for job in left]))
        if not self.train:
            there = {*self._loaded, *(job.training.name for job in self._jobs if job.done)}
            for name in drawn:
                self._say_lacking(name, [network.name for network in SHOWN[name] if network.name not in there])
        for backbone, start in {job.recipe.backbone: job.start for job in left}.items():
            self._say(f"{backbone} starts from {start.name if start else 'random weights'}.")

    def _say_lacking(self, figure: str, lacking: Sequence[str]) -> None:
        if lacking:
            how = "not drawn" if len(lacking) == len(SHOWN[figure]) else "drawn without some networks"
            self._say(
                f"{figure} {how}: there is no network {' or '.join(lacking)}; give it as --model {lacking[0]}=FILE, or train it."
            )

    def _lacks_data(self, table: PaperTable, row: TableRow) -> str:
        """Name the data set that a row lacks; empty if none."""
        roles = [MEASURED_ON[table.measure]]
        if row.training is not None and row.training.name not in self.models:
            roles.append(row.training.role)
        return next((f"no {LAYOUTS[role]} are given with --data" for role in roles if role not in self._sources), "")

    def _reason(self, table: PaperTable, row: TableRow) -> str:
        """Return the reason why a row cannot run; empty if it can, or is quoted."""
        if row.quoted:
            return ""
        if lacking := self._lacks_data(table, row):
            return lacking
        if row.training is None:
            backbone = self.scale.base.backbone
            return "" if backbone in self._starts else f"no --init has the weights of {backbone}"
        name = row.training.name
        ends = [job.ended for job in self._jobs if job.training.name == name]
        if name in self._loaded or "finished" in ends:
            return ""
        if self._is_copy(row.training):
            return "without train/google it would be the network of LPN"
        if all(end == "diverged" for end in ends):
            return "its training diverged"
        return "" if self.train else f"no --model gives {name}, and --no-train trains none"

    def _planned_rows(self, table: PaperTable) -> str:
        """Count the rows of a table that can run, and give the reasons of the others."""
        own = [row for row in table.rows if not row.quoted]
        quoted = len(table.rows) - len(own)
        lacking: dict[str, list[str]] = {}
        for row in own:
            lacking.setdefault(self._reason(table, row), []).append(row.label)
        text = f"{table.key}: {len(lacking.pop('', []))} of {len(own)} rows" + (
            f", and {quoted} quoted" if quoted else ""
        )
        for reason, labels in lacking.items():
            text += f"; {reason}" + (f" ({', '.join(labels)})" if len(labels) < len(own) else "")
        return text

    def _is_copy(self, training: Training) -> bool:
        """Return whether a network would repeat the LPN for lack of google pictures."""
        return training.name == "lpn-without-google" and not self._sources["places"][0].has_google

    def _models(self, row: TableRow) -> dict[str, Model]:
        """Return the networks of a row by seed, or the given one."""
        if row.training is not None:
            return self._networks(row.training.name)
        start = self._starts.get(self.scale.base.backbone)
        return {} if start is None or row.quoted else {"given": features_alone(self.scale.base, start)}

    def _networks(self, name: str) -> dict[str, Model]:
        """Return the networks of a training by seed, or the given one."""
        if name in self._loaded:
            return {"given": self._loaded[name]}
        return {f"seed {job.seed}": lpn.load(job.model) for job in self._own(name)}

    def _own(self, name: str) -> list[TrainingJob]:
        return [job for job in self._jobs if job.training.name == name and job.done]

    def _table(self, table: PaperTable) -> list[Path]:
        data = self._sources.get(MEASURED_ON[table.measure], [])
        rows: list[RowRecord] = []
        protocols: dict[str, str] = {}
        for row in table.rows:
            measured = {
                name: self._store.figures(row, table.measure, model, data, self.scale.released)
                for name, model in (self._models(row) if data else {}).items()
            }
            if measured:
                protocols[row.label] = next(iter(measured.values())).protocol
            own = self._own(row.training.name) if row.training is not None else []
            trained = {f"seed {job.seed}": run.made for job in own if (run := read_run(job.folder)) is not None}
            values = {name: of.values for name, of in measured.items()}
            made = {name: of.made for name, of in measured.items()}
            reason = "" if measured else self._reason(table, row)
            rows.append(RowRecord(row.label, values, row.paper, row.note, row.quoted, trained, made, reason))
        columns, beside, alone = _columns(table, data)
        title = table.title if table.measure == "landmarks" or not data else f"{table.title}, on {data[0].kind}"
        below = [
            report.protocol_note(protocols),
            *report.data_notes(table, data, self.scale),
            *self._of_networks(table),
        ]
        record = TableRecord(table.key, title, columns, beside, tuple(rows), tuple(below), alone)
        self._store.keep(record)
        return report.write(record, self.out)

    def _of_networks(self, table: PaperTable) -> list[str]:
        """Describe the origin of the table's networks."""
        names = {row.training.name for row in table.rows if row.training}
        given = [
            f"{n} = {self.models[n].name} ({self._loaded[n].describe()})" for n in sorted(names & set(self._loaded))
        ]
        said = [f"Networks given: {', '.join(given)}."] if given else []
        said += report.network_notes([job for job in self._jobs if job.training.name in names], self.scale, self.seeds)
        places = self._sources.get("places", []) if MEASURED_ON[table.measure] == "places" else []
        if places and names - set(self._loaded) and not places[0].has_google:
            said.append("There is no train/google, so all networks are trained without it.")
        return said

    def _figure(self, name: str) -> Path | None:
        """Draw a figure with the available networks, and return its file; None without any."""
        of = {network.name: networks for network in SHOWN[name] if (networks := self._networks(network.name))}
        if self.train:
            self._say_lacking(name, [network.name for network in SHOWN[name] if network.name not in of])
        if not of:
            return None
        role = SHOWN[name][0].role
        dataset, places = self._sources[role][0].dataset, role == "places"
        drawn = [(network, next(iter(networks.values()))) for network, networks in of.items()]
        first, queries = drawn[0][1], self.queries if places else ()
        if name.startswith("figure8"):
            views: tuple[View, ...] = ("drone", "satellite") if places else ("street",)
            data = figures.retrievals(first, dataset, views, queries, 5 if places else 3)
        elif name in ("figure3", "figure4"):
            draw = network_figures.network if name == "figure3" else network_figures.partitions
            data = draw(first, figures.described(first, dataset, queries))
        else:
            one = name == "figure1"
            shown = queries[:1] if one else queries
            data = figures.heatmaps(drawn, dataset, "drone" if places else "street", shown, 1 if one else 4)
        write_atomic(self.out / f"{name}.png", data)
        return self.out / f"{name}.png"


def _shown(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{view} {partition.kind}" for view, partition in value.items())
    return " x ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _columns(
    table: PaperTable, data: Sequence[Source]
) -> tuple[tuple[str, ...], tuple[int | None, ...], dict[int, str]]:
    """Return the measured columns, each with its column of the paper, and the paper's other columns."""
    count = range(len(table.columns))
    if table.measure == "landmarks" and data:
        beside = tuple({"Oxford5k": 0, "Paris6k": 1}.get(source.dataset.kind) for source in data)
        alone = {index: table.columns[index] for index in count if index not in beside}
        return tuple(f"{source.name} mAP" for source in data), beside, alone
    # CVACT is not the data of the paper's Table II, and Figure 7 has no numbers.
    same = table.measure != "centre" and not (data and data[0].dataset.kind == "CVACT")
    return table.columns, tuple(index if same else None for index in count), {}
