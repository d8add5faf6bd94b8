"""Commands that make something new: train, export, world, reproduce."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import tyro

from lpn.core.errors import InputError
from lpn.training.recipes import RECIPES, Recipe, method

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


@dataclass
class Train:
    """Train an LPN by a named recipe, any number of which can be changed."""

    data: Path
    """Data set with pictures to train on, in any layout of docs/data.md."""
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
        trainer = import_module("lpn.training.trainer").Trainer
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        group = import_module("lpn.training.multi_process").join()
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

    def going_on(self) -> str:
        """What to do after a stop."""
        if not (self.out / "state.pt").is_file():
            return "No epoch was whole yet, so nothing is kept; give the same command again."
        return f"The whole epochs in {self.out} are kept; go on with the same command{'' if self.resume else ' and --resume'}."


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
        files = import_module("lpn.models.export").export(self.model, self.out, self.storage)
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")


@dataclass
class Quantize:
    """Write an exported model again so that it computes in 8-bit integers, calibrated on real pictures."""

    model: Path
    """Model exported with --storage float32 (.onnx)."""
    data: Path
    """Data set whose pictures set the ranges of the 8-bit numbers, in any layout of docs/data.md."""
    out: Path
    """File to write, ending in .onnx; views with weights of their own get files beside it."""
    pictures: int = 128
    """How many pictures, spread evenly over the training split, or over the test split where there is none."""

    def run(self) -> None:
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        files, agreement = import_module("lpn.models.quantize").quantize(self.model, dataset, self.out, self.pictures)
        print(f"Wrote {', '.join(file.name for file in files)} to {self.out.parent}.")
        said = ", ".join(f"{view} {cosine:.4f}" for view, cosine in agreement.items())
        print(f"Mean cosine with the float32 descriptors of calibration pictures: {said}.")
        print("Measure what it costs on your data: lpn evaluate with either model.")


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

    def going_on(self) -> str:
        """What to do after a stop."""
        return f"The pictures in {self.out} are kept; the same command goes on."


@dataclass
class Reproduce:
    """Make the paper's tables and figures again; resumable."""

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """table1 to table6, figure5, figure7, figure8, or all."""
    data: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A data set's folder (University-1652, CVUSA, Oxford5k, Paris6k, or a rendered world), or the word world for the demo's;
    once for each data set."""
    out: Path = Path("runs/reproduce")
    """Folder for trainings, measurements, and the tables."""
    model: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A network to use instead of training one: FILE for the LPN, or NAME=FILE, such as instance=net_119.pth; once for each."""
    init: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """ImageNet weights a backbone starts from (.safetensors or .pth, torchvision's names); once for each backbone."""
    scale: Literal["auto", "paper", "reduced"] = "auto"
    """Size of networks and trainings; auto is reduced for a rendered world and the paper's for everything else."""
    seeds: tuple[int, ...] = (0,)
    """A training is made with each, and the mean reported."""
    epochs: int | None = None
    """Epochs of every training, where the scale's are not wanted."""
    backbone: Literal["resnet18", "resnet50", "vgg16_bn"] | None = None
    """Backbone of every training, where the scale's is not wanted."""
    batch: int | None = None
    """Places a step of every training, where the scale's are not wanted: more than there are to train on cannot be."""
    train: bool = True
    """Train what is missing; otherwise such rows are left out."""
    queries: tuple[str, ...] = ()
    """Queries shown in figures 7 and 8, by name."""

    def run(self) -> None:
        import_module("torch")
        from lpn.reproduce.command import KEYS, Reproduction
        from lpn.reproduce.sources import is_rendered
        from lpn.reproduce.tables import SCALES

        if not self.what or not self.data:
            raise InputError(
                f"Say what to reproduce ({', '.join(KEYS)}, or all) and on which data: lpn reproduce table1 --data FOLDER."
            )
        keys = KEYS if self.what == ("all",) else tuple(dict.fromkeys(self.what))
        rendered = {is_rendered(given) for given in self.data}
        if len(rendered) > 1 and self.scale == "auto":
            raise InputError(
                "--data names a rendered world and others; say with --scale whether it is paper or reduced."
            )
        scale = SCALES[self.scale if self.scale != "auto" else "reduced" if True in rendered else "paper"]
        numbers = {"epochs": self.epochs, "batch": self.batch}
        changes: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
        if self.backbone:
            changes |= {"backbone": self.backbone, "last_layer": "layer4"}
        made = Reproduction(
            self.data, self.out, _by_name(self.model), self.init, self.seeds, scale, changes, self.train, self.queries
        ).run(keys)
        print(f"Wrote {', '.join(file.name for file in made)} to {self.out}.")

    def going_on(self) -> str:
        """What to do after a stop."""
        return f"Whole epochs and measurements in {self.out} are kept; the same command goes on."


def _by_name(given: Sequence[str]) -> dict[str, Path]:
    """The files given with --model by the network they stand for.

    Raises:
        InputError: when two stand for one.
    """
    found: dict[str, Path] = {}
    for text in given:
        name, _, file = text.partition("=")
        name, file = (name, file) if file else ("lpn", name)
        if name in found:
            raise InputError(f"--model gives two files as {name}, {found[name]} and {file}; give one of them.")
        found[name] = Path(file)
    return found


def parse_train(arguments: list[str], program: str) -> Train:
    """The options of a training; the recipe and the method named decide what the other flags default to.

    Raises:
        InputError: when there is no such recipe or method.
    """
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
