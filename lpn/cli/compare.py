"""The command compare: several models on the same queries and gallery."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

import lpn
from lpn.core.resources import ProviderName
from lpn.core.views import TaskName
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from rich.console import Console

    from lpn.analysis.model_table import ModelTable


@dataclass
class CompareCommand:
    """Compare two or more models on the same queries and gallery: figures with intervals, and paired tests."""

    models: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Models (.onnx, .safetensors, .pth), or results of the published test code (pytorch_result.mat)."""
    data: Path
    """Data set in any layout of docs/data.md."""
    task: TaskName | None = None
    """Views of query and gallery; by default the first task of the data set."""
    gallery: Literal["full", "without-distractors"] = "full"
    """The gallery that all of them rank: full (as LPN and FSRA do), or without-distractors (as Sample4Geo and DAC do)."""
    calibrate: bool = False
    """Rank with each model calibrated on the pictures without labels as well (docs/evaluation.md); a row of its own."""
    csls: int = 0
    """Rank with each model, calibrated if --calibrate is given, by CSLS over this many nearest queries as well, such as 3
    (docs/evaluation.md); a row of its own. 0 for none."""
    seed: int = 0
    """Seed of the bootstrap."""
    resamples: int = 1000
    """Number of bootstrap resamples."""
    kind: tuple[Kind | Literal["auto"], ...] = ()
    """Method of each model in their order: auto, or, for a published .pth whose entries do not tell it, such as dac; by default
    auto for all (docs/models.md)."""
    provider: ProviderName = "auto"
    """Provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, tensorrt."""
    markdown: Path | None = None
    """File to write the tables to, as Markdown."""
    csv: Path | None = None
    """File to write one line a model to."""
    json: Path | None = None
    """File to write everything to, as JSON."""

    def run(self) -> None:
        from lpn.analysis.model_table import compare, rank_model, rank_saved
        from lpn.core.consoles import wide_console
        from lpn.core.errors import InputError
        from lpn.core.files import check_writable, distinct_names, write_atomic, write_json
        from lpn.datasets import open_dataset
        from lpn.descriptors import descriptor_reader
        from lpn.retrieval.published_results import load_saved

        for file in filter(None, (self.markdown, self.csv, self.json)):
            check_writable(file)
        if self.csls < 0:
            raise InputError(f"--csls is {self.csls}; expected a number of nearest queries, such as 3, or 0.")
        if not self.models or (len(self.models) < 2 and not self.calibrate and not self.csls):
            raise InputError(
                f"A comparison takes two models or more, or one with --calibrate or --csls; found {len(self.models)}."
            )
        if self.kind and len(self.kind) != len(self.models):
            raise InputError(
                f"There are {len(self.kind)} kinds for {len(self.models)} models; give one for each in their order, or auto."
            )
        saved = [file.name for file in self.models if file.suffix.lower() == ".mat"]
        if saved and (self.calibrate or self.csls):
            raise InputError(
                f"{saved[0]} holds descriptors, not pictures, so it can be neither calibrated nor ranked anew; leave it, or "
                "--calibrate and --csls, out."
            )
        kinds: list[Kind | None] = [None if kind == "auto" else kind for kind in self.kind]
        kinds = kinds or [None] * len(self.models)
        dataset = open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "drone-to-satellite")
        ranked = []
        for file, name, kind in zip(self.models, distinct_names(self.models), kinds, strict=True):
            if file.suffix.lower() == ".mat":
                if kind is not None:
                    raise InputError(f"{name} holds descriptors and needs no kind; give auto in place of {kind}.")
                ranked.append(rank_saved(load_saved(file), name, dataset, task, self.gallery))
            else:
                model = lpn.load(file, self.provider, kind=kind)
                read = descriptor_reader(dataset.root)
                rows = {name: (False, 0)}
                if self.calibrate:
                    rows[f"{name}, calibrated"] = (True, 0)
                if self.csls:
                    rows[f"{list(rows)[-1]}, CSLS"] = (self.calibrate, self.csls)
                ranked += [
                    rank_model(model, title, dataset, task, self.gallery, read, calibrated, neighbours)
                    for title, (calibrated, neighbours) in rows.items()
                ]
        found = compare(ranked, self.seed, self.resamples)
        _print(found, wide_console())
        if self.markdown is not None:
            write_atomic(self.markdown, found.to_markdown().encode())
        if self.csv is not None:
            write_atomic(self.csv, found.to_csv())
        if self.json is not None:
            write_json(self.json, found.to_dict())


def _print(found: ModelTable, console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=f"{found.task}, {found.gallery_name}")
    names = list(found.figures[0])
    for name in ("model", *names):
        table.add_column(name, justify="left" if name == "model" else "right")
    for one, figures in zip(found.models, found.figures, strict=True):
        table.add_row(Text(one.name), *map(str, figures.values()))
    tests = Table(title="Queries that only one of two models finds first")
    for name in ("A", "B", "only A", "only B", "both", "neither", "p"):
        tests.add_column(name, justify="left" if name in "AB" else "right")
    for test in found.tests:
        counts = (test.only_first, test.only_second, test.both, test.neither)
        tests.add_row(Text(test.first), Text(test.second), *map(str, counts), f"{test.p:.3g}")
    console.print(table, tests)
    console.print(found.sentence, markup=False, highlight=False)
