"""Commands that use a trained model or a data set as it is: explore, evaluate, doctor."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import lpn
from lpn.core.errors import InputError

if TYPE_CHECKING:
    from lpn.retrieval.evaluate import Result
    from lpn.retrieval.protocol import Protocol

DEMO = Path(__file__).parents[2] / "assets" / "demo"
"""The demo's data set and model, in a checkout."""
DEMO_QUERY = "0394/06"
"""What the demo opens with."""

ViewName = Literal["satellite", "street", "drone"]
TaskName = Literal[
    "drone-to-satellite",
    "satellite-to-drone",
    "street-to-satellite",
    "satellite-to-street",
    "drone-to-street",
    "street-to-drone",
    "street-to-street",
]


@dataclass
class Explore:
    """Open the explorer in a browser."""

    data: Path | None = None
    """Data set in any layout of docs/data.md, of which the test split is shown; by default the demo."""
    model: Path | None = None
    """Trained LPN: .onnx (needs no torch), .safetensors, or a published .pth; by default the demo's, for the demo."""
    beside: Path | None = None
    """Another trained LPN, to compare with on every query (Y, then Two models): of other parts, or before more training."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, to explore in place of a model's; needs --data."""
    n_parts: int | None = None
    """Parts that the descriptors in --saved consist of; 1 by default."""
    query: str | None = None
    """Name of the query to open with, as the picker shows it; by default the first."""
    host: str = "127.0.0.1"
    """Address to listen on; any other than 127.0.0.1 lets other machines in, who need the token in the link that is printed."""
    port: int = 8080
    """Port to listen on."""
    token: str | None = None
    """Token to ask for, of 12 characters or more; others see it in the list of processes, so better set LPN_TOKEN to it."""
    ask_token: bool = False
    """Ask for a token on 127.0.0.1 too, where other users of this machine could come in otherwise."""
    allow_host: tuple[str, ...] = ()
    """Further names the page is opened by, such as that of a reverse proxy (docs/serving.md)."""

    def run(self) -> None:
        from explorer.app import run, run_saved
        from explorer.server.auth import entry

        door = entry(self.host or "0.0.0.0", self.token, self.ask_token, self.allow_host)
        if self.saved is not None:
            if self.data is None or self.model is not None or self.beside is not None:
                raise InputError(
                    "A saved result is explored with its data set and without a model; give --saved and --data."
                )
            run_saved(self.data, self.saved, _parts_of(self.n_parts), self.query, self.host, self.port, door)
            return
        _only_saved(self.n_parts)
        if self.data is not None and self.model is None:
            raise InputError(f"There is no model for {self.data}; give a trained LPN with --model.")
        if self.data is None and not DEMO.is_dir():
            raise InputError(
                "The demo is not part of this installation; give a data set with --data and a model with --model."
            )
        query = DEMO_QUERY if self.data is None and self.query is None else self.query
        run(self.data or DEMO, self.model or DEMO / "lpn.onnx", query, self.host, self.port, self.beside, door)


@dataclass
class Evaluate:
    """Recall and AP on the test split, by the published protocol, or of a saved result."""

    data: Path | None = None
    """Data set; see docs/evaluation.md for the kinds."""
    model: Path | None = None
    """Trained LPN: .onnx, .safetensors, or .pth."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, in place of --data and --model."""
    n_parts: int | None = None
    """Parts that the descriptors in --saved consist of; needed with --parts and --average-queries, else 1 will do."""
    task: TaskName | None = None
    """Which view is the query and which the gallery; by default the first that the data set offers."""
    rotate: float = 0.0
    """Degrees counter-clockwise each query is turned first (Table IV)."""
    shift: int = 0
    """Pixels of the network's input each query is moved to the right, black at its left; negative: to the left."""
    scale: float = 1.0
    """Factor each query is zoomed by about its centre; below 1 with black around it."""
    parts: str | None = None
    """Parts to use, from 1, such as 1,2 (Table V); all by default."""
    branch: ViewName | None = None
    """Branch of the model that describes both queries and gallery (Table VI); by default each view's own."""
    average_queries: bool = False
    """Average all query pictures of a place into one query."""
    whole: bool = False
    """Describe queries whole where the data set marks a part of them (Oxford5k, Paris6k)."""
    json: Path | None = None
    """File to write the figures to."""

    def run(self) -> None:
        from lpn.core.files import check_writable, write_whole
        from lpn.descriptors.transforms import Change
        from lpn.retrieval.protocol import Protocol

        if self.json is not None:
            check_writable(self.json)
        parts = _numbers(self.parts)
        protocol = Protocol(
            Change(self.rotate, self.shift, self.scale),
            None if parts is None else tuple(parts),
            self.branch,
            self.average_queries,
            self.whole,
        )
        title, result = self._saved(self.saved, protocol) if self.saved else self._described(protocol)
        _print_result(title, result)
        if self.json is not None:
            write_whole(self.json, (json.dumps(result.to_dict(), indent=1) + "\n").encode())

    def _saved(self, saved: Path, protocol: Protocol) -> tuple[str, Result]:
        from lpn.retrieval.evaluate import evaluate_saved
        from lpn.retrieval.published_results import load_saved

        if self.data is not None or self.model is not None or self.task is not None:
            raise InputError("A saved result is evaluated alone; leave --data, --model, and --task out.")
        if protocol.average and self.n_parts is None:
            raise InputError(
                "Each part of averaged queries is normalised, and a saved result does not say of how many its descriptors "
                "consist; give their number with --n-parts (1 for a baseline)."
            )
        opened = load_saved(saved, _parts_of(self.n_parts))
        return opened.name, evaluate_saved(opened, protocol)

    def _described(self, protocol: Protocol) -> tuple[str, Result]:
        from lpn.datasets import open_dataset
        from lpn.descriptors import reader
        from lpn.retrieval.evaluate import evaluate

        _only_saved(self.n_parts)
        if self.data is None or self.model is None:
            raise InputError(
                "There is nothing to evaluate; give --data and --model, or a pytorch_result.mat with --saved."
            )
        model, dataset = lpn.load(self.model), open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "drone-to-satellite")
        title = f"{self.model.name} ({model.describe()}) on {self.data.resolve().name}"
        return title, evaluate(model, dataset, task, protocol, reader(dataset.root))


