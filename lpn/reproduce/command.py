"""`lpn reproduce`: trains what a table needs, measures it, and writes the table."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

import lpn
from lpn.datasets import Dataset, open_dataset
from lpn.errors import InputError
from lpn.files import check_writable, write_whole
from lpn.model import Model
from lpn.reproduce import pictures, report, runs, world
from lpn.reproduce.measure import Notebook
from lpn.reproduce.paper import Values
from lpn.reproduce.tables import SCALES, Role, Row, Scale, Table, find, tables
from lpn.spec import ModelSpec

_SHOWN = {"figure7": ("instance", "lpn"), "figure8": ("lpn",)}
"""The trainings of Table I that each drawn figure shows."""
_APART = {
    "table2": ("SAFA and SAFA + LPN are described without their mirror.",),
    "table4": ("Queries are turned counter-clockwise by the degrees named, on their own canvas, corners black.",),
    "table5": ("The parts named, counted from the centre, are compared and no others.",),
    "table6": ("Both sides are described by the branch named; ImageNet alone: the mean over the last feature map.",),
}
"""In what the rows' protocols differ from the first one's."""
KEYS = (*tables(SCALES["paper"]), *_SHOWN)
"""Everything that can be reproduced."""


@dataclass
class Reproduction:
    """One call of `lpn reproduce`.

    Args:
        data: data set folders, or "world".
        out: folder for runs, measurements, and tables.
        models: networks given, by row label, training name, or "" for the one LPN.
        init: weights the backbones start from.
        seeds: a training of each is made, and their mean is reported.
        scale: of `SCALES`.
        changes: of the recipe, for every row alike.
        train: train what is missing; otherwise such rows are not run.
        queries: queries shown in figures 7 and 8.
    """

    data: Sequence[str]
    out: Path
    models: Mapping[str, Path]
    init: Path | None
    seeds: Sequence[int]
    scale: Scale
    changes: Mapping[str, Any]
    train: bool = True
    queries: Sequence[str] = ()
    console: Console = field(default_factory=Console)

    def run(self, keys: Sequence[str]) -> list[Path]:
        """Make the tables and figures named and return the files written.

        Raises:
            LPNError: when data, models, or settings do not fit.
        """
        check_writable(self.out / "measured.json")
        self._open()
        wanted = [find(key, self.scale) for key in keys if key not in _SHOWN]
        drawn = [key for key in keys if key in _SHOWN]
        self._check(wanted, drawn)
        self._jobs = runs.jobs(self._missing(wanted, drawn), self.seeds, self.scale, self.changes, self.out)
        if self.train:
            runs.train(self._jobs, self._roles, self.init, self.console)
        written: list[Path] = []
        for table in wanted:
            files = self._table(table)
            self.console.print(files[0].read_text(), markup=False)
            written += files
        for key in drawn:
            written.append(self._figure(key))
        return written

    def _open(self) -> None:
        """Sort the data sets by what they are good for."""
        self._roles: dict[Role, Dataset] = {}
        self._landmarks: list[Dataset] = []
        self._worlds = False
        for given in self.data:
            root = Path(given)
            if given == "world" and not root.is_dir():
                root = _rendered(self.out)
            if world.is_world(root):
                self._worlds = True
                made = world.prepare(root, self.out / "data")
                self._roles |= {"places": open_dataset(made["places"]), "panoramas": open_dataset(made["panoramas"])}
                self._landmarks.append(open_dataset(made["landmarks"]))
                continue
            dataset = open_dataset(root)
            if "street-to-street" in dataset.tasks():
                self._landmarks.append(dataset)
            else:
                self._roles["panoramas" if dataset.panoramas else "places"] = dataset

    def _check(self, wanted: Sequence[Table], drawn: Sequence[str]) -> None:
        for table in wanted:
            if table.measure == "both ways" and "places" not in self._roles:
                raise InputError(f"{table.title} needs places as in University-1652; give them with --data.")
            if table.measure == "ground" and "panoramas" not in self._roles:
                raise InputError(f"{table.title} needs panoramas and tiles as in CVUSA; give them with --data.")
            if table.measure == "landmarks" and not self._landmarks:
                raise InputError(f"{table.title} needs landmarks as in Oxford5k or Paris6k; give them with --data.")
        if drawn and "places" not in self._roles:
            raise InputError(f"{', '.join(drawn)} needs places as in University-1652; give them with --data.")
        known = {row.label for table in wanted for row in table.rows} | {""}
        known |= {row.training.name for table in wanted for row in table.rows if row.training} | {"lpn", "instance"}
        unknown = sorted(set(self.models) - known)
        if unknown:
            raise InputError(f"--model names {unknown[0]!r}; the rows are {', '.join(sorted(known - {''}))}.")

    def _missing(self, wanted: Sequence[Table], drawn: Sequence[str]) -> list[Any]:
        """The trainings that no given model stands for."""
        needed = {training.name: training for table in wanted for training in table.trainings}
        names = {name for key in drawn for name in _SHOWN[key]}
        needed |= {
            training.name: training for training in find("table1", self.scale).trainings if training.name in names
        }
        rows = [row for table in wanted for row in table.rows if row.training]
        given = {row.training.name for row in rows if row.training and self._given(row)}
        given |= {name for name in needed if name in self.models or (name == "lpn" and "" in self.models)}
        return [training for name, training in needed.items() if name not in given]

    def _given(self, row: Row) -> Path | None:
        name = row.training.name if row.training else ""
        fallback = self.models.get("") if name == "lpn" else None
        return self.models.get(row.label) or self.models.get(name) or fallback

    def _models(self, row: Row) -> list[Model]:
        """The networks of a row: the one given, or one for each seed."""
        if row.training is None:
            if self.init is None:
                return []
            recipe = self.scale.places
            spec = ModelSpec(recipe.backbone, recipe.last_layer, input_size=recipe.input_size)
            return [runs.imagenet_features(spec, self.init)]
        given = self._given(row)
        if given is not None:
            return [lpn.load(given)]
        return [lpn.load(job.model) for job in self._jobs if job.training.name == row.training.name and job.done]

    def _table(self, table: Table) -> list[Path]:
        notebook = Notebook(self.out / "measured.json")
        data, columns = self._measured_on(table)
        measured: dict[str, list[Values]] = {}
        protocols: dict[str, None] = {}
        for row in table.rows:
            found = [notebook.figures(row, table.measure, model, data) for model in self._models(row)]
            if found:
                measured[row.label] = [figures.values for figures in found]
                protocols[found[0].protocol] = None
        foot = [*(list(protocols)[:1] or ["Nothing was measured."]), *_APART.get(table.key, ()), *self._foot(table)]
        return report.write(table, measured, columns, foot, self.out)

    def _measured_on(self, table: Table) -> tuple[list[Dataset], tuple[str, ...]]:
        if table.measure == "landmarks":
            return self._landmarks, tuple(f"{self._name(dataset)} mAP" for dataset in self._landmarks)
        role: Role = "places" if table.measure == "both ways" else "panoramas"
        return [self._roles[role]], table.columns

    def _name(self, dataset: Dataset) -> str:
        return "World" if self._worlds else dataset.root.resolve().name

    def _foot(self, table: Table) -> list[str]:
        """What a reader must know of how the figures came about."""
        said: list[str] = []
        if self._worlds:
            said.append(
                "**Data: the rendered world, not the paper's data sets**; its figures compare with one another only."
            )
        else:
            said.append(f"Data: {', '.join(dataset.root.resolve().name for dataset in self._measured_on(table)[0])}.")
        if self.models:
            said.append(f"Models given: {', '.join(sorted({path.name for path in self.models.values()}))}.")
        if any(row.training and not self._given(row) for row in table.rows):
            said.append(self.scale.said)
            if self.changes:
                said.append(f"Changed: {', '.join(f'{name} = {value}' for name, value in self.changes.items())}.")
            if len(self.seeds) > 1:
                said.append(
                    f"Mean of {len(self.seeds)} seeds, ± half of the distance between the lowest and the highest."
                )
        return said

    def _figure(self, key: str) -> Path:
        table = find("table1", self.scale)
        of = {row.training.name: self._models(row) for row in table.rows if row.training}
        missing = [name for name in _SHOWN[key] if not of[name]]
        if missing:
            raise InputError(
                f"{key} needs the network {missing[0]}; give it with --model {missing[0]}=FILE, or train it."
            )
        places = self._roles["places"]
        if key == "figure7":
            both = [("baseline", of["instance"][0]), ("LPN", of["lpn"][0])]
            data = pictures.heatmaps(both, places, self.queries)
        else:
            data = pictures.retrievals(of["lpn"][0], places, self.queries)
        write_whole(self.out / f"{key}.png", data)
        return self.out / f"{key}.png"


def _rendered(out: Path) -> Path:
    """The demo's world with street pictures and panoramas, rendered in `out`/world where Blender's package is there."""
    root = out / "world"
    if importlib.util.find_spec("bpy") is None:
        if not world.is_world(root):
            raise InputError(
                f"There is no rendered world in {root}, and rendering one needs the package bpy: pip install "
                "'lpn-explorer[world]', or give a world's folder with --data."
            )
        return root
    from lpn.world.atlas import Settings
    from lpn.world.build import Part, build_world

    build_world(Settings(0, 460, 8, 256, 384, 4, 4, 1), root, Part.parse("1/1"), 0)
    return root
