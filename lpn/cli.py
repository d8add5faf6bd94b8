"""The `lpn` command. Each subcommand imports what it needs, so that those which can do without torch run without it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

import lpn
from lpn.errors import InputError, LPNError, MissingPackageError
from lpn.recipes import RECIPES, Recipe, method

if TYPE_CHECKING:
    from lpn.evaluate import Result
    from lpn.protocol import Protocol

DEMO = Path(__file__).parents[1] / "assets" / "demo"
"""The demo's data set and model, in a checkout."""
DEMO_QUERY = "0394/06"
"""What the demo opens with."""

MethodName = Literal[
    "lpn",
    "instance",
    "contrastive",
    "triplet-0.3",
    "triplet-0.5",
    "soft-margin",
    "lpn-cvusa",
    "lpn-strips",
    "safa",
    "safa-lpn",
]
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
    """Data set in University-1652's layout, of which the test split is shown; by default the demo."""
    model: Path | None = None
    """Trained LPN: .onnx (needs no torch), .safetensors, or a published .pth; by default the demo's, for the demo."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, to explore in place of a model's; needs --data."""
    n_parts: int | None = None
    """Parts that the descriptors in --saved consist of; 1 by default."""
    query: str | None = None
    """Name of the query to open with, as the picker shows it; by default the first."""
    host: str = "127.0.0.1"
    """Address to listen on; any other than 127.0.0.1 lets other machines in, without a password."""
    port: int = 8080
    """Port to listen on."""

    def run(self) -> None:
        from explorer.app import run, run_saved

        if self.saved is not None:
            if self.data is None or self.model is not None:
                raise InputError(
                    "A saved result is explored with its data set and without a model; give --saved and --data."
                )
            run_saved(self.data, self.saved, _parts_of(self.n_parts), self.query, self.host, self.port)
            return
        _only_saved(self.n_parts)
        if self.data is not None and self.model is None:
            raise InputError(f"There is no model for {self.data}; give a trained LPN with --model.")
        if self.data is None and not DEMO.is_dir():
            raise InputError(
                "The demo is not part of this installation; give a data set with --data and a model with --model."
            )
        query = DEMO_QUERY if self.data is None and self.query is None else self.query
        run(self.data or DEMO, self.model or DEMO / "lpn.onnx", query, self.host, self.port)


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
    """Parts that the descriptors in --saved consist of; 1 by default, and needed only with --parts."""
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
        from lpn.changes import Change
        from lpn.files import check_writable, write_whole
        from lpn.protocol import Protocol

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
        from lpn.evaluate import evaluate_saved
        from lpn.saved import load_saved

        if self.data is not None or self.model is not None or self.task is not None:
            raise InputError("A saved result is evaluated alone; leave --data, --model, and --task out.")
        opened = load_saved(saved, _parts_of(self.n_parts))
        return opened.name, evaluate_saved(opened, protocol)

    def _described(self, protocol: Protocol) -> tuple[str, Result]:
        from lpn.datasets import open_dataset
        from lpn.evaluate import evaluate

        _only_saved(self.n_parts)
        if self.data is None or self.model is None:
            raise InputError(
                "There is nothing to evaluate; give --data and --model, or a pytorch_result.mat with --saved."
            )
        model, dataset = lpn.load(self.model), open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "drone-to-satellite")
        title = f"{self.model.name} ({model.spec.describe()}) on {self.data.resolve().name}"
        return title, evaluate(model, dataset, task, protocol)


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
class Train:
    """Train an LPN by a named recipe, any number of which can be changed."""

    data: Path
    """Data set in University-1652's layout."""
    out: Path
    """Folder of the run: last.safetensors, best.safetensors, log.csv, tensorboard, and what --resume needs."""
    recipe: Literal["university1652", "cvusa", "safa", "small", "world"] = "university1652"
    """The paper's recipe for a data set, SAFA's, one for some hundred places, or the latter for pictures of all headings."""
    method: MethodName | None = None
    """One of the methods the paper compares, by default what the recipe says: lpn, the instance-loss baseline, the baseline
    by another loss, strips, or SAFA."""
    init: Path | None = None
    """Weights for the backbone (.safetensors or .pth, torchvision's names), loaded as far as they go."""
    resume: bool = False
    """Go on with the run in --out."""
    evaluate_every: int = 0
    """Test every so many epochs, and keep the best; 0 for the end only."""
    validate: float = 0.0
    """Share of the training places held out to choose the best epoch by; at 0 the test split chooses."""
    workers: int = 0
    """Threads that prepare pictures; 0 for what suits the machine. They change no result."""
    settings: tyro.conf.OmitArgPrefixes[Recipe] = field(default_factory=Recipe)

    def run(self) -> None:
        trainer = import_module("lpn.train").Trainer
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        group = import_module("lpn.distributed").join()
        run = group.together(
            lambda: trainer(
                dataset,
                self.out,
                self.settings,
                self.init,
                self.resume,
                self.evaluate_every,
                workers=self.workers,
                validate=self.validate,
                group=group,
            )
        )
        run.console.print(f"Recipe {self.recipe}: {self.settings.to_json()}")
        model = run.run()
        group.leave()
        if group.leads:
            print(f"The model is in {model}.")