def _print_result(title: str, result: Result) -> None:
    """A table of the figures, and under it how they were measured."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    figures = {**{f"recall@{k}": value for k, value in result.recall.items()}, "ap": result.ap}
    facts = {"task": result.task, "queries": str(result.queries), "gallery": str(result.gallery)}
    for name in (*facts, *figures):
        table.add_column(name, justify="right")
    table.add_row(*facts.values(), *(f"{value:.2f}" for value in figures.values()))
    console = Console(width=max(120, Console().width))
    console.print(table)
    console.print(result.said)
    if near := result.distances():
        shares = ", ".join(f"{value:.1f} % {key}" for key, value in near.items() if key.startswith("within"))
        console.print(f"Error of the top match: median {near['median error m']:.1f} m; {shares} (geo.csv).")


@dataclass
class Doctor:
    """Say what this machine lacks, or, of a data set, what it holds and what is broken; ends with status 1 at damage."""

    data: Path | None = None
    """Data set in any layout of docs/data.md; without it, machine, packages, and demo are looked at."""
    quick: bool = False
    """Read the headers and ends of the pictures only, and do not decode them."""
    json: Path | None = None
    """File to write everything found to, with every name."""

    def run(self) -> int:
        from lpn.core.files import check_writable, write_whole

        if self.json is not None:
            check_writable(self.json)
        if self.data is None:
            return self._machine()  # which needs no package

        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from lpn.datasets import open_dataset
        from lpn.doctor.dataset_check import examine, show

        console = Console(width=max(120, Console().width))
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("Reading pictures", total=None)
            dataset = open_dataset(self.data)
            report = examine(dataset, not self.quick, lambda done, of: bar.update(task, completed=done, total=of))
        show(report, console)
        if self.json is not None:
            write_whole(self.json, (json.dumps(report.to_dict(), indent=1) + "\n").encode())
        return 0 if report.healthy else 1

    def _machine(self) -> int:
        from lpn.core.files import write_whole
        from lpn.doctor import environment_check

        if self.quick:
            raise InputError("--quick is about the pictures of a data set; give one with --data.")
        findings = []
        for finding in environment_check.look(DEMO):
            findings.append(finding)
            print(finding.line, flush=True)
        healthy = environment_check.healthy(findings)
        print("Nothing that is needed is broken." if healthy else "Something is broken: see the problems above.")
        if self.json is not None:
            write_whole(self.json, (json.dumps(environment_check.to_dict(findings), indent=1) + "\n").encode())
        return 0 if healthy else 1


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The parts are {text!r}; expected numbers from 1, such as 1,2.") from error


def _parts_of(n_parts: int | None) -> int:
    """The number of parts of a saved result."""
    if n_parts is not None and n_parts < 1:
        raise InputError(f"The number of parts is {n_parts}; expected 1 or more.")
    return n_parts or 1


def _only_saved(n_parts: int | None) -> None:
    if n_parts is not None:
        raise InputError(
            "A model knows its number of parts; give --n-parts with --saved only, or choose parts with --parts."
        )
