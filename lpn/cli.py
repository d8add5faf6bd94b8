"""The `lpn` command. Each subcommand imports what it needs, so that those which can do without torch run without it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast

import tyro

import lpn
from lpn.errors import InputError, LPNError, MissingPackageError
from lpn.recipes import RECIPES, Recipe

DEMO = Path(__file__).parents[1] / "assets" / "demo"
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
]


@dataclass
class Explore:
    """Open the explorer in a browser."""

    data: Path | None = None
    """Data set in University-1652's layout, of which the test split is shown; by default the demo."""
    model: Path | None = None
    """Trained LPN: .onnx (needs no torch), .safetensors, or a published .pth; by default the demo's, for the demo."""
    query: str | None = None
    """Name of the query to open with, as the picker shows it; by default the first."""
    host: str = "127.0.0.1"
    """Address to listen on; any other than 127.0.0.1 lets other machines in, without a password."""
    port: int = 8080
    """Port to listen on."""

    def run(self) -> None:
        from explorer.app import run

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
    """Recall and AP on the test split, by the published protocol."""

    data: Path
    """Data set in University-1652's layout."""
    model: Path
    """Trained LPN: .onnx, .safetensors, or .pth."""
    task: TaskName = "drone-to-satellite"
    """Which view is the query and which the gallery."""
    rotate: float = 0.0
    """Degrees counter-clockwise each query is turned first (Table IV)."""
    parts: str | None = None
    """Parts to use, from 1, such as 1,2 (Table V); all by default."""
    json: Path | None = None
    """File to write the figures to."""

    def run(self) -> None:
        from rich.console import Console
        from rich.table import Table

        from lpn.datasets import open_dataset
        from lpn.evaluate import PROTOCOL, evaluate
        from lpn.files import check_writable, write_whole

        if self.json is not None:
            check_writable(self.json)
        model = lpn.load(self.model)
        result = evaluate(model, open_dataset(self.data), self.task, self.rotate, _numbers(self.parts))
        values = result.to_dict()
        table = Table(title=f"{self.model.name} ({model.spec.describe()}) on {self.data.resolve().name}")
        shown = [key for key in values if key.startswith("recall") or key == "ap"]
        for name in ("task", "rotate", "parts", "queries", "gallery", *shown):
            table.add_column(name, justify="right")
        parts = ",".join(map(str, result.parts))
        row = [self.task, f"{self.rotate:g}", parts, str(result.queries), str(result.gallery)]
        table.add_row(*row, *(f"{values[key]:.2f}" for key in shown))
        console = Console(width=max(120, Console().width))
        console.print(table)
        console.print(PROTOCOL)
        if near := result.distances():
            shares = ", ".join(f"{value:.1f} % {key}" for key, value in near.items() if key.startswith("within"))
            console.print(f"Error of the top match: median {near['median error m']:.1f} m; {shares} (geo.csv).")
        if self.json is not None:
            write_whole(self.json, (json.dumps(values, indent=1) + "\n").encode())


@dataclass
class Train:
    """Train an LPN by a named recipe, any number of which can be changed."""

    data: Path
    """Data set in University-1652's layout."""
    out: Path
    """Folder of the run: last.safetensors, best.safetensors, log.csv, tensorboard, and what --resume needs."""
    recipe: Literal["university1652", "small", "world"] = "university1652"
    """The paper's recipe, one for some hundred places, or the latter for drone pictures of all headings."""
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


COMMANDS: dict[str, type[Explore | Evaluate | Train | Export | Describe | World]] = {
    "explore": Explore,
    "train": Train,
    "evaluate": Evaluate,
    "export": Export,
    "describe": Describe,
    "world": World,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, or 2 after an error the user can mend."""
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
        command.run()
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
    return 0


def _parse(command: Callable[..., Any], arguments: list[str], program: str) -> Any:
    if command is not Train:
        return tyro.cli(command, args=arguments, prog=program)
    # The recipe named decides what the other flags default to, so it is read first.
    name = "university1652"
    for position, argument in enumerate(arguments):
        if argument.startswith("--recipe="):
            name = argument.partition("=")[2]
        elif argument == "--recipe" and position + 1 < len(arguments):
            name = arguments[position + 1]
    if name not in RECIPES:
        raise InputError(f"There is no recipe {name!r}; choose one of {', '.join(RECIPES)}.")
    return tyro.cli(
        Train,
        args=arguments,
        prog=program,
        default=Train(tyro.MISSING, tyro.MISSING, cast(Any, name), settings=RECIPES[name]),
    )


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(item) for item in text.split(",")]
    except ValueError as error:
        raise InputError(f"The parts are {text!r}; expected numbers from 1, such as 1,2.") from error


def _missing(error: ModuleNotFoundError) -> MissingPackageError:
    package = (error.name or "").split(".")[0]
    extra = "train" if package in ("torch", "onnx", "onnxscript", "safetensors", "yaml", "tensorboardX") else ""
    extra = "world" if package in ("bpy", "mathutils") else extra
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