@dataclass
class Export:
    """Write a .pth or .safetensors model as .onnx, which needs no torch."""

    model: Path
    """Trained LPN: .safetensors or .pth."""
    out: Path
    """File to write, ending in .onnx; views with weights of their own get files beside it."""
    storage: Literal["float32", "float16", "int8"] = "float32"
    """Of the weights in the file: float16 halves it, int8 takes it to about a third; all compute in float32."""

    def run(self) -> None:
        files = import_module("lpn.export").export(self.model, self.out, self.storage)
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")


@dataclass
class Describe:
    """Describe a folder of pictures into a store of descriptors on disk; resumable."""

    model: Path
    """Trained LPN: .onnx, .safetensors, or .pth."""
    images: Path
    """Folder of pictures, searched with all folders below it."""
    view: ViewName
    """The view the pictures show."""
    out: Path
    """Folder of the store."""
    precision: Literal["float32", "float16", "int8"] = "float32"
    """Numbers on disk; float16 halves the store, int8 quarters it."""

    def run(self) -> None:
        from lpn import features

        model = lpn.load(self.model)
        model.check_view(self.view)
        files = features.pictures_below(self.images)
        store = features.describe(model, files, self.view, self.out, root=self.images, precision=self.precision)
        shape = " x ".join(map(str, store.descriptors.shape))
        print(f"{self.out} holds {shape} numbers: pictures x parts x dimensions.")


@dataclass
class Doctor:
    """Say what a data set holds, what is broken in it, and what can be run; ends with status 1 where something is broken."""

    data: Path
    """Data set in any layout of docs/data.md."""
    quick: bool = False
    """Read the headers and ends of the pictures only, and do not decode them."""
    json: Path | None = None
    """File to write everything found to, with every name."""

    def run(self) -> int:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from lpn.datasets import open_dataset
        from lpn.doctor import examine, show
        from lpn.files import check_writable, write_whole

        if self.json is not None:
            check_writable(self.json)
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


@dataclass
class World:
    """Plan and render a fictional city as a data set with exact positions; resumable."""

    out: Path
    """Folder to write, in University-1652's layout, with world.json and geo.csv."""
    seed: int = 0
    """The city; the same seed and numbers give the same pictures."""
    buildings: int = 460
    """Places to take pictures of, about a third of them for testing."""
    views: int = 12
    """Drone pictures of each place, the last from straight above."""
    pixels: int = 256
    """Side of a drone picture."""
    tile_pixels: int = 512
    """Side of a satellite tile, which shows 160 m."""
    samples: int = 4
    """Light paths a pixel; more is slower and finer."""
    streets: int = 0
    """Street-level pictures of each place; can be raised in a world that is there."""
    panoramas: int = 0
    """Panoramas near each place, in cvusa/ with a tile around each; can be raised in a world that is there."""
    part: str = "1/1"
    """Share of the work, as i/k: k processes with the same --out render one world."""
    threads: int = 0
    """Processor threads; 0 for all."""

    def run(self) -> None:
        from lpn.world.atlas import Settings
        from lpn.world.build import Part, build_world

        settings = Settings(
            self.seed,
            self.buildings,
            self.views,
            self.pixels,
            self.tile_pixels,
            self.samples,
            self.streets,
            self.panoramas,
        )
        tally = build_world(settings, self.out, Part.parse(self.part), self.threads)
        print(f"{tally.describe()} The world is in {self.out}.")


