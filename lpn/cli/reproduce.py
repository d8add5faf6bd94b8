"""The command reproduce: the paper's tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from lpn.core.errors import InputError


@dataclass
class ReproduceCommand:
    """Reproduce the paper's tables and figures; resumable."""

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
    """Random seeds: one training for each, and the mean is reported."""
    epochs: int | None = None
    """Epochs of every training, instead of the scale's."""
    backbone: Literal["resnet18", "resnet50", "vgg16", "vgg16_bn"] | None = None
    """Backbone of every training, instead of the scale's."""
    batch: int | None = None
    """Places per step of every training, instead of the scale's; at most the number of training places."""
    train: bool = True
    """Train missing models; otherwise their rows are left out."""
    queries: tuple[str, ...] = ()
    """Queries shown in figures 7 and 8, by name."""

    def run(self) -> None:
        import_module("torch")
        from lpn.reproduce.command import KEYS, Reproduction
        from lpn.reproduce.sources import is_world
        from lpn.reproduce.tables import SCALES

        if not self.what or not self.data:
            raise InputError(
                f"Say what to reproduce ({', '.join(KEYS)}, or all) and on which data: lpn reproduce table1 --data FOLDER."
            )
        keys = KEYS if self.what == ("all",) else tuple(dict.fromkeys(self.what))
        rendered = {is_world(given) for given in self.data}
        if len(rendered) > 1 and self.scale == "auto":
            raise InputError(
                "--data names a rendered world and others; say with --scale whether it is paper or reduced."
            )
        scale = SCALES[self.scale if self.scale != "auto" else "reduced" if True in rendered else "paper"]
        numbers = {"epochs": self.epochs, "batch": self.batch}
        changes: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
        if self.backbone:
            changes |= {"backbone": self.backbone, "last_layer": "layer4"}
            # SAFA's recipe has a dropout in its VGG-16.
            changes |= {} if self.backbone.startswith("vgg16") else {"backbone_dropout": 0.0}
        made = Reproduction(
            self.data, self.out, _by_name(self.model), self.init, self.seeds, scale, changes, self.train, self.queries
        ).run(keys)
        print(f"Wrote {', '.join(file.name for file in made)} to {self.out}.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"Whole epochs and measurements in {self.out} are kept; the same command goes on."


def _by_name(given: Sequence[str]) -> dict[str, Path]:
    """Return the files given with --model by the network they replace.

    Raises:
        InputError: if two files replace the same network.
    """
    found: dict[str, Path] = {}
    for text in given:
        name, _, file = text.partition("=")
        name, file = (name, file) if file else ("lpn", name)
        if name in found:
            raise InputError(f"--model gives two files as {name}, {found[name]} and {file}; give one of them.")
        found[name] = Path(file)
    return found
