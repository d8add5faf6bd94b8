"""Images per second in training: `python -m tools.bench train`.

The peer is the plain loop of the published recipe: each step takes one batch per view, its pictures decoded by Pillow one
after the other, resized, padded, cropped, mirrored, and satellites turned; a float32 pass for each view, the cross-entropy
of all parts and views summed, SGD with momentum.

Ours is `lpn.training.trainer` with the same network, batch, and recipe, whose pictures are prepared by threads: `ours, first
pass` decodes every picture, as the plain loop does, `ours` finds it kept, and `ours, float32` is that without mixed precision.
All take turns in one process, and the table gives medians. Pictures are synthetic JPEG files: satellites of 512 x 512 pixels,
drone pictures of 256 x 256.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.consoles import Console
from lpn.core.views import View
from lpn.datasets import open_dataset
from lpn.models.lpn import LPN
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from lpn.training.training_set import TrainingSet
from tools.bench.figures import Figure, take_turns
from tools.bench.pictures import make_train_split

# More than a batch has, which takes each place once.
PLACES = 40
ROUNDS = 5
STEPS = 4
# Pixels of the edge of a picture before it is cropped, as released.
PAD = 10


class PlainLoop:
    """The published training loop, which prepares and computes in turn."""

    def __init__(self, network: LPN, places: TrainingSet, recipe: Recipe) -> None:
        self.network, self.places, self.recipe = network.train(), places, recipe
        backbone = {id(p) for view in network.spec.views for p in network.branch(view).parameters()}
        groups = [
            {"params": [p for p in network.parameters() if id(p) in backbone], "lr": 0.1 * recipe.lr},
            {"params": [p for p in network.parameters() if id(p) not in backbone], "lr": recipe.lr},
        ]
        self.optimizer = torch.optim.SGD(groups, momentum=0.9, nesterov=True, weight_decay=recipe.weight_decay)
        self.rng = np.random.default_rng(0)

    def steps(self) -> None:
        for _ in range(STEPS):
            self.step()

    def step(self) -> None:
        """One step over a random batch."""
        loss = torch.zeros(())
        for view, (pictures, labels) in self.batches().items():
            _, scores = self.network(pictures, view)
            loss = loss + sum(F.cross_entropy(scores[:, part], labels) for part in range(scores.shape[1]))
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        loss.item()

    def batches(self) -> dict[View, tuple[torch.Tensor, torch.Tensor]]:
        """Prepare pictures and places of each view, one picture after the other."""
        chosen = self.rng.permutation(len(self.places))[: self.recipe.batch]
        found: dict[View, tuple[torch.Tensor, torch.Tensor]] = {}
        for view in self.network.spec.views:
            files = self.places.files[view]
            paths = [files[place][int(self.rng.integers(len(files[place])))] for place in chosen]
            pictures = [augmented(path, view == "satellite", self.recipe.size, self.rng) for path in paths]
            found[view] = torch.stack(pictures), torch.from_numpy(chosen)
        return found


def augmented(path: Path, satellite: bool, size: int, rng: np.random.Generator) -> torch.Tensor:
    """Read, turn, crop, and mirror a picture, (3, S, S)."""
    with Image.open(path) as file:
        picture = file.convert("RGB").resize((size, size), Image.Resampling.BICUBIC)
    if satellite:
        picture = picture.rotate(float(rng.uniform(-90, 90)))
    padded = np.pad(np.asarray(picture), ((PAD, PAD), (PAD, PAD), (0, 0)), mode="edge")
    top, left = (int(v) for v in rng.integers(0, 2 * PAD + 1, 2))
    crop = padded[top : top + size, left : left + size]
    return torch.from_numpy(images.normalise(crop[:, ::-1] if rng.random() < 0.5 else crop))


class Unkept(TrainingSet):
    """A training set that decodes pictures every time, as in the first pass."""

    def picture(self, path: Path) -> UInt8Array:
        return images.load_picture(path)


def ours(trainer: Trainer) -> Callable[[], None]:
    """Steps of our trainer; the time includes all work of its threads."""
    trainer.network.train()

    def steps() -> None:
        with closing(cast(Any, trainer.loader.stream(0, 1_000_000))) as stream:
            for batch in islice(stream, STEPS):
                terms, _ = trainer.learner.step(batch, 0, trainer.steps)
            terms["loss"].item()

    return steps


def figures() -> list[Figure]:
    """Measure each loop, in median images per second."""
    torch.manual_seed(0)
    quiet = Console(quiet=True)
    recipe = replace(RECIPES["released"], batch=32, backbone="resnet18", last_layer="layer3")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = make_train_split(folder / "data", PLACES)

        def trainer(name: str, precision: Any = recipe.precision) -> Trainer:
            changed = replace(recipe, precision=precision)
            cpu = torch.device("cpu")
            return Trainer(open_dataset(data), folder / name, changed, console=quiet, device=cpu, from_scratch=True)

        first, cold = trainer("plain"), trainer("cold")
        places = first.places
        assert isinstance(places, TrainingSet)
        peer = PlainLoop(LPN(first.network.spec), places, recipe)
        cold.loader.places = Unkept(open_dataset(data), quiet)
        tasks: dict[str, Callable[[], object]] = {
            "plain loop": peer.steps,
            "ours, first pass": ours(cold),
            "ours": ours(trainer("kept")),
            "ours, float32": ours(trainer("float32", "float32")),
        }
        times = take_turns(tasks, ROUNDS)
    pictures = STEPS * recipe.batch * len(places.views)
    plain, *speeds = (pictures / statistics.median(values) for values in times.values())
    return [
        Figure(f"training ResNet-18 to layer3, {recipe.batch} per view, {loop}", speed, "images/s", plain, more=True)
        for loop, speed in zip(list(times)[1:], speeds, strict=True)
    ]