@dataclass
class Reproduce:
    """Make the paper's tables and figures again; resumable."""

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """table1 to table6, figure5, figure7, figure8, or all."""
    data: tuple[str, ...]
    """Data set folders (University-1652, CVUSA, Oxford5k, Paris6k, or a rendered world), or the word world for the demo's."""
    out: Path = Path("runs/reproduce")
    """Folder for trainings, measurements, and the tables."""
    model: tuple[str, ...] = ()
    """Networks to use instead of training: FILE for the LPN, or ROW=FILE."""
    init: Path | None = None
    """ImageNet weights the backbones start from (.safetensors or .pth, torchvision's names)."""
    scale: Literal["auto", "paper", "reduced"] = "auto"
    """Size of networks and trainings; auto is reduced for a rendered world and the paper's for everything else."""
    seeds: tuple[int, ...] = (0,)
    """A training is made with each, and the mean reported."""
    epochs: int | None = None
    """Epochs of every training, where the scale's are not wanted."""
    backbone: Literal["resnet18", "resnet50", "vgg16_bn"] | None = None
    """Backbone of every training, where the scale's is not wanted."""
    train: bool = True
    """Train what is missing; otherwise such rows are left out."""
    queries: tuple[str, ...] = ()
    """Queries shown in figures 7 and 8, by name."""

    def run(self) -> None:
        import_module("torch")
        from lpn.reproduce.command import KEYS, Reproduction
        from lpn.reproduce.tables import SCALES
        from lpn.reproduce.world import is_world

        keys = KEYS if self.what == ("all",) else self.what
        for key in keys:
            if key not in KEYS:
                raise InputError(f"There is no {key!r} to reproduce; choose one of {', '.join(KEYS)}, or all.")
        worlds = any(given == "world" or is_world(Path(given)) for given in self.data)
        scale = SCALES[self.scale if self.scale != "auto" else "reduced" if worlds else "paper"]
        changes: dict[str, Any] = {"epochs": self.epochs} if self.epochs else {}
        if self.backbone:
            changes |= {"backbone": self.backbone, "last_layer": "layer4"}
        models = {name if rest else "": Path(rest or name) for name, _, rest in (m.partition("=") for m in self.model)}
        made = Reproduction(
            self.data, self.out, models, self.init, self.seeds, scale, changes, self.train, self.queries
        ).run(keys)
        print(f"Wrote {', '.join(file.name for file in made)} to {self.out}.")


COMMANDS: dict[str, type[Explore | Evaluate | Train | Export | Describe | Doctor | World | Reproduce]] = {
    "explore": Explore,
    "train": Train,
    "evaluate": Evaluate,
    "export": Export,
    "describe": Describe,
    "doctor": Doctor,
    "world": World,
    "reproduce": Reproduce,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 where doctor found damage, or 2 after an error the user can mend."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(_help())
        return 0
    if given[0] == "--version":
        print(lpn.__version__)
        return 0
    if given[0] not in COMMANDS:
        print(f"lpn has no command {given[0]!r}; it has {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    try:
        command = _parse(COMMANDS[given[0]], given[1:], f"lpn {given[0]}")
        return int(command.run() or 0)
    except LPNError as error:
        print(f"lpn: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(f"lpn: {_missing(error)}", file=sys.stderr)
        return 2
    except OSError as error:
        name = f" ({error.filename})" if error.filename else ""
        print(f"lpn: The system refused a file or device{name}: {error.strerror or error}.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lpn: stopped.", file=sys.stderr)
        return 130


def _parse(command: Callable[..., Any], arguments: list[str], program: str) -> Any:
    if command is not Train:
        return tyro.cli(command, args=arguments, prog=program)
    # The recipe and the method named decide what the other flags default to, so they are read first.
    name, chosen = (_given(arguments, flag) for flag in ("--recipe", "--method"))
    if name is not None and name not in RECIPES:
        raise InputError(f"There is no recipe {name!r}; choose one of {', '.join(RECIPES)}.")
    settings = RECIPES[name or "university1652"]
    if chosen is not None:
        settings = method(chosen, settings)
    named = Train(tyro.MISSING, tyro.MISSING, cast(Any, name or "university1652"), cast(Any, chosen), settings=settings)
    return tyro.cli(Train, args=arguments, prog=program, default=named)


def _given(arguments: Sequence[str], flag: str) -> str | None:
    """The value given to a flag, before the rest is parsed."""
    value = None
    for position, argument in enumerate(arguments):
        if argument.startswith(f"{flag}="):
            value = argument.partition("=")[2]
        elif argument == flag and position + 1 < len(arguments):
            value = arguments[position + 1]
    return value


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


_EXTRAS = {
    **dict.fromkeys(("torch", "onnx", "onnxscript", "safetensors", "yaml", "matplotlib", "tensorboardX"), "train"),
    "scipy": "data",
    **dict.fromkeys(("bpy", "mathutils"), "world"),
}
"""The extra that brings each package that the base installation has not."""


def _missing(error: ModuleNotFoundError) -> MissingPackageError:
    package = (error.name or "").split(".")[0]
    extra = _EXTRAS.get(package)
    wanted = f"lpn-explorer[{extra}]" if extra else "lpn-explorer"
    return MissingPackageError(f"This needs the package {error.name}, which is not installed; pip install '{wanted}'.")


def _help() -> str:
    lines = [f"  {name:10} {(command.__doc__ or '').strip()}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: lpn COMMAND [--help]",
            "",
            "LPN, the Local Pattern Network for cross-view geo-localization, and its explorer.",
            "",
            *lines,
            "",
            "lpn COMMAND --help lists the options of a command; lpn --version prints the version.",
        ]
    )


def run() -> None:
    """The console script."""
    sys.exit(main())


if __name__ == "__main__":
    run()
