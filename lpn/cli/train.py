"""The command train."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast

import tyro

from lpn.training import recipes
from lpn.training.recipes import Recipe, RecipeName

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
class TrainCommand:
    """Train an LPN by a named recipe; every number of the recipe is a flag."""

    data: Path
    """Data set with pictures to train on, in any layout of docs/data.md."""
    out: Path
    """Folder of the run: last.safetensors, best.safetensors, log.csv, tensorboard, and what --resume needs."""
    recipe: RecipeName = recipes.DEFAULT
    """Recipe: as the paper states (paper, cvusa-paper, safa-paper), as the released code does (released, cvusa-released,
    safa-released), for some hundred places (small), or the same for all headings (world); see docs/recipes.md."""
    method: MethodName | None = None
    """One of the methods that the paper compares, by default the recipe's: lpn, the instance-loss baseline, the baseline with
    another loss, strips, or SAFA."""
    compare_recipes: tuple[str, str] | None = None
    """Print the settings in which two recipes differ, each with its source, and train nothing."""
    init: Path | None = None
    """Weights of the backbone trained on ImageNet (.safetensors or .pth, torchvision's names), loaded as far as they fit."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    resume: bool = False
    """Resume the run in --out."""
    evaluate_every: int = 0
    """Evaluate every so many epochs, and keep the best model; 0 for the end only."""
    validate: float = 0.0
    """Share of the training places held out to select the best epoch; at 0 the test split selects it."""
    workers: int = 0
    """Threads that prepare pictures; 0 chooses by the machine. They do not affect the result."""
    compile: bool = False
    """Compile the backbone by torch.compile; the first step then takes seconds to minutes, and losses differ by rounding."""
    settings: tyro.conf.OmitArgPrefixes[Recipe] = field(default_factory=Recipe)

    def run(self) -> None:
        if self.compare_recipes is not None:
            print(import_module("lpn.training.recipe_sources").difference(*self.compare_recipes))
            return
        trainer = import_module("lpn.training.trainer").Trainer
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        group = import_module("lpn.training.multi_process").join()
        run = group.run_on_all(
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
                compiled=self.compile,
                from_scratch=self.from_scratch,
            )
        )
        run.console.print(f"Recipe {self.recipe}: {self.settings.to_json()}")
        model = run.run()
        group.leave()
        if group.is_leader:
            print(f"The model is in {model}.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        if not (self.out / "state.pt").is_file():
            return "No epoch was whole yet, so nothing is kept; give the same command again."
        return f"The whole epochs in {self.out} are kept; go on with the same command{'' if self.resume else ' and --resume'}."


def parse_train(arguments: list[str], program: str) -> TrainCommand:
    """Parse the options of a training; recipe and method set the defaults of the other flags.

    Raises:
        InputError: if the recipe or the method is unknown.
    """
    name, chosen = flag_value(arguments, "--recipe") or recipes.DEFAULT, flag_value(arguments, "--method")
    settings = recipes.find(name, chosen)
    # A comparison of recipes needs neither data nor a folder.
    folder = Path() if flag_value(arguments, "--compare-recipes") else tyro.MISSING
    named = TrainCommand(folder, folder, cast(Any, name), method=cast(Any, chosen), settings=settings)
    return tyro.cli(TrainCommand, args=arguments, prog=program, default=named)


def flag_value(arguments: Sequence[str], flag: str) -> str | None:
    """Return the value of a flag, written with hyphens or underscores, before the other flags are parsed."""
    value = None
    for position, argument in enumerate(arguments):
        name, given, after = argument.partition("=")
        if name.replace("_", "-") != flag:
            continue
        if given:
            value = after
        elif position + 1 < len(arguments):
            value = arguments[position + 1]
    return value
