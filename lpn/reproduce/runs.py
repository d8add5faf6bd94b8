"""Trainings of a reproduction: each in a folder of its own, resumed where it stopped, with an estimate of the time left."""

from __future__ import annotations

import csv
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from torch import nn

from lpn import checkpoints
from lpn.datasets import Dataset
from lpn.errors import InputError
from lpn.files import write_whole
from lpn.network import LPN
from lpn.recipes import Recipe
from lpn.reproduce.tables import Role, Scale, Training
from lpn.spec import ModelSpec, View


@dataclass(frozen=True)
class Job:
    """One training with one seed.

    Attributes:
        folder: where it is.
    """

    training: Training
    seed: int
    recipe: Recipe
    folder: Path

    @property
    def name(self) -> str:
        """Such as "lpn, seed 0"."""
        return f"{self.training.name}, seed {self.seed}"

    @property
    def epochs_done(self) -> int:
        """Whole epochs of it that are on disk."""
        return len(_log(self.folder))

    @property
    def done(self) -> bool:
        """Whether it is trained to the end."""
        return (self.folder / "finished.json").is_file()

    @property
    def model(self) -> Path:
        """The trained network."""
        return self.folder / "last.safetensors"

    @property
    def work(self) -> float:
        """What it costs relative to others: pixels through the network, in millions of a training step times epochs."""
        height, width = self.recipe.input_size
        costs = {"resnet18": 1.0, "resnet50": 2.3, "vgg16_bn": 8.5}
        return self.recipe.epochs * height * width * costs[self.recipe.backbone] / 1e6


def jobs(
    trainings: Sequence[Training], seeds: Sequence[int], scale: Scale, changes: Mapping[str, Any], out: Path
) -> list[Job]:
    """The trainings with every seed, in `out`/runs."""
    made = []
    for seed in seeds:
        for training in trainings:
            recipe = scale.recipe(training, seed, changes)
            made.append(Job(training, seed, recipe, out / "runs" / f"{training.name}-seed{seed}"))
    return made


def train(work: Sequence[Job], data: Mapping[Role, Dataset], init: Path | None, console: Console) -> None:
    """Train what is not trained yet, one after the other.

    Raises:
        InputError: when a run on disk has another recipe or was made of other pictures, or data are missing.
        LPNError: as `lpn.train.Trainer`.
    """
    from lpn.train import Trainer

    left = [job for job in work if not job.done]
    for job in work:
        if job.done:
            _check_same(job)
    for position, job in enumerate(left):
        console.rule(f"{job.name} ({position + 1} of {len(left)} trainings; {_said_left(left[position:], work)})")
        if job.training.role not in data:
            raise InputError(
                f"{job.name} needs {'panoramas and tiles, as in CVUSA' if job.training.role == 'panoramas' else 'places'}; "
                "give them with --data."
            )
        resume = (job.folder / "state.pt").is_file()
        Trainer(data[job.training.role], job.folder, job.recipe, init, resume=resume, console=console, test=False).run()
        note = {"recipe": job.recipe.to_json(), "data": data[job.training.role].root.resolve().name}
        write_whole(job.folder / "finished.json", (json.dumps(note, indent=1) + "\n").encode())


def seconds_left(left: Sequence[Job], known: Sequence[Job]) -> float | None:
    """Seconds that trainings will take, from the median speed of the epochs on disk; None before there are any."""
    speeds = [job.work / job.recipe.epochs / float(row["seconds"]) for job in known for row in _log(job.folder)]
    if not speeds:
        return None
    return sum(job.work * (1 - job.epochs_done / job.recipe.epochs) for job in left) / statistics.median(speeds)


def _said_left(left: Sequence[Job], known: Sequence[Job]) -> str:
    seconds = seconds_left(left, known)
    if seconds is None:
        return "time left not known yet"
    return f"about {seconds / 3600:.1f} h left" if seconds > 5400 else f"about {max(seconds / 60, 1):.0f} min left"


def _log(folder: Path) -> list[dict[str, str]]:
    if not (folder / "log.csv").is_file():
        return []
    with (folder / "log.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _check_same(job: Job) -> None:
    held = json.loads(json.loads((job.folder / "finished.json").read_bytes())["recipe"])
    asked = json.loads(job.recipe.to_json())
    differs = [key for key, value in asked.items() if held.get(key) != value]
    if differs:
        raise InputError(
            f"{job.folder} was trained with another {', '.join(differs)}; give the same settings, or another --out."
        )


def imagenet_features(backbone: ModelSpec, init: Path) -> checkpoints.TorchModel:
    """A network whose descriptor is the mean over the last feature map of a backbone that only `init` trained.

    Raises:
        ModelFileError: when `init` does not fit.
    """
    views: tuple[View, ...] = ("street",)
    channels = LPN(backbone).branch(backbone.views[0]).model.channels
    spec = ModelSpec(
        backbone.backbone, backbone.last_layer, backbone.last_stride, views, shared=False, n_parts=1, embedding=channels,
        classes=1, input_size=backbone.input_size,
    )  # fmt: skip
    network = LPN(spec)
    checkpoints.load_backbone(network, init)
    block = network.heads[0].add_block
    linear, norm = cast(nn.Linear, block[0]), cast(nn.BatchNorm1d, block[1])
    with torch.no_grad():
        linear.weight.copy_(torch.eye(channels))
        norm.weight.fill_(1.0)
    return checkpoints.TorchModel(network.to(checkpoints.best_device()), f"imagenet-{init.name}-{spec.to_json()}")
